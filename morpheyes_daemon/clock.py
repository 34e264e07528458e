"""The only place that reads time.

Everything above takes a `Clock`. `MonotonicClock` is real; `VirtualLoop` is an asyncio event loop whose time
jumps to the next timer as soon as nothing is left to do, so that the very same tasks run faster than real time
and in an order that depends on nothing but the seed.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Coroutine
from typing import Any, Protocol, TypeVar

S = 1_000_000_000
MS = 1_000_000

T = TypeVar("T")


class Clock(Protocol):
    """Monotonic nanoseconds and the sleep that goes with them."""

    def now_ns(self) -> int:
        """Return the monotonic time in nanoseconds."""

    async def sleep_until_ns(self, t_ns: int) -> None:
        """Return at `t_ns` or as soon after as possible; yields once even when `t_ns` has passed."""


class MonotonicClock:
    """The machine's monotonic clock."""

    def now_ns(self) -> int:
        """Return the monotonic time in nanoseconds."""
        return time.monotonic_ns()

    async def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; yields once even when `t_ns` has passed."""
        await asyncio.sleep(max(0.0, (t_ns - self.now_ns()) / S))


class VirtualClock:
    """The clock of a `VirtualLoop`."""

    def __init__(self, loop: VirtualLoop) -> None:
        self._loop = loop

    def now_ns(self) -> int:
        """Return the virtual time in nanoseconds."""
        return round(self._loop.time() * S)

    async def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until virtual time `t_ns`; yields once even when `t_ns` has passed."""
        await asyncio.sleep(max(0.0, (t_ns - self.now_ns()) / S))


class _LeapingSelector(selectors.SelectSelector):
    """Polls instead of waiting, and moves virtual time on by what it was asked to wait."""

    loop: VirtualLoop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise RuntimeError("virtual time cannot pass: every task waits for something outside the loop")
        events = super().select(0)
        if not events and timeout > 0:
            self.loop.leap(timeout)
        return events


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop on virtual time; only in-memory links may be used on it."""

    def __init__(self, start_s: float = 1000.0) -> None:
        selector = _LeapingSelector()
        selector.loop = self
        self._virtual_s = start_s
        super().__init__(selector)

    def time(self) -> float:
        """Return the virtual time in seconds."""
        return self._virtual_s

    def leap(self, seconds: float) -> None:
        """Move virtual time on; called by the selector only."""
        self._virtual_s += seconds


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a fresh virtual loop and return its result."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main)


def running_clock() -> Clock:
    """Return the clock that belongs to the running event loop."""
    loop = asyncio.get_running_loop()
    return VirtualClock(loop) if isinstance(loop, VirtualLoop) else MonotonicClock()


class Ticker:
    """Wakes a loop at a fixed rate on a grid; missed beats are skipped, not made up for."""

    def __init__(self, clock: Clock, rate_hz: float) -> None:
        self._clock = clock
        self.period_ns = round(S / rate_hz)
        self._next_ns = clock.now_ns() + self.period_ns

    async def wait(self) -> int:
        """Sleep to the next beat and return by how many nanoseconds it was missed."""
        await self._clock.sleep_until_ns(self._next_ns)
        late_ns = max(0, self._clock.now_ns() - self._next_ns)
        self._next_ns += self.period_ns * (1 + late_ns // self.period_ns)
        return late_ns


def wall_time_s() -> float:
    """Return the wall time; for the header of a log only."""
    return time.time()


def stopwatch_s() -> float:
    """Return a high-resolution reading for measuring how long a computation takes."""
    return time.perf_counter()


def processor_s() -> float:
    """Return the processor time of this process: what a computation costs whatever else the machine does."""
    return time.process_time()
