"""Depth error of a baseline, and the range of depths in which it stays within a bound (paper, section II).

Pure formulas for planning and figures; the error of a real depth map, with all its terms, is
`stereo.depth.depth_sigma`.
"""

from __future__ import annotations


def depth_error_m(z_m: float, baseline_m: float, f_px: float, disparity_error_px: float) -> float:
    """Return eps_z = z^2 eps_d / (b f) in metres, the paper's first equation."""
    return z_m**2 * disparity_error_px / (baseline_m * f_px)


def farthest_m(baseline_m: float, f_px: float, disparity_error_px: float, relative_error: float) -> float:
    """Return the far end of the trusted range, metres: eps_z / z = `relative_error` (paper, section II)."""
    return relative_error * baseline_m * f_px / disparity_error_px


def nearest_m(baseline_m: float, f_px: float, num_disparities: int) -> float:
    """Return Z_min = b f / numDisparities, the near limit in metres (paper-notes 11)."""
    return baseline_m * f_px / num_disparities
