"""The callback by which long work reports its progress. How it is shown is decided in `cli.terminal`."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the name of the step, the number of items done, and the number of items in all."""


def silent(_step: str, _done: int, _total: int) -> None:
    """Show no progress."""
