"""Stopping distance after the sticks go neutral in Loiter, as a table made from the vehicle's own parameters.

The plant was identified on recorded stops (docs/decisions, 0006): dead time, lean angle as a critically damped second
order, drag, and a brake that starts LOIT_BRK_DELAY after the stick is neutral, with a square-root controller on speed
slewed at LOIT_BRK_JERK (AC_Loiter::calc_desired_velocity). Speeds only, no sticks.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

G_M_S2 = 9.80665
"""Standard gravity. Source: equation, g_n = 9.80665 m/s2 (ISO 80000-3)."""

DEAD_TIME_S = 0.02
"""Delay from override to attitude controller, identified on ArduCopter 4.7-dev SITL.

Source: measured, `pytest tests/unit/control/test_loiter.py::test_stopping_distance_is_the_measured_one`."""

LEAN_RAD_S = 1.0 / 0.075
"""Corner frequency of the lean response, identified together with the dead time.

Source: measured, `pytest tests/unit/control/test_loiter.py::test_stopping_distance_is_the_measured_one`."""

SPEED_STEP_M_S = 0.1
"""Spacing of the table.

Chosen: interpolation error against the size of the table; the table agrees with a slow plant to 2 %."""

MAX_SPEED_M_S = 10.0
"""Largest speed of the table.

Chosen: above every `max_speed_m_s` that the configuration allows; beyond it the last slope is extrapolated."""

_DT_S = 0.005
"""Step of the simulation.

Chosen: a fifteenth of the lean's time constant; smaller makes the table slower to compute."""

_LONGEST_STOP_S = 30.0
"""Longest simulated stop.

Chosen: several times a vehicle's longest stop; bounds the computation for implausible parameters."""

_SHORTEST_STOP_S = 0.5
"""Time before which the simulation does not end.

Chosen: longer than dead time and lean response, during which the speed may not have begun to fall."""

_STANDSTILL_M_S = 0.02
"""Speed that counts as standing.

Chosen: the distance still flown from it is below a centimetre."""


@dataclass(frozen=True, slots=True)
class Brake:
    """Loiter's brake: LOIT_BRK_* in SI units and half of the velocity controller's P gain."""

    accel_m_s2: float
    jerk_m_s3: float
    delay_s: float
    gain_1_s: float = 1.0


def braking_distances_m(
    speeds_m_s: NDArray[np.float64], limits_m_s: NDArray[np.float64], lean_max_rad: float, brake: Brake
) -> NDArray[np.float64]:
    """Return the distances (M, N), metres, from neutral sticks to standstill.

    From each of the speeds (N,), m/s, flown steadily until the sticks go neutral, under each of the speed limits (M,),
    m/s: LOIT_SPEED, or the lower limit that the flow sensor imposes. `lean_max_rad` is the lean of full stick.
    """
    limit, v = np.meshgrid(limits_m_s, speeds_m_s, indexing="ij")
    v = v.copy()
    drag_1_s = G_M_S2 * math.tan(lean_max_rad) / limit
    lean = np.arctan(np.minimum(1.0, v / limit) * math.tan(lean_max_rad))
    wanted, rate = lean.copy(), np.zeros_like(v)
    braking, distance = np.zeros_like(v), np.zeros_like(v)
    for step in range(round(_LONGEST_STOP_S / _DT_S)):
        t_s = step * _DT_S
        if t_s >= DEAD_TIME_S:
            wanted = np.zeros_like(v)
        target = np.minimum(brake.accel_m_s2, _square_root_controller(v, brake.gain_1_s, brake.jerk_m_s3))
        target = target if t_s >= DEAD_TIME_S + brake.delay_s else np.zeros_like(v)
        braking += np.clip(target - braking, -brake.jerk_m_s3 * _DT_S, brake.jerk_m_s3 * _DT_S)
        rate += (LEAN_RAD_S**2 * (wanted - lean) - 2.0 * LEAN_RAD_S * rate) * _DT_S
        lean += rate * _DT_S
        v = np.maximum(0.0, v + (G_M_S2 * np.tan(lean) - drag_1_s * v - braking) * _DT_S)
        distance += v * _DT_S
        if t_s > _SHORTEST_STOP_S and float(v.max()) < _STANDSTILL_M_S:
            break
    return distance


def _square_root_controller(v: NDArray[np.float64], gain_1_s: float, limit_m_s2: float) -> NDArray[np.float64]:
    """ArduPilot's sqrt_controller for v >= 0: linear near zero, constant deceleration of the error beyond."""
    knee = limit_m_s2 / gain_1_s**2
    return np.where(v > knee, np.sqrt(np.maximum(0.0, 2.0 * limit_m_s2 * (v - knee / 2.0))), v * gain_1_s)


class StoppingTable:
    """Braking distance over speed for several speed limits; both look-ups take a few microseconds."""

    def __init__(self, limits_m_s: list[float], lean_max_rad: float, brake: Brake) -> None:
        speeds = np.arange(0.0, MAX_SPEED_M_S + SPEED_STEP_M_S / 2, SPEED_STEP_M_S)
        rows = braking_distances_m(speeds, np.array(limits_m_s), lean_max_rad, brake)
        self._limits = limits_m_s
        self._rows: list[list[float]] = [[float(d) for d in np.maximum.accumulate(row)] for row in rows]

    def distance_m(self, speed_m_s: float, limit_m_s: float, reaction_s: float) -> float:
        """Return the distance to standstill, metres, when the sticks go neutral `reaction_s` from now.

        Beyond MAX_SPEED_M_S the last slope of the table is extrapolated.
        """
        speed_m_s = abs(speed_m_s)
        position = speed_m_s / SPEED_STEP_M_S
        k = min(int(position), len(self._rows[0]) - 2)
        low, high, share = self._between(limit_m_s)
        at = [(1.0 - share) * low[i] + share * high[i] for i in (k, k + 1)]
        return at[0] + (position - k) * (at[1] - at[0]) + speed_m_s * reaction_s

    def speed_m_s(self, distance_m: float, limit_m_s: float, reaction_s: float) -> float:
        """Return the largest speed, at most MAX_SPEED_M_S, whose stopping distance is at most `distance_m`."""
        if not distance_m > 0.0:
            return 0.0
        low, high, share = self._between(limit_m_s)

        def needed(i: int) -> float:
            return (1.0 - share) * low[i] + share * high[i] + i * SPEED_STEP_M_S * reaction_s

        k = bisect_right(range(len(low)), distance_m, key=needed) - 1
        if k >= len(low) - 1:
            return MAX_SPEED_M_S
        below, above = needed(k), needed(k + 1)
        return (k + (distance_m - below) / (above - below)) * SPEED_STEP_M_S

    def _between(self, limit_m_s: float) -> tuple[list[float], list[float], float]:
        """Return the rows of the limits below and above a speed limit, and the weight of the upper one."""
        i = min(bisect_right(self._limits, limit_m_s), len(self._limits) - 1)
        j = max(0, i - 1)
        span = self._limits[i] - self._limits[j]
        share = (limit_m_s - self._limits[j]) / span if span > 0.0 else 1.0
        return self._rows[j], self._rows[i], max(0.0, min(1.0, share))
