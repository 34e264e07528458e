"""Obstacle profile: the part of a depth map that matters to a vehicle at its height, in polar cells seen from above.

Depth pixels inside the height band that the vehicle sweeps are gathered into azimuth bins and logarithmic range
cells; a cell is an obstacle when enough pixels support it, so that single mismatches do not stop a flight. Bins
without depth stay unknown: neither free nor occupied.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Mask, Pinhole
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.obstacles.ground_slope import ground_slope
from morpheyes_daemon.transforms import R_FRD_CAM, Array

NEAREST_CELL_M = 0.25
"""Near edge of the first range cell.

Chosen: below the near limit of every baseline; nearer obstacles all count as the first cell."""

CELL_RATIO = 1.05
"""Ratio of the edges of a range cell. Unit: none.

Chosen: 5 % of the range, less than the depth error within trusted range and more than single-pixel steps near by."""

CELLS = 110
"""Number of range cells, from 0.25 m to 53 m. Unit: cells.

Chosen: past the trusted range of every baseline; more cost time and memory."""

RANGE_EDGES_M: Array = NEAREST_CELL_M * np.power(CELL_RATIO, np.arange(CELLS + 1, dtype=np.float64))
"""Edges (CELLS + 1,) of the range cells. Source: equation, NEAREST_CELL_M · CELL_RATIO^k."""

BIN_RAD = math.radians(0.6)
"""Width of an azimuth bin.

Chosen: 0.1 m at 10 m, a thin trunk; narrower bins hold too few pixels of a sampled depth map."""

MIN_BINS = 8
"""Fewest azimuth bins over the field of view. Unit: bins.

Chosen: keeps a very narrow field of view usable; no effect on the vehicle's cameras."""

SAMPLED_COLUMNS = 160
"""Columns of the depth map that are used, about; every n-th row and column. Unit: px.

Chosen: time in the vision worker against thin obstacles far away."""

MIN_NEAR_BINS = 4
"""Run of adjacent bins that makes an obstacle closer than the near limit. Unit: bins.

Chosen: such an obstacle fills many (a 0.1 m trunk at 1.4 m: 13); shorter runs are mismatches."""

NEAR_SHARE = 0.4
"""Share of a bin's pixels in the band that must be closer than the near limit. Unit: none.

Chosen: lower stops for mismatches, higher overlooks what fills half a bin."""

MATCHED_SHARE = 0.35
"""Share of a bin's pixels in the band that must have a depth, or the bin is unknown. Unit: none.

Chosen: lower takes holes for free space, higher makes thin foliage unknown."""

SHADOWED_SHARE = 0.5
"""Share of a bin's pixels in the band that must be half-occluded, or its range stays unknown. Unit: none.

Chosen: a majority; lower gives the range of an occluder to bins that only border on its shadow."""

SUPPORT_SHARE, MIN_SUPPORT_PX = 0.2, 2.0
"""Share of a surface that fills bin and band, and pixels at least, that make a cell an obstacle. Unit: none, px.

Chosen: lower stops for mismatches, higher overlooks branches that fill a fifth of the band."""

LEVEL_NEAREST_M, LEVEL_FARTHEST_M = 1.0, 8.0
"""Range at which the height band is taken for the elevation within which a bin's pixels are counted.

Chosen: the trusted range within these bounds; nearer counts ground and sky, farther leaves a line of pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleProfile:
    """Obstacles in azimuth bins around the camera, headings in ned (rad); B bins from left to right.

    `range_m` (B,) nearest obstacle, inf where none is seen. `unknown` (B,) bool: nothing was matched there;
    `behind_m` (B,) then is the range behind which it must lie, NaN where that is unknown too.
    `near` (B,) bool: something is closer than `near_limit_m`. `points_ned_m` (N, 2) the obstacle cells, north and
    east. `origin_ned_m` is the camera, horizontally; `p_ned_m` the vehicle at exposure. `trust_m` is the trusted range.
    """

    t_ns: int
    p_ned_m: tuple[float, float, float]
    origin_ned_m: tuple[float, float]
    azimuth_rad: Array
    range_m: Array
    unknown: Mask
    behind_m: Array
    near: Mask
    points_ned_m: Array
    trust_m: float
    near_limit_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Sampled pixels (n,): rays in ned with z = 1 in the camera (3, n), azimuth bin, whether it lies in a bin."""

    stride: int
    bins: int
    bin_rad: float
    azimuth_rad: Array
    directions: Array
    horizontal: Array
    index: NDArray[np.int64]
    inside: Mask


