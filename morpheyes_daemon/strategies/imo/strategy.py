"""The moving-object mission: find it, track it in 3D, set the baseline by its depth, and observe, pursue or dodge.

The paper's section V-C: tracklets clustered by motion and depth, b = K median(Z_IMO). `perceive` keeps the tracklets
and tracks between frames (in the vision worker); `decide` keeps where the mission engaged and what the object was
last known to do (in the loop).
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
from morpheyes_daemon.strategies.imo.behaviours import (
    Behaviour,
    Dodge,
    ObjectState,
    Observe,
    Pursue,
    encounter,
    pursuit_velocity,
    way_out,
)
from morpheyes_daemon.strategies.imo.tracker import ObjectTracker
from morpheyes_daemon.strategies.obstacles.corridor import free_distance_m
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile, obstacle_profile
from morpheyes_daemon.transforms import Array, R_from_rpy, wrap_rad

TURN_RAD, TURNED_RAD = math.radians(6.0), math.radians(2.0)
"""Turning starts when the object is further off the image's middle than the first and ends at the second: turning
between the two exposures shifts the right image, so a still camera measures better."""

CLIMB_RAD = math.radians(7.0)
"""Height follows when the object is further above or below the image's middle than this."""

TRUST_M = 12.0
"""How far ahead the way is looked at for obstacles."""


class ImoParameters(StrategyParameters):
    """What `parameters:` of a moving-object mission may say."""

    behaviour: Behaviour = Observe()
    duration_s: float = Field(60.0, gt=0, le=3600, description="the mission is done after this")
    baseline_gain: float = Field(0.04, gt=0, le=1, description="K of b = K median(Z_IMO)")
    coast_s: float = Field(2.0, ge=0, le=30, description="an object out of sight is expected back for so long")
    speed_m_s: float = Field(1.5, gt=0.1, le=10, description="never wanted faster; the governor is the real bound")
    height_m: tuple[float, float] = Field((1.0, 2.5), description="lowest and highest flying height")
    free_radius_m: float = Field(
        0.0, ge=0, le=50, description="room around the place of engaging that the pilot knows to be free"
    )
    band_margin_m: float = Field(0.20, ge=0, le=3, description="room kept above and below")
    margin_m: float = Field(0.30, ge=0, le=3, description="room kept to obstacles on each side")

    @model_validator(mode="after")
    def _ordered(self) -> ImoParameters:
        low_m, high_m = self.height_m
        if not 0.3 < low_m <= high_m <= 20.0:
            raise ValueError("height_m must be the lowest and then the highest flying height, from 0.3 to 20 m")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class ImoPercept:
    """What one frame showed: the object, if any, how many tracklets stand and how many move, and the way ahead."""

    track: Track | None
    standing: int
    moving: int
    profile: ObstacleProfile


