"""Turns of a vehicle that takes up a velocity over a second: how fast one may be flown, and what room it needs.

Places are (N, 2) north and east of the vehicle in metres, velocities (2,) in m/s.
"""

from __future__ import annotations

import math

import numpy as np

from morpheyes_daemon.strategies.obstacles.polar_profile import Floats
from morpheyes_daemon.transforms import wrap_rad

RESPONSE_S = 0.7
"""Time constant with which Loiter takes up a velocity."""

MOST_TURN_RAD = 0.9
"""A command turns the course by no more."""

POINTS = 12
"""The way that is looked ahead is looked at in so many."""

STEERED = 4
"""From so many of them on a command shows in the course; braking from before would follow the old one in any case."""


def slim_margin_m(tight_margin_m: float, frame_period_s: float) -> float:
    """Room kept on the way that is flown anyway; more with frames far apart, since forecasts of it err more."""
    return tight_margin_m * min(1.0, max(0.5, frame_period_s))


def homing_m_s(to_goal_m: tuple[float, float], course_rad: float, frame_period_s: float) -> float:
    """Return the speed at which the turn onto the goal is narrow enough not to circle around it."""
    rate_rad_s = MOST_TURN_RAD / (2.0 * frame_period_s + RESPONSE_S)
    off_rad = min(math.pi / 2, abs(wrap_rad(math.atan2(to_goal_m[1], to_goal_m[0]) - course_rad)))
    return rate_rad_s * math.hypot(*to_goal_m) / (2.0 * max(0.01, math.sin(off_rad)))


def turnable_share(
    obstacles_m: Floats,
    v_m_s: Floats,
    wanted_m_s: Floats,
    half_width_m: float,
    braking_s: float,
    frame_period_s: float,
) -> float:
    """Return which share of the wanted velocity keeps clear on the way to the next decision.

    A velocity changes over a second, so the way to a new heading bends: with frames far apart it leaves the corridors
    of both the old course and the new one, and points at what stands between them. It must be possible to stop before
    that, too: `braking_s` is the braking distance over the speed.
    """
    t = np.linspace(0.0, 1.0, POINTS)[:, None] * 2.0 * frame_period_s
    kept = np.exp(-t / RESPONSE_S)
    best, best_room = 0.0, -math.inf
    for share in (1.0, 0.7, 0.45, 0.25, 0.0):
        v = share * wanted_m_s
        path = t * v + RESPONSE_S * (1.0 - kept) * (v_m_s - v)
        braking = braking_s * (v + kept * (v_m_s - v))
        braking[:STEERED] = 0.0
        room = _room_m(obstacles_m, path, braking)
        if room > half_width_m:
            return share
        if room > best_room + 0.02:
            best, best_room = share, room
    return best


def _room_m(obstacles: Floats, path: Floats, ways: Floats) -> float:
    """Return how near any obstacle (N, 2) comes to the stretches (M, 2) that lead from a path (M, 2) by `ways`."""
    if not len(obstacles):
        return math.inf
    off = obstacles[:, None, :] - path
    length_2 = np.maximum((ways**2).sum(axis=1), 1e-12)
    share = np.clip((off * ways).sum(axis=2) / length_2, 0.0, 1.0)
    return float(np.linalg.norm(off - share[..., None] * ways, axis=2).min())
