"""How well the rows of both eyes align, measured in the images themselves, and what makes them not.

In a rectified pair of a rigid, synchronous rig a point has the same row in both eyes. Row offsets of a few hundred
well-textured points tell a right eye that has turned (pitch lifts all rows, roll tilts them) from one that exposes
late (rows then follow the motion). Yaw between the eyes leaves no trace here (paper-notes 14).

Lateness is told from the rig's travel alone: how fast it moves a point's row depends on the point's depth, which no
turn imitates, and the autopilot knows the travel well. How the rig turned in those milliseconds it knows badly, since
vibration is faster than its messages; so each frame has a turn of its own, and only what stays is the eye's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.stereo.lucas_kanade import follow
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

CORRELATED = 4.0
"""Points err together, by light and texture: in flights the scatter over frames is 3 to 6 times what the points say."""

TURN_RATE_SIGMA_RAD_S = 0.2
"""How badly the turn rate during the time between the eyes is known."""

SHARP_S = 5e-4
"""One sigma from which a measured lateness is better than the expected one."""


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


def levelled(offsets: RowOffsets, pinhole: Pinhole, fit: RowFit) -> RowOffsets:
    """Return row offsets less what the pitch and roll of `fit` make of them."""
    turn = np.array([fit.pitch_rad, 0.0, fit.roll_rad])
    return replace(offsets, dv_px=offsets.dv_px - _turn_columns(offsets, pinhole) @ turn)


def row_offsets(left: Image, right: Image, disparity_px: FloatMap) -> RowOffsets:
    """Measure row offsets of a rectified grey pair (H, W) with its disparity map (H, W), NaN unknown.

    Points are followed from eye to eye and back by Lucas and Kanade's method, beginning at the disparity and free
    to move both ways: kept to the row direction, an oblique texture would trade columns for rows.
    """
    uv = _textured_points(left, disparity_px)
    d = disparity_px[uv[:, 1], uv[:, 0]]
    inside = (uv[:, 0] - d >= WINDOW_PX // 2) & (uv[:, 0] - d < left.shape[1] - WINDOW_PX // 2)
    start, d = uv[inside].astype(np.float64), d[inside].astype(np.float64)
    if not len(start):
        return RowOffsets(np.empty((0, 2)), np.empty(0), np.empty(0))
    expected = start - np.stack([d, np.zeros_like(d)], axis=1)
    found, good = follow(
        left,
        right,
        start,
        expected,
        window_px=WINDOW_PX,
        levels=1,
        return_px=RETURN_PX,
        least_texture=1e-3,
    )
    aside, down = (found - expected).T
    good &= (np.abs(aside) < SIDEWAYS_PX) & (np.abs(down) < REACH_PX)
    return RowOffsets(start[good], (d - aside)[good], down[good], len(start))


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


@dataclass(slots=True)
class RowWatch:
    """Collects row offsets over frames and explains them; older frames fade by `memory` per frame.

    In each frame, points that its own explanation leaves far out are left out. `expected_late_s` is reckoned with
    until the lateness is measured; what was made of the rows by then is forgotten.
    """

    memory: float = 0.9
    expected_late_s: float = 0.0
    sharp: bool = False
    _reckoned_s: tuple[float, float] | None = None
    _late_moment: float = 0.0
    _late_information: float = 0.0
    _turn_moment: Array = field(default_factory=lambda: np.zeros(2))
    _turn_information: Array = field(default_factory=lambda: np.zeros((2, 2)))
    _square: float = 0.0
    _count: float = 0.0

    def add(
        self, offsets: RowOffsets, pinhole: Pinhole, travel_px_s: Array | None = None, turn_px_s: Array | None = None
    ) -> RowFit:
        """Take one frame's offsets and return the present explanation.

        `travel_px_s` and `turn_px_s` (n,) are how fast the rows of the points move in the right eye since the rig
        travels and turns; None for a rig that stands still.
        """
        self._fade()
        travel, turning = (np.zeros(offsets.count) if rate is None else rate for rate in (travel_px_s, turn_px_s))
        columns = np.column_stack([travel, _turn_columns(offsets, pinhole)])
        kept = _consistent(columns, offsets.dv_px)
        if kept.any():
            columns, dv = columns[kept], offsets.dv_px[kept]
            left_over = dv - columns @ _least_squares(columns, dv)
            noise_px = CORRELATED * max(float(left_over.std()), 0.02)
            self._square += float(left_over @ left_over)
            self._count += len(dv)
            self._add_late(columns[:, 0], columns[:, 1:], dv, noise_px)
            late_s, doubt_s = self._reckon()
            rest = dv - late_s * (columns[:, 0] + turning[kept])
            self._add_turn(columns[:, [1, 3]], rest, noise_px, math.hypot(late_s, doubt_s))
        return self._fit()

    def forget_turn(self) -> None:
        """Start anew with pitch and roll, for a rig that was turned; the lateness stays."""
        self._turn_moment, self._turn_information = np.zeros(2), np.zeros((2, 2))

    def _reckon(self) -> tuple[float, float]:
        """Return the lateness to reckon with and the doubt in it: the last sharp one, else the expected one."""
        late_s, sigma_s = self._measured_late()
        if sigma_s < SHARP_S:
            if not self.sharp:
                self.forget_turn()
            self.sharp, self._reckoned_s = True, (late_s, sigma_s)
        return self._reckoned_s or (self.expected_late_s, self.expected_late_s)

    def _fade(self) -> None:
        self._late_moment *= self.memory
        self._late_information *= self.memory
        self._turn_moment = self.memory * self._turn_moment
        self._turn_information = self.memory * self._turn_information
        self._square *= self.memory
        self._count *= self.memory

    def _add_late(self, travel: Array, turns: Array, dv: Array, noise_px: float) -> None:
        """Regress on the part of the travel that no turn of this frame could have made."""
        basis, _ = np.linalg.qr(turns)
        travel = travel - basis @ (basis.T @ travel)
        self._late_moment += float(travel @ dv) / noise_px**2
        self._late_information += float(travel @ travel) / noise_px**2

    def _add_turn(self, columns: Array, dv: Array, noise_px: float, late_s: float) -> None:
        """Weigh this frame's pitch and roll by its points' noise and by how the rig may turn within `late_s`."""
        information = columns.T @ columns / noise_px**2 + 1e-3 * np.eye(2)
        turn = np.linalg.solve(information, columns.T @ dv / noise_px**2)
        meanwhile = (late_s * TURN_RATE_SIGMA_RAD_S) ** 2 * np.eye(2)
        weight = np.linalg.inv(np.linalg.inv(information) + meanwhile)
        self._turn_moment = self._turn_moment + weight @ turn
        self._turn_information = self._turn_information + weight

    def _measured_late(self) -> tuple[float, float]:
        if self._late_information < 1e-3:
            return 0.0, math.inf
        return self._late_moment / self._late_information, 1.0 / math.sqrt(self._late_information)

    def _fit(self) -> RowFit:
        late_s, late_sigma_s = self._measured_late()
        if self._count < MIN_POINTS or not self._turn_information.any():
            return RowFit(0.0, math.inf, 0.0, math.inf, 0.0, math.inf, math.nan, 0)
        pitch, roll = (float(angle) for angle in np.linalg.solve(self._turn_information, self._turn_moment))
        pitch_sigma, roll_sigma = (float(s) for s in np.sqrt(np.diag(np.linalg.inv(self._turn_information))))
        residual_px = math.sqrt(self._square / self._count)
        return RowFit(late_s, late_sigma_s, pitch, pitch_sigma, roll, roll_sigma, residual_px, round(self._count))


def _turn_columns(offsets: RowOffsets, pinhole: Pinhole) -> Array:
    """Return how the rows (n, 3) change per radian of pitch, yaw and roll of the right eye."""
    x = (offsets.uv[:, 0] - offsets.d_px - pinhole.cx_px) / pinhole.f_px
    y = (offsets.uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    return np.asarray(pinhole.f_px * np.stack([1.0 + y * y, -x * y, -x], axis=1))


def _least_squares(columns: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(columns, values, rcond=1e-9)[0])


def _consistent(columns: Array, values: Array) -> NDArray[np.bool_]:
    """Return which values one explanation fits, by least squares on ever fewer of them (three rounds)."""
    kept = np.ones(len(values), dtype=np.bool_)
    for _ in range(3):
        if kept.sum() < MIN_POINTS:
            return np.zeros(len(values), dtype=np.bool_)
        off = np.abs(values - columns @ _least_squares(columns[kept], values[kept]))
        kept = off <= max(0.1, 2.5 * 1.4826 * float(np.median(off)))
    return kept
