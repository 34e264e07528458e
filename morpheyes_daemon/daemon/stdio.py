"""Standard output and error of the flight process: given away, so that a reader who stops reading cannot stop it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager

STDOUT, STDERR = 1, 2


@contextmanager
def given_away() -> Iterator[int | None]:
    """Within the body nothing that this process writes to stdout and stderr goes anywhere.

    Yields a file descriptor of the real stderr for whoever may wait for its reader (the observer), None when it was
    closed. At the end both are as before.
    """
    saved = {number: _copy(number) for number in (STDOUT, STDERR)}
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in saved:
        os.dup2(nowhere, number)
    os.close(nowhere)
    try:
        yield saved[STDERR]
    finally:
        for number, copy in saved.items():
            if copy is not None:
                os.dup2(copy, number)
                os.close(copy)


def _copy(number: int) -> int | None:
    with contextlib.suppress(OSError):
        return os.dup(number)
    return None
