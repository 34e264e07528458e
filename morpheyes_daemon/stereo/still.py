"""Depth of a single stereo pair of any camera: rectified images with f and b, or raw ones with a calibrated rig.

The pipeline in flight is `depth.DepthEstimator`, which is used here for raw images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.errors import CalibrationError, InputError
from morpheyes_daemon.messages.core import BaselineEstimate, FloatMap, Image, Mask, StereoFrame
from morpheyes_daemon.stereo.depth import DepthEstimator, depth_from_disparity, grey, near_limit_m
from morpheyes_daemon.stereo.matching import MatchSettings, disparity_range, match
from morpheyes_daemon.stereo.rig import RigModel

SEARCHED_SHARE = 0.25
"""Share of the image width that is searched without `near_m`; chosen: more finds nearer objects and takes longer."""

SMALLEST_PX = 32, 16
"""Width and height of the smallest picture; chosen: a few of the matcher's blocks."""


@dataclass(frozen=True, slots=True, eq=False)
class StillDepth:
    """depth_m (H, W) float32 metres of the (rectified) left picture, NaN unknown; `near` and
    `half_occluded` (H, W) as in `messages.core.DepthMap`; `baseline_m` is the true one."""

    left: Image
    depth_m: FloatMap
    near: Mask
    half_occluded: Mask
    near_limit_m: float
    baseline_m: float
    f_px: float

    @property
    def valid_fraction(self) -> float:
        """Fraction of the pixels with a depth."""
        return float(np.isfinite(self.depth_m).mean())

    @property
    def ceiling_fraction(self) -> float:
        """Fraction of the pixels that are nearer than `near_limit_m`."""
        return float(self.near.mean())

    @property
    def median_depth_m(self) -> float | None:
        """Median of the known depths, metres; None when none is known."""
        known = self.depth_m[np.isfinite(self.depth_m)]
        return float(np.median(known)) if known.size else None


def rectified_depth(
    left: Image, right: Image, *, f_px: float, baseline_m: float, doffs_px: float = 0.0, near_m: float | None = None
) -> StillDepth:
    """Return the depth of an already rectified pair: Z = b f / (d + doffs).

    `left`, `right` (H, W) or (H, W, 3) uint8; `near_m` is the nearest depth to search. Raises InputError
    when the sizes differ or `near_m` needs more disparities than the images are wide.
    """
    require_same_size(left, right)
    _require_matchable(left, doffs_px)
    width = left.shape[1]
    low = math.floor(-doffs_px)
    if near_m is None:
        count = disparity_range(SEARCHED_SHARE * width - 1, width)
    else:
        largest = f_px * baseline_m / near_m - doffs_px - low
        count = disparity_range(largest, width)
        if count <= largest:
            nearest = near_limit_m(baseline_m, f_px, low + count, doffs_px)
            raise InputError(
                f"Images {width} px wide at this baseline have no depth nearer than {nearest:.2f} m; "
                f"give at least that to --near-m."
            )
    found = match(grey(left), grey(right), count, MatchSettings(), min_disparity=low)
    depth_m = depth_from_disparity(found.disparity_px, baseline_m, f_px, doffs_px)
    limit = near_limit_m(baseline_m, f_px, found.ceiling_px, doffs_px)
    return StillDepth(left, depth_m, found.near, found.half_occluded, limit, baseline_m, f_px)


def raw_depth(
    left: Image, right: Image, rig: RigModel, baseline_m: float | None = None, near_m: float | None = None
) -> StillDepth:
    """Return the depth of a raw pair (H, W) or (H, W, 3) of a calibrated rig, in its rectified left image.

    `baseline_m` is the nominal one and may be left out for a fixed rig. Raises InputError when the sizes differ,
    CalibrationError when the rig does not fit the pictures or the baseline.
    """
    require_same_size(left, right)
    _require_matchable(left, 0.0)
    if baseline_m is None:
        low, high = rig.range_m
        if low != high:
            raise CalibrationError(
                f"The calibration covers {low * 1e3:g} to {high * 1e3:g} mm; name the baseline with --baseline-m."
            )
        baseline_m = low
    height, width = left.shape[:2]
    estimator = DepthEstimator(rig, size=(width, height), settings=MatchSettings())
    frame = StereoFrame(0, 0, left, right, BaselineEstimate(0, baseline_m, baseline_m, 0.0, False))
    pair = estimator.rectified(frame)
    depth = estimator.depth(frame, pair, near_m)
    shown = pair.rectification.cam0.image(left)
    limit, f_px = depth.near_limit_m, depth.pinhole.f_px
    return StillDepth(shown, depth.depth_m, depth.near, depth.half_occluded, limit, depth.baseline_m, f_px)


def _require_matchable(left: Image, doffs_px: float) -> None:
    height, width = left.shape[:2]
    if width < SMALLEST_PX[0] or height < SMALLEST_PX[1]:
        raise InputError(
            f"Pictures of {width}x{height} px show nothing to match; "
            f"give pictures of {SMALLEST_PX[0]}x{SMALLEST_PX[1]} px at least."
        )
    if not abs(doffs_px) < width:
        raise InputError(f"An offset of {doffs_px:g} px between the principal points is no offset of a camera.")


def halves(picture: Image) -> tuple[Image, Image]:
    """Return the left and right half of a side-by-side picture (H, 2 W[, 3]); raises InputError on an odd width."""
    width = picture.shape[1]
    if width % 2:
        raise InputError(f"A side-by-side picture has an even width, this one is {width} px wide; name two pictures.")
    return np.ascontiguousarray(picture[:, : width // 2]), np.ascontiguousarray(picture[:, width // 2 :])


def require_same_size(left: Image, right: Image) -> None:
    """Raise InputError when two images (H, W[, 3]) differ in size."""
    if left.shape[:2] != right.shape[:2]:
        sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (left, right)]
        raise InputError(f"The left picture is {sizes[0]} px, the right one {sizes[1]} px; both must be the same size.")
