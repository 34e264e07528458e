"""Dense matching of a rectified pair: disparity, and for what is unknown whether it is near or seen by one camera only.

Semi-global matching is OpenCV's (StereoSGBM, Hirschmüller 2008, three path directions), on images padded so that
only what the right camera cannot see is lost. What is nearer than the largest disparity has no match at all, and the
matcher then often invents a far one; so a coarse search over a longer range runs beside it, finds such regions and
overrules the fine one there. The result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import FloatMap, Image, Mask

COARSE_ROW_FACTOR = 2
"""Coarse pixels are so much taller than wide: half the time, and what is near is tall as well."""

STEP = 16
"""OpenCV wants the number of disparities to be a multiple of this."""

SUBPIXELS = 16
"""StereoSGBM returns disparities in sixteenths of a pixel."""


def _straightened() -> FloatMap:
    """Return the true fraction (16,) for each fraction that StereoSGBM gives, relative to its whole pixel.

    OpenCV fits a parabola to a cost that is a V, which draws x = delta / (2 (1 - delta)) from the true delta towards
    whole pixels, and its integer division lifts negative fractions by one step. Both are undone.
    """
    step = np.arange(SUBPIXELS)
    step = np.where(step <= SUBPIXELS // 2, step, step - SUBPIXELS)
    x = (step - np.select([step < 0, step == 0], [1.0, 0.5], 0.0)) / SUBPIXELS
    true = np.sign(x) * 2 * np.abs(x) / (1 + 2 * np.abs(x))
    return np.asarray(true - step / SUBPIXELS, dtype=np.float32)


_CORRECTION_PX = _straightened()


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """How to match; the penalties are per pixel of the block's area, sizes are pixels of the image matched.

    `row_step` 2 matches rows averaged two by two: half the time, all of the disparity resolution.
    """

    block_px: int = 3
    small_step_penalty: int = 4
    large_step_penalty: int = 16
    gradient_cap: int = 63
    uniqueness_pct: int = 15
    left_right_px: int = 1
    speckle_per_image: float = 1 / 1200
    island_per_image: float = 1 / 400
    island_unknown_share: float = 0.8
    row_step: int = 1
    coarse_width_px: int = 160
    coarse_range: float = 3.0
    coarse_speckle_px: int = 30


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """disparity_px (H, W) float32, NaN unknown; near: unknown because nearer than `ceiling_px`; half_occluded: unknown
    because only the left camera sees it."""

    disparity_px: FloatMap
    near: Mask
    half_occluded: Mask
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

    `left_seen` and `right_seen` (H, W) mark the pixels that the cameras really cover. Raises InputError when the images
    cannot be matched at all.
    """
    _require_pair(left, right, num_disparities)
    settings = settings or MatchSettings()
    shape, step = left.shape, settings.row_step
    ceiling = min_disparity + num_disparities
    near = _beyond_ceiling(left, right, min_disparity, num_disparities, settings)[::step][: shape[0] // step]
    if step > 1:
        left, right = _downsampled(left, 1, step), _downsampled(right, 1, step)
    speckle_px = round(left.size * settings.speckle_per_image)
    disparity = semi_global(left, right, min_disparity, num_disparities, settings, speckle_px)
    near |= disparity > ceiling - 1.5
    disparity[near] = np.nan
    left_seen, right_seen = (_rows_of(seen, step) for seen in (left_seen, right_seen))
    _remove_unseen(disparity, near, left_seen, right_seen)
    _remove_islands(disparity, round(left.size * settings.island_per_image), settings.island_unknown_share)
    half_occluded = _half_occluded(disparity, near, ceiling)
    if step > 1:
        disparity, near, half_occluded = (
            _upsampled(array, 1, step, shape) for array in (disparity, near, half_occluded)
        )
    return Match(disparity, near, half_occluded, float(ceiling))


def semi_global(left: Image, right: Image, low: int, count: int, settings: MatchSettings, speckle_px: int) -> FloatMap:
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
    padded = [cv2.copyMakeBorder(side, 0, 0, before, after, cv2.BORDER_REPLICATE) for side in (left, right)]
    fixed = np.asarray(matcher.compute(*padded), dtype=np.int16)[:, before : before + left.shape[1]]
    disparity = fixed.astype(np.float32) / np.float32(SUBPIXELS) + _CORRECTION_PX[fixed & (SUBPIXELS - 1)]
    column = np.arange(left.shape[1], dtype=np.float32)
    disparity[(fixed < low * SUBPIXELS) | (disparity > column + 0.5)] = np.nan
    return np.asarray(disparity)


def _beyond_ceiling(left: Image, right: Image, low: int, count: int, settings: MatchSettings) -> Mask:
    """Return where a coarse search over a longer range prefers a disparity beyond the fine search's ceiling."""
    height, width = left.shape
    scale = max(1, round(width / settings.coarse_width_px))
    small_left, small_right = (_downsampled(side, scale, COARSE_ROW_FACTOR * scale) for side in (left, right))
    reach = disparity_range(count * settings.coarse_range / scale, small_left.shape[1])
    coarse = semi_global(small_left, small_right, low // scale, reach, settings, settings.coarse_speckle_px)
    beyond = coarse * scale > low + count + scale / 2
    return _upsampled(beyond, scale, COARSE_ROW_FACTOR * scale, (height, width))


def _downsampled(image: Image, across: int, down: int) -> Image:
    height, width = image.shape
    rows, columns = height // down, width // across
    cut = image[: rows * down, : columns * across]
    return np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA))


