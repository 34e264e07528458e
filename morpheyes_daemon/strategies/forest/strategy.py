"""Forest flight: to the goal between the trees (paper, section V-A).

The free direction v_free and the goal direction v_g are weighted by how close the nearest obstacle of the corridor
is; a PID turns the velocity towards the result; the vehicle stops where the corridor closes within tau_safe, searches
by yaw, and goes on towards free space. The baseline follows K Z_close. The governor bounds the speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.control.baseline import baseline_law
from morpheyes_daemon.control.pid import Pid, PidGains
from morpheyes_daemon.messages.core import Intent, MissionCommand, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import Craft, Strategy, View
from morpheyes_daemon.strategies.command import CommandBuilder, Decision
from morpheyes_daemon.strategies.forest.bug_algorithm import IN_VIEW_RAD, BugAlgorithm
from morpheyes_daemon.strategies.forest.obstacle_memory import MIN_KEEP_FRAMES, ObstacleMemory
from morpheyes_daemon.strategies.forest.parameters import OPEN_BEYOND_M, ForestParameters
from morpheyes_daemon.strategies.forest.turn_feasibility import (
    MAX_TURN_RAD,
    Turn,
    feasible_speed_share,
    goal_approach_m_s,
    path_margin_m,
)
from morpheyes_daemon.strategies.obstacles.corridor import free_distance_m
from morpheyes_daemon.strategies.obstacles.polar_profile import (
    ObstacleProfile,
    obstacle_profile,
    wide_runs,
    wrapped_rad,
)
from morpheyes_daemon.transforms import Array, wrap_rad

GOAL_BEHIND_RAD = math.radians(75.0)
"""A goal further off the vehicle's heading than this lies behind.

Chosen: outside the field of view whatever the yaw error; a smaller angle interrupts detours."""

FIRST_DETOUR_M, SHORT_DETOUR_FROM_M = 4.0, 8.0
"""Distance flown away from the goal before the first turn back; shorter in proportion from the second on.

Chosen: room to leave a pocket; longer flies on past a goal that was missed by a little."""

PROGRESS_M = 2.0
"""Decrease of the distance to the goal that resets the detour.

Chosen: half of the first detour; less resets it by drift."""

OPEN_SHARE = 0.6
"""A heading is open when it is free for this share of the range compared. Unit: none.

Chosen: independent of the speed, or a slow vehicle would accept a heading into a tree and stay slow."""

UNSEEN_M = 2.0
"""An obstacle is assumed at this range in directions about which nothing is known.

Chosen: nearer makes every hole in the depth a stop, farther flies into unknown space too fast to stop."""

MIN_UNKNOWN_BINS = 3
"""Run of adjacent bins without depth that counts as unknown. Unit: bins.

Chosen: 1.8 degrees; narrower ones are single holes in the depth."""

EDGE_BINS = 3
"""Bins at each edge of the view that are no headings to fly in. Unit: bins.

Chosen: a corridor there lies half outside the view."""

GOAL_ANGLE_SCALE = 0.8
"""Factor on the angle to the goal in the progress along a heading. Unit: none.

Chosen: below 1 so that a heading across the goal direction still counts a third of its free distance."""

COURSE_WEIGHT_M_RAD, GOAL_WEIGHT_M_RAD = 0.8, 0.5
"""Free distance that one radian off the present heading, and off the goal, is worth. Unit: m/rad.

Chosen: larger ones keep the heading past an opening, smaller ones alternate between equal openings."""

WEIGHT_Z0_M = 4.0
"""Smallest Z_0 of the weight with `weight: stopping`.

Chosen: at 1 m the vehicle steers at a tree until it collides, at 8 m it does not; 4 m at low speed."""

STOPPING_FACTOR = 2.0
"""Z_0 of the weight over the distance to stop, with `weight: stopping`. Unit: none.

Chosen: the weight reaches a half of its range while there is room to stop."""

MOVING_M_S = 0.5
"""Speed from which the velocity has a course.

