"""How far and how fast a rig may move before the time between its cameras costs more than k pixels (paper, section II).

The right camera exposes dt after the left one, from where the rig is by then. The paper gives the case of moving away
from a point on the optical axis; paper-notes 4 derives the others. Pure formulas: distances v dt first, speeds after.
"""

from __future__ import annotations

import math


def receding_m(z_m: float, baseline_m: float, f_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z^2 / (b f - k Z), the paper's printed bound: backwards, on the axis; inf where d <= k."""
    margin = baseline_m * f_px - k_px * z_m
    return k_px * z_m**2 / margin if margin > 0.0 else math.inf


def approaching_m(z_m: float, baseline_m: float, f_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z^2 / (b f + k Z): forwards, on the axis."""
    return k_px * z_m**2 / (baseline_m * f_px + k_px * z_m)


def off_axis_m(z_m: float, baseline_m: float, f_px: float, half_width_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z / (W/2 + d + k): forwards, for every column of an image `2 * half_width_px` wide.

    A point at column u from the centre shifts by |d - u| v dt / (Z - v dt), most at the left edge.
    """
    return k_px * z_m / (half_width_px + baseline_m * f_px / z_m + k_px)


def sideways_m(z_m: float, f_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z / f: along the baseline, which the motion lengthens or shortens."""
    return k_px * z_m / f_px


def yaw_rad(f_px: float, k_px: float = 1.0) -> float:
    """Return w dt = k / f: turning about the vertical, on the axis."""
    return k_px / f_px


def sync_speed_bound_m_s(
    *, dt_s: float, baseline_m: float, z_m: float, f_px: float, k_px: float = 1.0, half_width_px: float = 0.0
) -> float:
    """Return the largest speed in any direction that keeps the disparity error within `k_px` over the whole image.

    No time between the cameras means no bound.
    """
    if dt_s <= 0.0:
        return math.inf
    forward = min(off_axis_m(z_m, baseline_m, f_px, half_width_px, k_px), approaching_m(z_m, baseline_m, f_px, k_px))
    return min(forward, sideways_m(z_m, f_px, k_px)) / dt_s
