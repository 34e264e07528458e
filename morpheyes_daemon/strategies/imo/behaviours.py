"""Behaviours towards a moving object: observe it, keep a set distance to it, or leave its predicted path.

Pure geometry in ned on the object's present state. Free distance and speed limits are decided elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.transforms import Array

MIN_SPEED_M_S, MIN_RANGE_M = 1e-3, 1e-3
"""Speed below which an object has no direction, and distance below which it has no line of sight.

Chosen: only avoid divisions by zero; far below what is measured."""


class Observe(Section):
    """Stay and keep the object in view; with `sway_m` move from side to side where the space is known to be free."""

    kind: Literal["observe"] = "observe"
    sway_m: float = Field(0.0, ge=0, le=3, description="amplitude of swaying across the line of sight; 0: hover")
    sway_period_s: float = Field(8.0, ge=2, le=60)


class Pursue(Section):
    """Keep a set distance to the object."""

    kind: Literal["pursue"]
    distance_m: float = Field(3.0, ge=1, le=30, description="from the camera to the visible face")
    gain_1_s: float = Field(0.8, gt=0, le=3, description="speed per metre of error")
    tolerance_m: float = Field(0.15, ge=0, le=3, description="error of the distance that is not corrected")

    @model_validator(mode="after")
    def _ordered(self) -> Pursue:
        if self.tolerance_m >= self.distance_m:
            raise ValueError("tolerance_m must be less than distance_m, or the vehicle never moves away from the object")
        return self


class Dodge(Section):
    """Stay until the object is about to come near, then leave its path, and return when it has passed."""

    kind: Literal["dodge"]
    margin_m: float = Field(0.5, ge=0.1, le=5, description="distance between hull and object")
    horizon_s: float = Field(4.0, ge=0.5, le=20, description="time for which paths are predicted")
    sigmas: float = Field(1.0, ge=0, le=5, description="sigmas of the predicted path that are added to the margin")


Behaviour = Annotated[Observe | Pursue | Dodge, Field(discriminator="kind")]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectState:
    """The object now: position (3,) and velocity (3,) in ned, their covariance (6, 6), and its radius."""

    p_ned_m: Array
    v_ned_m_s: Array
    covariance: Array
    radius_m: float

    def predicted_m(self, dt_s: float) -> Array:
        """Return the position (3,), ned metres, after `dt_s` at constant velocity."""
        return np.asarray(self.p_ned_m + dt_s * self.v_ned_m_s)

    def spread_m(self, dt_s: float) -> float:
        """Return the larger horizontal sigma of `predicted_m`, from the covariance of position and velocity."""
        P = self.covariance
        at = P[:3, :3] + dt_s * (P[:3, 3:] + P[3:, :3]) + dt_s**2 * P[3:, 3:]
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(at[:2, :2])[-1])))


@dataclass(frozen=True, slots=True)
class ClosestApproach:
    """When the object is nearest to a point, seconds from now, and the horizontal vector from it to the point then."""

    in_s: float
    offset_m: tuple[float, float]
    spread_m: float

    @property
    def distance_m(self) -> float:
        """Smallest horizontal distance."""
        return math.hypot(*self.offset_m)


def closest_approach(moving: ObjectState, point_ned_m: Array, horizon_s: float) -> ClosestApproach | None:
    """Return the object's closest approach to a point (3,), ned metres, within `horizon_s`; None when it recedes."""
    away = point_ned_m[:2] - moving.p_ned_m[:2]
    v = moving.v_ned_m_s[:2]
    speed2 = float(v @ v)
    if speed2 < MIN_SPEED_M_S**2 or float(away @ v) <= 0.0:
        return None
    in_s = min(float(away @ v) / speed2, horizon_s)
    offset = away - in_s * v
    return ClosestApproach(in_s, (float(offset[0]), float(offset[1])), moving.spread_m(in_s))


def pursuit_velocity(moving: ObjectState, camera_ned_m: Array, pursue: Pursue) -> Array:
    """Return the horizontal velocity (2,), ned m/s, that keeps the distance from the camera (3,), ned metres.

    The object's own velocity along the line of sight plus a gain times the error; across the line of sight the vehicle
    yaws instead of moving.
    """
    to = moving.p_ned_m[:2] - camera_ned_m[:2]
    range_m = float(np.linalg.norm(to))
    if range_m < MIN_RANGE_M:
        return np.zeros(2)
    along = to / range_m
    error_m = range_m - pursue.distance_m
    if abs(error_m) < pursue.tolerance_m:
        error_m = 0.0
    return np.asarray((float(moving.v_ned_m_s[:2] @ along) + pursue.gain_1_s * error_m) * along)


def evasion_direction(approach: ClosestApproach, moving: ObjectState) -> Array:
    """Return the horizontal unit vector (2,), unitless, across the object's path, to the side of the vehicle."""
    v = moving.v_ned_m_s[:2]
    across = np.array([-v[1], v[0]]) / max(float(np.linalg.norm(v)), MIN_SPEED_M_S)
    side = float(across @ np.array(approach.offset_m))
    return across if side >= 0.0 else -across
