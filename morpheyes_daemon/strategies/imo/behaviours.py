"""What to do about a moving object: watch it, keep a set distance to it, or leave its predicted path.

Pure geometry in ned, on what is known of the object at this moment. How far the way is free, and how fast it may be
flown, is decided elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.transforms import Array


class Observe(Section):
    """Stay, and keep the object in view; `sway_m` moves from side to side meanwhile, where the room is known free."""

    kind: Literal["observe"] = "observe"
    sway_m: float = Field(0.0, ge=0, le=3, description="amplitude of swaying across the line of sight; 0: hover")
    sway_period_s: float = Field(8.0, ge=2, le=60)


class Pursue(Section):
    """Keep a set distance to the object."""

    kind: Literal["pursue"]
    distance_m: float = Field(3.0, ge=1, le=30, description="kept from the camera to its visible face")
    gain_1_s: float = Field(0.8, gt=0, le=3, description="speed per metre of error")
    tolerance_m: float = Field(0.15, ge=0, le=3, description="within this the distance is right")

    @model_validator(mode="after")
    def _ordered(self) -> Pursue:
        if self.tolerance_m >= self.distance_m:
            raise ValueError("tolerance_m must be less than distance_m, or the object is never too near")
        return self


class Dodge(Section):
    """Stay until the object is about to come near, then step out of its way, and come back when it has passed."""

    kind: Literal["dodge"]
    margin_m: float = Field(0.5, ge=0.1, le=5, description="room between hull and object")
    horizon_s: float = Field(4.0, ge=0.5, le=20, description="how far ahead paths are predicted")
    sigmas: float = Field(1.0, ge=0, le=5, description="of the predicted path, added to the margin")


Behaviour = Annotated[Observe | Pursue | Dodge, Field(discriminator="kind")]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectState:
    """The object now: position (3,), velocity (3,) in ned, their covariance (6, 6), half its size."""

    p_ned_m: Array
    v_ned_m_s: Array
    covariance: Array
    radius_m: float

    def ahead(self, dt_s: float) -> Array:
        """Return where it will be (3,) when nothing changes."""
        return np.asarray(self.p_ned_m + dt_s * self.v_ned_m_s)

    def spread_m(self, dt_s: float) -> float:
        """Return one horizontal sigma of `ahead`: position, velocity, and what they have to do with each other."""
        P = self.covariance
        at = P[:3, :3] + dt_s * (P[:3, 3:] + P[3:, :3]) + dt_s**2 * P[3:, 3:]
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(at[:2, :2])[-1])))


@dataclass(frozen=True, slots=True)
class Encounter:
    """When (seconds from now) the object passes nearest to a place, and the horizontal way (2,) from it to the place."""

    in_s: float
    miss_m: tuple[float, float]
    spread_m: float

    @property
    def distance_m(self) -> float:
        """How near it comes."""
        return math.hypot(*self.miss_m)


def encounter(thing: ObjectState, place_ned_m: Array, horizon_s: float) -> Encounter | None:
    """Return the nearest passage of the object by a place (3,) within `horizon_s`; None when it does not come nearer."""
    away = place_ned_m[:2] - thing.p_ned_m[:2]
    v = thing.v_ned_m_s[:2]
    speed2 = float(v @ v)
    if speed2 < 1e-6 or float(away @ v) <= 0.0:
        return None
    in_s = min(float(away @ v) / speed2, horizon_s)
    miss = away - in_s * v
    return Encounter(in_s, (float(miss[0]), float(miss[1])), thing.spread_m(in_s))


def pursuit_velocity(thing: ObjectState, eye_ned_m: Array, pursue: Pursue) -> Array:
    """Return the horizontal velocity (2,) that holds the distance: the object's own along the line of sight, and a
    share of what is missing. Across the line of sight the vehicle turns instead of flying."""
    to = thing.p_ned_m[:2] - eye_ned_m[:2]
    range_m = float(np.linalg.norm(to))
    if range_m < 1e-3:
        return np.zeros(2)
    along = to / range_m
    error_m = range_m - pursue.distance_m
    if abs(error_m) < pursue.tolerance_m:
        error_m = 0.0
    return np.asarray((float(thing.v_ned_m_s[:2] @ along) + pursue.gain_1_s * error_m) * along)


def way_out(passing: Encounter, thing: ObjectState) -> Array:
    """Return the horizontal direction (2,) that leaves the object's path soonest: across it, to the side one is on."""
    v = thing.v_ned_m_s[:2]
    across = np.array([-v[1], v[0]]) / max(float(np.linalg.norm(v)), 1e-6)
    side = float(across @ np.array(passing.miss_m))
    return across if side >= 0.0 else -across
