"""When the autopilot measured something, on our clock.

Messages carry the autopilot's milliseconds since boot. A message can arrive late but never early, so the smallest
difference between reception and boot time over some seconds is the offset plus the shortest delay of the link (a
min-filter). TIMESYNC exchanges give the offset with half the round trip taken off; the fastest exchange is
believed. Two half windows make the filter forget, so that drift between the two clocks does not add up.
"""

from __future__ import annotations

from dataclasses import dataclass

from morpheyes_daemon.clock import MS, S

HALF_WINDOW_NS = 10 * S
"""Crystals differ by up to 50 ppm: 0.5 ms in this time."""
MAX_AGE_NS = 1 * S
"""A stamp is never put further back than this, whatever the autopilot's clock says."""
REBOOT_MS = 2000
"""Boot time that is this much behind what it must be is a reboot; reordering is milliseconds."""


@dataclass(slots=True)
class _Window:
    """The smallest value of the present and the last half window."""

    started_ns: int = 0
    present: int | None = None
    last: int | None = None

    def add(self, value: int, now_ns: int) -> None:
        if now_ns - self.started_ns >= HALF_WINDOW_NS:
            self.started_ns, self.last, self.present = now_ns, self.present, None
        self.present = value if self.present is None else min(self.present, value)

    def smallest(self) -> int | None:
        known = [value for value in (self.present, self.last) if value is not None]
        return min(known) if known else None


class BootClock:
    """Maps the autopilot's boot time to our monotonic nanoseconds."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the autopilot rebooted."""
        self._arrival = _Window()
        self._round_trip_ns: int | None = None
        self._round_trip_at_ns = 0
        self._synced_ns = 0

    def stamp_ns(self, boot_ms: int, now_ns: int) -> int:
        """Return when a message stamped `boot_ms` and received at `now_ns` was measured."""
        boot_ns = boot_ms * MS
        self._arrival.add(now_ns - boot_ns, now_ns)
        offset_ns = self._offset_ns()
        assert offset_ns is not None
        return max(now_ns - MAX_AGE_NS, min(now_ns, boot_ns + offset_ns))

    def rebooted(self, boot_ms: int, now_ns: int) -> bool:
        """Return whether `boot_ms` is too far back for the boot that was known so far."""
        offset_ns = self._offset_ns()
        return offset_ns is not None and boot_ms * MS + offset_ns < now_ns - REBOOT_MS * MS

    def add_round_trip(self, sent_ns: int, autopilot_ns: int, now_ns: int) -> None:
        """Take one TIMESYNC exchange: our request at `sent_ns`, answered at the autopilot's `autopilot_ns`."""
        round_trip_ns = now_ns - sent_ns
        stale = now_ns - self._round_trip_at_ns > 2 * HALF_WINDOW_NS
        if self._round_trip_ns is None or stale or round_trip_ns <= self._round_trip_ns:
            self._round_trip_ns = round_trip_ns
            self._round_trip_at_ns = now_ns
            self._synced_ns = (sent_ns + now_ns) // 2 - autopilot_ns

    def _offset_ns(self) -> int | None:
        """The exchange's offset where it makes a plausible delay of the fastest arrival, else that arrival's."""
        arrival_ns = self._arrival.smallest()
        if arrival_ns is None or self._round_trip_ns is None:
            return arrival_ns
        delay_ns = arrival_ns - self._synced_ns
        return self._synced_ns if -MS <= delay_ns <= self._round_trip_ns else arrival_ns
