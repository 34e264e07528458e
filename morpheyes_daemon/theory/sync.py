"""Bounds on the motion of a rig between its two exposures for a disparity error of k pixels (paper, section II).

The right camera exposes dt after the left one, from the position reached by then. The paper gives the case of moving
away from a point on the optical axis; paper-notes 4 derives the others. All distances v dt are in metres.
"""

from __future__ import annotations

import math


def receding_m(z_m: float, baseline_m: float, f_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z^2 / (b f - k Z): backwards, on the axis (paper, section II); inf where d <= k."""
    margin = baseline_m * f_px - k_px * z_m
    return k_px * z_m**2 / margin if margin > 0.0 else math.inf


def approaching_m(z_m: float, baseline_m: float, f_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z^2 / (b f + k Z): forwards, on the axis (paper-notes 4)."""
    return k_px * z_m**2 / (baseline_m * f_px + k_px * z_m)


def off_axis_m(z_m: float, baseline_m: float, f_px: float, half_width_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z / (W/2 + d + k): forwards, over an image `2 * half_width_px` wide (paper-notes 4).

    A point at column u from the centre shifts by |d - u| v dt / (Z - v dt), most at the left edge.
    """
    return k_px * z_m / (half_width_px + baseline_m * f_px / z_m + k_px)


def sideways_m(z_m: float, f_px: float, k_px: float = 1.0) -> float:
    """Return v dt = k Z / f: along the baseline, which the motion lengthens or shortens (paper-notes 4)."""
    return k_px * z_m / f_px


def yaw_rad(f_px: float, k_px: float = 1.0) -> float:
    """Return w dt = k / f in radians: yaw, for points on the axis (paper-notes 4)."""
    return k_px / f_px


def sync_speed_bound_m_s(
    *, dt_s: float, baseline_m: float, z_m: float, f_px: float, k_px: float = 1.0, half_width_px: float = 0.0
) -> float:
    """Return the largest speed, m/s, in any direction with a disparity error within `k_px` over the whole image.

    Minimum of the bounds above over `dt_s`; inf for `dt_s` <= 0.
    """
    if dt_s <= 0.0:
        return math.inf
    forward = min(off_axis_m(z_m, baseline_m, f_px, half_width_px, k_px), approaching_m(z_m, baseline_m, f_px, k_px))
    return min(forward, sideways_m(z_m, f_px, k_px)) / dt_s