def _upsampled(small: NDArray[Any], across: int, down: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return `small` with every pixel repeated; what is left over at the right and bottom repeats the edge."""
    drawn = small.view(np.uint8) if small.dtype == np.bool_ else small
    size = (small.shape[1] * across, small.shape[0] * down)
    grown = cv2.resize(drawn, size, interpolation=cv2.INTER_NEAREST)
    missing = shape[0] - size[1], shape[1] - size[0]
    whole = np.asarray(cv2.copyMakeBorder(grown, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE))
    return whole.view(np.bool_) if small.dtype == np.bool_ else whole


def _rows_of(seen: Mask | None, step: int) -> Mask | None:
    return None if seen is None else seen[::step][: seen.shape[0] // step]


def _remove_unseen(disparity: FloatMap, near: Mask, left_seen: Mask | None, right_seen: Mask | None) -> None:
    if left_seen is not None:
        disparity[~left_seen] = np.nan
        near &= left_seen
    if right_seen is not None:
        # what a camera sees of a rectified row is one piece
        width = right_seen.shape[1]
        first = right_seen.argmax(axis=1)
        last = np.where(right_seen.any(axis=1), width - 1 - right_seen[:, ::-1].argmax(axis=1), -1)
        partner = np.arange(width, dtype=np.float32) - disparity
        disparity[(partner < first[:, None] - 0.5) | (partner > last[:, None] + 0.5)] = np.nan


def _remove_islands(disparity: FloatMap, largest_px: int, shore: float) -> None:
    """Forget small patches of disparity in a sea of unknown: where nothing can match, something always seems to.

    A patch goes when more than the share `shore` of its neighbours is unknown; a thin branch stays, since on one side
    of it lies what it does not hide.
    """
    none = np.iinfo(np.int16).min
    unknown = np.isnan(disparity)
    fixed = np.where(unknown, none, disparity * SUBPIXELS).astype(np.int16)
    large = fixed.copy()
    cv2.filterSpeckles(large, none, largest_px, SUBPIXELS)
    count, labels = cv2.connectedComponents((fixed != large).view(np.uint8), connectivity=4)
    around, sea = np.zeros(count), np.zeros(count)
    for patch, beside, water in _neighbours(labels, unknown):
        edge = (patch != beside) & (patch > 0)
        around += np.bincount(patch[edge], minlength=count)
        sea += np.bincount(patch[edge], weights=water[edge], minlength=count)
    drowned = sea > shore * around
    disparity[drowned[labels]] = np.nan


def _neighbours(labels: NDArray[Any], unknown: Mask) -> Iterator[tuple[NDArray[Any], NDArray[Any], Mask]]:
    """Yield labels, the labels on one side of them, and whether that side is unknown, for the four sides."""
    yield labels[:, :-1], labels[:, 1:], unknown[:, 1:]
    yield labels[:, 1:], labels[:, :-1], unknown[:, :-1]
    yield labels[:-1], labels[1:], unknown[1:]
    yield labels[1:], labels[:-1], unknown[:-1]


def _half_occluded(disparity: FloatMap, near: Mask, ceiling: float) -> Mask:
    """Return where something nearer hides an unknown pixel from the right camera, or the image's edge does.

    Seen from the right camera a nearer surface with disparity d_f covers d_f - d_b pixels of the background (d_b) left
    of its own left edge; at the image's edge d_f pixels are missing. What lies left of something too near may well
    belong to it, so nothing is said about that.
    """
    height, width = disparity.shape
    row, first, end = _runs(np.isnan(disparity) & ~near)
    left, right = np.maximum(first - 1, 0), np.minimum(end, width - 1)
    d_left = np.where(near[row, left], np.float32(ceiling), disparity[row, left])
    covers = (end < width) & ~near[row, right]
    d_right = np.where(covers, disparity[row, right], np.float32(-width))
    hidden_from = np.where(first == 0, 0, np.maximum(first, end - np.floor(d_right - d_left + 1.0)))
    hidden_to = np.where(first == 0, np.minimum(end, np.floor(d_right) + 1.0), end)
    some = hidden_from < hidden_to
    change = np.zeros((height, width + 1), dtype=np.int8)
    change[row[some], hidden_from[some].astype(np.intp)] = 1
    change[row[some], hidden_to[some].astype(np.intp)] = -1
    return np.asarray(np.cumsum(change, axis=1, dtype=np.int8)[:, :width].astype(np.bool_))


def _runs(mask: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return row, first column and end column (one past the last) of every unbroken run of True along a row."""
    width = mask.shape[1] + 2
    framed = np.pad(mask, ((0, 0), (1, 1))).ravel()
    edges = np.flatnonzero(framed[1:] != framed[:-1]) + 1
    return edges[::2] // width, edges[::2] % width - 1, edges[1::2] % width - 1


def _require_pair(left: Image, right: Image, num_disparities: int) -> None:
    if left.ndim != 2 or left.shape != right.shape or left.dtype != np.uint8 or right.dtype != np.uint8:
        raise InputError("Matching needs two grey 8-bit images of the same size.")
    if num_disparities < STEP or num_disparities % STEP:
        raise InputError(f"The number of disparities must be a multiple of {STEP}, not {num_disparities}.")
    if num_disparities >= left.shape[1]:
        raise InputError(
            f"The images are {left.shape[1]} px wide, too narrow for a search over {num_disparities} disparities."
        )
