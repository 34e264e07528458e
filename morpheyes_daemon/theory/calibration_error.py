"""Pixel error by an error of one calibrated parameter: figures 2 and 3 and table I of the paper (section II).

Intrinsics go through the lens model of `stereo.intrinsics`, extrinsics through the rectifying homographies
H_L = K R_rect K^-1 and H_R = K R_rect R^T K^-1. One parameter is wrong at a time, without further distortion. The
statistic is the largest error over the image, at a corner: with it table I is reproduced (a mean gives a ratio of
2.67 for k3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rectify import homogeneous, rectifying_rotation
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array, R_from_rotvec

STATISTIC = "largest pixel error of the image"

WIDTH_PX = 128
SENSOR_MM = 4.24
FOCAL_LENGTHS_MM = (1.5, 2.0, 3.0, 4.0, 8.0, 16.0)
"""Image, sensor and lenses of the paper's figures 2 and 3."""

INTRINSIC = ("f", "alpha", "k1", "k2", "k3", "k5")
SWEPT = (*INTRINSIC, "k4")
"""Parameters of figure 2: the columns of table I, and k4, which the paper omits since it mirrors k3."""
EXTRINSIC = ("T", "phi", "theta", "psi")
"""The columns of table I: T is T_x; phi, theta, psi are rotations about x, y, z of the right camera."""

NOMINAL: Mapping[str, float] = {"alpha": 1e-3, "k1": -0.1, "k2": 0.02, "k3": 1e-3, "k4": 1e-3, "k5": 5e-3}
"""Values that errors in percent refer to; chosen, since the paper does not state them; table I does not depend on
them."""

GRID_POINTS = 65
"""Points per side of the grid of errors; chosen: the errors are smooth over 2 pixels."""

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5")
"""Names of the distortion coefficients in the paper's order."""

ERROR_PCT = 1.0
ERROR_DEG = 0.1
"""Errors (percent, degrees) at which table I is computed; chosen: small enough to act linearly."""


@dataclass(frozen=True, eq=False)
class CameraPair:
    """Two cameras to be analysed: lenses and relative pose.

    R_cam1_cam0 (3, 3) is the paper's R, right camera from left; t_cam0_cam1_m (3,) its T in metres.
    """

    cam0: CameraIntrinsics
    cam1: CameraIntrinsics
    R_cam1_cam0: Array
    t_cam0_cam1_m: Array


@dataclass(frozen=True)
class PixelError:
    """Largest error in x and y over the image, in pixels."""

    x_px: float
    y_px: float


def paper_lens(focal_mm: float) -> CameraIntrinsics:
    """Return the paper's camera: 128 x 128 px on a 4.24 mm sensor, without distortion."""
    f_px = focal_mm * WIDTH_PX / SENSOR_MM
    middle = (WIDTH_PX - 1) / 2
    return CameraIntrinsics(WIDTH_PX, WIDTH_PX, f_px, f_px, middle, middle)


def paper_pair(focal_mm: float) -> CameraPair:
    """Return the paper's rig for extrinsic errors: R = I, T = (200, 2, 2) mm (paper-notes 3), no distortion."""
    lens = paper_lens(focal_mm)
    return CameraPair(lens, lens, np.eye(3), np.array([0.200, 0.002, 0.002]))


def rig_pair(rig: RigModel, baseline_m: float) -> CameraPair:
    """Return a calibrated rig at a nominal baseline; raises CalibrationError outside its range."""
    T_cam0_cam1 = rig.T_cam0_cam1(baseline_m)
    return CameraPair(rig.cam0, rig.cam1, T_cam0_cam1[:3, :3].T, T_cam0_cam1[:3, 3])


def intrinsic_error(lens: CameraIntrinsics, name: str, error_pct: float) -> PixelError:
    """Return the largest pixel error when the parameter `name` is wrong by `error_pct` percent.

    Percent of the lens's own value, or of `NOMINAL` where that is zero (paper, figure 2).
    """
    xy = _ideal_grid(lens)
    right = _alone(lens, name, 1.0)
    wrong = _alone(lens, name, 1.0 + error_pct / 100.0)
    return _largest(wrong.pixels_from_normalised(xy) - right.pixels_from_normalised(xy))


