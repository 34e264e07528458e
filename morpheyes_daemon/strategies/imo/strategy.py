"""Moving-object mission: tracks the object in 3D, sets the baseline by its depth, and observes, pursues or dodges it.

The paper's section V-C: tracklets clustered by motion and depth, b = K median(Z_IMO). `perceive` keeps tracklets and
tracks between frames (in the vision worker); `decide` keeps where the mission engaged and the object's last depth (in
the event loop).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.clock import S
from morpheyes_daemon.control.baseline import baseline_law
from morpheyes_daemon.messages.core import Intent, MissionCommand, Track, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import Craft, Strategy, StrategyParameters, View
from morpheyes_daemon.strategies.command import CommandBuilder, Decision
from morpheyes_daemon.strategies.imo.behaviours import (
    Behaviour,
    Dodge,
    ObjectState,
    Observe,
    Pursue,
    closest_approach,
    evasion_direction,
    pursuit_velocity,
)
from morpheyes_daemon.strategies.imo.tracker import ObjectTracker
from morpheyes_daemon.strategies.obstacles.corridor import free_distance_m
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile, obstacle_profile
from morpheyes_daemon.transforms import Array, R_from_rpy, wrap_rad

TURN_RAD, TURNED_RAD = math.radians(6.0), math.radians(2.0)
"""Angle of the object off the image's centre at which yawing starts, and yaw error at which it ends.

Chosen: rotation between the two exposures shifts the right image, so a camera that does not rotate measures better."""

CLIMB_RAD = math.radians(7.0)
"""Angle of the object above or below the image's centre from which the height follows.

Chosen: a third of the vertical field of view; smaller climbs all the time."""

TRUST_M = 12.0
"""Range up to which obstacles ahead are used.

Chosen: more than a stop from `speed_m_s` needs; farther adds obstacles with large depth errors."""

SWAY_GAIN_1_S, RETURN_GAIN_1_S = 0.8, 0.5
"""Gains towards the swaying target, and back to the home position after dodging.

Chosen: as the velocity loop can follow; higher overshoots."""

HOME_M = 0.3
"""Distance from the home position from which the vehicle returns to it.

Chosen: above the drift of the position estimate."""

HOME_HORIZON = 3.0
"""Time for which an object's approach to the home position is predicted, in horizons of the behaviour. Unit: none.

Chosen: longer waits beside paths that change, shorter returns into the path."""

MIN_SPEED_M_S = 1e-3
"""Speed below which the velocity has no direction.

Chosen: only avoids a division by zero."""

VIEW_TOLERANCE_RAD, EDGE_BINS = math.radians(3.0), 2
"""Largest angle to the nearest azimuth bin, and bins at each edge of the view, outside of which nothing is seen free.

