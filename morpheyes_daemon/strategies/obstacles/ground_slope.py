"""How the ground ahead rises, from the points that are seen of it: a vehicle that keeps its height follows it.

A plane through the lowest points of each cell of the view; trunks and bushes in front of the ground count little.
"""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.transforms import Array

FROM_M, TO_M = 2.0, 12.0
RINGS, SECTORS = 6, 10
LEAST_POINTS, LEAST_CELLS = 6, 12

LEVEL_ENOUGH = 0.05
"""Rise below this counts as level: over 10 m the ground then stays a metre below the band that is flown through."""

STEEPEST = 0.45


def ground_rise(points_m: Array, height_m: float) -> tuple[float, float]:
    """Return the rise of the ground per metre north and east, zeros when it is level or not seen well.

    points_m: (3, N) north, east, down from the vehicle; `height_m` is how high it believes to be over the ground.
    """
    reach = np.hypot(points_m[0], points_m[1])
    points = points_m[:, (reach > FROM_M) & (reach < TO_M)]
    lowest = _lowest_of_cells(points)
    if lowest.shape[1] < LEAST_CELLS:
        return 0.0, 0.0
    north, east, above = lowest[0], lowest[1], height_m - lowest[2]
    rows = np.stack([north, east, np.ones_like(north)], axis=1)
    weight, plane = np.ones_like(north), np.zeros(3)
    for _ in range(6):
        square = rows.T @ (weight[:, None] * rows) + np.diag([0.0, 0.0, 2.0])
        plane = np.linalg.solve(square, rows.T @ (weight * above))
        off = above - rows @ plane
        weight = 1.0 / (1.0 + (off / np.where(off > 0.0, 0.1, 0.25)) ** 2)
    size = float(np.hypot(plane[0], plane[1]))
    if not LEVEL_ENOUGH < size < STEEPEST or weight.sum() < LEAST_CELLS / 2:
        return 0.0, 0.0
    return float(plane[0]), float(plane[1])


def _lowest_of_cells(points_m: Array) -> Array:
    """Return (3, M) one low point of each cell of azimuth and range that holds enough of them."""
    north, east, down = points_m
    ring = np.log(np.hypot(north, east) / FROM_M) / np.log(TO_M / FROM_M) * RINGS
    turn = (np.arctan2(east, north) + np.pi) / (2.0 * np.pi) * 6 * SECTORS
    cell = np.floor(turn).astype(np.int64) * RINGS + np.floor(ring).astype(np.int64)
    order = np.lexsort((-down, cell))
    _, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    # the very lowest are mismatches
    chosen = order[(starts + counts // 10)[counts >= LEAST_POINTS]]
    return points_m[:, chosen]
