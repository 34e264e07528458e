"""Object segmentation in one frame: the object's pixels, and its depth to a fraction of a disparity step.

Pixels belong to the object when the depth map has them where the tracker predicts it. Their common disparity is then
refined by registering the left image's patch in the right image (one shift added to the matched disparities, with gain
and offset between the cameras estimated), which averages the errors of single matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Mask
from morpheyes_daemon.strategies.imo.plane_sweep import plane_sweep_depth
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.transforms import Array

FACE_RADII = 1.25
"""Extent of the visible face from its centre, in radii. Unit: none.

Chosen: the corner of a square is at 1.25 radii of the circle of equal area; larger takes in the background."""

MIN_DISC_SHARE, MIN_PX = 0.12, 10
"""Share of the predicted disc, and pixels at 640 px of image width, from which the object is present. Unit: none, px.

Chosen: half hidden objects; lower accepts single mismatches."""

MIN_CORRELATION = 0.6
"""Normalised cross-correlation between the cameras from which the patch is the same object. Unit: none.

Chosen: lower accepts occluders, higher loses small patches in noise."""

MATCH_PX = 1.0
"""Error of a depth map's disparity on a small object.

Chosen: two steps of the matching; smaller loses pixels, larger takes in the background."""

SEPARATE_PX = 0.5
"""Difference of disparity from which background is separated from the object.

Chosen: the noise of a swept window's disparity; smaller cuts the object by noise."""

SMALL_PX = 60.0
"""Window size, from its centre, at 640 px of image width, below which depth is computed by plane sweep.

Chosen: larger objects are in the depth map; the sweep's time grows with the area."""

REGISTRATION_STEPS, REGISTERED_PX = 6, 5e-3
"""Gauss-Newton steps of the registration, and the change at which it ends. Unit: steps, px.

Chosen: a tenth of a typical error of the depth map is reached in three."""

MAX_STEP_PX, MAX_SHIFT_PX = 0.7, 2.0 * MATCH_PX
"""Largest shift of one step and in all.

Chosen: within the range in which image gradients are linear; a larger shift is another object."""

MIN_GAIN = 0.2
"""Estimated gain between the cameras below which 1 is used. Unit: none.

Chosen: excludes patches without texture."""

WINDOW_RADII, WINDOW_SIGMAS, WINDOW_PX = 1.8, 3.0, 4.0
"""Extent of the window from the predicted centre: radii, lateral sigmas and pixels. Unit: none, none, px.

Chosen: covers the ring around the object; larger costs time."""

MIN_WINDOW_PX = 4
"""Smallest side of a window inside the image.

Chosen: fewer pixels have no texture to register."""

SWEEP_NEAREST, SWEEP_FARTHEST, SWEEP_RADII, SWEEP_SIGMAS = 0.85, 2.5, 2.0, 4.0
"""Depth range of the plane sweep: factors on the predicted depth, and margin in radii and depth sigmas. Unit: none.

Chosen: the background must be in it to be separated; more planes cost time."""

NEAREST_M = 0.3
"""Nearest depth of the plane sweep.

Chosen: the near limit at the smallest baseline."""

MAX_DEPTH_M = 1e3
"""Depth above which a result is discarded.

Chosen: far beyond what any baseline resolves."""

RING_RADII = (1.35, 1.75)
"""Inner and outer radius of the ring in which the surroundings are compared, in radii of the object. Unit: none.

Chosen: outside the visible face and inside the window."""

RING_SECTORS = 8
"""Sectors of the ring. Unit: sectors.

Chosen: 45 degrees, about the width of a trunk behind an object; even, so that sectors have an opposite."""


@dataclass(frozen=True, slots=True, eq=False)
class PredictedObject:
    """Prediction of the tracker: centre of the visible face (3,), rect metres, sigmas across and along, radius."""

    p_rect: Array
    across_m: float
    along_m: float
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """The object in one frame: mask (H, W), centre pixel (2,), depth of the visible face, its point (3,), rect metres.

    `correlation` of the patch between the cameras. `inside`: it does not touch the edge of the image. `continuity`:
    depth continuity across the contour, 0 isolated object, 1 part of a larger surface. `occluded`: share of the
    surroundings that is nearer and may hide a part of it.
    """

    mask: Mask
    uv: Array
    depth_m: float
    p_rect: Array
    radius_m: float
    correlation: float
    inside: bool
    continuity: float
    occluded: float


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """A window of the image: first row and column, and its depth (h, w), metres."""

    top: int
    left: int
    depth_m: FloatMap

    @property
    def box(self) -> tuple[slice, slice]:
        height, width = self.depth_m.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


