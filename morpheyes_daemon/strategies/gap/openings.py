"""Openings in a wall: where they are, how far away, and with how much room the vehicle's silhouette fits through.

Works on the two clusters of `strategies.wall`. The contour C is where depth jumps from the wall to what lies behind;
what only the left eye sees at its right inside edge belongs to the opening (paper-notes 15). The opening is measured
as it is passed: projected along the way through the wall, so a turned wall is as narrow as it really is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import DepthMap, FloatMap, Pinhole
from morpheyes_daemon.strategies.gap.wall_segmentation import Box, Mask, Plane, Split, median
from morpheyes_daemon.transforms import Array

CELLS = 160
"""Cells over the larger extent of an opening when looking for the place where the vehicle fits."""

SEEN_THROUGH = 0.25
"""Share of an opening that must really be seen to be far; the rest may be what only one eye sees."""

PLATEAU_M = 0.008
"""Places with as much room as the best, to within this, count as one."""

BAND_M = 0.06
"""Width of the foreground band around the contour."""

TUNNEL_M = 0.10
"""Room around the silhouette behind the wall within which things count as in the way."""

SAMPLES = 5000
"""Pixels of an opening, about, that tell what lies behind it."""

COARSE_PX = 160
"""Holes are first looked for in about so many columns."""

LEAST_PX = 40
MOST_OPENINGS = 4


@dataclass(frozen=True, slots=True)
class Silhouette:
    """What must fit through: the vehicle seen along its way, in crossing attitude and at the crossing baseline."""

    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the wall's plane (ned) with the room around the silhouette there; negative: it does not fit."""

    p_ned_m: tuple[float, float, float]
    clearance_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """One opening. `contour_px` (n, 2) float32 closed polygon in the rectified left image; `z_m` median of Z_C.

    `places`: where the silhouette fits best, the roomiest first. `safest` is the paper's x_s. `width_m, height_m`
    are its extents as it is passed. `beyond_m` is how far behind the wall the nearest thing seen through it lies.
    `cut`: it touches the edge of the image, so there may be more of it.
    """

    contour_px: FloatMap
    z_m: float
    places: tuple[Place, ...]
    safest: Place
    width_m: float
    height_m: float
    beyond_m: float
    cut: bool


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """The way through a wall: horizontal, along the wall's normal.

    Axes (3, 3) in the rectified camera as columns: right, down, along. `H_px` (3, 3) takes metres to the right of and
    below the camera, measured across the way, to pixels of the wall's plane.
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
        """Return the point of the wall's plane that is passed so far right of and below the camera."""
        u, v, s = self.H_px @ np.array([right_m, down_m, 1.0])
        return self.ned_of_pixel(u / s, v / s)

    def ned_of_pixel(self, u: float, v: float) -> tuple[float, float, float]:
        """Return the point of the wall's plane at a pixel."""
        z = 1.0 / (self.plane.a * u + self.plane.b * v + self.plane.c)
        ray = np.array([(u - self.pinhole.cx_px) / self.pinhole.f_px, (v - self.pinhole.cy_px) / self.pinhole.f_px, 1])
        p = self.origin_ned_m + self.R_ned_rect @ (z * ray)
        return float(p[0]), float(p[1]), float(p[2])


def passage(plane: Plane, pinhole: Pinhole, T_ned_rect: Array) -> Passage | None:
    """Return the way through a wall's plane, None when it lies flat or is seen from behind."""
    f, cx, cy = pinhole.f_px, pinhole.cx_px, pinhole.cy_px
    normal = np.array([plane.a * f, plane.b * f, plane.a * cx + plane.b * cy + plane.c])  # normal . X = 1
    R = T_ned_rect[:3, :3]
    ned = R @ normal
    size = math.hypot(ned[0], ned[1])
    if size < 0.5 * float(np.linalg.norm(normal)) or normal[2] <= 0.0:
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
    return Passage(axes, R, T_ned_rect[:3, 3], pinhole, plane, H, yaw, share)


