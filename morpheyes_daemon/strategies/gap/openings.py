"""Openings in a wall: where they are, and with how much clearance the vehicle's silhouette fits through.

Works on the two clusters of `wall_segmentation`. The contour C is where depth jumps from the wall to the background;
the half-occluded strip at its right inside edge, f b (1/Z_wall - 1/Z_background) wide, belongs to the opening. The
opening is measured in projection along the wall's normal, so that an oblique view does not make it narrower.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import DepthMap, FloatMap, Mask, Pinhole
from morpheyes_daemon.strategies.gap.wall_segmentation import Box, Plane, WallSegmentation, median
from morpheyes_daemon.transforms import Array

RASTER_CELLS = 160
"""Cells over the larger extent of an opening in the search for the crossing point. Unit: cells.

Chosen: 4 mm for an opening of 0.6 m, less than a pixel at the stand-off; more cost time in the vision worker."""

MIN_FAR_FRACTION = 0.25
"""Share of an opening that must be in the far cluster; the rest may be half-occluded. Unit: none.

Chosen: a narrow opening is mostly half-occluded; lower takes holes of the matching for openings."""

COARSE_FRACTION = 0.8
"""Share of MIN_FAR_FRACTION that is asked for in the coarse search. Unit: none.

Chosen: below 1, so that sampling does not lose an opening that the full resolution accepts."""

PLATEAU_M = 0.008
"""Points whose clearance differs from the largest by less than this count as one region.

Chosen: about a pixel at the stand-off; a larger one moves the middle of a long opening less stably."""

CONTOUR_BAND_M = 0.06
"""Width of the foreground band F around the contour.

Chosen: several pixels at the stand-off; wider includes what stands before the wall."""

TUNNEL_M = 0.10
"""Margin around the silhouette within which things behind the wall count as obstacles.

Chosen: the vehicle's offset from the line; wider counts ground and walls that are passed."""

BEYOND_PERCENTILE = 3.0
"""Percentile of the depths behind the wall that counts as the nearest obstacle. Unit: %.

Chosen: single mismatches are below it; higher overlooks thin obstacles."""

DEPTH_SAMPLES = 5000
"""Pixels of an opening, about, that are used for the room behind it. Unit: px.

Chosen: time in the vision worker against thin obstacles behind the wall."""

COARSE_COLUMNS = 160
"""Columns, about, of the image in which holes are first searched. Unit: columns.

Chosen: every second or fourth pixel; fewer miss small openings from afar."""

MIN_HOLE_PX = 40
"""Pixels of the smallest hole.

Chosen: 6 by 6 px; smaller ones are holes of the matching."""

MAX_OPENINGS = 4
"""Openings returned, the largest ones. Unit: openings.

Chosen: more cost time in the vision worker."""

MAX_POINTS = 3
"""Crossing points of an opening, those with the largest clearance. Unit: points.

Chosen: an opening with more separate equal points is not flown through."""

MIN_RANGE_M = 0.2
"""Range by which sizes in pixels are computed at least.

Chosen: bounds the size of the band when the wall is very near."""

MIN_NORMAL_SHARE = 0.5
"""Horizontal part of a wall's normal below which it is no wall but ground or ceiling. Unit: none.

Source: equation, cos(60 degrees): the wall leans by at most 60 degrees."""


@dataclass(frozen=True, slots=True)
class Silhouette:
    """The vehicle's outline along its path, in crossing attitude and at the crossing baseline, metres."""

    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class CrossingPoint:
    """A point of the wall's plane (ned) and the clearance around the silhouette there; negative: it does not fit."""

    p_ned_m: tuple[float, float, float]
    clearance_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """One opening. `contour_px` (n, 2) float32 closed polygon in the rectified left image; `z_m` median of Z_C.

    `crossing_points`: where the silhouette fits best, the largest clearance first. `safe_point` is the paper's x_s.
    `width_m, height_m` are its extents across the wall's normal. `beyond_m` is the distance from the wall to the
    nearest obstacle seen through it. `cut`: it touches the edge of the image, so it may be larger.
    """

    contour_px: FloatMap
    z_m: float
    crossing_points: tuple[CrossingPoint, ...]
    safe_point: CrossingPoint
    width_m: float
    height_m: float
    beyond_m: float
    cut: bool