def detect_object(frame: RectifiedFrame, predicted: PredictedObject, beyond_m: float = 0.0) -> Detection | None:
    """Return the object in `frame`, None when it is not where it is predicted; only pixels beyond `beyond_m` count."""
    patch = _window(frame, predicted)
    if patch is None:
        return None
    mask = _object_pixels(frame, patch, predicted, beyond_m)
    if mask is None:
        return None
    disparity, correlation = _registered(frame, patch, mask)
    if correlation < MIN_CORRELATION:
        return None
    return _detection(frame, patch, _Registered(mask, disparity, correlation), predicted)


def _window(frame: RectifiedFrame, predicted: PredictedObject) -> _Patch | None:
    """Return the window that the object can cover, its uncertainty included; None outside the image."""
    u, v, d = frame.project(predicted.p_rect)
    if not np.isfinite(d):
        return None
    reach = (WINDOW_RADII * predicted.radius_m + WINDOW_SIGMAS * predicted.across_m) * d / frame.baseline_m + WINDOW_PX
    height, width = frame.left.shape
    left, right = max(0, round(u - reach)), min(width, round(u + reach) + 1)
    top, bottom = max(0, round(v - reach)), min(height, round(v + reach) + 1)
    if right - left < MIN_WINDOW_PX or bottom - top < MIN_WINDOW_PX:
        return None
    box = slice(top, bottom), slice(left, right)
    if reach > SMALL_PX * frame.scale:
        return _Patch(top, left, frame.depth_m[box])
    z0, margin_m = float(predicted.p_rect[2]), SWEEP_RADII * predicted.radius_m + SWEEP_SIGMAS * predicted.along_m
    nearest_m, farthest_m = max(NEAREST_M, SWEEP_NEAREST * z0 - margin_m), SWEEP_FARTHEST * z0 + margin_m
    return _Patch(top, left, plane_sweep_depth(frame, box, nearest_m, farthest_m))


def _object_pixels(frame: RectifiedFrame, patch: _Patch, predicted: PredictedObject, beyond_m: float) -> Mask | None:
    """Return the pixels (h, w) of the window at the predicted place, as one component; None when they are too few.

    The pixels around the predicted disc are the background; where that lies clearly behind, a pixel is the object's
    when its disparity is closer to the object's (predicted, or found if that is larger) than to the background's.
    """
    z0 = float(predicted.p_rect[2])
    own_px, reach_m, slack_m = frame.bf_m_px / z0, FACE_RADII * predicted.radius_m, 3.0 * predicted.across_m
    centre = frame.project(predicted.p_rect)[:2]
    with np.errstate(invalid="ignore"):
        disparity_px = frame.bf_m_px / patch.depth_m
        same_depth = np.abs(patch.depth_m - z0) < reach_m + 3.0 * predicted.along_m + MATCH_PX * z0 / own_px
        same_depth &= patch.depth_m > beyond_m
    around = disparity_px[np.isfinite(disparity_px) & ~_disc(frame, patch, centre, z0, reach_m + slack_m)]
    behind_px = float(np.median(around)) if around.size else 0.0
    mask = np.asarray(same_depth)
    for reach in (reach_m + slack_m, reach_m):
        mask = same_depth & _disc(frame, patch, centre, z0, reach)
        if own_px - behind_px > SEPARATE_PX:
            mask &= disparity_px > 0.5 * (own_px + behind_px)
        mask = _nearest_component(mask, centre - (patch.left, patch.top))
        if not mask.any():
            return None
        rows, columns = np.nonzero(mask)
        centre = np.array([columns.mean() + patch.left, rows.mean() + patch.top])
        own_px = max(own_px, float(np.median(disparity_px[mask])))
    disc_px = np.pi * (predicted.radius_m * frame.pinhole.f_px / z0) ** 2
    inside = min(1.0, mask.size / disc_px)
    return mask if mask.sum() >= max(MIN_PX * frame.scale, MIN_DISC_SHARE * disc_px * inside) else None


def _disc(frame: RectifiedFrame, patch: _Patch, centre: Array, z_m: float, reach_m: float) -> Mask:
    """Return the pixels (h, w) of the window within `reach_m` of `centre` (2,), px, at depth `z_m`."""
    height, width = patch.depth_m.shape
    v, u = np.ogrid[patch.top : patch.top + height, patch.left : patch.left + width]
    reach_px = reach_m * frame.pinhole.f_px / z_m + 1.0
    return np.asarray((u - centre[0]) ** 2 + (v - centre[1]) ** 2 < reach_px**2)


def _nearest_component(mask: Mask, centre: Array) -> Mask:
    """Return the largest connected component of `mask`, weighted by its distance to `centre` (2,), px."""
    count, labels, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask)
    area = stats[1:, cv2.CC_STAT_AREA]
    away = np.linalg.norm(centres[1:] - centre, axis=1)
    best = 1 + int(np.argmax(area / (1.0 + (away / np.sqrt(area + 1.0)) ** 2)))
    return np.asarray(labels == best)


