"""A simulated flight that goes on in two ways from one moment: a forked process lives one of them and reports.

Only for lockstep on a virtual clock, where nothing but the process itself has a state. The parent stands still
meanwhile; what the child sees comes back as JSON.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class ForkedFlight:
    """A child process on its way."""

    pid: int
    answer: int

    def result(self) -> Any:
        """Wait for the child and return what it said; None when it died."""
        with os.fdopen(self.answer, encoding="utf-8") as file:
            text = file.read()
        os.waitpid(self.pid, 0)
        return json.loads(text) if text else None


async def branch(story: Callable[[], Awaitable[Any]]) -> ForkedFlight:
    """Fork; the parent gets the branch at once, the child lives `story`, reports its JSON value and never returns."""
    loop = asyncio.get_running_loop()
    answer, writer = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writer)
        return ForkedFlight(pid, answer)
    asyncio._set_running_loop(loop)  # asyncio remembers in which process its loop runs
    try:
        with os.fdopen(writer, "w", encoding="utf-8") as file:
            json.dump(await story(), file)
    finally:
        os._exit(0)
