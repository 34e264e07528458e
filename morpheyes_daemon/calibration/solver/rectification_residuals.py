"""Residuals after rectification: row error between the images, and disparity of points at infinity.

The row (epipolar) error impairs matching; the disparity at infinity is the bias that an error of the yaw or of a
principal point adds to every disparity, without any row error. Both are in rectified pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rectify import homogeneous, rectifying_rotation
from morpheyes_daemon.transforms import Array

_GRID, _GRID_INSET = (9, 7), 0.06
"""Columns and rows of the grid of test points, and its distance from the border as a fraction of the image; chosen:
the residuals are smooth over the cells."""


@dataclass(frozen=True, eq=False)
class StereoGeometry:
    """Calibrated cameras and the pose T_cam0_cam1 (4, 4) between them at one baseline."""

    cam0: CameraIntrinsics
    cam1: CameraIntrinsics
    T_cam0_cam1: Array

    @property
    def f_px(self) -> float:
        """Common focal length of the rectified images, pixels, as in `stereo.rectify`."""
        return (self.cam0.fx + self.cam0.fy + self.cam1.fx + self.cam1.fy) / 4

    @property
    def length_m(self) -> float:
        """True baseline, metres."""
        return float(np.linalg.norm(self.T_cam0_cam1[:3, 3]))

    def rectified(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Return the rectified pixels (..., 2) of raw ones (..., 2), relative to the principal point; NaN stays NaN."""
        R_rect_cam0 = rectifying_rotation(self.T_cam0_cam1[:3, 3])
        R_rect_cam1 = R_rect_cam0 @ self.T_cam0_cam1[:3, :3]
        return self._turned(self.cam0, R_rect_cam0, left), self._turned(self.cam1, R_rect_cam1, right)

    def _turned(self, camera: CameraIntrinsics, R_rect_cam: Array, uv: Array) -> Array:
        rays = homogeneous(camera.normalised_from_pixels(uv)) @ R_rect_cam.T
        return np.asarray(self.f_px * rays[..., :2] / rays[..., 2:3])


def row_error_px(geometry: StereoGeometry, left: Array, right: Array) -> Array:
    """Return the row error (...,), left minus right, of raw pixels (..., 2) of the same points after rectification."""
    rect_left, rect_right = geometry.rectified(left, right)
    return np.asarray(rect_left[..., 1] - rect_right[..., 1])


def disparity_px(geometry: StereoGeometry, left: Array, right: Array) -> Array:
    """Return the disparity (...,) of raw pixels (..., 2) of the same points after rectification."""
    rect_left, rect_right = geometry.rectified(left, right)
    return np.asarray(rect_left[..., 0] - rect_right[..., 0])


def infinity_px(believed: StereoGeometry, true: StereoGeometry) -> Array:
    """Return the disparity (n,) of points at infinity seen by the rig `true` and rectified by `believed`.

    The points cover the left image; those outside the right one are left out.
    """
    left = image_grid(true.cam0)
    rays_cam1 = homogeneous(true.cam0.normalised_from_pixels(left)) @ true.T_cam0_cam1[:3, :3]
    ahead = rays_cam1[:, 2] > 0
    right = true.cam1.project(np.where(ahead[:, None], rays_cam1, 1.0))
    inside = ahead & np.all((right >= 0) & (right <= [true.cam1.width - 1, true.cam1.height - 1]), axis=1)
    return disparity_px(believed, left[inside], right[inside])


def image_grid(camera: CameraIntrinsics) -> Array:
    """Return a grid of pixels (n, 2) over the image of a camera."""
    width, height = camera.width - 1, camera.height - 1
    u = np.linspace(_GRID_INSET, 1 - _GRID_INSET, _GRID[0]) * width
    v = np.linspace(_GRID_INSET, 1 - _GRID_INSET, _GRID[1]) * height
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