@dataclass(frozen=True, slots=True, eq=False)
class CrossingFrame:
    """Coordinates for crossing a wall: right, down and ahead, with ahead horizontal along the wall's normal.

    `axes_rect` (3, 3) has these axes as columns, in rect. `H_px` (3, 3) is the homography from metres right of and
    below the camera, in projection along the normal, to pixels of the wall's plane. `yaw_rad` is the normal's heading,
    `range_m` the distance from the camera to the wall along it.
    """

    axes_rect: Array
    R_ned_rect: Array
    origin_ned_m: Array
    pinhole: Pinhole
    plane: Plane
    H_px: Array
    yaw_rad: float
    range_m: float

    def ned(self, right_m: float, down_m: float) -> tuple[float, float, float]:
        """Return the point (ned, m) of the wall's plane that is passed `right_m` of and `down_m` below the camera."""
        u, v, s = self.H_px @ np.array([right_m, down_m, 1.0])
        return self.ned_of_pixel(u / s, v / s)

    def ned_of_pixel(self, u: float, v: float) -> tuple[float, float, float]:
        """Return the point (ned, m) of the wall's plane at a pixel."""
        z = 1.0 / (self.plane.a * u + self.plane.b * v + self.plane.c)
        ray = np.array([(u - self.pinhole.cx_px) / self.pinhole.f_px, (v - self.pinhole.cy_px) / self.pinhole.f_px, 1])
        p = self.origin_ned_m + self.R_ned_rect @ (z * ray)
        return float(p[0]), float(p[1]), float(p[2])


def crossing_frame(plane: Plane, pinhole: Pinhole, T_ned_rect: Array) -> CrossingFrame | None:
    """Return the crossing frame of a wall's plane, None when it is no wall or is seen from behind.

    T_ned_rect: pose (4, 4) of the rectified left camera, metres.
    """
    f, cx, cy = pinhole.f_px, pinhole.cx_px, pinhole.cy_px
    normal = np.array([plane.a * f, plane.b * f, plane.a * cx + plane.b * cy + plane.c])  # normal . X = 1
    R = T_ned_rect[:3, :3]
    ned = R @ normal
    size = math.hypot(ned[0], ned[1])
    if size < MIN_NORMAL_SHARE * float(np.linalg.norm(normal)) or normal[2] <= 0.0:
        return None
    along = np.array([ned[0] / size, ned[1] / size, 0.0])
    to_the_right, down = np.array([-along[1], along[0], 0.0]), np.array([0.0, 0.0, 1.0])
    axes = R.T @ np.stack([to_the_right, down, along], axis=1)
    K = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
    right, below, ahead = axes.T
    share = 1.0 / float(normal @ ahead)
    H = K @ np.stack([right - ahead * (normal @ right) * share, below - ahead * (normal @ below) * share,
                      ahead * share], axis=1)  # fmt: skip
    yaw = math.atan2(along[1], along[0])
    return CrossingFrame(axes, R, T_ned_rect[:3, 3], pinhole, plane, H, yaw, share)


def find_openings(
    depth: DepthMap, found: WallSegmentation, frame: CrossingFrame, silhouette: Silhouette
) -> tuple[Opening, ...]:
    """Return the openings of a wall, the largest first."""
    if not found.bimodal:
        return ()
    openings: list[Opening] = []
    for box, cut in _candidates(found, depth.pinhole.f_px / max(frame.range_m, MIN_RANGE_M)):
        far, wall = found.clusters(box)
        hole = _largest(~wall)
        if hole is None or np.count_nonzero(hole & far) < MIN_FAR_FRACTION * np.count_nonzero(hole):
            continue
        openings.append(_opening(depth, frame, silhouette, _Hole(hole, hole & far, wall, box, cut)))
        if len(openings) == MAX_OPENINGS:
            break
    return tuple(openings)


