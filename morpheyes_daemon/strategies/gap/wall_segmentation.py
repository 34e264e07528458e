"""What stands before what: one depth image split into a near surface and the far cluster behind it.

The near cluster of a gap scene is a wall, whose inverse depth is an affine function of the pixel; with that taken out
the two clusters of the paper (section V-B, bimodal depth) stand apart even when the wall is turned. It says when they
do not. Where openings are and whether the vehicle fits is told elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import DepthMap, FloatMap
from morpheyes_daemon.transforms import Array

Mask = NDArray[np.bool_]

GRID_PX = 48
"""The wall is fitted on about so many columns."""

TRIPLES = 64
"""Planes tried; with half of the image on the wall all of them miss it once in 5000 images."""

VOTERS = 3
"""Every third known pixel votes on them; the least squares afterwards take all."""

ROUNDS = 2

CLEAR_SIGMAS = 4.0
"""What lies so many sigmas of inverse depth behind the wall may belong to the far cluster."""

LEAST_JUMP = 0.08
"""A background nearer than this share behind the wall is a bulge of the wall."""

LEAST_FAR = 0.001
"""Share of the known pixels that make a cluster; the smallest opening at 8 m is 0.004 of the image."""

BIMODAL = 2.0
"""Ashman's D above which two Gaussians are separate (Ashman, Bird and Zepf 1994)."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane in the rectified camera: 1/Z = a u + b v + c for pixel (u, v)."""

    a: float
    b: float
    c: float

    def inverse_depth(self, rows: range, columns: range) -> FloatMap:
        """Return 1/Z over some rows and columns of the image."""
        u = np.float32(self.a) * _floats(columns) + np.float32(self.c)
        v = np.float32(self.b) * _floats(rows)
        return np.asarray(v[:, None] + u)

    def at(self, uv: Array) -> Array:
        """Return 1/Z (n,) at pixels (n, 2)."""
        return np.asarray(self.a * uv[:, 0] + self.b * uv[:, 1] + self.c)


def _floats(indices: range) -> FloatMap:
    return np.arange(indices.start, indices.stop, indices.step, dtype=np.float32)


Box = tuple[slice, slice]
"""Rows and columns of an image."""

WHOLE: Box = (slice(None), slice(None))

InverseDepth = Callable[[Box], FloatMap]
"""Gives the inverse depth of a part of an image (float32, NaN unknown), worked out only where somebody looks."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """The two clusters of a depth image (H, W), told apart where somebody looks.

    `near` (H, W) is unknown but close. What lies `threshold_1_m` of inverse depth behind the plane is far.
    `separation` is Ashman's D of the two. `bimodal` is False when there is no second cluster: then far is what little
    there was.
    """

    plane: Plane
    inverse_1_m: InverseDepth
    near: Mask
    threshold_1_m: float
    separation: float
    bimodal: bool

    def clusters(self, box: Box = WHOLE) -> tuple[Mask, Mask]:
        """Return the far cluster, behind the wall, and the near one, on it or before it; unknown is in neither."""
        height, width = self.near.shape
        behind = self.plane.inverse_depth(range(height)[box[0]], range(width)[box[1]])
        behind -= self.inverse_1_m(box)
        return behind > self.threshold_1_m, (behind <= self.threshold_1_m) | self.near[box]


def split(depth: DepthMap) -> Split | None:
    """Return the clusters of a depth map, None when too little is known for a wall."""
    sigma_1_m = depth.sigma_disparity_px / (depth.baseline_m * depth.pinhole.f_px)
    return split_inverse(lambda box: np.reciprocal(depth.depth_m[box]), depth.near, sigma_1_m)


def split_inverse(inverse: InverseDepth, near: Mask, sigma_1_m: float) -> Split | None:
    """Return the clusters of an image by its inverse depth; any scale, `sigma_1_m` in the same.

    `near` (H, W) marks unknown pixels that are known to be close.
    """
    height, width = near.shape
    fitted = _wall_plane(inverse, width, sigma_1_m)
    if fitted is None:
        return None
    plane, level = fitted
    stride = max(1, width // (2 * GRID_PX))
    every = (slice(None, None, stride), slice(None, None, stride))
    coarse = plane.inverse_depth(range(height)[every[0]], range(width)[every[1]]) - inverse(every)
    known = coarse[np.isfinite(coarse)]
    least = max(CLEAR_SIGMAS * sigma_1_m, LEAST_JUMP * level)
    jump, separation = _clusters(known, least)
    threshold = max(jump / 2, 0.6 * least)
    count = int((known > threshold).sum())
    bimodal = separation > BIMODAL and count >= max(6, LEAST_FAR * known.size)
    return Split(plane, inverse, near, threshold, separation, bimodal)


def _clusters(behind: FloatMap, least: float) -> tuple[float, float]:
    """Return how far the far cluster lies behind the wall and Ashman's D of the two; (least, 0) when there is none.

    Two means, the wall's fixed at zero by the fit: the split is half-way, where the jump across an edge is steepest.
    """
    far = behind[behind > least]
    if far.size < 3:
        return least, 0.0
    jump = median(far)
    for _ in range(2):
        far = behind[behind > max(jump / 2, 0.6 * least)]
        jump = median(far)
    near = behind[np.abs(behind) < min(jump / 2, 2 * least)]
    if near.size < 3:
        return jump, 0.0
    spread = math.hypot(float(near.std()), 1.4826 * median(np.abs(far - jump)))
    return jump, math.sqrt(2.0) * jump / max(spread, 1e-9)


def _wall_plane(inverse: InverseDepth, width: int, sigma_1_m: float) -> tuple[Plane, float] | None:
    """Return the plane that most known pixels lie on and its inverse depth there; RANSAC, then least squares."""
    stride = max(1, width // GRID_PX)
    grid = inverse((slice(stride // 2, None, stride), slice(stride // 2, None, stride)))
    row, column = np.nonzero(np.isfinite(grid))
    if row.size < 50:
        return None
    w = grid[row, column].astype(np.float64)
    A = np.stack([column * stride + stride // 2, row * stride + stride // 2, np.ones(row.size)], axis=1)
    chosen = (_triples() * row.size).astype(np.int64)
    corners = A[chosen]
    good = np.abs(np.linalg.det(corners)) > 1.0
    candidates = np.linalg.solve(corners[good], w[chosen[good]][..., None])[..., 0]
    if not len(candidates):
        return None
    tolerance = max(2.5 * sigma_1_m, 0.02 * median(w))
    off = np.abs(A[::VOTERS] @ candidates.T - w[::VOTERS, None])
    plane = candidates[int(np.argmax(np.count_nonzero(off < tolerance, axis=0)))]
    for _ in range(ROUNDS):
        on = np.abs(A @ plane - w) < tolerance
        A_on = A[on]
        plane = np.linalg.solve(A_on.T @ A_on, A_on.T @ w[on])
    on = np.abs(A @ plane - w) < tolerance
    return Plane(*(float(x) for x in plane)), median(w[on])


def median(values: NDArray[np.floating]) -> float:
    """Return the median of known values (n,), n > 0, without the checks of np.median."""
    half = values.size // 2
    if values.size % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return float((low + high) / 2)


@lru_cache(maxsize=1)
def _triples() -> Array:
    """Return (TRIPLES, 3) places in a list, 0 to 1, the same every time."""
    return np.random.default_rng(15).random((TRIPLES, 3))
