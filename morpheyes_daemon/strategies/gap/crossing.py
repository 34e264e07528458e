"""When an opening that sways is crossed: where it turns back, and while its wall stands across the way.

Knows times and places only; when the vehicle stands right for its run is the mission's to say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.gap.opening_tracker import PointTrack
from morpheyes_daemon.strategies.gap.parameters import GapParameters
from morpheyes_daemon.transforms import Array

SLOW_M_S, TURNS_RAD = 0.2, math.radians(9.0)
"""At the crossing an opening is to move and a wall to be turned by no more, at first."""

HORIZON_S, STEP_S = 10.0, 0.1
"""So far ahead the crossing is looked for, in such steps."""

PATIENCE_S = 9.0
"""For so long after the watch it waits for that; in as much again twice as much is taken."""

EARLY_S, LATE_S = 0.15, 0.2
"""A run that would arrive so much before or after the planned crossing may begin: the mission decides at each frame."""

KEPT_S = 0.1
"""The run's way meets the opening at the planned crossing even when it will arrive so much before or after it.

Two seconds ahead a tenth of a second moves that way by a hundred millimetres, but the place at the wall by three: the
opening's speed is allowed for, its acceleration is small."""

GATHER_S = 0.75
"""What gathering speed costs in time."""


@dataclass(slots=True)
class Crossing:
    """The crossing that is waited for; `track` is the opening's and `yaw` its wall's heading's."""

    parameters: GapParameters
    t_ns: int = 0
    begun_ns: int = 0

    def begin(self, now_ns: int) -> None:
        """The run begins."""
        self.begun_ns = now_ns

    def plan(self, track: PointTrack, yaw: PointTrack, watched_s: float, now_ns: int) -> None:
        """Keep to the crossing there is while it can still be reached and is slow; else take the slowest ahead."""
        earliest_ns = now_ns + self.run_ns
        if self.t_ns < earliest_ns - LATE_S * S or self.haste(self.t_ns, track, yaw, watched_s) > 1.0:
            times = [earliest_ns + round(step * S) for step in np.arange(0.0, HORIZON_S, STEP_S).tolist()]
            self.t_ns = min(times, key=lambda t_ns: self.haste(t_ns, track, yaw, watched_s))

    def due(self, track: PointTrack, yaw: PointTrack, watched_s: float, now_ns: int) -> bool:
        """Tell whether a run that begins now arrives at the crossing."""
        arrives_ns = now_ns + self.run_ns
        if watched_s <= self.parameters.watch_s or self.t_ns - arrives_ns > EARLY_S * S:
            return False
        return self.haste(arrives_ns, track, yaw, watched_s) <= 1.0

    def waiting_place(self, track: PointTrack, watched_s: float) -> Array:
        """Return where (ned) the opening is to be waited for: while it is watched, the middle of its way.

        Then where the straight way of the run begins that meets it as it moves at the crossing.
        """
        if watched_s <= self.parameters.watch_s:
            return track.middle_ned()
        crossed = track.at(self.t_ns)
        return np.asarray(crossed.p_m - self.run_ns / S * crossed.v_m_s)

    def haste(self, t_ns: int, track: PointTrack, yaw: PointTrack, watched_s: float) -> float:
        """Return how fast the opening moves and turns at a time; above 1 is too much, which waiting makes milder."""
        fast = float(np.linalg.norm(track.at(t_ns).v_m_s)) / SLOW_M_S
        turned = abs(float(yaw.at(t_ns).p_m[1] - yaw.middle[1])) / TURNS_RAD
        waited_s = watched_s - self.parameters.watch_s - PATIENCE_S
        return max(fast, turned) / (1.0 + max(0.0, waited_s) / PATIENCE_S)

    @property
    def run_ns(self) -> int:
        """Time from the stand-off to the wall."""
        return round(self.to_wall_s(self.parameters.stand_off_m, 0.0) * S)

    def left_s(self, range_m: float, speed_m_s: float, now_ns: int) -> float:
        """Return the time to the crossing on the run: as planned, but no farther than `KEPT_S` from the arrival."""
        arrives_s = self.arrives_s(range_m, speed_m_s, now_ns)
        planned_s = (self.t_ns - now_ns) / S
        return max(0.0, min(arrives_s + KEPT_S, max(arrives_s - KEPT_S, planned_s)))

    def arrives_s(self, range_m: float, speed_m_s: float, now_ns: int) -> float:
        """Return the time to the wall on the run; as reckoned at first while a lean does not show as speed."""
        planned_s = (self.begun_ns + self.run_ns - now_ns) / S
        soonest_s = max(0.0, range_m) / self.parameters.speed_m_s
        return min(self.to_wall_s(range_m, speed_m_s), max(planned_s, soonest_s))

    def to_wall_s(self, range_m: float, speed_m_s: float) -> float:
        """Return the time for a range: at the set speed, reached with about the lean that Loiter gives it."""
        missing = max(0.0, 1.0 - speed_m_s / self.parameters.speed_m_s)
        return max(0.0, range_m) / self.parameters.speed_m_s + GATHER_S * missing**2
