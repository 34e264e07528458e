"""Ground slope ahead, from the depth points: a vehicle that keeps its height above ground follows the slope.

A plane is fitted robustly through one low point of each polar cell; trunks and bushes in front of the ground get
little weight.
"""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.transforms import Array

NEAREST_M, FARTHEST_M = 2.0, 12.0
"""Horizontal range of the points that are used.

Chosen: nearer the ground is below the image, farther its height errs by more than the slope is worth."""

RANGE_CELLS, CELLS_PER_SEXTANT = 6, 10
"""Logarithmic range cells, and azimuth cells in each sixth of the circle (about one field of view). Unit: cells.

Chosen: cells large enough for MIN_POINTS of a sampled depth map, small enough for one trunk to fill few of them."""

MIN_POINTS, MIN_CELLS = 6, 12
"""Points that a cell and cells that a plane need. Unit: counts.

Chosen: fewer let mismatches tilt the plane, more give no slope in dense forest."""

LEVEL_SLOPE = 0.05
"""Slope below which the ground counts as level. Unit: none (m/m).

Chosen: over 10 m such ground still stays a metre below the band that is flown through; lower follows noise."""

MAX_SLOPE = 0.45
"""Slope above which the fit is taken for something else than ground. Unit: none (m/m).

Chosen: 24 degrees, above the slopes flown; a wall fits a steeper plane."""

FIT_STEPS = 6
"""Steps of the iteratively reweighted least squares. Unit: steps.

Chosen: the weights change little after five; each step costs time in the vision worker."""

OFFSET_PRIOR = 2.0
"""Weight, in cells, of the prior that the ground below the vehicle lies at its height above ground. Unit: cells.

Chosen: a rangefinder over a bush must not tilt the plane, which a larger weight would."""

KERNEL_ABOVE_M, KERNEL_BELOW_M = 0.1, 0.25
"""Width of the robust kernel for points above and below the plane.

Chosen: what stands on the ground lies above it, so a point above loses its weight sooner."""


def ground_slope(points_m: Array, height_m: float) -> tuple[float, float]:
    """Return the rise of the ground in metres per metre north and east; zeros when it is level or hardly visible.

    points_m: (3, N) north, east, down from the vehicle, metres; `height_m` is its height above ground.
    """
    reach = np.hypot(points_m[0], points_m[1])
    points = points_m[:, (reach > NEAREST_M) & (reach < FARTHEST_M)]
    lowest = _lowest_of_cells(points)
    if lowest.shape[1] < MIN_CELLS:
        return 0.0, 0.0
    north, east, above = lowest[0], lowest[1], height_m - lowest[2]
    rows = np.stack([north, east, np.ones_like(north)], axis=1)
    weight, plane = np.ones_like(north), np.zeros(3)
    for _ in range(FIT_STEPS):
        square = rows.T @ (weight[:, None] * rows) + np.diag([0.0, 0.0, OFFSET_PRIOR])
        plane = np.linalg.solve(square, rows.T @ (weight * above))
        residual = above - rows @ plane
        weight = 1.0 / (1.0 + (residual / np.where(residual > 0.0, KERNEL_ABOVE_M, KERNEL_BELOW_M)) ** 2)
    size = float(np.hypot(plane[0], plane[1]))
    if not LEVEL_SLOPE < size < MAX_SLOPE or weight.sum() < MIN_CELLS / 2:
        return 0.0, 0.0
    return float(plane[0]), float(plane[1])


def _lowest_of_cells(points_m: Array) -> Array:
    """Return (3, M) one low point of each cell of azimuth and range that holds at least MIN_POINTS."""
    north, east, down = points_m
    ring = np.log(np.hypot(north, east) / NEAREST_M) / np.log(FARTHEST_M / NEAREST_M) * RANGE_CELLS
    turn = (np.arctan2(east, north) + np.pi) / (2.0 * np.pi) * 6 * CELLS_PER_SEXTANT
    cell = np.floor(turn).astype(np.int64) * RANGE_CELLS + np.floor(ring).astype(np.int64)
    order = np.lexsort((-down, cell))
    _, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    # the lowest tenth of a cell are mismatches
    chosen = order[(starts + counts // 10)[counts >= MIN_POINTS]]
    return points_m[:, chosen]
