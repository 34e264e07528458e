"""Depth with its uncertainty from a stereo frame: Z = b f / d; pixels without a match stay unknown (NaN).

Composes rectification and matching. How depth is used, and what is done where there is none, is decided elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.config.vehicle import StereoConfig
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import DepthMap, FloatMap, Image, StereoFrame, frozen
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.matching import Match, MatchSettings, disparity_range, match
from morpheyes_daemon.stereo.rectify import Rectification, Rectifier
from morpheyes_daemon.stereo.rig import RigModel

ROW_STEP_MIN_HEIGHT_PX = 400
"""Image height in pixels from which rows are matched two by two; chosen: half the time at 640x480, which is still
more accurate than 320x240 in full (tests/unit/stereo/test_depth_on_real_images.py)."""


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedPair:
    """Both rectified grey images (H, W) uint8 and their rectification."""

    left: Image
    right: Image
    rectification: Rectification


class DepthEstimator:
    """Computes depth maps of stereo frames for one rig; `size` (width, height) of the images, None for the rig's own.

    Raises CalibrationError when the rig cannot be read out at `size`.
    """

    def __init__(
        self,
        rig: RigModel,
        config: StereoConfig | None = None,
        size: tuple[int, int] | None = None,
        settings: MatchSettings | None = None,
    ) -> None:
        self.rectifier = Rectifier(rig, size)
        self.calibration_hash = calibration_hash(rig)
        self.config = config or StereoConfig()
        self.settings = settings or default_settings(self.rig.size[1])

    def with_rig(self, rig: RigModel) -> DepthEstimator:
        """Return an estimator of the same settings for a corrected rig at the size of the images."""
        return DepthEstimator(rig, self.config, settings=self.settings)

    @property
    def rig(self) -> RigModel:
        """The rig at the size of the images."""
        return self.rectifier.rig

    def estimate(self, frame: StereoFrame, near_m: float | None = None) -> DepthMap:
        """Return the depth map of a raw frame: `rectified`, then `depth`."""
        return self.depth(frame, self.rectified(frame), near_m)

    def rectified(self, frame: StereoFrame) -> RectifiedPair:
        """Return the rectified grey pair of a raw frame.

        Raises InputError on a wrong image size, CalibrationError outside the calibrated range.
        """
        left, right = grey(frame.left), grey(frame.right)
        width, height = self.rig.size
        if left.shape != (height, width) or right.shape != (height, width):
            raise InputError(
                f"The images are {left.shape[1]}x{left.shape[0]} px, but {width}x{height} px were expected; "
                "set the camera's size in the configuration."
            )
        rectification = self.rectifier.at(frame.baseline.baseline_m)
        return RectifiedPair(*rectification.pair(left, right), rectification)

    def depth(self, frame: StereoFrame, pair: RectifiedPair, near_m: float | None = None) -> DepthMap:
        """Return the depth map of a rectified pair.

        `near_m` limits the search to the disparity of that depth (paper-notes 10); None searches the configured share
        of the image width.
        """
        rectification = pair.rectification
        baseline_m = self.rig.length_m(frame.baseline.baseline_m)
        count = self._disparities(baseline_m, rectification.pinhole.f_px, near_m)
        found = match(
            pair.left,
            pair.right,
            count,
            self.settings,
            covered=(rectification.cam0.covered, rectification.cam1.covered),
        )
        return self._depth_map(frame, rectification, found, baseline_m)

    def _disparities(self, baseline_m: float, f_px: float, near_m: float | None) -> int:
        width = self.rig.size[0]
        most = disparity_range(self.config.disparities_fraction * width - 1, width)
        return most if near_m is None else min(most, disparity_range(baseline_m * f_px / near_m, width))

    def _depth_map(self, frame: StereoFrame, rectified: Rectification, found: Match, baseline_m: float) -> DepthMap:
        nominal_m, f_px = frame.baseline.baseline_m, rectified.pinhole.f_px
        depth_m = depth_from_disparity(found.disparity_px, baseline_m, f_px)
        yaw_px = f_px * self.rig.sigma_yaw_rad(nominal_m)
        return DepthMap(
            seq=frame.seq,
            t_ns=frame.t_ns,
            depth_m=frozen(depth_m),
            near=frozen(found.near),
            half_occluded=frozen(found.half_occluded),
            pinhole=rectified.pinhole,
            T_rig_rect=rectified.T_rig_rect,
            baseline_m=baseline_m,
            baseline_sigma_m=math.hypot(frame.baseline.sigma_m, self.rig.sigma_length_m(nominal_m)),
            sigma_disparity_px=math.hypot(self.config.sigma_disparity_px, yaw_px),
            near_limit_m=near_limit_m(baseline_m, f_px, found.ceiling_px),
            valid_fraction=float(np.isfinite(depth_m).mean()),
            ceiling_fraction=float(found.near.mean()),
            calibration_hash=self.calibration_hash,
        )


def default_settings(height: int) -> MatchSettings:
    """Return the settings in flight: from ROW_STEP_MIN_HEIGHT_PX rows on, rows are matched two by two."""
    return MatchSettings(row_step=2 if height >= ROW_STEP_MIN_HEIGHT_PX else 1)


def depth_from_disparity(disparity_px: FloatMap, baseline_m: float, f_px: float, doffs_px: float = 0.0) -> FloatMap:
    """Return Z = b f / (d + doffs) (H, W) float32 metres, NaN where the disparity is unknown or Z is not finite.

    `doffs_px` is the difference of the principal points, x right - x left, as Middlebury data sets define it.
    """
    total = disparity_px + np.float32(doffs_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0, np.float32(baseline_m * f_px) / total, np.float32(np.nan))


def disparity_of(depth: DepthMap) -> FloatMap:
    """Return the disparity (H, W) float32 pixels of a depth map, NaN where unknown: d = b f / Z."""
    return np.asarray(np.float32(depth.baseline_m * depth.pinhole.f_px) / depth.depth_m, np.float32)


def near_limit_m(baseline_m: float, f_px: float, ceiling_px: float, doffs_px: float = 0.0) -> float:
    """Return the near limit Z_min = b f / (largest disparity + doffs), metres (paper-notes 11)."""
    return baseline_m * f_px / (ceiling_px + doffs_px)


@overload
def depth_sigma(
    depth_m: float, baseline_m: float, f_px: float, sigma_disparity_px: float, baseline_sigma_m: float = ...,
    yaw_sigma_rad: float = ...,
) -> float: ...  # fmt: skip


@overload
def depth_sigma(
    depth_m: NDArray[Any], baseline_m: float, f_px: float, sigma_disparity_px: float, baseline_sigma_m: float = ...,
    yaw_sigma_rad: float = ...,
) -> NDArray[Any]: ...  # fmt: skip


def depth_sigma(
    depth_m: float | NDArray[Any],
    baseline_m: float,
    f_px: float,
    sigma_disparity_px: float,
    baseline_sigma_m: float = 0.0,
    yaw_sigma_rad: float = 0.0,
) -> float | NDArray[Any]:
    """Return one sigma of a depth (any shape), metres: eps_z = z^2 eps_d / (b f) (paper, section II) and further terms.

    A relative error of the baseline causes the same relative error of depth; a yaw between the cameras moves the
    disparity by f per radian. The three are independent and added in squares.
    """
    error_px = math.hypot(sigma_disparity_px, f_px * yaw_sigma_rad)
    relative = np.hypot(depth_m * (error_px / (baseline_m * f_px)), baseline_sigma_m / baseline_m)
    return depth_m * relative


def grey(image: Image) -> Image:
    """Return an image (H, W) or BGR (H, W, 3) uint8 as grey (H, W) uint8."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
