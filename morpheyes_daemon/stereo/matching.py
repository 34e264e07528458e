"""Dense matching of a rectified pair: disparity, and for what is unknown whether it is near or seen by one eye only.

Semi-global matching is OpenCV's (StereoSGBM, Hirschmüller 2008, three path directions), on images padded so that
only what the right eye cannot see is lost. What is nearer than the largest disparity has no match at all, and the
matcher then often invents a far one; so a coarse search over a longer range runs beside it, finds such regions and
overrules the fine one there. The result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages import FloatMap, Image

Mask = NDArray[np.bool_]

STEP = 16
"""OpenCV wants the number of disparities to be a multiple of this."""

SUBPIXELS = 16
"""StereoSGBM returns disparities in sixteenths of a pixel."""


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """How to match; the penalties are per pixel of the block's area, sizes are pixels of the image matched.

    `row_step` 2 matches rows averaged two by two: half the time, all of the disparity resolution.
    """

    block_px: int = 3
    small_step_penalty: int = 8
    large_step_penalty: int = 32
    gradient_cap: int = 31
    uniqueness_pct: int = 10
    left_right_px: int = 1
    speckle_per_image: float = 1 / 3000
    row_step: int = 1
    coarse_width_px: int = 160
    coarse_range: float = 3.0
    coarse_speckle_px: int = 30


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """disparity_px (H, W) float32, NaN unknown; near: unknown because nearer than `ceiling_px`; one_eyed: unknown
    because only the left eye sees it."""

    disparity_px: FloatMap
    near: Mask
    one_eyed: Mask
    ceiling_px: float


def disparity_range(largest_px: float, width: int) -> int:
    """Return the number of disparities to search so that `largest_px` is covered: a multiple of 16, below `width`."""
    most = max(STEP, (width - 1) // STEP * STEP)
    return min(most, max(STEP, math.ceil((largest_px + 1.0) / STEP) * STEP))


def match(
    left: Image,
    right: Image,
    num_disparities: int,
    settings: MatchSettings | None = None,
    *,
    min_disparity: int = 0,
    left_seen: Mask | None = None,
    right_seen: Mask | None = None,
) -> Match:
    """Match rectified grey images (H, W) uint8 over [min_disparity, min_disparity + num_disparities).

    `left_seen` and `right_seen` (H, W) mark the pixels that the eyes really cover. Raises InputError when the images
    cannot be matched at all.
    """
    _require_pair(left, right, num_disparities)
    settings = settings or MatchSettings()
    ceiling = min_disparity + num_disparities
    disparity = _fine(left, right, min_disparity, num_disparities, settings)
    _forget_unseen(disparity, left_seen, right_seen)
    near = _too_near(left, right, min_disparity, num_disparities, settings)
    near |= disparity > ceiling - 1.5
    if left_seen is not None:
        near &= left_seen
    disparity[near] = np.nan
    return Match(disparity, near, _one_eyed(disparity, near, ceiling), float(ceiling))


def semi_global(
    left: Image, right: Image, low: int, count: int, settings: MatchSettings, speckle_px: int
) -> FloatMap:
    """Return the disparity (H, W) float32 of left pixels, NaN where unknown or outside the right image."""
    block_area = settings.block_px**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=settings.block_px,
        P1=settings.small_step_penalty * block_area,
        P2=settings.large_step_penalty * block_area,
        disp12MaxDiff=settings.left_right_px,
        preFilterCap=settings.gradient_cap,
        uniquenessRatio=settings.uniqueness_pct,
        speckleWindowSize=speckle_px,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    before, after = max(0, low + count), max(0, -low)
    padded = [cv2.copyMakeBorder(eye, 0, 0, before, after, cv2.BORDER_REPLICATE) for eye in (left, right)]
    fixed = matcher.compute(*padded)[:, before : before + left.shape[1]]
    disparity = fixed.astype(np.float32) / np.float32(SUBPIXELS)
    column = np.arange(left.shape[1], dtype=np.float32)
    disparity[(disparity < low) | (disparity > column + 0.5)] = np.nan
    return np.asarray(disparity)


def _fine(left: Image, right: Image, low: int, count: int, settings: MatchSettings) -> FloatMap:
    height, width = left.shape
    step = settings.row_step
    if step > 1:
        left, right = (_shrunk(eye, 1, step) for eye in (left, right))
    disparity = semi_global(left, right, low, count, settings, round(left.size * settings.speckle_per_image))
    return disparity if step == 1 else _grown(disparity, 1, step, (height, width))


def _too_near(left: Image, right: Image, low: int, count: int, settings: MatchSettings) -> Mask:
    """Return where a coarse search over a longer range prefers a disparity beyond the fine search's ceiling."""
    height, width = left.shape
    scale = max(1, round(width / settings.coarse_width_px))
    small_left, small_right = (_shrunk(eye, scale, scale) for eye in (left, right))
    reach = disparity_range(count * settings.coarse_range / scale, small_left.shape[1])
    coarse = semi_global(small_left, small_right, low // scale, reach, settings, settings.coarse_speckle_px)
    beyond = coarse * scale > low + count + scale / 2
    return np.asarray(_grown(beyond.view(np.uint8), scale, scale, (height, width)).view(np.bool_))


def _shrunk(image: Image, across: int, down: int) -> Image:
    height, width = image.shape
    rows, columns = height // down, width // across
    cut = image[: rows * down, : columns * across]
    return np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA))


