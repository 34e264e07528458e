"""How well the rows of both eyes align, measured in the images themselves, and what makes them not.

In a rectified pair of a rigid, synchronous rig a point has the same row in both eyes. Row offsets of a few hundred
well-textured points tell a right eye that has turned (pitch lifts all rows, roll tilts them) from one that exposes
late (rows then follow the motion). Yaw between the eyes leaves no trace here (paper-notes 14).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages import FloatMap, Image, Pinhole
from morpheyes_daemon.transforms import Array

CELLS = (24, 18)
"""Columns and rows of cells; each gives its best-textured point."""

PATCH_RADIUS_PX = 4
REACH_PX = 3
"""Largest row offset that is found."""

BLUR_PX = 1.0

MIN_CONTRAST = 5.0
"""Least standard deviation of a blurred patch in grey levels; the sensor's noise is below 1 then."""

MIN_CORRELATION = 0.85
"""Least normalised correlation of the best match."""


MIN_POINTS = 12
"""Fewer points than this explain nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class RowOffsets:
    """dv_px (n,) = row in the right eye - row in the left, of left points uv (n, 2) with disparity d_px (n,)."""

    uv: Array
    d_px: Array
    dv_px: Array

    @property
    def count(self) -> int:
        """Number of points measured."""
        return len(self.dv_px)

    @property
    def median_px(self) -> float:
        """Median of the offsets' size, NaN without points: the epipolar residual."""
        return float(np.median(np.abs(self.dv_px))) if self.count else math.nan


@dataclass(frozen=True, slots=True)
class RowFit:
    """What explains row offsets: time by which the right eye exposes late, and its turn from where it should be.

    Sigmas are one standard deviation; inf where the motion or the points say nothing.
    """

    late_s: float
    late_sigma_s: float
    pitch_rad: float
    pitch_sigma_rad: float
    roll_rad: float
    roll_sigma_rad: float
    residual_px: float
    count: int


def row_offsets(left: Image, right: Image, disparity_px: FloatMap) -> RowOffsets:
    """Measure row offsets of a rectified grey pair (H, W) with its disparity map (H, W), NaN unknown."""
    uv = _textured_points(left, disparity_px)
    d = disparity_px[uv[:, 1], uv[:, 0]].astype(np.float64)
    r = PATCH_RADIUS_PX
    inside = (uv[:, 0] - d >= r) & (uv[:, 0] - d < left.shape[1] - r - 1)
    uv, d = uv[inside], d[inside]
    if not len(uv):
        return RowOffsets(uv.astype(np.float64), d, np.empty(0))
    # without aliasing a step of a fraction of a row shows in grey levels as one
    soft = [cv2.GaussianBlur(eye, (0, 0), BLUR_PX) for eye in (left, right)]
    patches, strips = _gathered(np.asarray(soft[0], np.uint8), np.asarray(soft[1], np.uint8), uv, d)
    scores = _correlations(patches, strips)
    best = scores.argmax(axis=1)
    points = np.arange(len(uv))
    sure = (best > 0) & (best < 2 * REACH_PX) & (scores[points, best] >= MIN_CORRELATION)
    points, best = points[sure], best[sure]
    offset = best - REACH_PX + _remainder(patches[points], strips[points], best)
    return RowOffsets(uv[points].astype(np.float64), d[points], offset)


