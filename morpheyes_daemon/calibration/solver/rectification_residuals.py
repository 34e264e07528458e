"""What is left after rectification: row error between the cameras, and the disparity that points at infinity show.

The row (epipolar) error is what a matcher suffers; the disparity at infinity is the bias that a yaw error or a wrong
principal point adds to every disparity, which no row error shows. Both are measured in rectified pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rectify import homogeneous, rectifying_rotation
from morpheyes_daemon.transforms import Array

_GRID = (9, 7)
_GRID_INSET = 0.06


@dataclass(frozen=True, eq=False)
class StereoGeometry:
    """Both cameras and the pose between them (4, 4) at one baseline, as a calibration believes them."""

    cam0: CameraIntrinsics
    cam1: CameraIntrinsics
    T_cam0_cam1: Array

    @property
    def f_px(self) -> float:
        """The common focal length of the rectified cameras, as stereo.rectify takes it."""
        return (self.cam0.fx + self.cam0.fy + self.cam1.fx + self.cam1.fy) / 4

    @property
    def length_m(self) -> float:
        """Distance between the cameras."""
        return float(np.linalg.norm(self.T_cam0_cam1[:3, 3]))

    def rectified(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Return raw pixels (..., 2) of both cameras as rectified ones about the principal point; NaN stays NaN."""
        R_rect_cam0 = rectifying_rotation(self.T_cam0_cam1[:3, 3])
        R_rect_cam1 = R_rect_cam0 @ self.T_cam0_cam1[:3, :3]
        return self._turned(self.cam0, R_rect_cam0, left), self._turned(self.cam1, R_rect_cam1, right)

    def _turned(self, camera: CameraIntrinsics, R_rect_cam: Array, uv: Array) -> Array:
        rays = homogeneous(camera.normalised_from_pixels(uv)) @ R_rect_cam.T
        return np.asarray(self.f_px * rays[..., :2] / rays[..., 2:3])


def row_error_px(geometry: StereoGeometry, left: Array, right: Array) -> Array:
    """Return how far (...,) the rows of the same points differ after rectification."""
    rect_left, rect_right = geometry.rectified(left, right)
    return np.asarray(rect_left[..., 1] - rect_right[..., 1])


def disparity_px(geometry: StereoGeometry, left: Array, right: Array) -> Array:
    """Return the disparity (...,) of the same points after rectification."""
    rect_left, rect_right = geometry.rectified(left, right)
    return np.asarray(rect_left[..., 0] - rect_right[..., 0])


def infinity_px(believed: StereoGeometry, true: StereoGeometry) -> Array:
    """Return the disparity (n,) that a rig believed to be `believed` shows for points at infinity seen by `true`.

    The points cover the left image; those outside the right one are left out.
    """
    left = image_grid(true.cam0)
    rays_cam1 = homogeneous(true.cam0.normalised_from_pixels(left)) @ true.T_cam0_cam1[:3, :3]
    ahead = rays_cam1[:, 2] > 0
    right = true.cam1.project(np.where(ahead[:, None], rays_cam1, 1.0))
    inside = ahead & np.all((right >= 0) & (right <= [true.cam1.width - 1, true.cam1.height - 1]), axis=1)
    return disparity_px(believed, left[inside], right[inside])


def image_grid(camera: CameraIntrinsics) -> Array:
    """Return points (n, 2) spread over the image."""
    width, height = camera.width - 1, camera.height - 1
    u = np.linspace(_GRID_INSET, 1 - _GRID_INSET, _GRID[0]) * width
    v = np.linspace(_GRID_INSET, 1 - _GRID_INSET, _GRID[1]) * height
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
