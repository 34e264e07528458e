"""Forest flight: to the goal between the trees (paper, section V-A, with paper-notes 4 to 11).

The free direction v_free and the goal direction v_g are weighted by how close the nearest obstacle of the corridor
is; a PID turns the velocity towards the result; the vehicle stops where the corridor closes within tau_safe, looks
around by yaw, and goes on towards free space. The baseline follows K Z_close. How fast it goes is the governor's.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.control.baseline import baseline_for
from morpheyes_daemon.control.pid import Pid, PidGains
from morpheyes_daemon.messages.core import Intent, MissionCommand, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import Craft, Strategy, StrategyParameters, View
from morpheyes_daemon.strategies.forest.bug_algorithm import BugAlgorithm
from morpheyes_daemon.strategies.forest.obstacle_memory import ObstacleMemory
from morpheyes_daemon.strategies.forest.turn_feasibility import MOST_TURN_RAD, homing_m_s, slim_margin_m, turnable_share
from morpheyes_daemon.strategies.obstacles.corridor import free_distance_m
from morpheyes_daemon.strategies.obstacles.polar_profile import Floats, ObstacleProfile, obstacle_profile, wide_runs
from morpheyes_daemon.transforms import wrap_rad


class Goal(Section):
    """Where to go, from where and in the heading in which the mission engaged."""

    forward_m: float = Field(80.0, ge=-10000, le=10000)
    right_m: float = Field(0.0, ge=-10000, le=10000)


class ForestParameters(StrategyParameters):
    """What `parameters:` of a forest mission may say."""

    goal: Goal = Goal()
    goal_radius_m: float = Field(1.5, gt=0.2, le=20, description="the goal counts as reached within this")
    height_m: float | None = Field(None, gt=0.3, le=20, description="None: the height at which it engaged")
    speed_m_s: float = Field(5.0, gt=0.1, le=10, description="never wanted faster; the governor is the real bound")
    baseline_gain: float = Field(0.02, gt=0, le=1, description="K of b = K Z_close")
    baseline_smoothing_s: float = Field(0.5, ge=0, le=10, description="time constant of the low-passed Z_close")
    margin_m: float = Field(0.30, ge=0, le=3, description="room kept to obstacles on each side")
    tight_margin_m: float = Field(0.15, ge=0, le=3, description="room kept where nothing wider is free")
    band_margin_m: float = Field(0.20, ge=0, le=3, description="room kept above and below")
    safe_m: float = Field(0.4, ge=0, le=10, description="tau_safe: stop when the corridor closes within this")
    memory_s: float = Field(6.0, ge=0, le=60, description="how long obstacles out of view are remembered")
    reach_m: float = Field(16.0, gt=1, le=100, description="how far ahead directions are compared")
    weight: Literal["stopping", "paper"] | float = Field(
        "stopping", description="Z_0 of the weight: twice the stopping distance, the paper's printed form, or metres"
    )
    turn_gains: tuple[float, float, float] = Field((1.2, 0.0, 0.05), description="kp, ki, kd on the heading error")
    look_rate_deg_s: float = Field(35.0, gt=1, le=90, description="yaw rate when looking around")

    @model_validator(mode="after")
    def _ordered(self) -> ForestParameters:
        if self.tight_margin_m > self.margin_m:
            raise ValueError("tight_margin_m must not be greater than margin_m")
        if self.reach_m < self.safe_m + OPEN_BEYOND_M:
            raise ValueError(f"reach_m must be at least {OPEN_BEYOND_M:g} m more than safe_m, or no direction is free")
        return self


ASTRAY_RAD = math.radians(75.0)
"""A goal further off the nose than this lies behind."""

FIRST_DETOUR_M = 4.0
"""Flown away from the goal before turning back for the first time; in proportion less from `DETOUR_FROM_M` on."""
DETOUR_FROM_M = 8.0

OPEN_SHARE = 0.6
"""A heading is open when it is free for this share of what is compared. It does not shrink with the speed: a slow
vehicle would find a heading into a tree good enough, and stay slow."""

OPEN_BEYOND_M = 0.6
"""A direction is worth flying in when it is free for so much more than `safe_m`."""

UNSEEN_M = 2.0
"""Where something is taken to stand in a direction of which nothing at all is known."""


IN_VIEW_RAD = 1e-6
"""The goal is in view when clipping to the view leaves its direction as it is, but for rounding and whole turns."""


class Phase(StrEnum):
    """What the decider is doing."""

    FLY = "fly"
    LOOK = "look"
    DONE = "done"


class Forest(Strategy):
    """See the module."""

    Parameters = ForestParameters
    parameters: ForestParameters

    def __init__(self, parameters: ForestParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._memory = ObstacleMemory(max(parameters.memory_s, 10 * craft.frame_period_s))
        self._turn = Pid(PidGains(*parameters.turn_gains))
        self._goal_ned_m: tuple[float, float] | None = None
        self._height_m = parameters.height_m
        self._phase = Phase.FLY
        self._z_close_m = math.nan
        self._last_ns = 0
        self._heading_rad = 0.0
        self._look_sign = 1.0
        self._look_left_rad = 0.0
        self._best_m = math.inf
        self._detour_m = FIRST_DETOUR_M
        self._strayed_m = 0.0
        self._around = BugAlgorithm()
        self._seq = 0

    def perceive(self, view: View) -> ObstacleProfile:
        """Return the obstacle profile at flying height, as far as the depth is believed."""
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
            self._settle(vehicle)
        self._memory.add(profile)
        dt_s = min(2.0, max(1e-3, (observation.now_ns - self._last_ns) / S)) if self._last_ns else 0.2
        self._last_ns = observation.now_ns
        assert self._goal_ned_m is not None
        to_goal = (self._goal_ned_m[0] - vehicle.p_ned_m[0], self._goal_ned_m[1] - vehicle.p_ned_m[1])
        distance_m = math.hypot(*to_goal)
        if self._phase is Phase.DONE or distance_m < self.parameters.goal_radius_m:
            self._phase = Phase.DONE
            return self._stop(observation, Intent.DONE, Reason.GOAL_REACHED)
        obstacles = self._obstacles(profile, observation)
        goal_rad = math.atan2(to_goal[1], to_goal[0])
        off_goal_rad = wrap_rad(goal_rad - vehicle.yaw_rad)
        around = self._around.update(distance_m, off_goal_rad, observation.now_ns)
        if not around and self._astray(off_goal_rad, distance_m, vehicle, dt_s):
            return self._look(observation, profile.near_limit_m, dt_s)
        choice = self._choose(profile, obstacles, observation, goal_rad, distance_m)
        if choice is None:
            right = self._around.side < 0 if around else _right_is_freer(profile)
            self._start_looking(1.0 if right else -1.0, math.inf)
            return self._look(observation, profile.near_limit_m, dt_s)
        return self._fly(choice, obstacles, observation, dt_s, to_goal)

    def _settle(self, vehicle: VehicleState) -> None:
        """Before the mission engages: goal and height follow the vehicle, and what the climb showed is forgotten."""
        self._memory.clear()
        self._around.reset()
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

    def _obstacles(self, profile: ObstacleProfile, observation: Observation) -> Floats:
        """Every known obstacle point (N, 2) relative to the vehicle; what was never seen to be free counts as one."""
        points = [self._memory.points_ned_m]
        reach_m = self.parameters.reach_m
        bins = np.nonzero(wide_runs(profile.unknown, 3))[0]
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
        obstacles: Floats,
        observation: Observation,
        goal_rad: float,
        distance_m: float,
    ) -> tuple[float, float, float] | None:
        """Return (heading, corridor half width, Z_close along it), or None when nothing in view is free."""
        parameters = self.parameters
        reach = min(parameters.reach_m, profile.trust_m)
        headings = profile.azimuth_rad[3:-3]
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
            self._around.end(observation.now_ns)
        if self._around.side:
            best = self._around.heading(headings, free)
            return float(headings[best]), half_width, float(free[best])
        capped = np.minimum(free, max(distance_m, 1.0))
        off_goal = np.abs(_wrapped(headings - goal_rad))
        off_course = np.abs(_wrapped(headings - self._heading_rad))
        progress = capped * np.cos(np.minimum(off_goal, math.pi / 2) * 0.8) - 0.8 * off_course - 0.5 * off_goal
        free_rad = float(headings[int(np.argmax(np.where(free >= parameters.safe_m, progress, -np.inf)))])
        weight = self._weight(z_goal, observation.reserve_m) if z_goal < min(reach, distance_m) else 0.0
        heading = clipped_goal + weight * wrap_rad(free_rad - clipped_goal)
        z_close = float(free_distance_m(obstacles, np.array([heading]), half_width, reach)[0])
        z_free = float(free_distance_m(obstacles, np.array([free_rad]), half_width, reach)[0])
        if z_close < min(OPEN_SHARE * reach, distance_m, z_free):
            heading, z_close = free_rad, z_free
        return heading, half_width, z_close

    def _weight(self, z_close_m: float, reserve_m: float) -> float:
        """Weight of the free direction, 0 (far) to 1 (close); paper-notes 5."""
        rule = self.parameters.weight
        if rule == "paper":
            return 1.0 / (1.0 + math.exp(-1.0 / max(z_close_m, 1e-3)))
        z0_m = max(2.0 * reserve_m, 4.0) if rule == "stopping" else float(rule)
        return math.tanh(z0_m / (2.0 * max(z_close_m, 1e-3)))

    def _fly(
        self,
        choice: tuple[float, float, float],
        obstacles: Floats,
        observation: Observation,
        dt_s: float,
        to_goal: tuple[float, float],
    ) -> MissionCommand:
        heading, half_width, z_close = choice
        vehicle, period_s = observation.vehicle, self.craft.frame_period_s
        self._phase = Phase.FLY
        vx, vy, _ = vehicle.v_ned_m_s
        speed = math.hypot(vx, vy)
        course = math.atan2(vy, vx) if speed > 0.5 else heading
        turn = self._turn.step(wrap_rad(heading - course), dt_s, low=-MOST_TURN_RAD, high=MOST_TURN_RAD)
        command_rad = course + turn if speed > 0.5 else heading
        slim = self._half_width_m(slim_margin_m(self.parameters.tight_margin_m, period_s), observation.baseline_m)
        reach = self.parameters.reach_m
        drift = float(free_distance_m(obstacles, np.array([course]), slim, reach)[0]) if speed > 0.5 else reach
        clear = min(z_close, drift)
        wanted = min(self.parameters.speed_m_s, 0.3 + 0.8 * math.hypot(*to_goal), homing_m_s(to_goal, course, period_s))
        facing = math.cos(min(math.pi / 2, 1.5 * abs(wrap_rad(heading - vehicle.yaw_rad))))
        wanted *= max(0.15, facing)
        way = np.array([math.cos(command_rad), math.sin(command_rad)])
        braking_s = min(observation.braking_m, reach) / max(speed, 1.0)
        wanted *= turnable_share(obstacles, np.array([vx, vy]), wanted * way, slim, braking_s, period_s)
        self._heading_rad = heading
        self._follow(z_close, dt_s)
        return self._command(
            observation,
            Intent.FLY,
            None,
            (wanted * math.cos(command_rad), wanted * math.sin(command_rad), 0.0),
            heading,
            clear,
            z_close,
            {"heading_rad": heading, "drift_m": drift, "half_width_m": half_width},
        )

    def _astray(self, off_goal_rad: float, distance_m: float, vehicle: VehicleState, dt_s: float) -> bool:
        """Tell whether it is time to turn back towards a goal that lies behind.

        A detour may lead away for `_detour_m`, less when the goal is near and was merely missed; each turn back that
        brings the goal no nearer doubles it, so that a pocket is left on a wider way the next time.
        """
        if self._phase is Phase.LOOK and math.isfinite(self._look_left_rad):
            return self._look_left_rad > 0.0
        if distance_m < self._best_m - 2.0:
            self._best_m, self._detour_m = distance_m, FIRST_DETOUR_M
        if abs(off_goal_rad) < ASTRAY_RAD:
            self._strayed_m = 0.0
            return False
        self._strayed_m += math.hypot(vehicle.v_ned_m_s[0], vehicle.v_ned_m_s[1]) * dt_s
        if self._strayed_m < self._detour_m * min(1.0, distance_m / DETOUR_FROM_M):
            return False
        self._strayed_m, self._detour_m = 0.0, 2.0 * self._detour_m
        self._start_looking(math.copysign(1.0, off_goal_rad), abs(off_goal_rad) - ASTRAY_RAD / 2)
        return True

    def _start_looking(self, sign: float, how_far_rad: float) -> None:
        if self._phase is not Phase.LOOK:
            self._phase, self._look_sign, self._look_left_rad = Phase.LOOK, sign, how_far_rad

    def _look(self, observation: Observation, near_limit_m: float, dt_s: float) -> MissionCommand:
        """Stand still and turn, to find a free direction or back towards the goal."""
        rate = math.radians(self.parameters.look_rate_deg_s)
        self._look_left_rad -= rate * dt_s
        self._heading_rad = observation.vehicle.yaw_rad
        self._follow(near_limit_m, dt_s)
        yaw_rad = wrap_rad(observation.vehicle.yaw_rad + self._look_sign * rate)
        return self._command(
            observation, Intent.STOP, Reason.NO_FREE_PATH, (0.0, 0.0, 0.0), yaw_rad, 0.0, self._z_close_m, {}
        )

    def _stop(self, observation: Observation, intent: Intent, reason: Reason) -> MissionCommand:
        return self._command(observation, intent, reason, (0.0, 0.0, 0.0), None, 0.0, self._z_close_m, {})

    def _follow(self, z_close_m: float, dt_s: float) -> None:
        """Low-pass Z_close, which the baseline follows."""
        smoothing = self.parameters.baseline_smoothing_s
        if math.isnan(self._z_close_m) or smoothing <= 0.0:
            self._z_close_m = z_close_m
        else:
            self._z_close_m += (z_close_m - self._z_close_m) * (1.0 - math.exp(-dt_s / smoothing))

    def _command(
        self,
        observation: Observation,
        intent: Intent,
        reason: Reason | None,
        v_ned_m_s: tuple[float, float, float],
        yaw_rad: float | None,
        clear_m: float,
        z_close_m: float,
        detail: dict[str, float],
    ) -> MissionCommand:
        self._seq += 1
        return MissionCommand(
            seq=self._seq,
            t_ns=observation.now_ns,
            expires_ns=observation.now_ns + round(3 * self.craft.frame_period_s * S),
            intent=intent,
            reason=reason,
            v_ned_m_s=v_ned_m_s,
            yaw_rad=yaw_rad,
            height_m=self._height_m,
            baseline_m=baseline_for(self._z_close_m, self.parameters.baseline_gain, self.craft.baseline_range_m),
            clear_m=clear_m,
            measured_ns=observation.vehicle.position_t_ns,
            p_measured_ned_m=observation.vehicle.p_ned_m,
            z_close_m=z_close_m,
            detail=detail,
        )


def _right_is_freer(profile: ObstacleProfile) -> bool:
    left, right = np.array_split(np.minimum(profile.range_m, profile.trust_m), 2)
    return float(right.mean()) >= float(left.mean())


def _wrapped(angle_rad: Floats) -> Floats:
    return np.asarray((angle_rad + math.pi) % (2 * math.pi) - math.pi)


def _clip(goal_rad: float, headings: Floats) -> float:
    """The goal direction, or the edge of the view nearest to it."""
    middle = float(headings[len(headings) // 2])
    half = float(headings[-1] - headings[0]) / 2
    return middle + max(-half, min(half, wrap_rad(goal_rad - middle)))