def _grown(small: NDArray[Any], across: int, down: int, shape: tuple[int, int]) -> NDArray[Any]:
    """Return `small` with every pixel repeated; what is left over at the right and bottom repeats the edge."""
    size = (small.shape[1] * across, small.shape[0] * down)
    grown = cv2.resize(small, size, interpolation=cv2.INTER_NEAREST)
    missing = shape[0] - size[1], shape[1] - size[0]
    return np.asarray(cv2.copyMakeBorder(grown, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE))


def _forget_unseen(disparity: FloatMap, left_seen: Mask | None, right_seen: Mask | None) -> None:
    if left_seen is not None:
        disparity[~left_seen] = np.nan
    if right_seen is not None:
        rows, columns = np.nonzero(np.isfinite(disparity))
        partner = np.clip(np.rint(columns - disparity[rows, columns]).astype(np.intp), 0, disparity.shape[1] - 1)
        lost = ~right_seen[rows, partner]
        disparity[rows[lost], columns[lost]] = np.nan


def _one_eyed(disparity: FloatMap, near: Mask, ceiling: float) -> Mask:
    """Return where something nearer hides an unknown pixel from the right eye, or the image's edge does.

    Seen from the right eye a nearer surface with disparity d_f covers d_f - d_b pixels of the background (d_b) left
    of its own left edge; at the image's edge d_f pixels are missing.
    """
    width = disparity.shape[1]
    unknown = np.isnan(disparity) & ~near
    nearer = np.where(near, np.float32(ceiling), disparity)
    column = np.arange(width, dtype=np.int32)
    before = np.maximum.accumulate(np.where(unknown, np.int32(-1), column), axis=1)
    after = np.minimum.accumulate(np.where(unknown, np.int32(width), column)[:, ::-1], axis=1)[:, ::-1]
    rows, columns = np.nonzero(unknown)
    left, right = before[rows, columns], after[rows, columns]
    d_right = np.where(right < width, nearer[rows, np.minimum(right, width - 1)], -np.inf)
    d_left = nearer[rows, np.maximum(left, 0)]
    hidden = np.where(left < 0, columns <= d_right, right - columns <= d_right - d_left + 1.0)
    mask = np.zeros(disparity.shape, dtype=np.bool_)
    mask[rows, columns] = hidden
    return mask


def _require_pair(left: Image, right: Image, num_disparities: int) -> None:
    if left.ndim != 2 or left.shape != right.shape or left.dtype != np.uint8 or right.dtype != np.uint8:
        raise InputError("Matching needs two grey 8-bit images of the same size.")
    if num_disparities < STEP or num_disparities % STEP:
        raise InputError(f"The number of disparities must be a multiple of {STEP}, not {num_disparities}.")
    if num_disparities >= left.shape[1]:
        raise InputError(
            f"The images are {left.shape[1]} px wide, too narrow for a search over {num_disparities} disparities."
        )
