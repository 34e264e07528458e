"""Uncertainty of a solve: its covariance propagated to the baseline and to the disparity.

The disparity bias at infinity is also given as an equivalent yaw (yaw and principal points are hardly separable, but
only their joint effect reaches the depth). Model errors, such as a board that is not flat, are not included.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.calibration.solver.bundle_adjustment import CAMERA_UNKNOWNS, POSE_UNKNOWNS
from morpheyes_daemon.calibration.solver.projection import CAMERA_PARAMETERS, camera_from_vector
from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry, infinity_px
from morpheyes_daemon.calibration.solver.solver import Calibration
from morpheyes_daemon.transforms import Array, R_from_rotvec, pose

_STEP = 1e-2
"""Step of the numeric derivative, in sigmas; chosen: small enough to be linear, large against rounding."""


@dataclass(frozen=True)
class BaselineUncertainty:
    """One sigma each at one baseline: true baseline, disparity at infinity, and that as a yaw."""

    length_m: float
    disparity_px: float
    yaw_rad: float


def baseline_uncertainty(calibration: Calibration, index: int) -> BaselineUncertainty:
    """Return the uncertainty of the true baseline and of the disparity at infinity at the baseline of an index.

    First-order propagation of the covariance, J C J^T.
    """
    solution = calibration.solution
    columns = np.concatenate(
        [np.arange(CAMERA_UNKNOWNS), CAMERA_UNKNOWNS + POSE_UNKNOWNS * index + np.arange(POSE_UNKNOWNS)]
    )
    covariance = solution.covariance[np.ix_(columns, columns)]
    values = solution.state.shared[columns]
    true = _geometry(values, calibration.observations.size)
    bias = _derivative(values, covariance, lambda v: _bias_px(v, true, calibration.observations.size))
    direction = values[CAMERA_UNKNOWNS + 3 :] / np.linalg.norm(values[CAMERA_UNKNOWNS + 3 :])
    length = float(np.sqrt(direction @ covariance[CAMERA_UNKNOWNS + 3 :, CAMERA_UNKNOWNS + 3 :] @ direction))
    sigma_px = float(np.sqrt(bias @ covariance @ bias))
    return BaselineUncertainty(length, sigma_px, sigma_px / true.f_px)


def camera_uncertainty(calibration: Calibration) -> tuple[dict[str, float], dict[str, float]]:
    """Return one sigma per parameter of the left and of the right camera."""
    sigma = np.sqrt(np.diag(calibration.solution.covariance)[:CAMERA_UNKNOWNS]).reshape(2, -1)
    left, right = (dict(zip(CAMERA_PARAMETERS, map(float, values), strict=True)) for values in sigma)
    return left, right


def _geometry(values: Array, size: tuple[int, int]) -> StereoGeometry:
    T_cam0_cam1 = pose(R_from_rotvec(values[CAMERA_UNKNOWNS : CAMERA_UNKNOWNS + 3]), values[CAMERA_UNKNOWNS + 3 :])
    return StereoGeometry(camera_from_vector(values[:10], size), camera_from_vector(values[10:20], size), T_cam0_cam1)


def _bias_px(values: Array, true: StereoGeometry, size: tuple[int, int]) -> float:
    return float(np.mean(infinity_px(_geometry(values, size), true)))


def _derivative(values: Array, covariance: Array, function: Callable[[Array], float]) -> Array:
    steps = _STEP * np.sqrt(np.diag(covariance))
    slopes = np.zeros(len(values))
    for i, step in enumerate(steps):
        shift = np.zeros(len(values))
        shift[i] = step
        slopes[i] = (function(values + shift) - function(values - shift)) / (2 * step)
    return slopes
