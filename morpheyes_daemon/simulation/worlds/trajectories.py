"""How things in a world move: poses as pure functions of time, from a few numbers and a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from pydantic import Field

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.transforms import Array, R_from_rpy, pose

PoseAt = Callable[[float], Array]
"""T_ned_object (4, 4) at world time in seconds."""

CHECKED_S = np.arange(0.0, 600.0, 0.05)
"""Times over which the fastest moment of irregular motion is looked for."""


class Motion(Section):
    """Swaying about a place: sideways, up and down, and turning about the vertical."""

    kind: Literal["none", "periodic", "irregular"] = "none"
    sideways_m: float = Field(0.0, ge=0, le=3, description="amplitude along y")
    vertical_m: float = Field(0.0, ge=0, le=1, description="amplitude along z")
    peak_speed_m_s: float = Field(0.5, gt=0, le=3, description="at the fastest moment")
    turn_deg: float = Field(0.0, ge=0, le=45, description="amplitude about the vertical")
    turn_period_s: float = Field(8.0, ge=1, le=120)


def swaying(motion: Motion, place_ned_m: Array, seed: int) -> PoseAt:
    """Return the pose of something that sways about a place as `motion` says."""
    rng = np.random.default_rng([seed, 400])
    amplitude = np.array([motion.sideways_m, motion.vertical_m])
    phase = float(rng.uniform(0, 2 * math.pi))
    turn_phase = float(rng.uniform(0, 2 * math.pi))
    shift = _irregular(rng, amplitude) if motion.kind == "irregular" else _ellipse(amplitude, phase)
    rate = motion.peak_speed_m_s / max(_peak_speed(shift), 1e-9)

    def T_ned_object(t_s: float) -> Array:
        if motion.kind == "none":
            return pose(np.eye(3), place_ned_m)
        yaw = math.radians(motion.turn_deg) * math.sin(2 * math.pi * t_s / motion.turn_period_s + turn_phase)
        y, z = shift(np.array([rate * t_s]))[0]
        return pose(R_from_rpy(0.0, 0.0, yaw), place_ned_m + np.array([0.0, y, z]))

    return T_ned_object


Shift = Callable[[Array], Array]
"""Displacement (n, 2) along y and z at times (n,)."""


def _ellipse(amplitude: Array, phase: float) -> Shift:
    return lambda t: amplitude * np.stack([np.sin(t + phase), np.cos(t + phase)], axis=-1)


def _irregular(rng: np.random.Generator, amplitude: Array) -> Shift:
    """Sum a few incommensurate waves; the largest displacement is the amplitude."""
    rates = np.array([1.0, 1.618, 2.303, 0.443, 3.117]) * rng.uniform(0.85, 1.15, 5)
    weights = rng.uniform(0.4, 1.0, (2, 5)) / rates
    phases = rng.uniform(0, 2 * math.pi, (2, 5))

    def raw(t: Array) -> Array:
        return np.asarray((weights * np.sin(t[:, None, None] * rates + phases)).sum(axis=-1))

    largest = np.abs(raw(CHECKED_S)).max(axis=0)
    return lambda t: amplitude * raw(t) / largest


def _peak_speed(shift: Shift) -> float:
    step = CHECKED_S[1] - CHECKED_S[0]
    return float(np.linalg.norm(np.diff(shift(CHECKED_S), axis=0), axis=1).max() / step)


def along_waypoints(waypoints: Array, spin_rad_s: float) -> PoseAt:
    """Return the pose of something that passes (t_s, x, y, height) smoothly, turning, and rests at both ends.

    Between waypoints a cubic Hermite spline with finite-difference tangents; before the first and after the last it
    stands still.
    """
    t, p = waypoints[:, 0], waypoints[:, 1:] * (1.0, 1.0, -1.0)
    tangent = np.gradient(p, t, axis=0)

    def T_ned_object(t_s: float) -> Array:
        now = min(max(t_s, float(t[0])), float(t[-1]))
        k = min(int(np.searchsorted(t, now, side="right")) - 1, len(t) - 2)
        h = t[k + 1] - t[k]
        s = (now - t[k]) / h
        place = (
            (1 + 2 * s) * (1 - s) ** 2 * p[k] + s * (1 - s) ** 2 * h * tangent[k]
            + s * s * (3 - 2 * s) * p[k + 1] + s * s * (s - 1) * h * tangent[k + 1]
        )  # fmt: skip
        return pose(R_from_rpy(0.3, 0.2, spin_rad_s * now), np.asarray(place))

    return T_ned_object