def _candidates(found: WallSegmentation, px_per_m: float) -> Iterator[tuple[Box, bool]]:
    """Yield boxes of possible holes, with the contour's band around them, and whether they touch the image's edge."""
    height, width = found.near.shape
    step = max(1, round(width / COARSE_COLUMNS))
    far, wall = found.clusters((slice(None, None, step), slice(None, None, step)))
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~wall).view(np.uint8), connectivity=4)
    seen = np.bincount(labels[far], minlength=count)
    pad = max(2, round(CONTOUR_BAND_M * px_per_m)) + step
    for label in (np.argsort(-stats[1:count, cv2.CC_STAT_AREA])[: 3 * MAX_OPENINGS] + 1).tolist():
        x, y, w, h, area = (int(value) * step for value in stats[label])
        if area * step < MIN_HOLE_PX:
            return
        if seen[label] * step < COARSE_FRACTION * MIN_FAR_FRACTION * area:
            continue
        cut = x == 0 or y == 0 or x + w >= width or y + h >= height
        yield (slice(max(0, y - pad), min(height, y + h + pad)), slice(max(0, x - pad), min(width, x + w + pad))), cut


def _largest(mask: Mask) -> Mask | None:
    """Return the largest connected component of a mask, None when it has fewer than MIN_HOLE_PX."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=4)
    if count < 2:
        return None
    label = 1 if count == 2 else 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    component = np.asarray(labels == label)
    return component if np.count_nonzero(component) >= MIN_HOLE_PX else None


@dataclass(frozen=True, slots=True, eq=False)
class _Hole:
    """Masks (h, w) within a box of the image: an opening, its pixels in the far cluster, and the wall around it."""

    inside: Mask
    far: Mask
    wall: Mask
    box: Box
    cut: bool


def _opening(depth: DepthMap, frame: CrossingFrame, silhouette: Silhouette, hole: _Hole) -> Opening:
    corner = np.array([hole.box[1].start, hole.box[0].start], dtype=np.float32)
    outlines, _ = cv2.findContours(hole.inside.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(outlines, key=len)[:, 0].astype(np.float32) + corner
    z_m = median(1.0 / np.maximum(frame.plane.at(contour.astype(np.float64)), 1e-3))
    raster = _raster(hole.inside, contour, corner, frame, silhouette)
    band_px = max(2, round(CONTOUR_BAND_M * depth.pinhole.f_px / max(frame.range_m, MIN_RANGE_M)))
    u, v = (float(c) for c in _safe_point_px(hole, band_px) + corner)
    safe_point = CrossingPoint(frame.ned_of_pixel(u, v), _clearance_at(raster, frame, u, v))
    points = _crossing_points(raster, frame)
    beyond_m = _beyond_m(depth, hole, frame, points[0], silhouette)
    return Opening(contour, z_m, points, safe_point, *raster.extent_m, beyond_m, hole.cut)


def _beyond_m(depth: DepthMap, hole: _Hole, frame: CrossingFrame, point: CrossingPoint, silhouette: Silhouette) -> float:
    """Return the distance from the wall to the nearest visible obstacle behind it, metres.

    Only points within TUNNEL_M of the silhouette count: the vehicle passes ground and sky behind the wall.
    """
    box, far = hole.box, hole.far
    step = max(1, round(math.sqrt(far.size / DEPTH_SAMPLES)))
    row, column = (index * step for index in np.nonzero(far[::step, ::step]))
    z = depth.depth_m[box][row, column].astype(np.float64)
    f, cx, cy = frame.pinhole.f_px, frame.pinhole.cx_px, frame.pinhole.cy_px
    points = np.stack([(column + box[1].start - cx) / f * z, (row + box[0].start - cy) / f * z, z])
    right, down, ahead = frame.axes_rect.T @ points
    at = frame.axes_rect.T @ (frame.R_ned_rect.T @ (np.array(point.p_ned_m) - frame.origin_ned_m))
    reach = (silhouette.width_m / 2 + TUNNEL_M, silhouette.height_m / 2 + TUNNEL_M)
    inside = (np.abs(right - at[0]) < reach[0]) & (np.abs(down - at[1]) < reach[1])
    met = ahead[inside] if inside.sum() >= MIN_HOLE_PX // (4 * step * step) + 3 else ahead
    return float(np.percentile(met, BEYOND_PERCENTILE) - at[2]) if met.size else 0.0


def _safe_point_px(hole: _Hole, band_px: int) -> FloatMap:
    """Return the paper's x_s (2,), px: median(F) if |F| >= |B|, else median(B); F is the band around the contour."""
    kernel = np.ones((2 * band_px + 1, 2 * band_px + 1), np.uint8)
    band = cv2.dilate(hole.inside.view(np.uint8), kernel).view(np.bool_) & hole.wall
    chosen = band if np.count_nonzero(band) >= np.count_nonzero(hole.far) else hole.far
    return np.array([_median_index(chosen, axis) for axis in (0, 1)], dtype=np.float32)


