"""The obstacle profile: what of a depth map matters to a vehicle at its height, seen from above.

Depth pixels inside the height band that the vehicle sweeps are gathered into azimuth bins and logarithmic range
cells; a cell is an obstacle when enough pixels support it, so that single wrong matches do not stop a flight. Bins
without depth stay unknown: neither free nor occupied.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.obstacles.ground_slope import ground_rise
from morpheyes_daemon.transforms import R_FRD_CAM

Floats = NDArray[np.float64]

NEAREST_CELL_M = 0.25
CELL_RATIO = 1.05
CELLS = 110
"""Range cells from 0.25 m to 53 m, each 5 % wider than the one before."""

NEAR_BINS = 4
"""What is closer than the near limit fills many bins (a 0.1 m trunk at 1.4 m: 13); thinner runs are mismatches."""

RANGE_EDGES_M: Floats = NEAREST_CELL_M * np.power(CELL_RATIO, np.arange(CELLS + 1, dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleProfile:
    """Obstacles in azimuth bins around the camera, ned headings; B bins from left to right.

    `range_m` (B,) nearest obstacle, inf where none is seen. `unknown` (B,) bool: nothing was matched there;
    `behind_m` (B,) then tells behind what range it must lie, NaN where nothing tells.
    `near` (B,) bool: something is closer than `near_limit_m`. `points_ned_m` (N, 2) the obstacle cells.
    `origin_ned_m` is the camera, horizontally; `p_ned_m` the vehicle at exposure.
    """

    t_ns: int
    p_ned_m: tuple[float, float, float]
    origin_ned_m: tuple[float, float]
    azimuth_rad: Floats
    range_m: Floats
    unknown: NDArray[np.bool_]
    behind_m: Floats
    near: NDArray[np.bool_]
    points_ned_m: Floats
    trust_m: float
    near_limit_m: float


@lru_cache(maxsize=4)
def _rays(pinhole: Pinhole, stride: int) -> Floats:
    """Viewing rays (3, n) with z = 1 of every `stride`-th pixel."""
    u, v = np.meshgrid(np.arange(0, pinhole.width, stride), np.arange(0, pinhole.height, stride))
    x = (u.ravel() - pinhole.cx_px) / pinhole.f_px
    y = (v.ravel() - pinhole.cy_px) / pinhole.f_px
    return np.stack([x, y, np.ones_like(x)])


BIN_RAD = math.radians(0.6)


def obstacle_profile(view: View, band_m: float, trust_m: float, bin_rad: float = BIN_RAD) -> ObstacleProfile:
    """Gather the obstacles within `band_m` above and below the way over the ground into azimuth bins.

    `trust_m` is how far depth is believed; obstacles beyond it are kept out.
    """
    depth, pinhole = view.depth, view.depth.pinhole
    stride = max(1, round(pinhole.width / 160))
    T = view.T_ned_rect
    directions = T[:3, :3] @ _rays(pinhole, stride)
    heading = T[:3, :3] @ R_FRD_CAM.T @ np.array([1.0, 0.0, 0.0])
    centre_rad = math.atan2(heading[1], heading[0])
    horizontal = np.hypot(directions[0], directions[1])
    relative = _wrapped(np.arctan2(directions[1], directions[0]) - centre_rad)
    half_rad = pinhole.h_fov_rad / 2
    bins = max(8, round(2 * half_rad / bin_rad))
    index = np.floor((relative + half_rad) / (2 * half_rad) * bins).astype(np.int64)
    inside = (index >= 0) & (index < bins)

    z = depth.depth_m[::stride, ::stride].ravel().astype(np.float64)
    known = np.isfinite(z)
    z0 = np.where(known, z, 0.0)
    down_m = T[2, 3] + z0 * directions[2] - view.vehicle.p_ned_m[2]
    range_m = z0 * horizontal
    points_m = np.stack([z0 * directions[0], z0 * directions[1], down_m])
    rise = ground_rise(points_m[:, known & inside], _height_m(view))
    climb_m = rise[0] * points_m[0] + rise[1] * points_m[1]
    in_band = known & inside & (np.abs(down_m + climb_m) <= band_m) & (range_m < min(trust_m, RANGE_EDGES_M[-1]))
    counts = _count(index[in_band], range_m[in_band], bins)
    support = _support_needed(pinhole, stride, band_m, 2 * half_rad / bins)
    occupied = _smoothed(counts) >= support

    edge = math.atan2(band_m, max(1.0, min(trust_m, 8.0)))
    climb_rad = np.arctan((rise[0] * directions[0] + rise[1] * directions[1]) / horizontal)
    level = inside & (np.abs(np.arctan2(directions[2], horizontal) + climb_rad) <= max(edge, 2 * stride / pinhole.f_px))
    looked = np.bincount(index[level], minlength=bins)
    matched = np.bincount(index[level & known], minlength=bins)
    too_near = np.bincount(index[level & depth.near[::stride, ::stride].ravel()], minlength=bins)
    shadowed = np.bincount(index[level & depth.half_occluded[::stride, ::stride].ravel()], minlength=bins)
    near = wide_runs(too_near > 0.4 * np.maximum(looked, 1), NEAR_BINS)
    unknown = (matched < 0.35 * looked) & ~near | (looked == 0)

    first = np.where(occupied.any(axis=1), RANGE_EDGES_M[np.argmax(occupied, axis=1)], np.inf)
    first = np.where(near, np.minimum(first, depth.near_limit_m), first)
    unknown &= ~np.isfinite(first)
    azimuth: Floats = centre_rad + (np.arange(bins, dtype=np.float64) + 0.5) * (2 * half_rad / bins) - half_rad
    origin = (float(T[0, 3]), float(T[1, 3]))
    return ObstacleProfile(
        t_ns=depth.t_ns,
        p_ned_m=view.vehicle.p_ned_m,
        origin_ned_m=origin,
        azimuth_rad=azimuth,
        range_m=first,
        unknown=unknown,
        behind_m=_behind(unknown, shadowed > 0.5 * np.maximum(looked, 1), first),
        near=near,
        points_ned_m=_points(occupied & (counts > 0), near, azimuth, origin, depth.near_limit_m),
        trust_m=trust_m,
        near_limit_m=depth.near_limit_m,
    )


def _height_m(view: View) -> float:
    """Height over the ground by the rangefinder, over the start where there is none."""
    vehicle = view.vehicle
    return vehicle.height_m if math.isfinite(vehicle.height_m) else -vehicle.p_ned_m[2]


def wide_runs(flags: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """Keep runs of at least `least` set bins (B,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    kept = np.zeros_like(flags)
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        kept[start:end] = end - start >= least
    return kept


def _wrapped(angle_rad: Floats) -> Floats:
    return np.asarray((angle_rad + math.pi) % (2 * math.pi) - math.pi)


def _count(index: NDArray[np.int64], range_m: Floats, bins: int) -> Floats:
    """Histogram (bins, CELLS) of pixels over azimuth and range."""
    cell = np.floor(np.log(np.maximum(range_m, NEAREST_CELL_M) / NEAREST_CELL_M) / math.log(CELL_RATIO))
    cell = np.clip(cell, 0, CELLS - 1).astype(np.int64)
    return np.bincount(index * CELLS + cell, minlength=bins * CELLS).reshape(bins, CELLS).astype(np.float64)


def _smoothed(counts: Floats) -> Floats:
    """Sum over three neighbouring range cells: one surface may fall across an edge."""
    total = counts.copy()
    total[:, 1:] += counts[:, :-1]
    total[:, :-1] += counts[:, 1:]
    return total


def _support_needed(pinhole: Pinhole, stride: int, band_m: float, bin_rad: float) -> Floats:
    """Pixels (CELLS,) that make an obstacle: a fifth of a surface that fills bin and band, at least 2."""
    rows = pinhole.f_px * 2 * band_m / RANGE_EDGES_M[:-1] / stride
    rows = np.minimum(rows, pinhole.height / stride)
    columns = max(1.0, bin_rad * pinhole.f_px / stride)
    return np.asarray(np.maximum(2.0, 0.2 * rows * columns))


def _behind(unknown: NDArray[np.bool_], shadowed: NDArray[np.bool_], range_m: Floats) -> Floats:
    """What only the left eye sees lies behind the obstacle to its right, whose shadow it is; (B,) NaN elsewhere.

    The strip along the left border is the right eye's missing view, not a shadow, and nothing tells its range.
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


def _points(
    occupied: NDArray[np.bool_], near: NDArray[np.bool_], azimuth: Floats, origin: tuple[float, float], near_m: float
) -> Floats:
    bins, cells = np.nonzero(occupied)
    ranges = RANGE_EDGES_M[cells] * math.sqrt(CELL_RATIO)
    close = np.nonzero(near)[0]
    bins = np.concatenate([bins, close])
    ranges = np.concatenate([ranges, np.full(close.size, near_m)])
    angle = azimuth[bins]
    return np.stack([origin[0] + ranges * np.cos(angle), origin[1] + ranges * np.sin(angle)], axis=1)
