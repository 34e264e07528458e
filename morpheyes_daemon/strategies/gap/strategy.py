"""Gap flight: through an opening of unknown shape and place, standing or moving (paper, section V-B).

Looks for the wall's openings, stands off before the one that fits best, sets image and height on its safest point,
shrinks the baseline ahead of time, watches whether the vehicle really fits, and then flies through along the wall's
normal at a set speed. Until it is committed it never flies faster than it can stop in before the wall; once an
opening has been confirmed over several frames, what is free reaches through it as far as it is seen to. The last
stretch, where the edges have left the view, is flown on the opening's track.
"""

from __future__ import annotations

import math
from collections import deque
from enum import StrEnum

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.control.baseline import baseline_law
from morpheyes_daemon.messages.core import Intent, Line, MissionCommand
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import Craft, Strategy, View
from morpheyes_daemon.strategies.gap.crossing import Crossing
from morpheyes_daemon.strategies.gap.opening_tracker import Motion, PointTrack
from morpheyes_daemon.strategies.gap.openings import Opening, Place, Silhouette
from morpheyes_daemon.strategies.gap.parameters import GapParameters
from morpheyes_daemon.strategies.gap.perception import GapPercept, PassedOver, at_range_of, gap_percept, tracked_place
from morpheyes_daemon.transforms import Array, wrap_rad


class Phase(StrEnum):
    """What the decider is doing. APPROACH: to the stand-off, and measuring there. CLOSE: the eyes draw together."""

    APPROACH = "approach"
    CLOSE = "close"
    RUN = "run"
    BEHIND = "behind"
    OVER = "over"


RANGE_SIGMA: Array = np.array([0.010, 0.003, 0.003])
"""One sigma of where an opening is seen along, across and down, per metre of range: a pixel."""

ATTITUDE_LATE_S = 0.03
"""An attitude's stamp may be late by this, which counts while the vehicle nods; before a wall it hardly turns."""

YAW_SIGMA: Array = np.full(3, 0.02)
"""One sigma of a wall's heading, radians."""

YAW_WALK_RAD_S = 0.002
"""And how that seems to wander, radians per root second."""

SURE_SCALE = 0.02
"""Lengths are taken from depth only when the baseline is known this well; while the eyes move they are not."""

FORGOTTEN_S = 2.0
"""Not seen for so long before the run: what is seen then is another opening."""

LOST_S = 0.7
"""Not seen for so long on the run, while there is room to stop: the run is broken off."""

STAND_M = 0.35
"""So near to the stand-off it may take its run."""

TURNED_RAD = math.radians(3.0)
SETTLED_M = 0.004

HOLD_1_S, RUN_1_S, RUN_1_S2 = 0.6, 8.0, 0.5
"""Gains on what is missing to the line and, on the run, on its integral.

Gentle before the wall, since a vehicle that brakes looks up."""

MOVES_M = 0.2
"""A place that wanders across by more within some seconds moves; the autopilot's drift is 0.05 m."""

NOSE_M = 0.3
"""From the autopilot to the foremost point, with some room."""


