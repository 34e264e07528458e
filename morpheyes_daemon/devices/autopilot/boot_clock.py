"""When the autopilot measured something, on our clock.

Messages carry the autopilot's milliseconds since boot. A message can arrive late but never early, so the smallest
difference between reception and boot time over some seconds is the offset plus the shortest delay of the link (a
min-filter). TIMESYNC exchanges give the offset with half the round trip taken off; the fastest exchange is
believed. Two half windows make the filter forget, so that drift between the two clocks does not add up.
"""

from __future__ import annotations

from typing import Generic, TypeVar

from morpheyes_daemon.clock import MS, S

HALF_WINDOW_NS = 10 * S
"""Crystals differ by up to 50 ppm: 0.5 ms in this time."""
MAX_AGE_NS = 1 * S
"""A stamp is never put further back than this, whatever the autopilot's clock says."""
REBOOT_MS = 2000
"""Boot time that is this much behind what it must be is a reboot; reordering is milliseconds."""


T = TypeVar("T", int, tuple[int, int])


class _Smallest(Generic[T]):
    """The smallest value of the present and the last half window."""

    def __init__(self) -> None:
        self._started_ns = 0
        self._present: T | None = None
        self._last: T | None = None

    def add(self, value: T, now_ns: int) -> None:
        if now_ns - self._started_ns >= HALF_WINDOW_NS:
            self._started_ns, self._last, self._present = now_ns, self._present, None
        self._present = value if self._present is None else min(self._present, value)

    def get(self) -> T | None:
        if self._present is None or self._last is None:
            return self._last if self._present is None else self._present
        return min(self._present, self._last)


class BootClock:
    """Maps the autopilot's boot time to our monotonic nanoseconds."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the autopilot rebooted."""
        self._arrival_ns = _Smallest[int]()
        self._exchange_ns = _Smallest[tuple[int, int]]()

    def stamp_ns(self, boot_ms: int, now_ns: int) -> int:
        """Return when a message stamped `boot_ms` and received at `now_ns` was measured."""
        boot_ns = boot_ms * MS
        self._arrival_ns.add(now_ns - boot_ns, now_ns)
        offset_ns = self._offset_ns()
        assert offset_ns is not None
        return max(now_ns - MAX_AGE_NS, min(now_ns, boot_ns + offset_ns))

    def rebooted(self, boot_ms: int, now_ns: int) -> bool:
        """Return whether `boot_ms` is too far back for the boot that was known so far."""
        offset_ns = self._offset_ns()
        return offset_ns is not None and boot_ms * MS + offset_ns < now_ns - REBOOT_MS * MS

    def add_round_trip(self, sent_ns: int, autopilot_ns: int, now_ns: int) -> None:
        """Take one TIMESYNC exchange: our request at `sent_ns`, answered at the autopilot's `autopilot_ns`."""
        self._exchange_ns.add((now_ns - sent_ns, (sent_ns + now_ns) // 2 - autopilot_ns), now_ns)

    def _offset_ns(self) -> int | None:
        """The fastest exchange's offset where it fits the fastest arrival, else that arrival's."""
        arrival_ns, exchange = self._arrival_ns.get(), self._exchange_ns.get()
        if arrival_ns is None or exchange is None:
            return arrival_ns
        round_trip_ns, synced_ns = exchange
        return synced_ns if -MS <= arrival_ns - synced_ns <= round_trip_ns + MS else arrival_ns
