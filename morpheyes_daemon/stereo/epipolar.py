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

WINDOW_PX = 11
"""Side of the patches that are compared."""

REACH_PX = 6.0
SIDEWAYS_PX = 1.5
"""Largest row offset that is found, and how far the matcher's disparity may be improved on."""

RETURN_PX = 0.3
"""How near the way back from the right eye must end."""

MIN_POINTS = 12
"""Fewer points than this explain nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class RowOffsets:
    """dv_px (n,) = row in the right eye - row in the left, of left points uv (n, 2) with disparity d_px (n,).

    `tried` counts the textured points that were looked for in the right eye.
    """

    uv: Array
    d_px: Array
    dv_px: Array
    tried: int = 0

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
    """Measure row offsets of a rectified grey pair (H, W) with its disparity map (H, W), NaN unknown.

    Points are followed from eye to eye and back by Lucas and Kanade's method, beginning at the disparity and free
    to move both ways: kept to the row direction, an oblique texture would trade columns for rows.
    """
    uv = _textured_points(left, disparity_px)
    d = disparity_px[uv[:, 1], uv[:, 0]]
    inside = (uv[:, 0] - d >= WINDOW_PX // 2) & (uv[:, 0] - d < left.shape[1] - WINDOW_PX // 2)
    start, d = uv[inside].astype(np.float32), d[inside]
    if not len(start):
        return RowOffsets(np.empty((0, 2)), np.empty(0), np.empty(0))
    expected = start - np.stack([d, np.zeros_like(d)], axis=1)
    found, good = _followed(left, right, start, expected)
    back, returned = _followed(right, left, found, start)
    aside, down = (found - expected).T
    good &= returned & (np.abs(back - start).max(axis=1) < RETURN_PX)
    good &= (np.abs(aside) < SIDEWAYS_PX) & (np.abs(down) < REACH_PX)
    return RowOffsets(
        start[good].astype(np.float64),
        (d - aside)[good].astype(np.float64),
        down[good].astype(np.float64),
        len(start),
    )


def _followed(first: Image, second: Image, points: FloatMap, guess: FloatMap) -> tuple[FloatMap, NDArray[np.bool_]]:
    """Return where points (n, 2) of the first image are in the second, beginning at `guess`, and which were found."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        points,
        guess.copy(),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=1,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-3,
    )
    return np.asarray(found, dtype=np.float32), np.asarray(status).ravel() > 0


def _textured_points(left: Image, disparity_px: FloatMap) -> NDArray[np.intp]:
    """Return (n, 2) the pixel of each cell with the strongest vertical gradient and a disparity."""
    margin = WINDOW_PX // 2
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
