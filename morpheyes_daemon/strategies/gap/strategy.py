"""Gap flight: through an opening of unknown shape and place, standing or moving (paper, section V-B).

Searches the wall's openings, flies to the stand-off before the one that fits best, aligns with its crossing point,
shrinks the baseline, measures whether the vehicle really fits, and then flies through along the wall's normal at a set
speed. Before the run it never flies faster than it can stop before the wall; on the run free space reaches through the
opening as far as it is seen. The last part, where the edges have left the view, is flown on the opening's tracker.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import StrEnum

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.control.baseline import baseline_law
from morpheyes_daemon.messages.core import Intent, Line, MissionCommand
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import Craft, Strategy, View
from morpheyes_daemon.strategies.command import CommandBuilder, Decision
from morpheyes_daemon.strategies.gap.crossing import Crossing
from morpheyes_daemon.strategies.gap.opening_following import CERTAIN_SCALE, OpeningFollower
from morpheyes_daemon.strategies.gap.opening_tracker import Motion
from morpheyes_daemon.strategies.gap.openings import Silhouette
from morpheyes_daemon.strategies.gap.parameters import GapParameters
from morpheyes_daemon.strategies.gap.perception import GapPercept, gap_percept
from morpheyes_daemon.transforms import Array, wrap_rad


class Phase(StrEnum):
    """State of the mission. APPROACH: to the stand-off, and measuring there. CLOSE: the baseline shrinks."""

    APPROACH = "approach"
    CLOSE = "close"
    RUN = "run"
    BEHIND = "behind"
    OVER = "over"


STAND_OFF_TOLERANCE_M = 0.35
"""Distance from the stand-off, along the normal, within which the run may begin.

Chosen: does not change the run; smaller waits for the position to settle."""

YAW_TOLERANCE_RAD = math.radians(3.0)
"""Yaw error up to which the run may begin.

Chosen: it adds 5 % of the hull's length to the vehicle's width; smaller waits for the yaw's drift."""

MOVING_TOLERANCE = 2.5
"""Factor on both tolerances before a moving opening. Unit: none.

Chosen: the waiting point itself moves with each new fit; smaller misses crossings."""

SETTLED_M, WIDTH_TOLERANCE_M = 0.004, 1e-3
"""Difference from the smallest baseline, and width above the silhouette's at 3 sigma, with which it may cross.

Chosen: below the clearance of 40 mm; smaller than the servo's repeatability would never be reached."""

HOLD_1_S = 0.6
"""Gain of the line before the wall.

Chosen: gentle, since a vehicle that brakes looks up and loses the opening."""

RUN_1_S, RUN_1_S2 = 8.0, 0.5
"""Gains of the line and of its integral on the run.

Chosen: the last measurement moves the line just before the wall; higher gains swing at the lean's delay."""

NOSE_M = 0.3
"""Distance from the autopilot to the vehicle's front, with a margin.

Chosen: half of the hull and propeller; larger stops earlier before the wall."""

STOPPED_M_S = 0.2
"""Speed below which the vehicle counts as stopped behind the wall.

Chosen: above the noise of the velocity estimate; lower waits longer for the end of the mission."""