def _registered(frame: RectifiedFrame, patch: _Patch, mask: Mask) -> tuple[FloatMap, float]:
    """Return disparities (h, w), px, of the window, shifted as one to register the object, and its correlation.

    Gauss-Newton on the shift, gain and offset (Lucas and Kanade 1981 along the epipolar line).
    """
    disparity = np.where(mask, frame.bf_m_px / patch.depth_m, np.nan).astype(np.float32)
    disparity = np.where(mask, disparity, np.float32(np.nanmedian(disparity)))
    smooth = cv2.GaussianBlur(disparity, (0, 0), 1.0)
    rows, columns = patch.box
    left = frame.left[rows, columns].astype(np.float32)[mask]
    v, u = np.mgrid[rows, columns].astype(np.float32)
    shift, correlation = 0.0, -1.0
    for _ in range(REGISTRATION_STEPS):
        right, slope = (image[mask] for image in _right_image(frame, u - smooth - np.float32(shift), v))
        A = np.stack([slope, right, np.ones_like(right)], axis=1)
        correlation = _correlation(left, right)
        solved, *_ = np.linalg.lstsq(A, left, rcond=None)
        gain = solved[1] if abs(solved[1]) > MIN_GAIN else 1.0
        change = float(np.clip(-solved[0] / gain, -MAX_STEP_PX, MAX_STEP_PX))
        shift += change
        if abs(change) < REGISTERED_PX or abs(shift) > MAX_SHIFT_PX:
            break
    if abs(shift) > MAX_SHIFT_PX:
        return np.asarray(smooth, dtype=np.float32), -1.0
    return np.asarray(smooth + np.float32(shift), dtype=np.float32), correlation


def _right_image(frame: RectifiedFrame, u: FloatMap, v: FloatMap) -> tuple[FloatMap, FloatMap]:
    """Return the right image (h, w) at pixels u, v (h, w), and its gradient along the row, per px."""
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


@dataclass(frozen=True, slots=True, eq=False)
class _Registered:
    """The object's pixels (h, w) in a window, the window's disparities (h, w), px, and the patch's correlation."""

    mask: Mask
    disparity: FloatMap
    correlation: float


def _detection(frame: RectifiedFrame, patch: _Patch, found: _Registered, predicted: PredictedObject) -> Detection | None:
    mask = found.mask
    depth_m = float(frame.bf_m_px / np.median(found.disparity[mask]))
    if not 0.0 < depth_m < MAX_DEPTH_M:
        return None
    rows, columns = np.nonzero(mask)
    uv = np.array([columns.mean() + patch.left, rows.mean() + patch.top])
    pixels = np.zeros(frame.left.shape, dtype=np.bool_)
    pixels[patch.box] = mask
    edge = bool(pixels[0].any() or pixels[-1].any() or pixels[:, 0].any() or pixels[:, -1].any())
    radius_m = float(np.sqrt(mask.sum() / np.pi)) * depth_m / frame.pinhole.f_px
    p_rect = frame.points(np.array([*uv, frame.bf_m_px / depth_m]))
    continuity, occluded = _surroundings(frame, patch, uv, depth_m, predicted.radius_m)
    return Detection(pixels, uv, depth_m, p_rect, radius_m, found.correlation, not edge, continuity, occluded)


def _surroundings(
    frame: RectifiedFrame, patch: _Patch, centre: Array, depth_m: float, radius_m: float
) -> tuple[float, float]:
    """Return the depth continuity across the contour (0 isolated, 1 part of a larger surface) and the share nearer.

    The ring around the object is divided into sectors. Of two opposite ones the smaller share at the object's depth
    counts (pixels outside the window are left out), and of all pairs the largest: a trunk continues in one direction,
    a wall in all, an object on the ground only downwards.
    """
    ring = _disc(frame, patch, centre, depth_m, RING_RADII[1] * radius_m)
    ring &= ~_disc(frame, patch, centre, depth_m, RING_RADII[0] * radius_m)
    if not ring.any():
        return 1.0, 0.0
    rows, columns = np.nonzero(ring)
    angle = np.arctan2(rows + patch.top - centre[1], columns + patch.left - centre[0])
    sector = np.rint(angle / (2.0 * np.pi / RING_SECTORS)).astype(np.intp) % RING_SECTORS
    step_m = MATCH_PX * depth_m * depth_m / frame.bf_m_px
    with np.errstate(invalid="ignore", divide="ignore"):
        same = np.abs(patch.depth_m[ring] - depth_m) < radius_m + step_m
        share = np.bincount(sector, same, RING_SECTORS) / np.bincount(sector, minlength=RING_SECTORS)
        occluded = float(np.mean(patch.depth_m[ring] < depth_m - radius_m - step_m))
    smaller = np.fmin(share[: RING_SECTORS // 2], share[RING_SECTORS // 2 :])
    return float(np.nanmax(smaller)), occluded
