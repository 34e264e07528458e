"""Dense matching of a rectified pair: disparity, and for unknown pixels whether they are too near or half-occluded.

Semi-global matching is OpenCV's (StereoSGBM, Hirschmüller 2008, three path directions), on images padded so that
only pixels outside the right image are lost. Objects nearer than the largest disparity have no match, and the matcher
often finds a false, far one there; so a coarse search over a longer range detects such regions and overrules the
fine search. The result does not depend on the number of threads.
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
"""Height over width of a coarse pixel; chosen: halves the time of the coarse search, loses low obstacles."""

STEP = 16
"""The number of disparities must be a multiple of this (OpenCV, StereoSGBM)."""

SUBPIXELS = 16
"""Steps per pixel of StereoSGBM's fixed-point disparity (OpenCV, StereoMatcher::DISP_SCALE)."""

CEILING_MARGIN_PX = 1.5
"""Disparities within this of the largest one count as beyond it: the matcher cannot interpolate there."""


def _subpixel_correction() -> FloatMap:
    """Return the correction (16,) in pixels for each sixteenth that StereoSGBM returns.

    OpenCV fits a parabola to a V-shaped cost, which biases the true fraction delta to x = delta / (2 (1 - delta)),
    towards whole pixels, and its integer division raises negative fractions by one step. Both are inverted.
    """
    step = np.arange(SUBPIXELS)
    step = np.where(step <= SUBPIXELS // 2, step, step - SUBPIXELS)
    x = (step - np.select([step < 0, step == 0], [1.0, 0.5], 0.0)) / SUBPIXELS
    true = np.sign(x) * 2 * np.abs(x) / (1 + 2 * np.abs(x))
    return np.asarray(true - step / SUBPIXELS, dtype=np.float32)


_CORRECTION_PX = _subpixel_correction()


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Settings of the matcher; all are chosen, with what each trades.

    Penalties are per pixel of the block's area; `_px` are pixels of the matched image.
    """

    block_px: int = 3
    """Side of the block; larger ones blur thin branches, smaller ones are noisier."""
    small_step_penalty: int = 4
    """P1 per pixel of the block; larger flattens slanted surfaces."""
    large_step_penalty: int = 16
    """P2 per pixel of the block; larger bridges depth edges."""
    gradient_cap: int = 63
    """Grey levels at which the horizontal gradient is truncated."""
    uniqueness_pct: int = 15
    """Margin in percent of the best cost over the second best; larger loses repetitive texture."""
    left_right_px: int = 1
    """Largest difference in the left-right check."""
    speckle_per_image: float = 1 / 1200
    """Patches below this fraction of the image are removed."""
    island_per_image: float = 1 / 400
    """Patches below this fraction are removed where ..."""
    island_unknown_share: float = 0.8
    """... more than this share of their neighbours is unknown."""
    row_step: int = 1
    """2 matches the means of two rows: half the time, the full disparity resolution."""
    coarse_width_px: int = 160
    """Width of the coarse image that is searched beyond the ceiling."""
    coarse_range: float = 3.0
    """Range of the coarse search over that of the fine one."""
    coarse_speckle_px: int = 30
    """Patches of the coarse disparity below this are removed."""


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """disparity_px (H, W) float32, NaN unknown. `near`: unknown since nearer than `ceiling_px` allows; `half_occluded`:
    unknown since seen by the left camera only; both (H, W) bool."""

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
    covered: tuple[Mask | None, Mask | None] = (None, None),
) -> Match:
    """Return the disparity of rectified grey images (H, W) uint8 over [min_disparity, min_disparity + num_disparities).

    `covered` are the pixels (H, W) of the left and of the right rectified image that the raw images cover, None for
    all. Raises InputError when sizes or types differ or `num_disparities` does not fit the width. Semi-global matching
    after Hirschmueller (2008), as OpenCV implements it.
    """
    _require_pair(left, right, num_disparities)
    settings = settings or MatchSettings()
    shape, step = left.shape, settings.row_step
    ceiling = min_disparity + num_disparities
    near = _beyond_ceiling(left, right, min_disparity, num_disparities, settings)[::step][: shape[0] // step]
    if step > 1:
        left, right = _downsampled(left, 1, step), _downsampled(right, 1, step)
    speckle_px = round(left.size * settings.speckle_per_image)
    disparity = semi_global(left, right, range(min_disparity, ceiling), settings, speckle_px)
    near |= disparity > ceiling - CEILING_MARGIN_PX
    disparity[near] = np.nan
    _remove_uncovered(disparity, near, _rows_of(covered[0], step), _rows_of(covered[1], step))
    _remove_islands(disparity, round(left.size * settings.island_per_image), settings.island_unknown_share)
    half_occluded = _half_occluded(disparity, near, ceiling)
    if step > 1:
        disparity, near, half_occluded = (
            _upsampled(array, 1, step, shape) for array in (disparity, near, half_occluded)
        )
    return Match(disparity, near, half_occluded, float(ceiling))


def semi_global(left: Image, right: Image, search: range, settings: MatchSettings, speckle_px: int) -> FloatMap:
    """Return the disparity (H, W) float32 of left pixels, NaN where unknown or outside the right image.

    `search` are the disparities in pixels; patches below `speckle_px` pixels are removed (OpenCV, StereoSGBM).
    """
    block_area = settings.block_px**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=search.start,
        numDisparities=len(search),
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
    before, after = max(0, search.stop), max(0, -search.start)
    padded = [cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right)]
    fixed = np.asarray(matcher.compute(*padded), dtype=np.int16)[:, before : before + left.shape[1]]
    disparity = fixed.astype(np.float32) / np.float32(SUBPIXELS) + _CORRECTION_PX[fixed & (SUBPIXELS - 1)]
    column = np.arange(left.shape[1], dtype=np.float32)
    disparity[(fixed < search.start * SUBPIXELS) | (disparity > column + 0.5)] = np.nan
    return np.asarray(disparity)


def _beyond_ceiling(left: Image, right: Image, low: int, count: int, settings: MatchSettings) -> Mask:
    """Return the pixels (H, W) whose coarse match, over a longer range, lies beyond the ceiling of the fine search."""
    height, width = left.shape
    scale = max(1, round(width / settings.coarse_width_px))
    small_left, small_right = (_downsampled(image, scale, COARSE_ROW_FACTOR * scale) for image in (left, right))
    reach = disparity_range(count * settings.coarse_range / scale, small_left.shape[1])
    search = range(low // scale, low // scale + reach)
    coarse = semi_global(small_left, small_right, search, settings, settings.coarse_speckle_px)
    beyond = coarse * scale > low + count + scale / 2
    return _upsampled(beyond, scale, COARSE_ROW_FACTOR * scale, (height, width))


def _downsampled(image: Image, across: int, down: int) -> Image:
    height, width = image.shape
    rows, columns = height // down, width // across
    cut = image[: rows * down, : columns * across]
    return np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA))


def _upsampled(small: NDArray[Any], across: int, down: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return `small` with every pixel repeated, and its right and bottom edge extended to `shape`."""
    drawn = small.view(np.uint8) if small.dtype == np.bool_ else small
    size = (small.shape[1] * across, small.shape[0] * down)
    grown = cv2.resize(drawn, size, interpolation=cv2.INTER_NEAREST)
    missing = shape[0] - size[1], shape[1] - size[0]
    whole = np.asarray(cv2.copyMakeBorder(grown, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE))
    return whole.view(np.bool_) if small.dtype == np.bool_ else whole


def _rows_of(covered: Mask | None, step: int) -> Mask | None:
    return None if covered is None else covered[::step][: covered.shape[0] // step]


def _remove_uncovered(disparity: FloatMap, near: Mask, left: Mask | None, right: Mask | None) -> None:
    """Make pixels unknown that are outside the left raw image, or whose match is outside the right one."""
    if left is not None:
        disparity[~left] = np.nan
        near &= left
    if right is not None:
        # the covered part of a rectified row is connected
        width = right.shape[1]
        first = right.argmax(axis=1)
        last = np.where(right.any(axis=1), width - 1 - right[:, ::-1].argmax(axis=1), -1)
        partner = np.arange(width, dtype=np.float32) - disparity
        disparity[(partner < first[:, None] - 0.5) | (partner > last[:, None] + 0.5)] = np.nan


def _remove_islands(disparity: FloatMap, largest_px: int, unknown_share: float) -> None:
    """Make small patches of disparity unknown that are surrounded by unknown pixels: false matches of textureless areas.

    A patch is removed when more than `unknown_share` of its neighbours are unknown; a thin branch stays, since the
    background is known on one side of it.
    """
    none = np.iinfo(np.int16).min
    unknown = np.isnan(disparity)
    fixed = np.where(unknown, none, disparity * SUBPIXELS).astype(np.int16)
    large = fixed.copy()
    cv2.filterSpeckles(large, none, largest_px, SUBPIXELS)
    count, labels = cv2.connectedComponents((fixed != large).view(np.uint8), connectivity=4)
    total, unknown_count = np.zeros(count), np.zeros(count)
    for patch, beside, beside_unknown in _neighbours(labels, unknown):
        edge = (patch != beside) & (patch > 0)
        total += np.bincount(patch[edge], minlength=count)
        unknown_count += np.bincount(patch[edge], weights=beside_unknown[edge], minlength=count)
    isolated = unknown_count > unknown_share * total
    disparity[isolated[labels]] = np.nan


def _neighbours(labels: NDArray[Any], unknown: Mask) -> Iterator[tuple[NDArray[Any], NDArray[Any], Mask]]:
    """Yield labels, the labels of the neighbours on one side, and whether these are unknown, for the four sides."""
    yield labels[:, :-1], labels[:, 1:], unknown[:, 1:]
    yield labels[:, 1:], labels[:, :-1], unknown[:, :-1]
    yield labels[:-1], labels[1:], unknown[1:]
    yield labels[1:], labels[:-1], unknown[:-1]


def _half_occluded(disparity: FloatMap, near: Mask, ceiling: float) -> Mask:
    """Return where an unknown pixel is hidden from the right camera by a nearer surface or by the edge of the image.

    Seen from the right camera a nearer surface with disparity d_f covers d_f - d_b pixels of the background (d_b) left
    of its own left edge; at the image's edge d_f pixels are missing. Pixels left of a region nearer than the ceiling may
    belong to it and are not marked.
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
    """Return row, first column and end column (one past the last) (n,) of every run of True along a row of (H, W)."""
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
