"""Following one opening: which one is chosen, its tracker, its measured clearance, and the wall's heading.

The opening with the largest clearance is chosen, and again when another one proves larger. What the vehicle does about
it is the strategy's.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.strategies.gap.opening_tracker import PointTracker
from morpheyes_daemon.strategies.gap.openings import CrossingPoint, Opening
from morpheyes_daemon.strategies.gap.parameters import GapParameters
from morpheyes_daemon.strategies.gap.perception import (
    GapPercept,
    LargerOpeningVote,
    at_known_range,
    match_tracked_opening,
)
from morpheyes_daemon.transforms import Array, wrap_rad

RANGE_SIGMA: Array = np.array([0.010, 0.003, 0.003])
"""One sigma (3,) of an opening's position along, across and down, as a share of its range. Unit: m/m.

Source: equation, 1/f: one pixel at f = 370 px (320x240) is 0.0027; along it three times as much."""

MIN_SIGMA_RANGE_M = 0.5
"""Range by which RANGE_SIGMA is multiplied at least.

Chosen: closer, the contour is blurred by more than a pixel."""

ATTITUDE_LATENCY_S = 0.03
"""Error of an attitude's stamp, which counts while the vehicle pitches; before a wall it hardly yaws.

Chosen: of the order of a message's period; larger discards measurements during every correction."""

YAW_SIGMA: Array = np.full(3, 0.02)
"""One sigma (3,) of a wall's measured heading. Unit: rad.

Chosen: a degree, the accuracy of a plane fitted at the stand-off; smaller follows its noise."""

YAW_WALK_RAD_SQRT_S = 0.002
"""Random walk of a standing wall's apparent heading. Unit: rad/sqrt(s).

Chosen: the drift of the autopilot's yaw; larger averages over less time."""

CERTAIN_SCALE = 0.02
"""Relative sigma of the baseline up to which lengths are taken from depth. Unit: none.

Chosen: exceeded only while the baseline moves; 2 % of 4 m is 80 mm, larger shifts the position."""

FORGOTTEN_S = 2.0
"""Without a measurement for this long before the run, a new opening is chosen.

Chosen: ten frames; shorter starts over after a few mismatched frames."""

LOST_S = 0.7
"""Without a measurement for this long the opening is lost: no run begins, and one that can still stop is aborted.

Chosen: three frames; longer flies on by prediction while the vehicle could still stop."""

MOVING_SPREAD_M, SPREAD_S = 0.2, 3.0
"""Spread across the heading, within the second, from which an opening is moving.

Chosen: four times the autopilot's drift of 0.05 m; larger notices slow walls later."""

KEPT_CLEARANCES = 30
"""Clearances kept besides the newest. Unit: frames.

Chosen: more than the frames that are evaluated (2 confirm_frames)."""

MEASURING_RANGE = 1.2
"""Range up to which clearance is measured, as a multiple of the stand-off. Unit: none.

Chosen: farther, a pixel is more than the clearance asked for."""