class Gap(Strategy):
    """See the module."""

    Parameters = GapParameters
    parameters: GapParameters

    def __init__(self, parameters: GapParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._phase = Phase.APPROACH
        self._track = PointTrack()
        self._yaw = PointTrack(walk_m_s=YAW_WALK_RAD_S)
        self._room: list[float] = []
        self._chosen: Opening | None = None
        self._beyond_m: deque[float] = deque(maxlen=2)
        self._passed_over = PassedOver(parameters.confirm_frames)
        self._crossing = Crossing(parameters)
        self._yaw_rad = 0.0
        self._height_m = math.nan
        self._settled_ns = 0
        self._seen_ns = 0
        self._seq = 0

    @property
    def silhouette(self) -> Silhouette:
        """The vehicle along its way, in crossing attitude at the smallest baseline."""
        footprint, lean = self.craft.footprint, math.radians(self.parameters.lean_deg)
        height_m = (footprint.hull_height_mm * math.cos(lean) + footprint.hull_length_mm * math.sin(lean)) / 1e3
        return Silhouette(footprint.width_m(self.craft.baseline_range_m[0]), height_m)

    def perceive(self, view: View) -> GapPercept:
        """Return the openings of the wall ahead."""
        return gap_percept(view, self.silhouette)

    def decide(self, observation: Observation) -> MissionCommand:
        """Return line, speed and baseline until the next frame."""
        if not observation.engaged:
            self._settle(observation)
        self._take_in(observation.percept, observation)
        match self._phase:
            case Phase.APPROACH | Phase.CLOSE:
                return self._approach(observation)
            case Phase.RUN:
                return self._run(observation)
            case Phase.BEHIND:
                return self._stop_behind(observation)
            case Phase.OVER:
                return self._command(observation, Intent.DONE, Reason.GOAL_REACHED)

    def _settle(self, observation: Observation) -> None:
        """Before the mission engages: forget what the climb showed."""
        self._phase = Phase.APPROACH
        self._yaw_rad = observation.vehicle.yaw_rad
        self._track, self._yaw = PointTrack(self._yaw_rad), PointTrack(walk_m_s=YAW_WALK_RAD_S)
        self._room, self._chosen, self._crossing = [], None, Crossing(self.parameters)
        self._settled_ns = self._seen_ns = observation.now_ns

    def _take_in(self, percept: GapPercept, observation: Observation) -> None:
        """Follow the chosen opening, or choose one: the roomiest, and again when another one shows more room."""
        if self._phase in (Phase.BEHIND, Phase.OVER):
            return
        if self._phase is not Phase.RUN and percept.t_ns - self._seen_ns > FORGOTTEN_S * S:
            self._track, self._room, self._phase = PointTrack(self._yaw_rad), [], Phase.APPROACH
        usable = [opening for opening in percept.openings if not opening.cut or self._may_be_cut(opening)]
        sure = percept.scale_sigma < SURE_SCALE
        if not usable or not (sure or self._track.count):
            return
        if self._track.count:
            found = tracked_place(usable, self._track.at(percept.t_ns).p_m, self._ahead(), sure)
        else:
            roomiest = max(usable, key=lambda opening: opening.places[0].clearance_m)
            found = roomiest, roomiest.places[0]
        if found is None:
            return
        opening, place = found
        others = [other for other in usable if other is not opening]
        if self._phase is Phase.APPROACH and sure and self._passed_over.more_room(others, place):
            self._track, self._room = PointTrack(self._yaw_rad), []
            return
        self._chosen = opening
        self._seen_ns = percept.t_ns
        self._beyond_m.append(opening.beyond_m)
        p = np.array(place.p_ned_m)
        if not sure and self._track.count:  # the direction, at the range known before
            p = at_range_of(self._track.at(percept.t_ns).p_m, p, percept, self._ahead())
        _, nods, _ = observation.at_exposure.rates_frd_rad_s
        sigma = np.hypot(RANGE_SIGMA, ATTITUDE_LATE_S * np.array([0.0, 0.0, nods]))
        sigma_m = np.hypot(sigma * max(0.5, opening.z_m), self._room_missed_m(place))
        self._track.see(percept.t_ns, p, sigma_m, opening.z_m)
        if self._phase is not Phase.RUN:
            heading = np.array([0.0, wrap_rad(percept.yaw_rad - self._yaw_rad), 0.0])
            self._yaw.see(percept.t_ns, heading, YAW_SIGMA)
        measures = self._phase is Phase.APPROACH and opening.z_m < 1.2 * self.parameters.stand_off_m
        if measures and sure:
            self._room = [*self._room[-30:], place.clearance_m]
        if self._phase in (Phase.APPROACH, Phase.CLOSE) and self._track.spread_m(3.0) > MOVES_M:
            self._track.move()
            self._yaw.move()

    def _may_be_cut(self, opening: Opening) -> bool:
        """Of an opening that is followed a part may be out of view, as long as the vehicle fits through what is seen.

        On the run only if it was so before: there the edges leave the view one by one, and the place goes with them.
        """
        before = self._phase is not Phase.RUN or (self._chosen is not None and self._chosen.cut)
        return before and self._track.count > 0 and opening.places[0].clearance_m >= self.parameters.margin_m

    def _room_missed_m(self, place: Place) -> float:
        """How much less room is seen than was measured: so much of the opening may be missing on one side."""
        return max(0.0, float(np.median(self._room)) - place.clearance_m) if self._phase is Phase.RUN else 0.0

    def _approach(self, observation: Observation) -> MissionCommand:
        """Fly to the stand-off, set on the opening, confirm that the vehicle fits; then take the run or refuse."""
        parameters, vehicle, now_ns = self.parameters, observation.vehicle, observation.now_ns
        percept: GapPercept = observation.percept
        if not self._track.count or now_ns - self._seen_ns > FORGOTTEN_S * S:
            if observation.engaged and now_ns - max(self._settled_ns, self._seen_ns) > parameters.look_s * S:
                why = "no opening in the wall" if percept.bimodal else "the depth has no two clusters"
                return self._command(observation, Intent.REFUSE, Reason.MISSION_REFUSED, text=why)
            return self._nearer(observation)
        ahead, opening = self._ahead(), self._awaited(now_ns)
        range_m = float((opening.p_m - np.array(vehicle.p_ned_m)) @ ahead)
        start = opening.p_m - parameters.stand_off_m * ahead
        if observation.engaged and self._stands(observation, start, ahead):
            if len(self._room) >= 2 * parameters.confirm_frames and not self._fits():
                return self._refuse(observation)
            if self._phase is Phase.APPROACH and len(self._room) >= 2 * parameters.confirm_frames:
                self._phase = Phase.CLOSE
            elif self._phase is Phase.CLOSE and self._closed(observation) and self._may_run(observation):
                self._phase = Phase.RUN
                self._crossing.begin(now_ns)
                return self._run(observation)
        return self._hold(observation, opening, start, ahead, range_m)

    def _nearer(self, observation: Observation) -> MissionCommand:
        """Go on to the stand-off before a wall in which no opening is seen yet: from there a small one is."""
        percept: GapPercept = observation.percept
        if not (observation.engaged and math.isfinite(percept.range_m) and percept.scale_sigma < SURE_SCALE):
            return self._command(observation, Intent.STOP, Reason.NO_FREE_PATH, z_m=percept.range_m)
        here, ahead = np.array(observation.vehicle.p_ned_m), self._ahead()
        place = here + max(0.0, percept.range_m - self.parameters.stand_off_m) * ahead
        return self._hold(observation, Motion(place, np.zeros(3), np.zeros(3), 0.0), place, ahead, percept.range_m)

    def _hold(
        self, observation: Observation, opening: Motion, start: Array, ahead: Array, range_m: float
    ) -> MissionCommand:
        """Go to the stand-off and follow the opening there."""
        line = Line(
            observation.now_ns, _three(start), _three(opening.v_m_s), _three(opening.a_m_s2), HOLD_1_S,
            max_m_s=self.parameters.approach_m_s,
        )  # fmt: skip
        return self._command(
            observation, Intent.FLY, None, line=line, yaw_rad=self._heading_rad(),
            clear_m=self._clear_m(observation, range_m), z_m=range_m,
        )  # fmt: skip

    def _clear_m(self, observation: Observation, range_m: float) -> float:
        """How far it may go before the wall: by the track, or by what this frame shows, if that is less."""
        percept: GapPercept = observation.percept
        seen_m = range_m
        if math.isfinite(percept.range_m):
            wall = np.array(percept.origin_ned_m) + percept.range_m * self._ahead()
            seen_m = float((wall - np.array(observation.vehicle.p_ned_m)) @ self._ahead())
        return max(0.0, min(range_m, seen_m) - NOSE_M)

    def _stands(self, observation: Observation, start: Array, ahead: Array) -> bool:
        """Tell whether it stands at the stand-off, set on the opening as it was seen a moment ago."""
        vehicle = observation.vehicle
        off = start - np.array(vehicle.p_ned_m)
        along_m = float(off @ ahead)
        across_m = float(np.linalg.norm(off - along_m * ahead))
        turned = abs(wrap_rad(self._heading_rad() - vehicle.yaw_rad))
        wide = 2.5 if self._track.moves else 1.0
        return (
            abs(along_m) < STAND_M
            and across_m < wide * self.parameters.off_line_m
            and turned < wide * TURNED_RAD
            and observation.now_ns - self._seen_ns < LOST_S * S
        )

    def _closed(self, observation: Observation) -> bool:
        """Tell whether the bar, modelled baseline and three sigmas of it, is no wider than it is to be."""
        low_m, summary = self.craft.baseline_range_m[0], observation.summary
        widest_m = summary.baseline_m + 3 * summary.baseline_sigma_m
        fits = self.craft.footprint.width_m(widest_m) <= self.silhouette.width_m + 1e-3
        return fits and abs(summary.baseline_m - low_m) < SETTLED_M

    def _fits(self) -> bool:
        """Tell whether the last frames show that the silhouette fits."""
        recent = self._room[-2 * self.parameters.confirm_frames :]
        return float(np.median(recent)) >= self.parameters.margin_m

    def _may_run(self, observation: Observation) -> bool:
        """A standing opening at once; a moving one when it will be slow, and the wall across, on arriving."""
        now_ns = observation.now_ns
        return not self._track.moves or self._crossing.due(self._track, self._yaw, self._watched_s(now_ns), now_ns)

    def _awaited(self, now_ns: int) -> Motion:
        """Return the opening as it is waited for: where it is or, when it sways, where it will be crossed."""
        if self._track.wave is None:
            self._crossing.t_ns = now_ns + self._crossing.run_ns
            return self._track.at(now_ns)
        watched_s = self._watched_s(now_ns)
        self._crossing.plan(self._track, self._yaw, watched_s, now_ns)
        return Motion(self._crossing.waiting_place(self._track, watched_s), np.zeros(3), np.zeros(3), 0.0)

    def _watched_s(self, now_ns: int) -> float:
        return (now_ns - self._settled_ns) / S

    def _refuse(self, observation: Observation) -> MissionCommand:
        need, chosen = self.silhouette, self._chosen
        assert chosen is not None
        room_m = float(np.median(self._room[-2 * self.parameters.confirm_frames :]))
        text = (
            f"the opening is {chosen.width_m:.2f} x {chosen.height_m:.2f} m with {room_m * 1e3:.0f} mm of room; "
            f"the vehicle needs {need.width_m:.2f} x {need.height_m:.2f} m and {self.parameters.margin_m * 1e3:.0f} mm "
            f"at a baseline of {self.craft.baseline_range_m[0] * 1e3:.0f} mm"
        )
        return self._command(observation, Intent.REFUSE, Reason.MISSION_REFUSED, text=text)

    def _run(self, observation: Observation) -> MissionCommand:
        """Through the opening; broken off while it can still stop before the wall and the opening is lost."""
        parameters, vehicle, now_ns = self.parameters, observation.vehicle, observation.now_ns
        ahead = self._ahead()
        range_m = float((self._track.at(now_ns).p_m - np.array(vehicle.p_ned_m)) @ ahead)
        if range_m < -parameters.behind_m:
            self._phase = Phase.BEHIND
            return self._stop_behind(observation)
        lost = now_ns - self._seen_ns > LOST_S * S
        stoppable = range_m - NOSE_M > observation.reserve_m
        if stoppable and (lost or not self._fits()):
            self._phase, self._room = Phase.APPROACH, []
            return self._approach(observation)
        beyond_m = range_m + self._seen_beyond_m
        v = parameters.speed_m_s * ahead
        left_s = self._crossing.left_s(range_m, float(np.array(vehicle.v_ned_m_s) @ ahead), now_ns)
        opening = self._track.at(now_ns + round(left_s * S))
        place = opening.p_m - left_s * opening.v_m_s  # a straight way that meets it as it moves then
        line = Line(
            now_ns, _three(place), _three(opening.v_m_s), gain_1_s=RUN_1_S, integral_1_s2=RUN_1_S2, fast_response=True
        )
        return self._command(
            observation, Intent.FLY, None, line=line, yaw_rad=self._heading_rad(), v_ned_m_s=_three(v),
            clear_m=max(0.0, beyond_m - NOSE_M), z_m=beyond_m, contour_m=range_m,
        )  # fmt: skip

    def _stop_behind(self, observation: Observation) -> MissionCommand:
        """Neutral sticks; over when it stands."""
        if math.hypot(*observation.vehicle.v_ned_m_s) < 0.2:
            self._phase = Phase.OVER
            return self._command(observation, Intent.DONE, Reason.GOAL_REACHED)
        return self._command(observation, Intent.STOP, None)

    @property
    def _seen_beyond_m(self) -> float:
        """Room behind the wall: what one frame alone takes for an obstacle there is not believed."""
        return max(self._beyond_m, default=0.0)

    def _ahead(self) -> Array:
        yaw_rad = self._heading_rad()
        return np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])

    def _heading_rad(self) -> float:
        """Heading of the wall's normal; of a wall that turns, the middle one."""
        return wrap_rad(self._yaw_rad + float(self._yaw.middle[1]))

    def _command(
        self,
        observation: Observation,
        intent: Intent,
        reason: Reason | None,
        *,
        line: Line | None = None,
        yaw_rad: float | None = None,
        v_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
        clear_m: float = 0.0,
        z_m: float = math.nan,
        contour_m: float = math.nan,
        text: str = "",
    ) -> MissionCommand:
        self._seq += 1
        z_c_m = z_m if math.isnan(contour_m) else contour_m
        low, high = self.craft.baseline_range_m
        following = self._phase is Phase.APPROACH
        wanted_m = baseline_law(z_c_m, self.parameters.baseline_gain, (low, high))
        if math.isnan(z_c_m):
            wanted_m = observation.baseline_m  # eyes that go to and fro lose their scale
        baseline_m = wanted_m if following else low
        return MissionCommand(
            seq=self._seq,
            t_ns=observation.now_ns,
            expires_ns=observation.now_ns + round(3 * self.craft.frame_period_s * S),
            intent=intent,
            reason=reason,
            v_ned_m_s=v_ned_m_s,
            yaw_rad=yaw_rad,
            height_m=None,
            baseline_m=baseline_m,
            clear_m=clear_m,
            measured_ns=observation.vehicle.position_t_ns,
            p_measured_ned_m=observation.vehicle.p_ned_m,
            z_close_m=z_m,
            detail=self._detail(z_c_m),
            line=line,
            text=text,
        )

    def _detail(self, z_c_m: float) -> dict[str, float]:
        chosen = self._chosen
        if chosen is None:
            return {}
        return {
            "range_m": z_c_m,
            "room_m": self._room[-1] if self._room else math.nan,
            "opening_width_m": chosen.width_m,
            "opening_height_m": chosen.height_m,
            "beyond_m": self._seen_beyond_m,
        }


def _three(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
