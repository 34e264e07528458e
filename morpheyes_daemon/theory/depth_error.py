"""What a baseline buys: the error of a depth, and the depths between which it can be trusted (paper, section II).

Pure formulas for planning and figures; the error of a real depth map, with everything that adds to it, is
`stereo.depth.depth_sigma`.
"""

from __future__ import annotations


def depth_error_m(z_m: float, baseline_m: float, f_px: float, disparity_error_px: float) -> float:
    """Return eps_z = z^2 eps_d / (b f), the paper's first equation."""
    return z_m**2 * disparity_error_px / (baseline_m * f_px)


def farthest_m(baseline_m: float, f_px: float, disparity_error_px: float, relative_error: float) -> float:
    """Return the depth up to which eps_z / z stays within `relative_error`."""
    return relative_error * baseline_m * f_px / disparity_error_px


def nearest_m(baseline_m: float, f_px: float, num_disparities: int) -> float:
    """Return Z_min = b f / numDisparities, nearer than which nothing can be matched (paper-notes 11)."""
    return baseline_m * f_px / num_disparities