class OpeningFollower:
    """The chosen opening over time; `update` once per percept."""

    def __init__(self, parameters: GapParameters) -> None:
        self._parameters = parameters
        self._vote = LargerOpeningVote(parameters.confirm_frames)
        self._beyond_m: deque[float] = deque(maxlen=2)
        self._yaw_rad = 0.0
        self.track = PointTracker()
        self.yaw = PointTracker(walk_sqrt_s=YAW_WALK_RAD_SQRT_S)
        self.clearances_m: list[float] = []
        self.chosen: Opening | None = None
        self.seen_ns = 0

    def reset(self, yaw_rad: float, now_ns: int) -> None:
        """Before the mission engages: forget the opening, and take the vehicle's heading for the wall's."""
        self._yaw_rad = yaw_rad
        self.restart()
        self.yaw = PointTracker(walk_sqrt_s=YAW_WALK_RAD_SQRT_S)
        self.chosen = None
        self.seen_ns = now_ns

    def restart(self) -> None:
        """Choose an opening anew with the next percept."""
        self.track, self.clearances_m = PointTracker(self._yaw_rad), []

    def is_forgotten(self, now_ns: int) -> bool:
        """Return whether the opening was not measured for more than FORGOTTEN_S."""
        return now_ns - self.seen_ns > FORGOTTEN_S * S

    def is_lost(self, now_ns: int) -> bool:
        """Return whether the opening was not measured for more than LOST_S."""
        return now_ns - self.seen_ns > LOST_S * S

    def is_fresh(self, now_ns: int) -> bool:
        """Return whether the opening was measured less than LOST_S ago."""
        return now_ns - self.seen_ns < LOST_S * S

    def ahead(self) -> Array:
        """Return the unit vector (3,), ned, unitless, through the wall along its mean normal."""
        yaw_rad = self.heading_rad()
        return np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])

    def heading_rad(self) -> float:
        """Return the heading of the wall's normal; of a wall that turns, the mean one."""
        return wrap_rad(self._yaw_rad + float(self.yaw.centre[1]))

    def is_measured(self) -> bool:
        """Return whether enough clearances were measured to decide."""
        return len(self.clearances_m) >= 2 * self._parameters.confirm_frames

    def clearance_m(self) -> float:
        """Return the median clearance of the last frames that measured it."""
        return float(np.median(self.clearances_m[-2 * self._parameters.confirm_frames :]))

    def fits(self) -> bool:
        """Return whether the last frames show that the silhouette fits with the margin asked for."""
        return self.clearance_m() >= self._parameters.margin_m

    def beyond_m(self) -> float:
        """Return the free distance behind the wall; an obstacle there counts when two frames show it."""
        return max(self._beyond_m, default=0.0)

    def update(self, percept: GapPercept, observation: Observation, *, measuring: bool, on_run: bool) -> None:
        """Follow the chosen opening, or choose one; `measuring` adds its clearance while the stand-off is near."""
        usable = [opening for opening in percept.openings if not opening.cut or self._accepts_cut(opening, on_run)]
        certain = percept.scale_sigma < CERTAIN_SCALE
        if not usable or not (certain or self.track.count):
            return
        found = self._matched(usable, percept, certain)
        if found is None:
            return
        opening, point = found
        others = [other for other in usable if other is not opening]
        if measuring and certain and self._vote.update(others, point):
            self.restart()
            return
        self.chosen = opening
        self.seen_ns = percept.t_ns
        self._beyond_m.append(opening.beyond_m)
        self._track_point(opening, point, percept, observation, on_run)
        if not on_run:
            heading = np.array([0.0, wrap_rad(percept.yaw_rad - self._yaw_rad), 0.0])
            self.yaw.update(percept.t_ns, heading, YAW_SIGMA)
        if measuring and opening.z_m < MEASURING_RANGE * self._parameters.stand_off_m and certain:
            self.clearances_m = [*self.clearances_m[-KEPT_CLEARANCES:], point.clearance_m]
        if not on_run and self.track.spread_m(SPREAD_S) > MOVING_SPREAD_M:
            self.track.set_moving()
            self.yaw.set_moving()

    def _matched(
        self, usable: list[Opening], percept: GapPercept, certain: bool
    ) -> tuple[Opening, CrossingPoint] | None:
        """Return the opening at the tracked position, or at first the one with the largest clearance."""
        if self.track.count:
            return match_tracked_opening(usable, self.track.at(percept.t_ns).p_m, self.ahead(), certain)
        largest = max(usable, key=lambda opening: opening.crossing_points[0].clearance_m)
        return largest, largest.crossing_points[0]

    def _track_point(
        self, opening: Opening, point: CrossingPoint, percept: GapPercept, observation: Observation, on_run: bool
    ) -> None:
        p = np.array(point.p_ned_m)
        certain = percept.scale_sigma < CERTAIN_SCALE
        if not certain and self.track.count:  # the direction alone, at the range known before
            p = at_known_range(self.track.at(percept.t_ns).p_m, p, percept, self.ahead())
        _, pitch_rate, _ = observation.at_exposure.rates_frd_rad_s
        sigma = np.hypot(RANGE_SIGMA, ATTITUDE_LATENCY_S * np.array([0.0, 0.0, pitch_rate]))
        sigma_m = np.hypot(sigma * max(MIN_SIGMA_RANGE_M, opening.z_m), self._missing_m(point, on_run))
        self.track.update(percept.t_ns, p, sigma_m, opening.z_m)

    def _accepts_cut(self, opening: Opening, on_run: bool) -> bool:
        """Return whether a followed opening may be partly out of view: when the vehicle fits through the visible part.

        On the run only if it was cut before: there the edges leave the view one by one, which would shift its point.
        """
        before = not on_run or (self.chosen is not None and self.chosen.cut)
        fits = opening.crossing_points[0].clearance_m >= self._parameters.margin_m
        return before and self.track.count > 0 and fits

    def _missing_m(self, point: CrossingPoint, on_run: bool) -> float:
        """Return how much less clearance is seen on the run than was measured: one side may be out of view."""
        return max(0.0, float(np.median(self.clearances_m)) - point.clearance_m) if on_run else 0.0
