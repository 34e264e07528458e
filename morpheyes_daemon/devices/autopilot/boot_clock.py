"""When the autopilot measured something, on our clock.

Messages carry the autopilot's milliseconds since boot. A message can arrive late but never early, so the smallest
difference between reception and boot time over a second or two is the offset plus the shortest delay of the link (a
min-filter). TIMESYNC exchanges give the offset with half the round trip taken off; the fastest of the last ones is
believed where it fits the arrivals. Two half windows make each filter forget, so that drift does not add up, and a
simulated autopilot that runs a little slower than real time is followed.
"""

from __future__ import annotations

from typing import Generic, TypeVar

from morpheyes_daemon.clock import MS, S

ARRIVALS_NS = 1 * S
EXCHANGES_NS = 10 * S
"""Half windows. Crystals differ by up to 50 ppm: 1 ms in twice the longer one."""
MAX_AGE_NS = 1 * S
"""A stamp is never put further back than this, whatever the autopilot's clock says."""
REBOOT_MS = 1000
"""Boot time that went back by this much is a reboot; reordering is milliseconds."""

T = TypeVar("T", int, tuple[int, int])


class _Smallest(Generic[T]):
    """The smallest value of the present and the last half window."""

    def __init__(self, half_window_ns: int) -> None:
        self._half_window_ns = half_window_ns
        self._started_ns = 0
        self._present: T | None = None
        self._last: T | None = None

    def add(self, value: T, now_ns: int) -> None:
        if now_ns - self._started_ns >= self._half_window_ns:
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
        self._arrival_ns = _Smallest[int](ARRIVALS_NS)
        self._exchange_ns = _Smallest[tuple[int, int]](EXCHANGES_NS)
        self._newest_ms: int | None = None

    def stamp_ns(self, boot_ms: int, now_ns: int) -> int:
        """Return when a message stamped `boot_ms` and received at `now_ns` was measured."""
        boot_ns = boot_ms * MS
        self._newest_ms = max(boot_ms, self._newest_ms or 0)
        self._arrival_ns.add(now_ns - boot_ns, now_ns)
        offset_ns = self._offset_ns()
        assert offset_ns is not None
        return max(now_ns - MAX_AGE_NS, min(now_ns, boot_ns + offset_ns))

    def rebooted(self, boot_ms: int) -> bool:
        """Return whether the autopilot's time went back."""
        return self._newest_ms is not None and boot_ms < self._newest_ms - REBOOT_MS

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