Unit: rad, bins. Chosen: five bins; a corridor at the edge lies half outside the view."""


class ImoParameters(StrategyParameters):
    """The keys of `parameters:` in a moving-object mission."""

    behaviour: Behaviour = Observe()
    duration_s: float = Field(60.0, gt=0, le=3600, description="time after which the mission is done")
    baseline_gain: float = Field(0.04, gt=0, le=1, description="K of b = K median(Z_IMO)")
    coast_s: float = Field(2.0, ge=0, le=30, description="time for which an object without detection is predicted")
    speed_m_s: float = Field(1.5, gt=0.1, le=10, description="largest speed wanted; the governor bounds it further")
    height_m: tuple[float, float] = Field((1.0, 2.5), description="lowest and highest flying height above ground")
    free_radius_m: float = Field(
        0.0, ge=0, le=50, description="radius around the position of engaging that the pilot knows to be free"
    )
    band_margin_m: float = Field(0.20, ge=0, le=3, description="margin above and below")
    margin_m: float = Field(0.30, ge=0, le=3, description="margin to obstacles on each side")

    @model_validator(mode="after")
    def _ordered(self) -> ImoParameters:
        low_m, high_m = self.height_m
        if not 0.3 < low_m <= high_m <= 20.0:
            raise ValueError("height_m must be the lowest and then the highest flying height, from 0.3 to 20 m")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class ImoPercept:
    """What one frame shows: the track, if any, the number of static and of moving tracklets, and the obstacles."""

    track: Track | None
    standing: int
    moving: int
    profile: ObstacleProfile


class Imo(Strategy):
    """The moving-object mission; see the module."""

    Parameters = ImoParameters
    parameters: ImoParameters

    def __init__(self, parameters: ImoParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._tracker = ObjectTracker(parameters.coast_s)
        self._began_ns = 0
        self._home_ned_m: Array = np.zeros(3)
        self._yaw_rad: float | None = None
        self._height_m: float | None = None
        self._depth_m = math.nan
        self._commands = CommandBuilder(craft.frame_period_s)

    def perceive(self, view: View) -> ImoPercept:
        """Return the track and the obstacles ahead."""
        track = self._tracker.step(view)
        band_m = self.craft.footprint.hull_height_mm / 2e3 + self.parameters.band_margin_m
        tracklets = self._tracker.tracklets
        static = int(tracklets.static.sum())
        return ImoPercept(track, static, len(tracklets.uvd) - static, obstacle_profile(view, band_m, TRUST_M))

    def track(self, percept: Any) -> Track | None:
        """Return the track of a percept, None without one."""
        found: ImoPercept = percept
        return found.track

    def decide(self, observation: Observation) -> MissionCommand:
        """Return velocity, heading, height and baseline until the next frame."""
        percept: ImoPercept = observation.percept
        vehicle = observation.vehicle
        if not observation.engaged or not self._began_ns:
            self._reset(observation)
        moving = None
        if percept.track is not None:
            self._depth_m = percept.track.p_rect_m[2]
            moving = _predicted(percept.track, observation.now_ns)
            self._face(moving, vehicle)
        if (observation.now_ns - self._began_ns) / S > self.parameters.duration_s:
            return self._command(observation, Intent.DONE, np.zeros(2), 0.0)
        velocity = self._velocity(moving, observation)
        speed = float(np.linalg.norm(velocity))
        if speed > self.parameters.speed_m_s:
            velocity = velocity * (self.parameters.speed_m_s / speed)
        return self._command(observation, Intent.FLY, velocity, self._clear_m(velocity, percept.profile, observation))

    def _reset(self, observation: Observation) -> None:
        """Before the mission engages: set home position, heading and height from the vehicle."""
        vehicle = observation.vehicle
        self._began_ns = observation.now_ns
        self._home_ned_m = np.array(vehicle.p_ned_m)
        self._yaw_rad = vehicle.yaw_rad
        self._height_m = vehicle.height_m if math.isfinite(vehicle.height_m) else -vehicle.p_ned_m[2]

    def _face(self, moving: ObjectState, vehicle: VehicleState) -> None:
        """Set yaw and height so that the object stays near the centre of the image."""
        R = R_from_rpy(vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)
        camera = np.array(vehicle.p_ned_m) + R @ self.craft.T_frd_rig[:3, 3]
        to = moving.p_ned_m - camera
        bearing = math.atan2(to[1], to[0])
        turning = self._yaw_rad is not None and abs(wrap_rad(self._yaw_rad - vehicle.yaw_rad)) > TURNED_RAD
        if turning or abs(wrap_rad(bearing - vehicle.yaw_rad)) > TURN_RAD:
            self._yaw_rad = bearing
        range_m = math.hypot(to[0], to[1])
        axis_rad = math.asin(float(np.clip(-(self.craft.T_frd_rig[:3, 2])[2], -1.0, 1.0)))
        elevation = math.atan2(-to[2], range_m)
        if abs(elevation - axis_rad) > CLIMB_RAD and self._height_m is not None:
            low, high = self.parameters.height_m
            wanted = -moving.p_ned_m[2] - range_m * math.tan(axis_rad) + self.craft.T_frd_rig[2, 3]
            self._height_m = min(max(float(wanted), low), high)

    def _velocity(self, moving: ObjectState | None, observation: Observation) -> Array:
        """Return the horizontal velocity (2,), ned m/s, that the behaviour wants."""
        behaviour, position = self.parameters.behaviour, np.array(observation.vehicle.p_ned_m)
        if isinstance(behaviour, Observe):
            return self._sway_velocity(behaviour, observation, position) if behaviour.sway_m else np.zeros(2)
        if isinstance(behaviour, Pursue):
            return pursuit_velocity(moving, position, behaviour) if moving is not None else np.zeros(2)
        return self._dodge_velocity(behaviour, moving, observation, position)

    def _sway_velocity(self, behaviour: Observe, observation: Observation, position: Array) -> Array:
        rate = 2 * math.pi / behaviour.sway_period_s
        phase = rate * (observation.now_ns - self._began_ns) / S
        yaw = observation.vehicle.yaw_rad
        across = np.array([-math.sin(yaw), math.cos(yaw)])
        amplitude = behaviour.sway_m
        target = self._home_ned_m[:2] + amplitude * math.sin(phase) * across
        return np.asarray(SWAY_GAIN_1_S * (target - position[:2]) + amplitude * rate * math.cos(phase) * across)

    def _dodge_velocity(
        self, behaviour: Dodge, moving: ObjectState | None, observation: Observation, position: Array
    ) -> Array:
        """Return the velocity (2,): out of the object's path while it comes too near, else back to the home position."""
        home = self._home_ned_m[:2] - position[:2]
        back = RETURN_GAIN_1_S * home if np.linalg.norm(home) > HOME_M else np.zeros(2)
        if moving is None:
            return np.asarray(back)
        clearance_m = self.craft.footprint.width_m(observation.baseline_m) / 2 + moving.radius_m + behaviour.margin_m
        approach = closest_approach(moving, position, behaviour.horizon_s)
        if approach is not None and approach.distance_m < clearance_m + behaviour.sigmas * approach.spread_m:
            return evasion_direction(approach, moving) * self.parameters.speed_m_s
        at_home = closest_approach(moving, self._home_ned_m, HOME_HORIZON * behaviour.horizon_s)
        threatened = at_home is not None and at_home.distance_m < clearance_m + behaviour.sigmas * at_home.spread_m
        return np.zeros(2) if threatened else np.asarray(back)

    def _clear_m(self, velocity: Array, profile: ObstacleProfile, observation: Observation) -> float:
        """Return the distance along `velocity` that is known to be free: seen, or declared by `free_radius_m`."""
        if float(np.linalg.norm(velocity)) < MIN_SPEED_M_S:
            return 0.0
        position = np.array(observation.vehicle.p_ned_m[:2])
        heading = math.atan2(velocity[1], velocity[0])
        return max(self._declared_free_m(position, heading), self._seen_free_m(position, heading, profile, observation))

    def _declared_free_m(self, position: Array, heading: float) -> float:
        """Return the distance to the edge of the circle that the pilot declared free."""
        radius = self.parameters.free_radius_m
        from_home = position - self._home_ned_m[:2]
        along = float(from_home @ np.array([math.cos(heading), math.sin(heading)]))
        inside = radius**2 - float(from_home @ from_home) + along**2
        return max(0.0, math.sqrt(inside) - along) if inside > 0.0 else 0.0

    def _seen_free_m(self, position: Array, heading: float, profile: ObstacleProfile, observation: Observation) -> float:
        """Return the free distance of the vehicle's corridor; 0 outside the view and where depth is unknown."""
        offset = np.abs([wrap_rad(float(angle) - heading) for angle in profile.azimuth_rad])
        nearest = int(np.argmin(offset))
        inside = EDGE_BINS < nearest < len(offset) - 1 - EDGE_BINS
        if offset[nearest] > VIEW_TOLERANCE_RAD or profile.unknown[nearest] or not inside:
            return 0.0
        half_width = self.craft.footprint.width_m(observation.baseline_m) / 2 + self.parameters.margin_m
        free = free_distance_m(profile.points_ned_m - position, np.array([heading]), half_width, profile.trust_m)
        return float(free[0])

    def _command(self, observation: Observation, intent: Intent, velocity: Array, clear_m: float) -> MissionCommand:
        track = observation.percept.track
        decision = Decision(
            intent,
            Reason.GOAL_REACHED if intent is Intent.DONE else None,
            v_ned_m_s=(float(velocity[0]), float(velocity[1]), 0.0),
            yaw_rad=self._yaw_rad,
            height_m=self._height_m,
            baseline_m=baseline_law(self._depth_m, self.parameters.baseline_gain, self.craft.baseline_range_m),
            clear_m=clear_m,
            z_close_m=self._depth_m,
            detail={} if track is None else {"object_seen": float(track.seen), "object_m": track.p_rect_m[2]},
        )
        return self._commands.build(observation, decision)


def _predicted(track: Track, now_ns: int) -> ObjectState:
    """Return the track's state predicted to the present."""
    dt_s = max(0.0, (now_ns - track.t_ns) / S)
    v = np.array(track.v_ned_m_s)
    return ObjectState(np.array(track.p_ned_m) + dt_s * v, v, track.covariance, track.radius_m)