def _median_index(mask: Mask, axis: int) -> float:
    """Return the median column (axis 0) or row (axis 1) of a mask's pixels."""
    total = np.cumsum(cv2.reduce(mask.view(np.uint8), axis, cv2.REDUCE_SUM, dtype=cv2.CV_32S))
    return float(np.searchsorted(total, total[-1] / 2))


@dataclass(frozen=True, slots=True, eq=False)
class _Raster:
    """An opening in projection along the normal: `clearance_m` (rows, columns); cell (0, 0) is at `low_m` (2,)."""

    clearance_m: FloatMap
    low_m: Array
    cell_m: float
    extent_m: tuple[float, float]


def _raster(hole: Mask, contour: FloatMap, corner: FloatMap, frame: CrossingFrame, silhouette: Silhouette) -> _Raster:
    """Return the clearance around the silhouette at every point of an opening.

    A rectangle is a line segment, as long as the sides differ, dilated in the maximum norm: one erosion by the segment
    and one chessboard distance transform give the clearance of all points at once.
    """
    (left, top), (right, bottom) = contour.min(axis=0), contour.max(axis=0)
    ends = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64)
    to_metres = np.linalg.inv(frame.H_px)
    across = np.concatenate([ends, np.ones((4, 1))], axis=1) @ to_metres.T
    across = across[:, :2] / across[:, 2:]
    low, high = across.min(axis=0), across.max(axis=0)
    cell = float((high - low).max()) / RASTER_CELLS
    low, size = low - 3 * cell, np.ceil((high - low) / cell).astype(int) + 6
    cells = np.array([[cell, 0.0, low[0]], [0.0, cell, low[1]], [0.0, 0.0, 1.0]])
    shift = np.array([[1.0, 0.0, -corner[0]], [0.0, 1.0, -corner[1]], [0.0, 0.0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    H = shift @ frame.H_px @ cells
    seen = cv2.warpPerspective(hole.view(np.uint8) * np.uint8(255), H, (int(size[0]), int(size[1])), flags=flags)
    inside = (np.asarray(seen) > 127).view(np.uint8)
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
    extent = (columns.size * cell, rows.size * cell)
    segment_m = abs(silhouette.width_m - silhouette.height_m)
    segment = 2 * round(segment_m / cell / 2) + 1
    kernel = (segment, 1) if silhouette.width_m > silhouette.height_m else (1, segment)
    fits = cv2.erode(inside, np.ones(kernel[::-1], np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    half = (cv2.distanceTransform(fits, cv2.DIST_C, 3) - np.float32(0.5)) * np.float32(cell)
    short = np.float32(min(silhouette.width_m, silhouette.height_m) / 2)
    return _Raster(np.asarray(half - short), low, cell, extent)


def _crossing_points(raster: _Raster, frame: CrossingFrame) -> tuple[CrossingPoint, ...]:
    """Return the points with the largest clearance, the largest first."""
    clearance = raster.clearance_m
    flat = (clearance > float(clearance.max()) - max(PLATEAU_M, 1.01 * raster.cell_m)).view(np.uint8)
    count, labels, _, centres = cv2.connectedComponentsWithStats(flat, connectivity=8)
    points = []
    for label in range(1, count):
        right, down = raster.low_m + centres[label] * raster.cell_m
        points.append(CrossingPoint(frame.ned(float(right), float(down)), float(clearance[labels == label].max())))
    return tuple(sorted(points, key=lambda point: -point.clearance_m)[:MAX_POINTS])


def _clearance_at(raster: _Raster, frame: CrossingFrame, u: float, v: float) -> float:
    """Return the clearance at the point of a pixel; outside the raster that of a closed wall."""
    right, down, s = np.linalg.inv(frame.H_px) @ np.array([u, v, 1.0])
    column, row = np.rint((np.array([right, down]) / s - raster.low_m) / raster.cell_m).astype(int)
    rows, columns = raster.clearance_m.shape
    return (
        float(raster.clearance_m[row, column])
        if 0 <= row < rows and 0 <= column < columns
        else float(raster.clearance_m.min())
    )
