"""Turn feasibility: how fast a turn may be flown by a vehicle that takes a second to reach a new velocity.

Places are (N, 2) north and east of the vehicle in metres, velocities (2,) in m/s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.transforms import Array, wrap_rad

RESPONSE_S = 0.7
"""Time constant with which Loiter reaches a wanted velocity: 90 % of a step after 1.5 s, 2.3 time constants.

Source: measured, `pytest tests/unit/control/test_velocity.py::test_steps_rise_in_time_without_overshoot`."""

MAX_TURN_RAD = 0.9
"""Largest turn of the course by one command.

Chosen: a larger one swings around beyond the new heading, a smaller one turns in several steps."""

PATH_SAMPLES = 12
"""Number of samples along the predicted path. Unit: samples.

Chosen: 0.1 m apart at 3 m/s and 5 Hz; more cost time in the event loop."""

BRAKING_FROM_SAMPLE = 4
"""First sample from which braking is checked. Unit: samples.

Chosen: before it a command does not show in the course yet; braking there would follow the old course anyway."""

PREDICTED_PERIODS = 2.0
"""Length of the predicted path. Unit: frame periods.

Chosen: until the next command can take effect, latency included."""

SPEED_SHARES = (1.0, 0.7, 0.45, 0.25, 0.0)
"""Shares of the wanted velocity that are tried, the largest first. Unit: none.

Chosen: steps of about 0.6; finer ones cost time in the event loop."""

BETTER_M = 0.02
"""Gain of clearance for which a slower share is preferred where none is clear.

Chosen: less than the obstacle cells resolve; zero would stop for a millimetre."""

MIN_MARGIN_SHARE = 0.5
"""Smallest share of the tight margin kept on the predicted path. Unit: none.

Chosen: the share is the frame period in seconds, since longer ones have larger prediction errors; at 5 Hz 75 mm."""


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """A change of velocity: present (2,) and wanted (2,), m/s north and east, and what bounds it in time.

    `braking_s` is the braking distance over the speed, `frame_period_s` the time between decisions.
    """

    v_m_s: Array
    wanted_m_s: Array
    braking_s: float
    frame_period_s: float


def path_margin_m(tight_margin_m: float, frame_period_s: float) -> float:
    """Return the margin kept on the predicted path; more for long frame periods, whose predictions err more."""
    return tight_margin_m * min(1.0, max(MIN_MARGIN_SHARE, frame_period_s))


def goal_approach_m_s(to_goal_m: tuple[float, float], course_rad: float, frame_period_s: float) -> float:
    """Return the largest speed at which the turn onto the goal is narrow enough not to circle around it."""
    rate_rad_s = MAX_TURN_RAD / (PREDICTED_PERIODS * frame_period_s + RESPONSE_S)
    off_rad = min(math.pi / 2, abs(wrap_rad(math.atan2(to_goal_m[1], to_goal_m[0]) - course_rad)))
    return rate_rad_s * math.hypot(*to_goal_m) / (2.0 * max(0.01, math.sin(off_rad)))


def feasible_speed_share(obstacles_m: Array, turn: Turn, half_width_m: float) -> float:
    """Return the largest share of the wanted velocity that stays clear until the next decision, 0 to 1 (unitless).

    obstacles_m: (N, 2) metres north and east of the vehicle; `half_width_m` is the clearance needed. The velocity
    changes over a second, so the path to a new heading is curved: at long frame periods it leaves the corridors of both
    the old and the new course. At each sample the vehicle must also be able to brake. Where no share is clear, the one
    with the most clearance is returned.
    """
    t = np.linspace(0.0, 1.0, PATH_SAMPLES)[:, None] * PREDICTED_PERIODS * turn.frame_period_s
    kept = np.exp(-t / RESPONSE_S)
    best, best_clearance_m = 0.0, -math.inf
    for share in SPEED_SHARES:
        v = share * turn.wanted_m_s
        path = t * v + RESPONSE_S * (1.0 - kept) * (turn.v_m_s - v)
        braking = turn.braking_s * (v + kept * (turn.v_m_s - v))
        braking[:BRAKING_FROM_SAMPLE] = 0.0
        clearance_m = _clearance_m(obstacles_m, path, braking)
        if clearance_m > half_width_m:
            return share
        if clearance_m > best_clearance_m + BETTER_M:
            best, best_clearance_m = share, clearance_m
    return best


def _clearance_m(obstacles: Array, path: Array, braking: Array) -> float:
    """Return the distance of obstacles (N, 2) to the segments that lead from a path (M, 2) along `braking` (M, 2)."""
    if not len(obstacles):
        return math.inf
    off = obstacles[:, None, :] - path
    length_2 = np.maximum((braking**2).sum(axis=1), 1e-12)
    share = np.clip((off * braking).sum(axis=2) / length_2, 0.0, 1.0)
    return float(np.linalg.norm(off - share[..., None] * braking, axis=2).min())
