"""How evenly the sticks go out: the time between consecutive stick messages while we hold them."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.clock import S
from morpheyes_daemon.safety.gate import GateOutput
from morpheyes_daemon.safety.states import Action


@dataclass(frozen=True, slots=True)
class StickIntervals:
    """Seconds between stick messages."""

    count: int
    p50_s: float
    p99_s: float
    max_s: float


class StickBeat:
    """Listens to the gate from construction on."""

    def __init__(self, gate: Latest[GateOutput]) -> None:
        self._intervals_ns = array("q")
        self._last_ns: int | None = None
        gate.tap(self._take)

    def intervals(self) -> StickIntervals:
        """Return what was measured so far, zeros when nothing was."""
        if not self._intervals_ns:
            return StickIntervals(0, 0.0, 0.0, 0.0)
        seconds = np.array(self._intervals_ns) / S
        p50, p99 = (float(value) for value in np.percentile(seconds, (50.0, 99.0)))
        return StickIntervals(len(seconds), p50, p99, float(seconds.max()))

    def _take(self, out: GateOutput) -> None:
        if out.action not in (Action.STICKS, Action.NEUTRAL):
            self._last_ns = None
            return
        if self._last_ns is not None:
            self._intervals_ns.append(out.t_ns - self._last_ns)
        self._last_ns = out.t_ns