class Imo(Strategy):
    """See the module."""

    Parameters = ImoParameters
    parameters: ImoParameters

    def __init__(self, parameters: ImoParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._finder = ObjectTracker(parameters.coast_s)
        self._began_ns = 0
        self._home_ned_m: Array = np.zeros(3)
        self._yaw_rad: float | None = None
        self._height_m: float | None = None
        self._depth_m = math.nan
        self._seq = 0

    def perceive(self, view: View) -> ImoPercept:
        """Return the track and the obstacles ahead."""
        track = self._finder.step(view)
        band_m = self.craft.footprint.hull_height_mm / 2e3 + self.parameters.band_margin_m
        tracklets = self._finder.tracklets
        standing = int(tracklets.static.sum())
        return ImoPercept(track, standing, len(tracklets.uvd) - standing, obstacle_profile(view, band_m, TRUST_M))

    def track(self, percept: Any) -> Track | None:
        """Return the object of a percept."""
        found: ImoPercept = percept
        return found.track

    def decide(self, observation: Observation) -> MissionCommand:
        """Return velocity, heading, height and baseline until the next frame."""
        percept: ImoPercept = observation.percept
        vehicle = observation.vehicle
        if not observation.engaged or not self._began_ns:
            self._settle(observation)
        thing = None
        if percept.track is not None:
            self._depth_m = percept.track.p_rect_m[2]
            thing = _now(percept.track, observation.now_ns)
            self._face(thing, vehicle)
        if (observation.now_ns - self._began_ns) / S > self.parameters.duration_s:
            return self._command(observation, Intent.DONE, np.zeros(2), 0.0)
        velocity = self._velocity(thing, observation)
        speed = float(np.linalg.norm(velocity))
        if speed > self.parameters.speed_m_s:
            velocity = velocity * (self.parameters.speed_m_s / speed)
        return self._command(observation, Intent.FLY, velocity, self._clear_m(velocity, percept.profile, observation))

    def _settle(self, observation: Observation) -> None:
        """Before the mission engages, home, heading and height follow the vehicle."""
        vehicle = observation.vehicle
        self._began_ns = observation.now_ns
        self._home_ned_m = np.array(vehicle.p_ned_m)
        self._yaw_rad = vehicle.yaw_rad
        self._height_m = vehicle.height_m if math.isfinite(vehicle.height_m) else -vehicle.p_ned_m[2]

    def _face(self, thing: ObjectState, vehicle: VehicleState) -> None:
        """Turn and climb so that the object stays in the middle of the image, or near enough."""
        R = R_from_rpy(vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)
        eye = np.array(vehicle.p_ned_m) + R @ self.craft.T_frd_rig[:3, 3]
        to = thing.p_ned_m - eye
        bearing = math.atan2(to[1], to[0])
        turning = self._yaw_rad is not None and abs(wrap_rad(self._yaw_rad - vehicle.yaw_rad)) > TURNED_RAD
        if turning or abs(wrap_rad(bearing - vehicle.yaw_rad)) > TURN_RAD:
            self._yaw_rad = bearing
        range_m = math.hypot(to[0], to[1])
        axis_rad = math.asin(float(np.clip(-(self.craft.T_frd_rig[:3, 2])[2], -1.0, 1.0)))
        elevation = math.atan2(-to[2], range_m)
        if abs(elevation - axis_rad) > CLIMB_RAD and self._height_m is not None:
            low, high = self.parameters.height_m
            wanted = -thing.p_ned_m[2] - range_m * math.tan(axis_rad) + self.craft.T_frd_rig[2, 3]
            self._height_m = min(max(float(wanted), low), high)

    def _velocity(self, thing: ObjectState | None, observation: Observation) -> Array:
        """Return the horizontal velocity (2,) that the behaviour wants."""
        behaviour, place = self.parameters.behaviour, np.array(observation.vehicle.p_ned_m)
        if isinstance(behaviour, Observe):
            return self._swaying(behaviour, observation, place) if behaviour.sway_m else np.zeros(2)
        if isinstance(behaviour, Pursue):
            return pursuit_velocity(thing, place, behaviour) if thing is not None else np.zeros(2)
        return self._dodging(behaviour, thing, observation, place)

    def _swaying(self, behaviour: Observe, observation: Observation, place: Array) -> Array:
        rate = 2 * math.pi / behaviour.sway_period_s
        phase = rate * (observation.now_ns - self._began_ns) / S
        yaw = observation.vehicle.yaw_rad
        across = np.array([-math.sin(yaw), math.cos(yaw)])
        amplitude = behaviour.sway_m
        target = self._home_ned_m[:2] + amplitude * math.sin(phase) * across
        return np.asarray(0.8 * (target - place[:2]) + amplitude * rate * math.cos(phase) * across)

    def _dodging(self, behaviour: Dodge, thing: ObjectState | None, observation: Observation, place: Array) -> Array:
        """Out of the way while something comes too near, home again when nothing does."""
        home = self._home_ned_m[:2] - place[:2]
        back = 0.5 * home if np.linalg.norm(home) > 0.3 else np.zeros(2)
        if thing is None:
            return np.asarray(back)
        need = self.craft.footprint.width_m(observation.baseline_m) / 2 + thing.radius_m + behaviour.margin_m
        passing = encounter(thing, place, behaviour.horizon_s)
        if passing is not None and passing.distance_m < need + behaviour.sigmas * passing.spread_m:
            return way_out(passing, thing) * self.parameters.speed_m_s
        at_home = encounter(thing, self._home_ned_m, 3.0 * behaviour.horizon_s)
        threatened = at_home is not None and at_home.distance_m < need + behaviour.sigmas * at_home.spread_m
        return np.zeros(2) if threatened else np.asarray(back)

    def _clear_m(self, velocity: Array, profile: ObstacleProfile, observation: Observation) -> float:
        """Return how far the way along `velocity` is known to be free: seen to be, or said to be by the pilot."""
        if float(np.linalg.norm(velocity)) < 1e-3:
            return 0.0
        place = np.array(observation.vehicle.p_ned_m[:2])
        heading = math.atan2(velocity[1], velocity[0])
        return max(self._told_free_m(place, heading), self._seen_free_m(place, heading, profile, observation))

    def _told_free_m(self, place: Array, heading: float) -> float:
        """Return the way to the edge of the circle that the pilot vouches for."""
        radius = self.parameters.free_radius_m
        from_home = place - self._home_ned_m[:2]
        along = float(from_home @ np.array([math.cos(heading), math.sin(heading)]))
        inside = radius**2 - float(from_home @ from_home) + along**2
        return max(0.0, math.sqrt(inside) - along) if inside > 0.0 else 0.0

    def _seen_free_m(self, place: Array, heading: float, profile: ObstacleProfile, observation: Observation) -> float:
        """Return how far a corridor as wide as the vehicle is free; nothing outside the view, or where it is unknown."""
        offset = np.abs([wrap_rad(float(angle) - heading) for angle in profile.azimuth_rad])
        nearest = int(np.argmin(offset))
        if offset[nearest] > math.radians(3.0) or profile.unknown[nearest] or not 2 < nearest < len(offset) - 3:
            return 0.0
        half_width = self.craft.footprint.width_m(observation.baseline_m) / 2 + self.parameters.margin_m
        free = free_distance_m(profile.points_ned_m - place, np.array([heading]), half_width, profile.trust_m)
        return float(free[0])

    def _command(self, observation: Observation, intent: Intent, velocity: Array, clear_m: float) -> MissionCommand:
        self._seq += 1
        track = observation.percept.track
        return MissionCommand(
            seq=self._seq,
            t_ns=observation.now_ns,
            expires_ns=observation.now_ns + round(3 * self.craft.frame_period_s * S),
            intent=intent,
            reason=Reason.GOAL_REACHED if intent is Intent.DONE else None,
            v_ned_m_s=(float(velocity[0]), float(velocity[1]), 0.0),
            yaw_rad=self._yaw_rad,
            height_m=self._height_m,
            baseline_m=baseline_law(self._depth_m, self.parameters.baseline_gain, self.craft.baseline_range_m),
            clear_m=clear_m,
            measured_ns=observation.vehicle.position_t_ns,
            p_measured_ned_m=observation.vehicle.p_ned_m,
            z_close_m=self._depth_m,
            detail={} if track is None else {"object_seen": float(track.seen), "object_m": track.p_rect_m[2]},
        )


def _now(track: Track, now_ns: int) -> ObjectState:
    """Carry a track on to the present."""
    dt_s = max(0.0, (now_ns - track.t_ns) / S)
    v = np.array(track.v_ned_m_s)
    return ObjectState(np.array(track.p_ned_m) + dt_s * v, v, track.covariance, track.radius_m)
