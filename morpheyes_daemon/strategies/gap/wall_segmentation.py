"""Wall segmentation: one depth image divided into a near wall and the far cluster behind it.

The near cluster of a gap scene is a wall, whose inverse depth is an affine function of the pixel; with the wall's plane
subtracted the two clusters of the paper (section V-B, bimodal depth) separate even when the wall is turned. The result
says when there is no second cluster. Openings and whether the vehicle fits are `openings`' part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import DepthMap, FloatMap, Mask
from morpheyes_daemon.transforms import Array

GRID_COLUMNS = 48
"""Columns, about, of the grid on which the wall is fitted. Unit: columns.

Chosen: a few hundred points are enough for a plane; more cost time in the vision worker."""

RANSAC_SAMPLES = 64
"""Planes tried. Unit: planes.

Source: equation, (1 - 0.5^3)^64 = 2e-4: with half of the image on the wall all miss it once in 5000 images."""

RANSAC_SEED = 15
"""Seed of the random triples, fixed so that the result is deterministic. Unit: none.

Chosen: any value does; another one changes which triples are tried, not the result beyond noise."""

VOTE_STRIDE = 3
"""Every n-th known point votes on the planes; the least squares afterwards take all. Unit: points.

Chosen: time against the number of votes, of which a hundred are enough."""

REFIT_STEPS = 2
"""Least-squares steps on the inliers. Unit: steps.

Chosen: the inliers do not change after the second."""

MIN_WALL_POINTS = 50
"""Known grid points from which a wall is fitted. Unit: points.

Chosen: fewer are a few percent of the grid, which chance planes fit."""

MIN_TRIPLE_PX2 = 1.0
"""Twice the area of the smallest triangle of points that gives a plane. Unit: px².

Chosen: only excludes points on a line, whose plane is undetermined."""

INLIER_SIGMAS, INLIER_SHARE = 2.5, 0.02
"""Distance from the plane, in sigmas of inverse depth and as a share of it, up to which a point is on the wall.

Unit: none. Chosen: larger takes what stands before the wall into it, smaller splits a rough wall."""

CLEAR_SIGMAS = 4.0
"""Sigmas of inverse depth behind the wall from which a pixel may belong to the far cluster. Unit: none.

Chosen: one false pixel in 30000; higher misses backgrounds near the wall."""

MIN_JUMP = 0.08
"""A background nearer than this share of the wall's inverse depth behind it is a bulge of the wall. Unit: none.

Chosen: 0.35 m behind a wall at 4 m; smaller takes relief for openings."""

THRESHOLD_SHARE = 0.6
"""Smallest threshold between the clusters, as a share of the smallest jump. Unit: none.

Chosen: above a half, so that noise of the wall stays in the near cluster when the jump is small."""

CLUSTER_STEPS = 2
"""Steps of the two-means iteration. Unit: steps.

Chosen: the far mean does not change after the second."""

MIN_CLUSTER_POINTS, MIN_FAR_POINTS = 3, 6
"""Points from which a cluster has a median and a spread, and that a far cluster needs. Unit: points.

Chosen: the smallest counts that mismatches alone seldom reach."""

MIN_FAR_SHARE = 0.001
"""Share of the known pixels that make a far cluster. Unit: none.

Chosen: the smallest opening at 8 m is 0.004 of the image; smaller counts mismatches."""

MAD_TO_SIGMA = 1.4826
"""Sigma of a Gaussian over its median absolute deviation. Unit: none. Source: equation, 1 / Phi^-1(3/4)."""

BIMODAL_D = 2.0
"""Ashman's D above which two Gaussians are separate. Unit: none.

Source: equation, D = sqrt(2) |mu1 - mu2| / sqrt(s1^2 + s2^2) > 2 (Ashman, Bird and Zepf 1994)."""

Box = tuple[slice, slice]
"""Rows and columns of an image."""

WHOLE: Box = (slice(None), slice(None))
"""The whole image. Unit: px. Source: equation, the slices without bounds."""

InverseDepth = Callable[[Box], FloatMap]
"""Returns the inverse depth (h, w) float32, 1/m, NaN unknown, of a part of an image; computed only where needed."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane in the rectified camera: 1/Z = a u + b v + c (1/m) for pixel (u, v)."""

    a: float
    b: float
    c: float

    def inverse_depth(self, rows: range, columns: range) -> FloatMap:
        """Return 1/Z (len(rows), len(columns)) over some rows and columns of the image, 1/m."""
        u = np.float32(self.a) * _floats(columns) + np.float32(self.c)
        v = np.float32(self.b) * _floats(rows)
        return np.asarray(v[:, None] + u)

    def at(self, uv: Array) -> Array:
        """Return 1/Z (n,), 1/m, at pixels (n, 2)."""
        return np.asarray(self.a * uv[:, 0] + self.b * uv[:, 1] + self.c)