class Gap(Strategy):
    """The gap mission; see the module."""

    Parameters = GapParameters
    parameters: GapParameters

    def __init__(self, parameters: GapParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._phase = Phase.APPROACH
        self._opening = OpeningFollower(parameters)
        self._crossing = Crossing(parameters)
        self._commands = CommandBuilder(craft.frame_period_s)
        self._reset_ns = 0

    @property
    def silhouette(self) -> Silhouette:
        """The vehicle's outline along its path, in crossing attitude at the smallest baseline."""
        footprint, lean = self.craft.footprint, math.radians(self.parameters.lean_deg)
        height_m = (footprint.hull_height_mm * math.cos(lean) + footprint.hull_length_mm * math.sin(lean)) / 1e3
        return Silhouette(footprint.width_m(self.craft.baseline_range_m[0]), height_m)

    def perceive(self, view: View) -> GapPercept:
        """Return the openings of the wall ahead."""
        return gap_percept(view, self.silhouette)

    def decide(self, observation: Observation) -> MissionCommand:
        """Return line, speed and baseline until the next frame."""
        if not observation.engaged:
            self._reset(observation)
        self._update_opening(observation.percept, observation)
        match self._phase:
            case Phase.APPROACH | Phase.CLOSE:
                return self._approach(observation)
            case Phase.RUN:
                return self._run(observation)
            case Phase.BEHIND:
                return self._stop_behind(observation)
            case Phase.OVER:
                return self._command(observation, Decision(Intent.DONE, Reason.GOAL_REACHED))

    def _reset(self, observation: Observation) -> None:
        """Before the mission engages: forget what was seen so far."""
        self._phase = Phase.APPROACH
        self._opening.reset(observation.vehicle.yaw_rad, observation.now_ns)
        self._crossing = Crossing(self.parameters)
        self._reset_ns = observation.now_ns

    def _update_opening(self, percept: GapPercept, observation: Observation) -> None:
        if self._phase in (Phase.BEHIND, Phase.OVER):
            return
        if self._phase is not Phase.RUN and self._opening.is_forgotten(percept.t_ns):
            self._opening.restart()
            self._phase = Phase.APPROACH
        measuring, on_run = self._phase is Phase.APPROACH, self._phase is Phase.RUN
        self._opening.update(percept, observation, measuring=measuring, on_run=on_run)

    def _approach(self, observation: Observation) -> MissionCommand:
        """Fly to the stand-off, align with the opening, confirm that the vehicle fits; then begin the run or refuse."""
        now_ns, followed = observation.now_ns, self._opening
        if not followed.track.count or followed.is_forgotten(now_ns):
            return self._without_opening(observation)
        ahead, opening = followed.ahead(), self._awaited(now_ns)
        range_m = float((opening.p_m - np.array(observation.vehicle.p_ned_m)) @ ahead)
        start = opening.p_m - self.parameters.stand_off_m * ahead
        if observation.engaged and self._is_at_stand_off(observation, start):
            if followed.is_measured() and not followed.fits():
                return self._refuse(observation)
            if self._phase is Phase.APPROACH and followed.is_measured():
                self._phase = Phase.CLOSE
            elif self._phase is Phase.CLOSE and self._is_narrow(observation) and self._may_run(observation):
                self._phase = Phase.RUN
                self._crossing.begin(now_ns)
                return self._run(observation)
        return self._hold(observation, replace(opening, p_m=start), range_m)

    def _without_opening(self, observation: Observation) -> MissionCommand:
        """Go on to the stand-off of a wall without a visible opening, from where small ones are; refuse after a time."""
        percept: GapPercept = observation.percept
        last_ns = max(self._reset_ns, self._opening.seen_ns)
        if observation.engaged and observation.now_ns - last_ns > self.parameters.look_s * S:
            why = "no opening in the wall" if percept.bimodal else "the depth has no two clusters"
            return self._command(observation, Decision(Intent.REFUSE, Reason.MISSION_REFUSED, text=why))
        certain = percept.scale_sigma < CERTAIN_SCALE
        if not (observation.engaged and math.isfinite(percept.range_m) and certain):
            return self._command(
                observation, Decision(Intent.STOP, Reason.NO_FREE_PATH, z_close_m=percept.range_m), percept.range_m
            )
        here, ahead = np.array(observation.vehicle.p_ned_m), self._opening.ahead()
        start = here + max(0.0, percept.range_m - self.parameters.stand_off_m) * ahead
        return self._hold(observation, Motion(start, np.zeros(3), np.zeros(3), 0.0), percept.range_m)

    def _hold(self, observation: Observation, start: Motion, range_m: float) -> MissionCommand:
        """Go to a point that moves as the opening does, at the stand-off, and stay there."""
        line = Line(
            observation.now_ns, _triple(start.p_m), _triple(start.v_m_s), _triple(start.a_m_s2), HOLD_1_S,
            max_m_s=self.parameters.approach_m_s,
        )  # fmt: skip
        clear_m = self._clear_m(observation, range_m)
        decision = Decision(
            Intent.FLY, line=line, yaw_rad=self._opening.heading_rad(), clear_m=clear_m, z_close_m=range_m
        )
        return self._command(observation, decision, range_m)

    def _clear_m(self, observation: Observation, range_m: float) -> float:
        """Return the free distance before the wall: by the tracker, or by this frame if that is less."""
        percept: GapPercept = observation.percept
        seen_m = range_m
        if math.isfinite(percept.range_m):
            wall = np.array(percept.origin_ned_m) + percept.range_m * self._opening.ahead()
            seen_m = float((wall - np.array(observation.vehicle.p_ned_m)) @ self._opening.ahead())
        return max(0.0, min(range_m, seen_m) - NOSE_M)

    def _is_at_stand_off(self, observation: Observation, start: Array) -> bool:
        """Return whether the vehicle is at the stand-off, aligned with an opening that was just measured."""
        vehicle, ahead = observation.vehicle, self._opening.ahead()
        off = start - np.array(vehicle.p_ned_m)
        along_m = float(off @ ahead)
        across_m = float(np.linalg.norm(off - along_m * ahead))
        yaw_error_rad = abs(wrap_rad(self._opening.heading_rad() - vehicle.yaw_rad))
        tolerance = MOVING_TOLERANCE if self._opening.track.is_moving else 1.0
        return (
            abs(along_m) < STAND_OFF_TOLERANCE_M
            and across_m < tolerance * self.parameters.off_line_m
            and yaw_error_rad < tolerance * YAW_TOLERANCE_RAD
            and self._opening.is_fresh(observation.now_ns)
        )

    def _is_narrow(self, observation: Observation) -> bool:
        """Return whether the vehicle at the modelled baseline plus three sigmas is as narrow as its silhouette."""
        low_m, summary = self.craft.baseline_range_m[0], observation.summary
        widest_m = summary.baseline_m + 3 * summary.baseline_sigma_m
        fits = self.craft.footprint.width_m(widest_m) <= self.silhouette.width_m + WIDTH_TOLERANCE_M
        return fits and abs(summary.baseline_m - low_m) < SETTLED_M

    def _may_run(self, observation: Observation) -> bool:
        """Return whether the run may begin: a standing opening at once, a moving one when its crossing is due."""
        track, yaw, now_ns = self._opening.track, self._opening.yaw, observation.now_ns
        return not track.is_moving or self._crossing.is_due(track, yaw, self._watched_s(now_ns), now_ns)

    def _awaited(self, now_ns: int) -> Motion:
        """Return the opening for which to wait: where it is or, when it oscillates, where it will be crossed."""
        track = self._opening.track
        if track.oscillation is None:
            self._crossing.t_ns = now_ns + self._crossing.run_ns
            return track.at(now_ns)
        watched_s = self._watched_s(now_ns)
        self._crossing.plan(track, self._opening.yaw, watched_s, now_ns)
        return Motion(self._crossing.waiting_point(track, watched_s), np.zeros(3), np.zeros(3), 0.0)

    def _watched_s(self, now_ns: int) -> float:
        return (now_ns - self._reset_ns) / S

    def _refuse(self, observation: Observation) -> MissionCommand:
        need, chosen = self.silhouette, self._opening.chosen
        assert chosen is not None
        text = (
            f"the opening is {chosen.width_m:.2f} x {chosen.height_m:.2f} m with "
            f"{self._opening.clearance_m() * 1e3:.0f} mm of clearance; "
            f"the vehicle needs {need.width_m:.2f} x {need.height_m:.2f} m and {self.parameters.margin_m * 1e3:.0f} mm "
            f"at a baseline of {self.craft.baseline_range_m[0] * 1e3:.0f} mm"
        )
        return self._command(observation, Decision(Intent.REFUSE, Reason.MISSION_REFUSED, text=text))

    def _run(self, observation: Observation) -> MissionCommand:
        """Fly through the opening; abort while the vehicle can still stop before the wall and the opening is lost."""
        parameters, vehicle, now_ns, followed = self.parameters, observation.vehicle, observation.now_ns, self._opening
        ahead = followed.ahead()
        range_m = float((followed.track.at(now_ns).p_m - np.array(vehicle.p_ned_m)) @ ahead)
        if range_m < -parameters.behind_m:
            self._phase = Phase.BEHIND
            return self._stop_behind(observation)
        can_stop = range_m - NOSE_M > observation.reserve_m
        if can_stop and (followed.is_lost(now_ns) or not followed.fits()):
            self._phase, followed.clearances_m = Phase.APPROACH, []
            return self._approach(observation)
        beyond_m = range_m + followed.beyond_m()
        left_s = self._crossing.time_to_crossing_s(range_m, float(np.array(vehicle.v_ned_m_s) @ ahead), now_ns)
        opening = followed.track.at(now_ns + round(left_s * S))
        point = opening.p_m - left_s * opening.v_m_s  # a straight path that meets the opening as it moves then
        decision = Decision(
            Intent.FLY,
            v_ned_m_s=_triple(parameters.speed_m_s * ahead),
            yaw_rad=followed.heading_rad(),
            clear_m=max(0.0, beyond_m - NOSE_M),
            z_close_m=beyond_m,
            line=Line(
                now_ns, _triple(point), _triple(opening.v_m_s),
                gain_1_s=RUN_1_S, integral_1_s2=RUN_1_S2, fast_response=True,
            ),
        )  # fmt: skip
        return self._command(observation, decision, range_m)

    def _stop_behind(self, observation: Observation) -> MissionCommand:
        """Neutral sticks; the mission is over when the vehicle has stopped."""
        if math.hypot(*observation.vehicle.v_ned_m_s) < STOPPED_M_S:
            self._phase = Phase.OVER
            return self._command(observation, Decision(Intent.DONE, Reason.GOAL_REACHED))
        return self._command(observation, Decision(Intent.STOP))

    def _command(self, observation: Observation, decision: Decision, contour_m: float = math.nan) -> MissionCommand:
        """Return the command with its baseline: b = K Z_C in the approach, where Z_C is known; else the smallest."""
        low, high = self.craft.baseline_range_m
        baseline_m = low
        if self._phase is Phase.APPROACH:
            baseline_m = baseline_law(contour_m, self.parameters.baseline_gain, (low, high))
            if math.isnan(contour_m):
                baseline_m = observation.baseline_m  # moving back and forth would make the scale uncertain
        return self._commands.build(
            observation, replace(decision, baseline_m=baseline_m, detail=self._detail(contour_m))
        )

    def _detail(self, contour_m: float) -> dict[str, float]:
        chosen, clearances_m = self._opening.chosen, self._opening.clearances_m
        if chosen is None:
            return {}
        return {
            "range_m": contour_m,
            "room_m": clearances_m[-1] if clearances_m else math.nan,
            "opening_width_m": chosen.width_m,
            "opening_height_m": chosen.height_m,
            "beyond_m": self._opening.beyond_m(),
        }


def _triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