def obstacle_profile(view: View, band_m: float, trust_m: float, bin_rad: float = BIN_RAD) -> ObstacleProfile:
    """Return the obstacles of a view within `band_m` above and below the path over the ground, in azimuth bins.

    Obstacles beyond the trusted range `trust_m` (metres) are left out; `bin_rad` is the width of a bin.
    """
    depth, samples = view.depth, _samples(view, bin_rad)
    stride, bins = samples.stride, samples.bins
    z = depth.depth_m[::stride, ::stride].ravel().astype(np.float64)
    known = np.isfinite(z)
    occupied, counts, slope = _occupied_cells(view, samples, z, band_m, trust_m)

    level = _level_pixels(samples, slope, band_m, trust_m, 2 * stride / depth.pinhole.f_px)
    looked = np.bincount(samples.index[level], minlength=bins)
    matched = np.bincount(samples.index[level & known], minlength=bins)
    too_near = np.bincount(samples.index[level & depth.near[::stride, ::stride].ravel()], minlength=bins)
    shadowed = np.bincount(samples.index[level & depth.half_occluded[::stride, ::stride].ravel()], minlength=bins)
    near = wide_runs(too_near > NEAR_SHARE * np.maximum(looked, 1), MIN_NEAR_BINS)
    unknown = (matched < MATCHED_SHARE * looked) & ~near | (looked == 0)

    first = np.where(occupied.any(axis=1), RANGE_EDGES_M[np.argmax(occupied, axis=1)], np.inf)
    first = np.where(near, np.minimum(first, depth.near_limit_m), first)
    unknown &= ~np.isfinite(first)
    T = view.T_ned_rect
    origin = (float(T[0, 3]), float(T[1, 3]))
    return ObstacleProfile(
        t_ns=depth.t_ns,
        p_ned_m=view.vehicle.p_ned_m,
        origin_ned_m=origin,
        azimuth_rad=samples.azimuth_rad,
        range_m=first,
        unknown=unknown,
        behind_m=_behind(unknown, shadowed > SHADOWED_SHARE * np.maximum(looked, 1), first),
        near=near,
        points_ned_m=_points(occupied & (counts > 0), near, samples.azimuth_rad, origin, depth.near_limit_m),
        trust_m=trust_m,
        near_limit_m=depth.near_limit_m,
    )


def _samples(view: View, bin_rad: float) -> _Samples:
    pinhole = view.depth.pinhole
    stride = max(1, round(pinhole.width / SAMPLED_COLUMNS))
    T = view.T_ned_rect
    directions = T[:3, :3] @ _rays(pinhole, stride)
    heading = T[:3, :3] @ R_FRD_CAM.T @ np.array([1.0, 0.0, 0.0])
    centre_rad = math.atan2(heading[1], heading[0])
    horizontal = np.hypot(directions[0], directions[1])
    relative = wrapped_rad(np.arctan2(directions[1], directions[0]) - centre_rad)
    half_rad = pinhole.h_fov_rad / 2
    bins = max(MIN_BINS, round(2 * half_rad / bin_rad))
    index = np.floor((relative + half_rad) / (2 * half_rad) * bins).astype(np.int64)
    azimuth: Array = centre_rad + (np.arange(bins, dtype=np.float64) + 0.5) * (2 * half_rad / bins) - half_rad
    inside = (index >= 0) & (index < bins)
    return _Samples(stride, bins, 2 * half_rad / bins, azimuth, directions, horizontal, index, inside)


def _occupied_cells(
    view: View, samples: _Samples, z: Array, band_m: float, trust_m: float
) -> tuple[Mask, Array, tuple[float, float]]:
    """Return occupied cells (B, CELLS), their pixel counts (B, CELLS), and the ground slope; z (n,) depths, metres."""
    pinhole, directions = view.depth.pinhole, samples.directions
    known = np.isfinite(z)
    z0 = np.where(known, z, 0.0)
    down_m = view.T_ned_rect[2, 3] + z0 * directions[2] - view.vehicle.p_ned_m[2]
    range_m = z0 * samples.horizontal
    points_m = np.stack([z0 * directions[0], z0 * directions[1], down_m])
    slope = ground_slope(points_m[:, known & samples.inside], _height_m(view))
    climb_m = slope[0] * points_m[0] + slope[1] * points_m[1]
    in_band = known & samples.inside & (np.abs(down_m + climb_m) <= band_m) & (range_m < min(trust_m, RANGE_EDGES_M[-1]))
    counts = _count(samples.index[in_band], range_m[in_band], samples.bins)
    support = _support_needed(pinhole, samples.stride, band_m, samples.bin_rad)
    return _summed_over_neighbours(counts) >= support, counts, slope