def find_openings(depth: DepthMap, found: Split, way: Passage, silhouette: Silhouette) -> tuple[Opening, ...]:
    """Return the openings of a wall, the largest first."""
    if not found.bimodal:
        return ()
    openings: list[Opening] = []
    for box, cut in _candidates(found, depth.pinhole.f_px / max(way.range_m, 0.2)):
        far, wall = found.clusters(box)
        hole = _largest(~wall)
        if hole is None or np.count_nonzero(hole & far) < SEEN_THROUGH * np.count_nonzero(hole):
            continue
        openings.append(_opening(depth, way, silhouette, _Hole(hole, hole & far, wall, box, cut)))
        if len(openings) == MOST_OPENINGS:
            break
    return tuple(openings)


def _candidates(found: Split, px_per_m: float) -> Iterator[tuple[Box, bool]]:
    """Yield where holes may be, with a band around them, and whether they touch the image's edge: a coarse look."""
    height, width = found.near.shape
    step = max(1, round(width / COARSE_PX))
    far, wall = found.clusters((slice(None, None, step), slice(None, None, step)))
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~wall).view(np.uint8), connectivity=4)
    seen = np.bincount(labels[far], minlength=count)
    pad = max(2, round(BAND_M * px_per_m)) + step
    for label in (np.argsort(-stats[1:count, cv2.CC_STAT_AREA])[: 3 * MOST_OPENINGS] + 1).tolist():
        x, y, w, h, area = (int(value) * step for value in stats[label])
        if area * step < LEAST_PX:
            return
        if seen[label] * step < 0.8 * SEEN_THROUGH * area:
            continue
        cut = x == 0 or y == 0 or x + w >= width or y + h >= height
        yield (slice(max(0, y - pad), min(height, y + h + pad)), slice(max(0, x - pad), min(width, x + w + pad))), cut


