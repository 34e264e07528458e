"""Rectification at any baseline: rotates both cameras parallel and gives them a common camera matrix.

R_rect follows the paper (section II); without one common K_rect rows would not align when the lenses differ. Maps
are computed on a coarse grid in double precision and interpolated linearly, which stays within 0.01 px (tested in
tests/unit/stereo/test_rectify.py) and makes a new baseline cheap. The content of the images is not used.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.messages.core import FloatMap, Image, Mask, Pinhole, frozen
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array, inverse, pose

WIDE_GRID_PX, NARROW_GRID_PX, WIDE_FROM_PX = 8, 4, 480
"""Steps of the coarse grid for wide and narrow images, and the width that separates them, pixels; chosen: within one
step a lens with k1 = -0.3 and a 47 degree view deviates from linear by less than 0.01 px."""

QUANTUM_M = 0.25e-3
"""Baselines within one quantum share their maps, metres; chosen: smaller ones compute maps more often while moving."""

CACHED = 8
"""Rectifications kept; chosen: 5 MB each at 640x480 (two maps of 2 x float32)."""


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedCamera:
    """Rectifying map of one camera.

    `R_rect_cam` (3, 3); `map_px` (H, W, 2) float32 is the raw pixel of every rectified one; `covered` (H, W) bool is
    False outside the raw image, None where the raw image covers everything.
    """

    intrinsics: CameraIntrinsics
    R_rect_cam: Array
    pinhole: Pinhole
    map_px: FloatMap
    covered: Mask | None

    def image(self, raw: Image) -> Image:
        """Return the rectified image (H, W) or (H, W, 3) of a raw one."""
        # the second map must be None: OpenCV 5 returns a wrong image for an empty array
        return np.asarray(
            cv2.remap(  # type: ignore[call-overload]
                raw, self.map_px, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            ),
            np.uint8,
        )

    def points(self, uv: Array) -> Array:
        """Return the rectified pixels (..., 2) of raw ones (..., 2), exactly; NaN outside the lens model."""
        rays = homogeneous(self.intrinsics.normalised_from_pixels(uv)) @ self.R_rect_cam.T
        return pixels(self.pinhole, rays)


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """Both cameras rectified for one baseline. `baseline_m` is the true length at the nominal one."""

    nominal_m: float
    baseline_m: float
    pinhole: Pinhole
    cam0: RectifiedCamera
    cam1: RectifiedCamera
    T_rig_rect: Array

    @property
    def R_rect_cam0(self) -> Array:
        """Rotation (3, 3) from the left camera to the rectified frame: the paper's R_rect."""
        return self.cam0.R_rect_cam

    def pair(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Return the rectified images (H, W) or (H, W, 3) of a raw pair."""
        return self.cam0.image(left), self.cam1.image(right)


class Rectifier:
    """Computes and caches the rectifications of one rig at one image size, (width, height) in pixels."""

    def __init__(self, rig: RigModel, size: tuple[int, int] | None = None) -> None:
        self.rig = rig.rescaled(*size) if size is not None else rig
        self._cache: OrderedDict[int, Rectification] = OrderedDict()

    def at(self, baseline_m: float) -> Rectification:
        """Return the rectification for a nominal baseline; raises CalibrationError outside the calibrated range."""
        low, high = self.rig.range_m
        key = round(baseline_m / QUANTUM_M)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        nominal_m = key * QUANTUM_M if low <= key * QUANTUM_M <= high else baseline_m
        made = rectify(self.rig, nominal_m)
        self._cache[key] = made
        if len(self._cache) > CACHED:
            self._cache.popitem(last=False)
        return made


def rectify(rig: RigModel, baseline_m: float) -> Rectification:
    """Return the rectification of `rig` at a nominal baseline, not cached; raises CalibrationError outside its range."""
    T_cam0_cam1 = rig.T_cam0_cam1(baseline_m)
    R_rect_cam0 = rectifying_rotation(T_cam0_cam1[:3, 3])
    R_rect_cam1 = R_rect_cam0 @ T_cam0_cam1[:3, :3]
    pinhole = common_pinhole(rig, R_rect_cam0, R_rect_cam1)
    length_m = float(np.linalg.norm(T_cam0_cam1[:3, 3]))
    T_rig_cam0 = pose(rig.R_rig_cam0, np.array([-length_m / 2, 0.0, 0.0]))
    return Rectification(
        nominal_m=baseline_m,
        baseline_m=length_m,
        pinhole=pinhole,
        cam0=_rectified_camera(rig.cam0, R_rect_cam0, pinhole),
        cam1=_rectified_camera(rig.cam1, R_rect_cam1, pinhole),
        T_rig_rect=frozen(T_rig_cam0 @ inverse(pose(R_rect_cam0, np.zeros(3)))),
    )


def rectifying_rotation(t_cam0_cam1: Array) -> Array:
    """Return R_rect_cam0 (3, 3) of the translation (3,) (paper, section II, equations of R_rect).

    Its rows are r_x along the baseline, r_z the part of the left optical axis normal to it, r_y = r_z x r_x.
    """
    r_x = t_cam0_cam1 / np.linalg.norm(t_cam0_cam1)
    axis = np.array([0.0, 0.0, 1.0])
    r_z = axis - (axis @ r_x) * r_x
    r_z = r_z / np.linalg.norm(r_z)
    return np.stack([r_x, np.cross(r_z, r_x), r_z])


def common_pinhole(rig: RigModel, R_rect_cam0: Array, R_rect_cam1: Array) -> Pinhole:
    """Return K_rect: the mean focal length, and the principal point that centres the common field of view.

    `R_rect_cam0` and `R_rect_cam1` (3, 3). Raises CalibrationError when the cameras have no common view.
    """
    width, height = rig.size
    f_px = (rig.cam0.fx + rig.cam0.fy + rig.cam1.fx + rig.cam1.fy) / 4
    views = np.stack([_view(rig.cam0, R_rect_cam0), _view(rig.cam1, R_rect_cam1)])
    middle = views.mean(axis=(0, 1))
    cx_px, cy_px = (np.array([width - 1, height - 1]) / 2 - f_px * middle).tolist()
    return Pinhole(width, height, f_px, cx_px, cy_px)


def homogeneous(xy: Array) -> Array:
    """Return normalised coordinates (..., 2) as rays (..., 3) with z = 1."""
    return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)


def pixels(pinhole: Pinhole, p_rect: Array) -> Array:
    """Return the rectified pixels (..., 2) of points (..., 3) in rect axes."""
    xy = p_rect[..., :2] / p_rect[..., 2:3]
    return np.asarray(pinhole.f_px * xy + np.array([pinhole.cx_px, pinhole.cy_px]))


def rays(pinhole: Pinhole, uv: Array) -> Array:
    """Return the rays (..., 3), z = 1, in rect axes, of rectified pixels (..., 2)."""
    return homogeneous((uv - np.array([pinhole.cx_px, pinhole.cy_px])) / pinhole.f_px)


def grid_step(width: int) -> int:
    """Return the step of the coarse grid in pixels for an image width."""
    return WIDE_GRID_PX if width >= WIDE_FROM_PX else NARROW_GRID_PX


def grid_pixels(width: int, height: int) -> Array:
    """Return the pixels (h, w, 2) at the centres of the cells that cover the image and one cell around it."""
    step = grid_step(width)
    u = (np.arange(-1, -(-width // step) + 1) + 0.5) * step - 0.5
    v = (np.arange(-1, -(-height // step) + 1) + 0.5) * step - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)


def _view(camera: CameraIntrinsics, R_rect_cam: Array) -> Array:
    """Return minimum and maximum (2, 2) of the normalised coordinates x, y that a camera covers in rect axes."""
    xy = camera.normalised_border
    if len(xy) < 4:
        raise CalibrationError("The lens distortion folds back within the image; calibrate the camera again.")
    turned = homogeneous(xy) @ R_rect_cam.T
    if np.any(turned[:, 2] <= 0.1):
        raise CalibrationError("The cameras diverge so far that they have no common view; calibrate the rig again.")
    turned = turned[:, :2] / turned[:, 2:]
    return np.stack([turned.min(axis=0), turned.max(axis=0)])


def _rectified_camera(camera: CameraIntrinsics, R_rect_cam: Array, pinhole: Pinhole) -> RectifiedCamera:
    raw, inset = _coarse_map(camera, R_rect_cam, pinhole)
    map_px = _spread(raw, pinhole)
    covered = None if inset.min() >= 0 else frozen(_spread(inset, pinhole) >= 0)
    return RectifiedCamera(camera, frozen(R_rect_cam.copy()), pinhole, frozen(map_px), covered)


def _coarse_map(camera: CameraIntrinsics, R_rect_cam: Array, pinhole: Pinhole) -> tuple[FloatMap, FloatMap]:
    """Return on the coarse grid the raw pixels (h, w, 2) and their distance (h, w) inside the raw image's border."""
    rays_cam = rays(pinhole, grid_pixels(pinhole.width, pinhole.height)) @ R_rect_cam
    xy = rays_cam[..., :2] / rays_cam[..., 2:3]
    raw = camera.pixels_from_normalised(xy)
    u, v = raw[..., 0], raw[..., 1]
    inset = np.minimum(np.minimum(u, camera.width - 1 - u), np.minimum(v, camera.height - 1 - v))
    usable = (rays_cam[..., 2] > 0) & ((xy * xy).sum(axis=-1) < camera.largest_radius**2)
    return raw.astype(np.float32), np.where(usable, inset, -camera.width).astype(np.float32)


def _spread(coarse: FloatMap, pinhole: Pinhole) -> FloatMap:
    """Return a coarse grid (h, w, ...) interpolated linearly at every pixel (H, W, ...)."""
    step = grid_step(pinhole.width)
    rows, columns = coarse.shape[:2]
    fine = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[step : step + pinhole.height, step : step + pinhole.width])