def extrinsic_error(pair: CameraPair, name: str, error: float) -> tuple[PixelError, PixelError]:
    """Return the largest pixel errors in the left and the right rectified image (paper, figure 3).

    `error` is percent for T (that is T_x; T_y and T_z act alike), degrees for phi, theta, psi (R wrong by R_e).
    """
    R_wrong, t_wrong = pair.R_cam1_cam0, pair.t_cam0_cam1_m
    if name == "T":
        t_wrong = t_wrong * np.array([1.0 + error / 100.0, 1.0, 1.0])
    else:
        axis = np.eye(3)[("phi", "theta", "psi").index(name)]
        R_wrong = R_wrong @ R_from_rotvec(np.radians(error) * axis)
    true = _rectified(pair, pair.R_cam1_cam0, pair.t_cam0_cam1_m)
    wrong = _rectified(pair, R_wrong, t_wrong)
    return _largest(wrong[0] - true[0]), _largest(wrong[1] - true[1])


def table_1(lens: CameraIntrinsics, pair: CameraPair) -> dict[str, object]:
    """Return table I: e_y / e_x per intrinsic parameter, left / right error per extrinsic one, in x and in y."""
    intrinsic = {}
    for name in INTRINSIC:
        error = intrinsic_error(lens, name, ERROR_PCT)
        intrinsic[name] = _ratio(error.y_px, error.x_px)
    extrinsic: dict[str, dict[str, float]] = {"x": {}, "y": {}}
    for name in EXTRINSIC:
        left, right = extrinsic_error(pair, name, ERROR_PCT if name == "T" else ERROR_DEG)
        extrinsic["x"][name] = _ratio(left.x_px, right.x_px)
        extrinsic["y"][name] = _ratio(left.y_px, right.y_px)
    return {"statistic": STATISTIC, "intrinsic": intrinsic, "extrinsic": extrinsic}


def nominal(lens: CameraIntrinsics, name: str) -> float:
    """Return the value that an error in percent of `name` refers to."""
    if name == "f":
        return lens.fx
    own = lens.alpha if name == "alpha" else lens.k[_COEFFICIENTS.index(name)]
    return own or NOMINAL[name]


def _alone(lens: CameraIntrinsics, name: str, factor: float) -> CameraIntrinsics:
    """Return the lens with the parameter `name` times `factor` and no other distortion."""
    straight = replace(lens, alpha=0.0, k=(0.0, 0.0, 0.0, 0.0, 0.0))
    if name == "f":
        return replace(straight, fx=lens.fx * factor, fy=lens.fy * factor)
    value = nominal(lens, name) * factor
    if name == "alpha":
        return replace(straight, alpha=value)
    k1, k2, k3, k4, k5 = (value if coefficient == name else 0.0 for coefficient in _COEFFICIENTS)
    return replace(straight, k=(k1, k2, k3, k4, k5))


def _ideal_grid(lens: CameraIntrinsics) -> Array:
    """Return normalised coordinates (h, w, 2) of a grid over the whole image without distortion: the paper's x."""
    u = np.linspace(0, lens.width - 1, min(lens.width, GRID_POINTS))
    v = np.linspace(0, lens.height - 1, min(lens.height, GRID_POINTS))
    return np.stack(np.meshgrid((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy), axis=-1)


def _rectified(pair: CameraPair, R_cam1_cam0: Array, t_cam0_cam1: Array) -> tuple[Array, Array]:
    """Return the rectified pixels (h, w, 2) of the grid in the left and the right image."""
    R_rect = rectifying_rotation(t_cam0_cam1)
    left = _turned(pair.cam0, R_rect)
    return left, _turned(pair.cam1, R_rect @ R_cam1_cam0.T)


def _turned(lens: CameraIntrinsics, R: Array) -> Array:
    rays = homogeneous(_ideal_grid(lens)) @ R.T
    xy = rays[..., :2] / rays[..., 2:]
    return np.stack([lens.fx * xy[..., 0] + lens.cx, lens.fy * xy[..., 1] + lens.cy], axis=-1)


def _largest(offset_px: Array) -> PixelError:
    largest = np.abs(offset_px).max(axis=(0, 1))
    return PixelError(float(largest[0]), float(largest[1]))


def _ratio(numerator: float, denominator: float) -> float:
    """Return the ratio, to nine digits so that rounding in the last bits does not show."""
    return round(numerator / denominator, 9)