def _level_pixels(samples: _Samples, slope: tuple[float, float], band_m: float, trust_m: float, min_rad: float) -> Mask:
    """Return which pixels (n,) look along the band: within its elevation at the trusted range, `min_rad` at least."""
    directions, horizontal = samples.directions, samples.horizontal
    edge = math.atan2(band_m, max(LEVEL_NEAREST_M, min(trust_m, LEVEL_FARTHEST_M)))
    climb_rad = np.arctan((slope[0] * directions[0] + slope[1] * directions[1]) / horizontal)
    elevation = np.abs(np.arctan2(directions[2], horizontal) + climb_rad)
    return np.asarray(samples.inside & (elevation <= max(edge, min_rad)))


@lru_cache(maxsize=4)
def _rays(pinhole: Pinhole, stride: int) -> Array:
    """Return viewing rays (3, n) with z = 1 of every `stride`-th pixel."""
    u, v = np.meshgrid(np.arange(0, pinhole.width, stride), np.arange(0, pinhole.height, stride))
    x = (u.ravel() - pinhole.cx_px) / pinhole.f_px
    y = (v.ravel() - pinhole.cy_px) / pinhole.f_px
    return np.stack([x, y, np.ones_like(x)])


def _height_m(view: View) -> float:
    """Return the height above ground by the rangefinder, above the local origin where there is none."""
    vehicle = view.vehicle
    return vehicle.height_m if math.isfinite(vehicle.height_m) else -vehicle.p_ned_m[2]


def wide_runs(flags: Mask, min_bins: int) -> Mask:
    """Return flags (B,) bool, unitless, with only the runs of at least `min_bins` set bins kept."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    kept = np.zeros_like(flags)
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        kept[start:end] = end - start >= min_bins
    return kept


def wrapped_rad(angle_rad: Array) -> Array:
    """Return angles (N,) in radians wrapped to -pi..pi."""
    return np.asarray((angle_rad + math.pi) % (2 * math.pi) - math.pi)


def _count(index: NDArray[np.int64], range_m: Array, bins: int) -> Array:
    """Return the histogram (bins, CELLS) of pixels over azimuth and range."""
    cell = np.floor(np.log(np.maximum(range_m, NEAREST_CELL_M) / NEAREST_CELL_M) / math.log(CELL_RATIO))
    cell = np.clip(cell, 0, CELLS - 1).astype(np.int64)
    return np.bincount(index * CELLS + cell, minlength=bins * CELLS).reshape(bins, CELLS).astype(np.float64)


def _summed_over_neighbours(counts: Array) -> Array:
    """Return the sum over three adjacent range cells: one surface may fall across an edge."""
    total = counts.copy()
    total[:, 1:] += counts[:, :-1]
    total[:, :-1] += counts[:, 1:]
    return total


def _support_needed(pinhole: Pinhole, stride: int, band_m: float, bin_rad: float) -> Array:
    """Return the pixels (CELLS,) that make a cell an obstacle."""
    rows = pinhole.f_px * 2 * band_m / RANGE_EDGES_M[:-1] / stride
    rows = np.minimum(rows, pinhole.height / stride)
    columns = max(1.0, bin_rad * pinhole.f_px / stride)
    return np.asarray(np.maximum(MIN_SUPPORT_PX, SUPPORT_SHARE * rows * columns))


def _behind(unknown: Mask, shadowed: Mask, range_m: Array) -> Array:
    """Return (B,) the range behind which a half-occluded bin lies: that of the obstacle to its right; NaN elsewhere.

    The bins along the left border are missing in the right camera's view, not shadowed, so their range is unknown.
    """
    behind = np.full(range_m.shape, np.nan)
    occluder = np.nan
    for i in range(len(range_m) - 1, -1, -1):
        if not unknown[i]:
            occluder = range_m[i] if np.isfinite(range_m[i]) else np.nan
        elif shadowed[i]:
            behind[i] = occluder
    border = int(np.argmin(unknown)) if not unknown.all() else len(unknown)
    behind[:border] = np.nan
    return behind


def _points(occupied: Mask, near: Mask, azimuth: Array, origin: tuple[float, float], near_m: float) -> Array:
    """Return the middles (N, 2) of occupied cells and of near bins, north and east, metres."""
    bins, cells = np.nonzero(occupied)
    ranges = RANGE_EDGES_M[cells] * math.sqrt(CELL_RATIO)
    close = np.nonzero(near)[0]
    bins = np.concatenate([bins, close])
    ranges = np.concatenate([ranges, np.full(close.size, near_m)])
    angle = azimuth[bins]
    return np.stack([origin[0] + ranges * np.cos(angle), origin[1] + ranges * np.sin(angle)], axis=1)
