"""The object in one frame: which pixels are its own, and how far they are, to a fraction of a disparity step.

Pixels belong to it when the depth map puts them where the track expects it. Their common disparity is then refined
by registering the left eye's patch in the right image (one shift on top of the matched disparities, gain and offset
between the eyes taken out), which averages out what a single match cannot know.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap
from morpheyes_daemon.strategies.imo.features import Mask
from morpheyes_daemon.strategies.imo.plane_sweep import swept_depth
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.transforms import Array

FILL = 1.25
"""The visible face reaches as much further from its middle than the radius says."""

LEAST_SHARE = 0.12
LEAST_PX = 10
"""Of the disc that the object should cover, and in pixels: with less it is not there."""

ALIKE = 0.6
"""Normalised cross-correlation between the eyes from which the patch is the same thing."""

MATCH_PX = 1.0
"""A disparity of the depth map may be off by so much on a small object."""

APART_PX = 0.5
"""A background at so much less disparity is told from the object."""

SMALL_PX = 60.0
"""A window that reaches less far than this from its middle, at 640 px of image width, is matched by itself."""

STEPS = 6

RING = (1.35, 1.75)
"""Radii of the ring around an object that should show something else, as multiples of its own."""

SECTORS = 8
"""Into which the ring is cut: does the object go on in any direction?"""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Where the track expects the middle of the visible face: p_rect (3,), one sigma across and along, its radius."""

    p_rect: Array
    across_m: float
    along_m: float
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What one frame says of the object: mask (H, W), middle pixel (2,), depth of the visible face and its point (3,).

    `alike` is the correlation of the patch between the eyes, `whole` whether it lies inside the image, `joined` how
    much the surroundings on both sides are as far away: a thing by itself has little of that, a piece of wall much.
    `covered` is the share of the surroundings that is nearer and may hide a part of it.
    """

    mask: Mask
    uv: Array
    depth_m: float
    p_rect: Array
    radius_m: float
    alike: float
    whole: bool
    joined: float
    covered: float


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """A window of the image: first row and column, and what the depth map says there."""

    top: int
    left: int
    depth_m: FloatMap

    @property
    def box(self) -> tuple[slice, slice]:
        height, width = self.depth_m.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


def sight(frame: Frame, expected: Expected, beyond_m: float = 0.0) -> Sighting | None:
    """Return the object as seen in `frame`, None when it is not where it is expected; what is not farther away than
    `beyond_m` is something else."""
    patch = _window(frame, expected)
    if patch is None:
        return None
    mask = _own_pixels(frame, patch, expected, beyond_m)
    if mask is None:
        return None
    disparity, alike = _registered(frame, patch, mask)
    if alike < ALIKE:
        return None
    return _sighting(frame, patch, mask, disparity, alike, expected)


def _window(frame: Frame, expected: Expected) -> _Patch | None:
    """Cut out what the object can cover, its uncertainty included."""
    u, v, d = frame.project(expected.p_rect)
    if not np.isfinite(d):
        return None
    reach = (1.8 * expected.radius_m + 3.0 * expected.across_m) * d / frame.baseline_m + 4.0
    height, width = frame.left.shape
    left, right = max(0, round(u - reach)), min(width, round(u + reach) + 1)
    top, bottom = max(0, round(v - reach)), min(height, round(v + reach) + 1)
    if right - left < 4 or bottom - top < 4:
        return None
    box = slice(top, bottom), slice(left, right)
    if reach > SMALL_PX * frame.scale:
        return _Patch(top, left, frame.depth_m[box])
    z0, margin_m = float(expected.p_rect[2]), 2.0 * expected.radius_m + 4.0 * expected.along_m
    return _Patch(top, left, swept_depth(frame, box, max(0.3, 0.85 * z0 - margin_m), 2.5 * z0 + margin_m))


def _own_pixels(frame: Frame, patch: _Patch, expected: Expected, beyond_m: float) -> Mask | None:
    """Return the pixels of the window that lie where the object should be, as one piece; None when they are too few.

    Whatever is seen around it is its background; where that lies clearly behind, a pixel is the object's when its
    disparity is nearer to the object's than to the background's: to the expected one or, if it is nearer, the one found.
    """
    z0 = float(expected.p_rect[2])
    own_px, reach_m, slack_m = frame.bf_m_px / z0, FILL * expected.radius_m, 3.0 * expected.across_m
    middle = frame.project(expected.p_rect)[:2]
    with np.errstate(invalid="ignore"):
        disparity_px = frame.bf_m_px / patch.depth_m
        as_far = np.abs(patch.depth_m - z0) < reach_m + 3.0 * expected.along_m + MATCH_PX * z0 / own_px
        as_far &= patch.depth_m > beyond_m
    around = disparity_px[np.isfinite(disparity_px) & ~_disc(frame, patch, middle, z0, reach_m + slack_m)]
    behind_px = float(np.median(around)) if around.size else 0.0
    mask = np.asarray(as_far)
    for reach in (reach_m + slack_m, reach_m):
        mask = as_far & _disc(frame, patch, middle, z0, reach)
        if own_px - behind_px > APART_PX:
            mask &= disparity_px > 0.5 * (own_px + behind_px)
        mask = _nearest_piece(mask, middle - (patch.left, patch.top))
        if not mask.any():
            return None
        rows, columns = np.nonzero(mask)
        middle = np.array([columns.mean() + patch.left, rows.mean() + patch.top])
        own_px = max(own_px, float(np.median(disparity_px[mask])))
    disc_px = np.pi * (expected.radius_m * frame.pinhole.f_px / z0) ** 2
    inside = min(1.0, mask.size / disc_px)
    return mask if mask.sum() >= max(LEAST_PX * frame.scale, LEAST_SHARE * disc_px * inside) else None


def _disc(frame: Frame, patch: _Patch, middle: Array, z_m: float, reach_m: float) -> Mask:
    height, width = patch.depth_m.shape
    v, u = np.ogrid[patch.top : patch.top + height, patch.left : patch.left + width]
    reach_px = reach_m * frame.pinhole.f_px / z_m + 1.0
    return np.asarray((u - middle[0]) ** 2 + (v - middle[1]) ** 2 < reach_px**2)


def _nearest_piece(mask: Mask, middle: Array) -> Mask:
    """Return the connected piece of `mask` that is largest, weighted by how near to `middle` (u, v) it lies."""
    count, labels, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask)
    area = stats[1:, cv2.CC_STAT_AREA]
    away = np.linalg.norm(centres[1:] - middle, axis=1)
    best = 1 + int(np.argmax(area / (1.0 + (away / np.sqrt(area + 1.0)) ** 2)))
    return np.asarray(labels == best)


def _registered(frame: Frame, patch: _Patch, mask: Mask) -> tuple[FloatMap, float]:
    """Return the disparities of the window, shifted as one so that the eyes agree best on the object, and how well.

    Gauss-Newton on the shift, gain and offset (Lucas and Kanade 1981 along the epipolar line).
    """
    own = np.where(mask, frame.bf_m_px / patch.depth_m, np.nan).astype(np.float32)
    own = np.where(mask, own, np.float32(np.nanmedian(own)))
    smooth = cv2.GaussianBlur(own, (0, 0), 1.0)
    rows, columns = patch.box
    left = frame.left[rows, columns].astype(np.float32)[mask]
    v, u = np.mgrid[rows, columns].astype(np.float32)
    shift, alike = 0.0, -1.0
    for _ in range(STEPS):
        seen, slope = (image[mask] for image in _right_eye(frame, u - smooth - np.float32(shift), v))
        A = np.stack([slope, seen, np.ones_like(seen)], axis=1)
        alike = _correlation(left, seen)
        solved, *_ = np.linalg.lstsq(A, left, rcond=None)
        gain = solved[1] if abs(solved[1]) > 0.2 else 1.0
        change = float(np.clip(-solved[0] / gain, -0.7, 0.7))
        shift += change
        if abs(change) < 5e-3 or abs(shift) > 2.0 * MATCH_PX:
            break
    if abs(shift) > 2.0 * MATCH_PX:
        return np.asarray(smooth, dtype=np.float32), -1.0
    return np.asarray(smooth + np.float32(shift), dtype=np.float32), alike


def _right_eye(frame: Frame, u: FloatMap, v: FloatMap) -> tuple[FloatMap, FloatMap]:
    """Return the right image (h, w) at pixels u, v (h, w), and its slope along the row."""
    values = [
        np.asarray(
            cv2.remap(frame.right, u + np.float32(step), v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            dtype=np.float32,
        )
        for step in (-0.5, 0.0, 0.5)
    ]
    return values[1], values[2] - values[0]


def _correlation(a: FloatMap, b: FloatMap) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-6))


def _sighting(
    frame: Frame, patch: _Patch, mask: Mask, disparity: FloatMap, alike: float, expected: Expected
) -> Sighting | None:
    depth_m = float(frame.bf_m_px / np.median(disparity[mask]))
    if not 0.0 < depth_m < 1e3:
        return None
    rows, columns = np.nonzero(mask)
    uv = np.array([columns.mean() + patch.left, rows.mean() + patch.top])
    whole = np.zeros(frame.left.shape, dtype=np.bool_)
    whole[patch.box] = mask
    edge = bool(whole[0].any() or whole[-1].any() or whole[:, 0].any() or whole[:, -1].any())
    radius_m = float(np.sqrt(mask.sum() / np.pi)) * depth_m / frame.pinhole.f_px
    p_rect = frame.points(np.array([*uv, frame.bf_m_px / depth_m]))
    joined, covered = _surroundings(frame, patch, uv, depth_m, expected.radius_m)
    return Sighting(whole, uv, depth_m, p_rect, radius_m, alike, not edge, joined, covered)


def _surroundings(frame: Frame, patch: _Patch, middle: Array, depth_m: float, radius_m: float) -> tuple[float, float]:
    """Return how much the object goes on, at its own depth, on both sides of itself: 0 a thing by itself, 1 a piece;

    and the share of what is around it that is nearer. The ring around it is cut into sectors; of two that face each
    other the lesser share that is as far away as the object counts (what lies outside the window is left out), and of
    all such pairs the greatest. A trunk goes on in one direction alone, a wall in all, what stands on the ground only
    downwards.
    """
    ring = _disc(frame, patch, middle, depth_m, RING[1] * radius_m)
    ring &= ~_disc(frame, patch, middle, depth_m, RING[0] * radius_m)
    if not ring.any():
        return 1.0, 0.0
    rows, columns = np.nonzero(ring)
    angle = np.arctan2(rows + patch.top - middle[1], columns + patch.left - middle[0])
    sector = np.rint(angle / (2.0 * np.pi / SECTORS)).astype(np.intp) % SECTORS
    step_m = MATCH_PX * depth_m * depth_m / frame.bf_m_px
    with np.errstate(invalid="ignore", divide="ignore"):
        same = np.abs(patch.depth_m[ring] - depth_m) < radius_m + step_m
        share = np.bincount(sector, same, SECTORS) / np.bincount(sector, minlength=SECTORS)
        covered = float(np.mean(patch.depth_m[ring] < depth_m - radius_m - step_m))
    lesser = np.fmin(share[: SECTORS // 2], share[SECTORS // 2 :])
    return float(np.nanmax(lesser)), covered