def _largest(mask: Mask) -> Mask | None:
    """Return the largest piece of a mask."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=4)
    if count < 2:
        return None
    label = 1 if count == 2 else 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    piece = np.asarray(labels == label)
    return piece if np.count_nonzero(piece) >= LEAST_PX else None


@dataclass(frozen=True, slots=True, eq=False)
class _Hole:
    """Pixels of an opening, those of them that are far, and the wall around it, all within a box of the image."""

    inside: Mask
    far: Mask
    wall: Mask
    box: Box
    cut: bool


def _opening(depth: DepthMap, way: Passage, silhouette: Silhouette, hole: _Hole) -> Opening:
    corner = np.array([hole.box[1].start, hole.box[0].start], dtype=np.float32)
    outlines, _ = cv2.findContours(hole.inside.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(outlines, key=len)[:, 0].astype(np.float32) + corner
    z_m = median(1.0 / np.maximum(way.plane.at(contour.astype(np.float64)), 1e-3))
    raster = _raster(hole.inside, contour, corner, way, silhouette)
    band_px = max(2, round(BAND_M * depth.pinhole.f_px / max(way.range_m, 0.2)))
    u, v = (float(c) for c in _safest_px(hole, band_px) + corner)
    safest = Place(way.ned_of_pixel(u, v), _room_at(raster, way, u, v))
    places = _places(raster, way)
    beyond_m = _beyond_m(depth, hole.box, hole.far, way, places[0], silhouette)
    return Opening(contour, z_m, places, safest, *raster.extent_m, beyond_m, hole.cut)


def _beyond_m(depth: DepthMap, box: Box, far: Mask, way: Passage, place: Place, silhouette: Silhouette) -> float:
    """Return how far behind the wall the first thing stands that the vehicle would meet, as far as it is seen.

    Only what lies in the tunnel of the silhouette counts: ground and sky behind the wall are passed.
    """
    step = max(1, round(math.sqrt(far.size / SAMPLES)))
    row, column = (index * step for index in np.nonzero(far[::step, ::step]))
    z = depth.depth_m[box][row, column].astype(np.float64)
    f, cx, cy = way.pinhole.f_px, way.pinhole.cx_px, way.pinhole.cy_px
    points = np.stack([(column + box[1].start - cx) / f * z, (row + box[0].start - cy) / f * z, z])
    right, down, ahead = way.axes_rect.T @ points
    at = way.axes_rect.T @ (way.R_ned_rect.T @ (np.array(place.p_ned_m) - way.origin_ned_m))
    reach = (silhouette.width_m / 2 + TUNNEL_M, silhouette.height_m / 2 + TUNNEL_M)
    inside = (np.abs(right - at[0]) < reach[0]) & (np.abs(down - at[1]) < reach[1])
    met = ahead[inside] if inside.sum() >= LEAST_PX // (4 * step * step) + 3 else ahead
    return float(np.percentile(met, 3.0) - at[2]) if met.size else 0.0


def _safest_px(hole: _Hole, band_px: int) -> FloatMap:
    """Return the paper's x_s: median(F) if |F| >= |B|, else median(B); F is the wall's band around the contour."""
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
    """An opening as it is passed: `room_m` (rows, columns) around the silhouette; cell (0, 0) is at `low_m`."""

    room_m: FloatMap
    low_m: Array
    cell_m: float
    extent_m: tuple[float, float]


def _raster(hole: Mask, contour: FloatMap, corner: FloatMap, way: Passage, silhouette: Silhouette) -> _Raster:
    """Return how much room the silhouette has at every place of an opening.

    A rectangle is a rod as long as it is longer than high, thickened in the maximum norm: one erosion by the rod and
    one chessboard distance give the room at every place at once.
    """
    (left, top), (right, bottom) = contour.min(axis=0), contour.max(axis=0)
    ends = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64)
    to_metres = np.linalg.inv(way.H_px)
    across = np.concatenate([ends, np.ones((4, 1))], axis=1) @ to_metres.T
    across = across[:, :2] / across[:, 2:]
    low, high = across.min(axis=0), across.max(axis=0)
    cell = float((high - low).max()) / CELLS
    low, size = low - 3 * cell, np.ceil((high - low) / cell).astype(int) + 6
    cells = np.array([[cell, 0.0, low[0]], [0.0, cell, low[1]], [0.0, 0.0, 1.0]])
    shift = np.array([[1.0, 0.0, -corner[0]], [0.0, 1.0, -corner[1]], [0.0, 0.0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    H = shift @ way.H_px @ cells
    seen = cv2.warpPerspective(hole.view(np.uint8) * np.uint8(255), H, (int(size[0]), int(size[1])), flags=flags)
    inside = (np.asarray(seen) > 127).view(np.uint8)
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
    extent = (columns.size * cell, rows.size * cell)
    rod_m = abs(silhouette.width_m - silhouette.height_m)
    rod = 2 * round(rod_m / cell / 2) + 1
    kernel = (rod, 1) if silhouette.width_m > silhouette.height_m else (1, rod)
    fits = cv2.erode(inside, np.ones(kernel[::-1], np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    half = (cv2.distanceTransform(fits, cv2.DIST_C, 3) - np.float32(0.5)) * np.float32(cell)
    short = np.float32(min(silhouette.width_m, silhouette.height_m) / 2)
    return _Raster(np.asarray(half - short), low, cell, extent)


def _places(raster: _Raster, way: Passage) -> tuple[Place, ...]:
    """Return where the silhouette fits best, the roomiest first."""
    room = raster.room_m
    flat = (room > float(room.max()) - max(PLATEAU_M, 1.01 * raster.cell_m)).view(np.uint8)
    count, labels, _, centres = cv2.connectedComponentsWithStats(flat, connectivity=8)
    places = []
    for label in range(1, count):
        right, down = raster.low_m + centres[label] * raster.cell_m
        places.append(Place(way.ned(float(right), float(down)), float(room[labels == label].max())))
    return tuple(sorted(places, key=lambda place: -place.clearance_m)[:3])


def _room_at(raster: _Raster, way: Passage, u: float, v: float) -> float:
    """Return the room around the silhouette at the place of a pixel; that of a closed wall outside the raster."""
    right, down, s = np.linalg.inv(way.H_px) @ np.array([u, v, 1.0])
    column, row = np.rint((np.array([right, down]) / s - raster.low_m) / raster.cell_m).astype(int)
    rows, columns = raster.room_m.shape
    return float(raster.room_m[row, column]) if 0 <= row < rows and 0 <= column < columns else float(raster.room_m.min())