def _textured_points(left: Image, disparity_px: FloatMap) -> NDArray[np.intp]:
    """Return (n, 2) the pixel of each cell with the strongest vertical gradient and a disparity."""
    margin = PATCH_RADIUS_PX + REACH_PX
    height, width = ((size - 2 * margin) // cells for size, cells in zip(left.shape, CELLS[::-1], strict=True))
    if height < 1 or width < 1:
        return np.empty((0, 2), dtype=np.intp)
    gradient = cv2.boxFilter(np.abs(cv2.Sobel(left, cv2.CV_32F, 0, 1)), -1, (5, 5))
    gradient = np.where(np.isfinite(disparity_px), gradient, np.float32(-1.0))
    used = gradient[margin : margin + height * CELLS[1], margin : margin + width * CELLS[0]]
    cells = used.reshape(CELLS[1], height, CELLS[0], width).swapaxes(1, 2).reshape(CELLS[1], CELLS[0], -1)
    best = cells.argmax(axis=2)
    row, column = np.nonzero(cells.max(axis=2) > 0)
    place = best[row, column]
    return np.stack([margin + column * width + place % width, margin + row * height + place // width], axis=1)


def _gathered(left: Image, right: Image, uv: NDArray[np.intp], d_px: Array) -> tuple[Array, Array]:
    """Return around each point the left patch with one more row above and below, and the right eye's strip.

    The strip (n, size + 2 REACH_PX, size) is taken at the disparity, between pixels by linear interpolation.
    """
    r = PATCH_RADIUS_PX
    u, v = uv[:, 0, None, None], uv[:, 1, None, None]
    across, down = np.arange(-r, r + 1)[None, None, :], np.arange(-r - REACH_PX, r + REACH_PX + 1)[None, :, None]
    patches = left[v + down[:, REACH_PX - 1 : 1 - REACH_PX], u + across].astype(np.float64)
    start = uv[:, 0] - d_px
    whole = np.floor(start).astype(np.intp)[:, None, None]
    share = (start - np.floor(start))[:, None, None]
    near = right[v + down, whole + across].astype(np.float64)
    far = right[v + down, whole + across + 1].astype(np.float64)
    return patches, near + share * (far - near)


def _correlations(patches: Array, strips: Array) -> Array:
    """Return the normalised correlation (n, 2 REACH_PX + 1) of each left patch with the strip at each row offset."""
    patch = _levelled(patches[:, 1:-1])
    size = patch.shape[1]
    windows = _levelled(np.stack([strips[:, k : k + size] for k in range(2 * REACH_PX + 1)], axis=1))
    contrast = np.sqrt((patch**2).sum(axis=(1, 2)))
    product = np.einsum("nij,nkij->nk", patch, windows)
    scores = product / np.maximum(contrast[:, None] * np.sqrt((windows**2).sum(axis=(2, 3))), 1e-9)
    return np.where(contrast[:, None] >= MIN_CONTRAST * size, scores, -1.0)


def _remainder(patches: Array, strips: Array, best: NDArray[np.intp]) -> Array:
    """Return the part of the row offset (n,) beyond the whole rows `best`, in (-1, 1).

    One least-squares step on the mean of both eyes' vertical gradients, which is exact to second order.
    """
    size = patches.shape[1] - 2
    rows = best[:, None] + np.arange(-1, size + 1)
    window = np.take_along_axis(strips, rows[:, :, None], axis=1)
    patch, middle = _levelled(patches[:, 1:-1]), _levelled(window[:, 1:-1])
    gain = (patch * middle).sum(axis=(1, 2), keepdims=True) / (middle**2).sum(axis=(1, 2), keepdims=True)
    slope = _levelled(0.25 * (patches[:, 2:] - patches[:, :-2]) + 0.25 * gain * (window[:, 2:] - window[:, :-2]))
    step = (slope * (patch - gain * middle)).sum(axis=(1, 2)) / ((slope**2).sum(axis=(1, 2)) + 1e-9)
    return np.asarray(np.clip(step, -1.0, 1.0))


def _levelled(patches: Array) -> Array:
    return np.asarray(patches - patches.mean(axis=(-2, -1), keepdims=True))


def row_rates(
    offsets: RowOffsets, pinhole: Pinhole, baseline_m: float, v_rect_m_s: Array, w_rect_rad_s: Array
) -> Array:
    """Return how fast (n,) the rows of static points move, px/s: the rig moves with v (3,) and turns with w (3,).

    dP/dt = -v - w x P, with P = (x, y, 1) b f / d.
    """
    x = (offsets.uv[:, 0] - pinhole.cx_px) / pinhole.f_px
    y = (offsets.uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    per_m = np.maximum(offsets.d_px, 0.0) / (baseline_m * pinhole.f_px)
    vx_vy_vz, (wx, wy, wz) = v_rect_m_s, w_rect_rad_s
    turning = wx * (1.0 + y * y) - wy * x * y - wz * x
    return np.asarray(pinhole.f_px * (turning + (y * vx_vy_vz[2] - vx_vy_vz[1]) * per_m))


@dataclass(slots=True)
class RowWatch:
    """Collects row offsets over frames and explains them; older frames fade by `memory` per frame.

    Three unknowns: lateness, pitch and roll of the right eye. In each frame, points that its own explanation leaves
    far out are left out.
    """

    memory: float = 0.9
    _normal: Array = field(default_factory=lambda: np.zeros((3, 3)))
    _moment: Array = field(default_factory=lambda: np.zeros(3))
    _square: float = 0.0
    _count: float = 0.0

    def add(self, offsets: RowOffsets, pinhole: Pinhole, rates_px_s: Array) -> RowFit:
        """Take one frame's offsets with the rows' rates (see `row_rates`) and return the present explanation."""
        x = (offsets.uv[:, 0] - pinhole.cx_px) / pinhole.f_px
        y = (offsets.uv[:, 1] - pinhole.cy_px) / pinhole.f_px
        causes = np.stack([rates_px_s, pinhole.f_px * (1.0 + y * y), -pinhole.f_px * x], axis=1)
        kept = _consistent(causes, offsets.dv_px)
        causes, dv = causes[kept], offsets.dv_px[kept]
        self._normal = self.memory * self._normal + causes.T @ causes
        self._moment = self.memory * self._moment + causes.T @ dv
        self._square = self.memory * self._square + float(dv @ dv)
        self._count = self.memory * self._count + len(dv)
        return self._fit()

    def _solution(self) -> Array:
        return np.asarray(np.linalg.lstsq(self._normal, self._moment, rcond=1e-12)[0])

    def _fit(self) -> RowFit:
        solution = self._solution()
        left_over = max(0.0, self._square - float(solution @ self._moment)) / max(1.0, self._count - 3.0)
        residual_px = math.sqrt(left_over)
        sigma = _sigmas(self._normal, max(residual_px, 0.02))
        late, pitch, roll = (float(value) for value in solution)
        return RowFit(late, sigma[0], pitch, sigma[1], roll, sigma[2], residual_px, round(self._count))


def _consistent(causes: Array, dv_px: Array) -> NDArray[np.bool_]:
    """Return which offsets one explanation fits, by least squares on ever fewer points (three rounds)."""
    kept = np.ones(len(dv_px), dtype=np.bool_)
    for _ in range(3):
        if kept.sum() < MIN_POINTS:
            return np.zeros(len(dv_px), dtype=np.bool_)
        solution = np.linalg.lstsq(causes[kept], dv_px[kept], rcond=1e-9)[0]
        off = np.abs(dv_px - causes @ solution)
        kept = off <= max(0.1, 2.5 * 1.4826 * float(np.median(off)))
    return kept


def _sigmas(normal: Array, residual_px: float) -> tuple[float, float, float]:
    """Return one sigma of each unknown, inf for those that the normal equations leave open."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-12))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    open_ = values < 1e-6
    spread = (vectors**2) @ np.where(open_, np.inf, 1.0 / np.maximum(values, 1e-6)) if not open_.any() else None
    if spread is None:
        touched = (vectors[:, open_] ** 2).sum(axis=1) > 1e-6
        known = (vectors[:, ~open_] ** 2) @ (1.0 / values[~open_])
        spread = np.where(touched, np.inf, known)
    late, pitch, roll = (float(s) for s in residual_px * np.sqrt(spread) / scale)
    return late, pitch, roll
