"""Crossing of a moving opening: planned for a time at which it moves little and its wall stands across the path.

Times and positions only; whether the vehicle is ready for its run is decided by the strategy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.gap.opening_tracker import PointTracker
from morpheyes_daemon.strategies.gap.parameters import GapParameters
from morpheyes_daemon.transforms import Array

MAX_OPENING_M_S, MAX_WALL_TURN_RAD = 0.2, math.radians(9.0)
"""Speed of the opening and turn of its wall at the crossing that are accepted at first.

Chosen: 0.1 s of timing error then costs 20 mm and the turn 1 % of the width; lower waits for more periods."""

PLAN_HORIZON_S, PLAN_STEP_S = 10.0, 0.1
"""How far ahead a crossing is planned, and in which steps.

Chosen: a period of most oscillations; farther the prediction errs by more than the clearance."""

PATIENCE_S = 9.0
"""Time after the observation for which the first limits hold; they double within as much again.

Chosen: about a period; shorter crosses at a worse time, longer delays openings that are never slow."""

EARLY_S, LATE_S = 0.15, 0.2
"""A run may begin when it arrives this much before or after the planned crossing.

Chosen: the frame period, since the strategy decides once per frame."""

MAX_PLAN_OFFSET_S = 0.1
"""The run's path meets the opening at the planned time if the arrival differs by no more than this.

Chosen: two seconds ahead 0.1 s moves the start of that path by 100 mm, but its end at the wall by 3 mm, since the
opening's speed is accounted for and its acceleration is small."""

ACCELERATION_COST_S = 0.75
"""Extra time of a run that starts at rest, compared with the set speed all the way.

Chosen: for about the lean that Loiter gives; a wrong value shifts the arrival by its error."""


@dataclass(slots=True)
class Crossing:
    """The planned crossing; `track` is the opening's tracker and `yaw` that of its wall's heading in all methods."""

    parameters: GapParameters
    t_ns: int = 0
    begun_ns: int = 0

    def begin(self, now_ns: int) -> None:
        """Record the start of the run."""
        self.begun_ns = now_ns

    def plan(self, track: PointTracker, yaw: PointTracker, watched_s: float, now_ns: int) -> None:
        """Keep the planned crossing while it can be reached and is slow; else plan the slowest one ahead."""
        earliest_ns = now_ns + self.run_ns
        if self.t_ns < earliest_ns - LATE_S * S or self.motion_cost(self.t_ns, track, yaw, watched_s) > 1.0:
            times = [earliest_ns + round(step * S) for step in np.arange(0.0, PLAN_HORIZON_S, PLAN_STEP_S).tolist()]
            self.t_ns = min(times, key=lambda t_ns: self.motion_cost(t_ns, track, yaw, watched_s))

    def is_due(self, track: PointTracker, yaw: PointTracker, watched_s: float, now_ns: int) -> bool:
        """Return whether a run that begins now arrives at the crossing."""
        arrives_ns = now_ns + self.run_ns
        if watched_s <= self.parameters.watch_s or self.t_ns - arrives_ns > EARLY_S * S:
            return False
        return self.motion_cost(arrives_ns, track, yaw, watched_s) <= 1.0

    def waiting_point(self, track: PointTracker, watched_s: float) -> Array:
        """Return the point (3,), ned metres, before which to wait: the centre of the motion while it is observed.

        Afterwards, where the straight path begins that meets the opening as it moves at the crossing.
        """
        if watched_s <= self.parameters.watch_s:
            return track.centre_ned()
        crossed = track.at(self.t_ns)
        return np.asarray(crossed.p_m - self.run_ns / S * crossed.v_m_s)

    def motion_cost(self, t_ns: int, track: PointTracker, yaw: PointTracker, watched_s: float) -> float:
        """Return how fast the opening moves or is turned at a time; above 1 is too much. Decreases with waiting."""
        speed = float(np.linalg.norm(track.at(t_ns).v_m_s)) / MAX_OPENING_M_S
        turn = abs(float(yaw.at(t_ns).p_m[1] - yaw.centre[1])) / MAX_WALL_TURN_RAD
        waited_s = watched_s - self.parameters.watch_s - PATIENCE_S
        return max(speed, turn) / (1.0 + max(0.0, waited_s) / PATIENCE_S)

    @property
    def run_ns(self) -> int:
        """Time from the stand-off to the wall."""
        return round(self.run_time_s(self.parameters.stand_off_m, 0.0) * S)

    def time_to_crossing_s(self, range_m: float, speed_m_s: float, now_ns: int) -> float:
        """Return the time left on the run: as planned, within MAX_PLAN_OFFSET_S of the arrival."""
        arrival_s = self.time_to_arrival_s(range_m, speed_m_s, now_ns)
        planned_s = (self.t_ns - now_ns) / S
        return max(0.0, min(arrival_s + MAX_PLAN_OFFSET_S, max(arrival_s - MAX_PLAN_OFFSET_S, planned_s)))

    def time_to_arrival_s(self, range_m: float, speed_m_s: float, now_ns: int) -> float:
        """Return the time to the wall on the run; as planned at first, while a lean does not show as speed yet."""
        planned_s = (self.begun_ns + self.run_ns - now_ns) / S
        soonest_s = max(0.0, range_m) / self.parameters.speed_m_s
        return min(self.run_time_s(range_m, speed_m_s), max(planned_s, soonest_s))

    def run_time_s(self, range_m: float, speed_m_s: float) -> float:
        """Return the time for a range from a speed: at the set speed, plus the time to accelerate to it."""
        missing = max(0.0, 1.0 - speed_m_s / self.parameters.speed_m_s)
        return max(0.0, range_m) / self.parameters.speed_m_s + ACCELERATION_COST_S * missing**2