Chosen: ten times the noise of the measured velocity."""

ARRIVE_M_S, ARRIVE_1_S = 0.3, 0.8
"""Speed wanted at the goal, and its increase per metre of distance.

Chosen: as the velocity loop can follow without overshooting the goal."""

FACING_SCALE, MIN_FACING = 1.5, 0.15
"""Factor on the angle between heading and yaw in the cosine that slows the vehicle, and its least value. Unit: none.

Chosen: the vehicle flies only where the camera looks; zero would never start a turn in place."""

SPEED_FLOOR_M_S = 1.0
"""Speed by which the braking distance is divided at least for the braking time.

Chosen: below it the braking distance is mostly the brake's delay."""

MIN_STEP_S, MAX_STEP_S, FIRST_STEP_S = 1e-3, 2.0, 0.2
"""Bounds of the time between decisions, and its value at the first one.

Chosen: around frame rates of 1 to 10 Hz; a longer step after a delay would jump the filters."""


class Phase(StrEnum):
    """State of the mission: flying, searching a direction by yaw, or done."""

    FLY = "fly"
    SEARCH = "search"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class Choice:
    """A heading to fly in, the half width of its corridor, and Z_close: the free distance along it."""

    heading_rad: float
    half_width_m: float
    z_close_m: float


class Forest(Strategy):
    """The forest mission; see the module."""

    Parameters = ForestParameters
    parameters: ForestParameters

    def __init__(self, parameters: ForestParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._memory = ObstacleMemory(max(parameters.memory_s, MIN_KEEP_FRAMES * craft.frame_period_s))
        self._turn = Pid(PidGains(*parameters.turn_gains))
        self._commands = CommandBuilder(craft.frame_period_s)
        self._goal_ned_m: tuple[float, float] | None = None
        self._height_m = parameters.height_m
        self._phase = Phase.FLY
        self._z_close_m = math.nan
        self._last_ns = 0
        self._heading_rad = 0.0
        self._search_sign = 1.0
        self._search_left_rad = 0.0
        self._best_m = math.inf
        self._detour_m = FIRST_DETOUR_M
        self._flown_away_m = 0.0
        self._bug = BugAlgorithm()

    def perceive(self, view: View) -> ObstacleProfile:
        """Return the obstacle profile at flying height, up to the trusted range."""
        depth = view.depth
        share = self.craft.max_relative_depth_error / self.craft.depth_sigmas
        trust_m = depth.baseline_m * depth.pinhole.f_px / depth.sigma_disparity_px * share
        band_m = self.craft.footprint.hull_height_mm / 2e3 + self.parameters.band_margin_m
        return obstacle_profile(view, band_m, trust_m)

    def decide(self, observation: Observation) -> MissionCommand:
        """Return velocity, heading and baseline until the next frame."""
        profile: ObstacleProfile = observation.percept
        vehicle = observation.vehicle
        if not observation.engaged or self._goal_ned_m is None:
            self._reset(vehicle)
        self._memory.add(profile)
        elapsed_s = (observation.now_ns - self._last_ns) / S
        dt_s = min(MAX_STEP_S, max(MIN_STEP_S, elapsed_s)) if self._last_ns else FIRST_STEP_S
        self._last_ns = observation.now_ns
        assert self._goal_ned_m is not None
        to_goal = (self._goal_ned_m[0] - vehicle.p_ned_m[0], self._goal_ned_m[1] - vehicle.p_ned_m[1])
        distance_m = math.hypot(*to_goal)
        if self._phase is Phase.DONE or distance_m < self.parameters.goal_radius_m:
            self._phase = Phase.DONE
            return self._command(observation, Decision(Intent.DONE, Reason.GOAL_REACHED, z_close_m=self._z_close_m))
        obstacles = self._obstacles(profile, observation)
        goal_rad = math.atan2(to_goal[1], to_goal[0])
        off_goal_rad = wrap_rad(goal_rad - vehicle.yaw_rad)
        following = self._bug.update(distance_m, off_goal_rad, observation.now_ns)
        if not following and self._must_turn_back(off_goal_rad, distance_m, vehicle, dt_s):
            return self._search(observation, profile.near_limit_m, dt_s)
        choice = self._choose(profile, obstacles, observation, goal_rad, distance_m)
        if choice is None:
            right = self._bug.side < 0 if following else _right_is_freer(profile)
            self._start_searching(1.0 if right else -1.0, math.inf)
            return self._search(observation, profile.near_limit_m, dt_s)
        return self._fly(choice, obstacles, observation, dt_s, to_goal)

    def _reset(self, vehicle: VehicleState) -> None:
        """Before the mission engages: set goal and height from the vehicle, and clear what was seen so far."""
        self._memory.clear()
        self._bug.reset()
        goal = self.parameters.goal
        cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
        self._goal_ned_m = (
            vehicle.p_ned_m[0] + goal.forward_m * cos - goal.right_m * sin,
            vehicle.p_ned_m[1] + goal.forward_m * sin + goal.right_m * cos,
        )
        self._heading_rad = vehicle.yaw_rad
        self._phase = Phase.FLY
        if self.parameters.height_m is None:
            self._height_m = vehicle.height_m if math.isfinite(vehicle.height_m) else -vehicle.p_ned_m[2]

    def _obstacles(self, profile: ObstacleProfile, observation: Observation) -> Array:
        """Return obstacle points (N, 2) relative to the vehicle, metres; unknown bins count as obstacles.

        An unknown bin ends where memory or its occluder ends the space known to be free, at UNSEEN_M at least.
        """
        points = [self._memory.points_ned_m]
        reach_m = self.parameters.reach_m
        bins = np.nonzero(wide_runs(profile.unknown, MIN_UNKNOWN_BINS))[0]
        if bins.size:
            ranges = np.fmax(self._memory.seen_free_m(profile, bins, UNSEEN_M, reach_m), profile.behind_m[bins])
            bins, ranges = bins[ranges < reach_m], ranges[ranges < reach_m]
            angle = profile.azimuth_rad[bins]
            x = profile.origin_ned_m[0] + ranges * np.cos(angle)
            y = profile.origin_ned_m[1] + ranges * np.sin(angle)
            points.append(np.stack([x, y], axis=1))
        return np.asarray(np.concatenate(points) - np.array(observation.vehicle.p_ned_m[:2]))

    def _half_width_m(self, margin_m: float, baseline_m: float) -> float:
        return self.craft.footprint.width_m(baseline_m) / 2 + margin_m

    def _choose(
        self,
        profile: ObstacleProfile,
        obstacles: Array,
        observation: Observation,
        goal_rad: float,
        distance_m: float,
    ) -> Choice | None:
        """Return the heading between free and goal direction, or None when nothing in view is free."""
        parameters = self.parameters
        reach = min(parameters.reach_m, profile.trust_m)
        headings = profile.azimuth_rad[EDGE_BINS:-EDGE_BINS]
        for margin_m in (parameters.margin_m, parameters.tight_margin_m):
            half_width = self._half_width_m(margin_m, observation.baseline_m)
            free = free_distance_m(obstacles, headings, half_width, reach)
            if free.max() >= parameters.safe_m + OPEN_BEYOND_M:
                break
        else:
            return None
        clipped_goal = _clip(goal_rad, headings)
        z_goal = float(free_distance_m(obstacles, np.array([clipped_goal]), half_width, reach)[0])
        if z_goal >= distance_m and abs(wrap_rad(clipped_goal - goal_rad)) < IN_VIEW_RAD:
            self._bug.end(observation.now_ns)
        if self._bug.side:
            best = self._bug.heading(headings, free)
            return Choice(float(headings[best]), half_width, float(free[best]))
        progress = self._progress_m(headings, free, goal_rad, distance_m)
        free_rad = float(headings[int(np.argmax(np.where(free >= parameters.safe_m, progress, -np.inf)))])
        weight = self._weight(z_goal, observation.reserve_m) if z_goal < min(reach, distance_m) else 0.0
        heading = clipped_goal + weight * wrap_rad(free_rad - clipped_goal)
        z_close = float(free_distance_m(obstacles, np.array([heading]), half_width, reach)[0])
        z_free = float(free_distance_m(obstacles, np.array([free_rad]), half_width, reach)[0])
        if z_close < min(OPEN_SHARE * reach, distance_m, z_free):
            heading, z_close = free_rad, z_free
        return Choice(heading, half_width, z_close)

    def _progress_m(self, headings: Array, free_m: Array, goal_rad: float, distance_m: float) -> Array:
        """Return (M,) what each heading is worth in metres: progress towards the goal less the cost of turning."""
        capped = np.minimum(free_m, max(distance_m, 1.0))
        off_goal = np.abs(wrapped_rad(headings - goal_rad))
        off_course = np.abs(wrapped_rad(headings - self._heading_rad))
        progress = capped * np.cos(np.minimum(off_goal, math.pi / 2) * GOAL_ANGLE_SCALE)
        return np.asarray(progress - COURSE_WEIGHT_M_RAD * off_course - GOAL_WEIGHT_M_RAD * off_goal)

    def _weight(self, z_close_m: float, reserve_m: float) -> float:
        """Return the weight w of the free direction, 0 (far) to 1 (close), w = tanh(Z_0 / (2 Z)).

        The paper's logistic (section V-A) runs from 1/2 to 1 and takes 1/Z without a unit; this is the same rescaled
        to 0..1 with a length Z_0. `weight: paper` is the printed form.
        """
        rule = self.parameters.weight
        if rule == "paper":
            return 1.0 / (1.0 + math.exp(-1.0 / max(z_close_m, 1e-3)))
        z0_m = max(STOPPING_FACTOR * reserve_m, WEIGHT_Z0_M) if rule == "stopping" else float(rule)
        return math.tanh(z0_m / (2.0 * max(z_close_m, 1e-3)))

    def _fly(
        self,
        choice: Choice,
        obstacles: Array,
        observation: Observation,
        dt_s: float,
        to_goal: tuple[float, float],
    ) -> MissionCommand:
        vehicle, period_s, heading = observation.vehicle, self.craft.frame_period_s, choice.heading_rad
        self._phase = Phase.FLY
        vx, vy, _ = vehicle.v_ned_m_s
        speed = math.hypot(vx, vy)
        course = math.atan2(vy, vx) if speed > MOVING_M_S else heading
        turn = self._turn.step(wrap_rad(heading - course), dt_s, low=-MAX_TURN_RAD, high=MAX_TURN_RAD)
        command_rad = course + turn if speed > MOVING_M_S else heading
        margin_m = path_margin_m(self.parameters.tight_margin_m, period_s)
        half_width = self._half_width_m(margin_m, observation.baseline_m)
        reach = self.parameters.reach_m
        drift_m = reach
        if speed > MOVING_M_S:
            drift_m = float(free_distance_m(obstacles, np.array([course]), half_width, reach)[0])
        wanted = min(
            self.parameters.speed_m_s,
            ARRIVE_M_S + ARRIVE_1_S * math.hypot(*to_goal),
            goal_approach_m_s(to_goal, course, period_s),
        )
        facing = math.cos(min(math.pi / 2, FACING_SCALE * abs(wrap_rad(heading - vehicle.yaw_rad))))
        wanted *= max(MIN_FACING, facing)
        direction = np.array([math.cos(command_rad), math.sin(command_rad)])
        braking_s = min(observation.braking_m, reach) / max(speed, SPEED_FLOOR_M_S)
        manoeuvre = Turn(np.array([vx, vy]), wanted * direction, braking_s, period_s)
        wanted *= feasible_speed_share(obstacles, manoeuvre, half_width)
        self._heading_rad = heading
        self._update_z_close(choice.z_close_m, dt_s)
        return self._command(
            observation,
            Decision(
                Intent.FLY,
                v_ned_m_s=(wanted * math.cos(command_rad), wanted * math.sin(command_rad), 0.0),
                yaw_rad=heading,
                clear_m=min(choice.z_close_m, drift_m),
                z_close_m=choice.z_close_m,
                detail={"heading_rad": heading, "drift_m": drift_m, "half_width_m": choice.half_width_m},
            ),
        )

    def _must_turn_back(self, off_goal_rad: float, distance_m: float, vehicle: VehicleState, dt_s: float) -> bool:
        """Return whether to turn back towards a goal that lies behind.

        A detour may lead away for `_detour_m`, less when the goal is near and was just missed; each turn back without
        progress doubles it, so that the next attempt leaves a pocket further.
        """
        if self._phase is Phase.SEARCH and math.isfinite(self._search_left_rad):
            return self._search_left_rad > 0.0
        if distance_m < self._best_m - PROGRESS_M:
            self._best_m, self._detour_m = distance_m, FIRST_DETOUR_M
        if abs(off_goal_rad) < GOAL_BEHIND_RAD:
            self._flown_away_m = 0.0
            return False
        self._flown_away_m += math.hypot(vehicle.v_ned_m_s[0], vehicle.v_ned_m_s[1]) * dt_s
        if self._flown_away_m < self._detour_m * min(1.0, distance_m / SHORT_DETOUR_FROM_M):
            return False
        self._flown_away_m, self._detour_m = 0.0, 2.0 * self._detour_m
        self._start_searching(math.copysign(1.0, off_goal_rad), abs(off_goal_rad) - GOAL_BEHIND_RAD / 2)
        return True

    def _start_searching(self, sign: float, turn_rad: float) -> None:
        if self._phase is not Phase.SEARCH:
            self._phase, self._search_sign, self._search_left_rad = Phase.SEARCH, sign, turn_rad

    def _search(self, observation: Observation, near_limit_m: float, dt_s: float) -> MissionCommand:
        """Stop and yaw, to find a free direction or back towards the goal."""
        rate = math.radians(self.parameters.look_rate_deg_s)
        self._search_left_rad -= rate * dt_s
        self._heading_rad = observation.vehicle.yaw_rad
        self._update_z_close(near_limit_m, dt_s)
        yaw_rad = wrap_rad(observation.vehicle.yaw_rad + self._search_sign * rate)
        return self._command(
            observation, Decision(Intent.STOP, Reason.NO_FREE_PATH, yaw_rad=yaw_rad, z_close_m=self._z_close_m)
        )

    def _update_z_close(self, z_close_m: float, dt_s: float) -> None:
        """Low-pass Z_close, from which the baseline is taken."""
        smoothing = self.parameters.baseline_smoothing_s
        if math.isnan(self._z_close_m) or smoothing <= 0.0:
            self._z_close_m = z_close_m
        else:
            self._z_close_m += (z_close_m - self._z_close_m) * (1.0 - math.exp(-dt_s / smoothing))

    def _command(self, observation: Observation, decision: Decision) -> MissionCommand:
        baseline_m = baseline_law(self._z_close_m, self.parameters.baseline_gain, self.craft.baseline_range_m)
        return self._commands.build(observation, replace(decision, height_m=self._height_m, baseline_m=baseline_m))


def _right_is_freer(profile: ObstacleProfile) -> bool:
    left, right = np.array_split(np.minimum(profile.range_m, profile.trust_m), 2)
    return float(right.mean()) >= float(left.mean())


def _clip(goal_rad: float, headings: Array) -> float:
    """Return the goal direction, or the edge of the view nearest to it."""
    middle = float(headings[len(headings) // 2])
    half = float(headings[-1] - headings[0]) / 2
    return middle + max(-half, min(half, wrap_rad(goal_rad - middle)))
