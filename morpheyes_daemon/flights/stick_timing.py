"""How evenly the sticks go out: the time between consecutive stick messages while we hold them.

On a virtual machine the host gives the processor to others now and then, and nothing that runs there beats meanwhile.
Linux counts that time, so intervals in which none was taken are told apart.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.safety import Action, GateOutput


def stolen_s() -> float:
    """Return the processor time that the machine's host gave to others since boot; 0 where no /proc/stat counts it."""
    try:
        return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) / os.sysconf("SC_CLK_TCK")
    except OSError:
        return 0.0


@dataclass(frozen=True, slots=True)
class StickIntervals:
    """Seconds between stick messages, `stolen_s` of processor time taken by the machine's host meanwhile.

    `own_` are the intervals in which it took none.
    """

    count: int = 0
    p50_s: float = 0.0
    p99_s: float = 0.0
    max_s: float = 0.0
    own_count: int = 0
    own_p99_s: float = 0.0
    own_max_s: float = 0.0
    stolen_s: float = 0.0


class StickTiming:
    """Listens to the gate from construction on; `stolen` tells the processor time taken by the host so far."""

    def __init__(self, gate: Latest[GateOutput], stolen: Callable[[], float] = stolen_s) -> None:
        self._intervals_ns = array("q")
        self._stolen_s = array("d")
        self._stolen = stolen
        self._last: tuple[int, float] | None = None
        gate.tap(self._take)

    def intervals(self) -> StickIntervals:
        """Return what was measured so far, zeros when nothing was."""
        if not self._intervals_ns:
            return StickIntervals()
        seconds = np.array(self._intervals_ns) / S
        own = seconds[np.array(self._stolen_s) == 0.0]
        p50, p99 = (float(value) for value in np.percentile(seconds, (50.0, 99.0)))
        found = StickIntervals(len(seconds), p50, p99, float(seconds.max()), stolen_s=sum(self._stolen_s))
        if not own.size:
            return found
        return replace(found, own_count=len(own), own_p99_s=float(np.percentile(own, 99.0)), own_max_s=float(own.max()))

    def _take(self, out: GateOutput) -> None:
        if out.action not in (Action.STICKS, Action.NEUTRAL):
            self._last = None
            return
        now = out.t_ns, self._stolen()
        if self._last is not None:
            self._intervals_ns.append(now[0] - self._last[0])
            self._stolen_s.append(now[1] - self._last[1])
        self._last = now