def _floats(indices: range) -> FloatMap:
    return np.arange(indices.start, indices.stop, indices.step, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class WallSegmentation:
    """The two clusters of a depth image (H, W), evaluated only where `clusters` is asked.

    `near` (H, W) is unknown but close. Pixels more than `threshold_1_m` of inverse depth behind the plane are far.
    `separation` is Ashman's D of the two. `bimodal` is False when there is no second cluster: then the far pixels are
    noise.
    """

    plane: Plane
    inverse_1_m: InverseDepth
    near: Mask
    threshold_1_m: float
    separation: float
    bimodal: bool

    def clusters(self, box: Box = WHOLE) -> tuple[Mask, Mask]:
        """Return masks (h, w), unitless: the far cluster, and the near one on or before the wall; unknown is in none."""
        height, width = self.near.shape
        behind = self.plane.inverse_depth(range(height)[box[0]], range(width)[box[1]])
        behind -= self.inverse_1_m(box)
        return behind > self.threshold_1_m, (behind <= self.threshold_1_m) | self.near[box]


def segment_wall(depth: DepthMap) -> WallSegmentation | None:
    """Return the clusters of a depth map, None when too few pixels are known for a wall."""
    sigma_1_m = depth.sigma_disparity_px / (depth.baseline_m * depth.pinhole.f_px)
    return segment_inverse_depth(lambda box: np.reciprocal(depth.depth_m[box]), depth.near, sigma_1_m)


def segment_inverse_depth(inverse: InverseDepth, near: Mask, sigma_1_m: float) -> WallSegmentation | None:
    """Return the clusters of an image by its inverse depth, 1/m or any other scale that `sigma_1_m` has too.

    `near` (H, W) marks unknown pixels that are known to be close. None when too few pixels are known for a wall.
    """
    height, width = near.shape
    fitted = _wall_plane(inverse, width, sigma_1_m)
    if fitted is None:
        return None
    plane, level = fitted
    stride = max(1, width // (2 * GRID_COLUMNS))
    every = (slice(None, None, stride), slice(None, None, stride))
    coarse = plane.inverse_depth(range(height)[every[0]], range(width)[every[1]]) - inverse(every)
    known = coarse[np.isfinite(coarse)]
    min_jump = max(CLEAR_SIGMAS * sigma_1_m, MIN_JUMP * level)
    jump, separation = _clusters(known, min_jump)
    threshold = max(jump / 2, THRESHOLD_SHARE * min_jump)
    count = int((known > threshold).sum())
    bimodal = separation > BIMODAL_D and count >= max(MIN_FAR_POINTS, MIN_FAR_SHARE * known.size)
    return WallSegmentation(plane, inverse, near, threshold, separation, bimodal)


def _clusters(behind: FloatMap, min_jump: float) -> tuple[float, float]:
    """Return how far the far cluster lies behind the wall and Ashman's D; (min_jump, 0) when there is none.

    Two means, with the wall's fixed at zero by the fit: the threshold is half-way, where the jump across an edge is
    steepest.
    """
    far = behind[behind > min_jump]
    if far.size < MIN_CLUSTER_POINTS:
        return min_jump, 0.0
    jump = median(far)
    for _ in range(CLUSTER_STEPS):
        far = behind[behind > max(jump / 2, THRESHOLD_SHARE * min_jump)]
        jump = median(far)
    near = behind[np.abs(behind) < min(jump / 2, 2 * min_jump)]
    if near.size < MIN_CLUSTER_POINTS:
        return jump, 0.0
    spread = math.hypot(float(near.std()), MAD_TO_SIGMA * median(np.abs(far - jump)))
    return jump, math.sqrt(2.0) * jump / max(spread, 1e-9)


def _wall_plane(inverse: InverseDepth, width: int, sigma_1_m: float) -> tuple[Plane, float] | None:
    """Return the plane with most inliers and its inverse depth there, 1/m; RANSAC, then least squares."""
    stride = max(1, width // GRID_COLUMNS)
    grid = inverse((slice(stride // 2, None, stride), slice(stride // 2, None, stride)))
    row, column = np.nonzero(np.isfinite(grid))
    if row.size < MIN_WALL_POINTS:
        return None
    w = grid[row, column].astype(np.float64)
    A = np.stack([column * stride + stride // 2, row * stride + stride // 2, np.ones(row.size)], axis=1)
    chosen = (_triples() * row.size).astype(np.int64)
    corners = A[chosen]
    good = np.abs(np.linalg.det(corners)) > MIN_TRIPLE_PX2
    candidates = np.linalg.solve(corners[good], w[chosen[good]][..., None])[..., 0]
    if not len(candidates):
        return None
    tolerance = max(INLIER_SIGMAS * sigma_1_m, INLIER_SHARE * median(w))
    residual = np.abs(A[::VOTE_STRIDE] @ candidates.T - w[::VOTE_STRIDE, None])
    plane = candidates[int(np.argmax(np.count_nonzero(residual < tolerance, axis=0)))]
    for _ in range(REFIT_STEPS):
        on = np.abs(A @ plane - w) < tolerance
        A_on = A[on]
        plane = np.linalg.solve(A_on.T @ A_on, A_on.T @ w[on])
    on = np.abs(A @ plane - w) < tolerance
    return Plane(*(float(x) for x in plane)), median(w[on])


def median(values: NDArray[np.floating]) -> float:
    """Return the median of known values (n,), n > 0, unitless or in their own unit; np.median without its checks."""
    half = values.size // 2
    if values.size % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return float((low + high) / 2)


@lru_cache(maxsize=1)
def _triples() -> Array:
    """Return (RANSAC_SAMPLES, 3) relative places in a list, 0 to 1, always the same."""
    return np.random.default_rng(RANSAC_SEED).random((RANSAC_SAMPLES, 3))
