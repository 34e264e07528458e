"""Row offsets of a rectified pair (the epipolar residual), and their explanation by rotation and time offset.

In a rectified pair of a rigid, synchronous rig a point has the same row in both images. The row offsets of a few
hundred textured points separate a rotated right camera (pitch shifts all rows, roll tilts them) from a time offset
between the exposures (rows then follow the motion). Yaw between the cameras has no effect on rows (paper-notes 14).

The time offset is estimated from the translation of the rig alone: the row rate it causes depends on the depth of
the point, which no rotation imitates, and the autopilot knows the velocity well. It knows the rotation within those
milliseconds badly, since vibration is faster than its messages; so a rotation is solved for in each frame, and only
its constant part is the right camera's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.stereo.lucas_kanade import LucasKanade
from morpheyes_daemon.transforms import Array

CELLS = (24, 18)
"""Columns and rows of the grid over the image, each cell of which gives its best-textured point; chosen: more
cost time."""

_TRACKER = LucasKanade(window_px=11, levels=1, min_eigenvalue=1e-3, return_px=0.3)
"""From the left to the right image; chosen: larger windows blur depth edges, a looser return check admits false
matches."""
_MARGIN_PX = _TRACKER.window_px // 2
"""Border of the image in which a window does not fit, pixels."""

ROW_REACH_PX = 6.0
DISPARITY_REACH_PX = 1.5
"""Largest row offset, and largest change of the matcher's disparity, pixels; chosen: larger ones are false matches."""

MIN_POINTS = 12
"""Least number of points of a fit of four unknowns; chosen: three per unknown."""

NOISE_INFLATION = 4.0
"""Factor on the noise since errors of the points are correlated by light and texture: in simulated forest flights the
scatter over frames is 3 to 6 times that of independent points."""

TURN_RATE_SIGMA_RAD_S = 0.2
"""One sigma of the turn rate between the two exposures, rad/s; chosen: that of the simulated autopilot
(benchmarks.online_calibration)."""

TIME_OFFSET_SIGMA_S = 5e-4
"""One sigma, s, below which the measured time offset replaces the expected one; chosen: a quarter of the usual 2 ms."""

_NOISE_FLOOR_PX = 0.02
"""Least noise of the row offsets of a frame, pixels; chosen: the accuracy of the coarse rectification map is 0.01."""

_REGULARISATION = 1e-3
"""Added to the information of a frame's rotation, 1/rad^2; chosen: negligible against one point."""

_OUTLIER_SIGMAS, _OUTLIER_FLOOR_PX, _ROUNDS = 2.5, 0.1, 3
"""Outlier limit in sigmas (1.4826 times the median absolute residual), its floor in pixels, rounds; chosen: a tighter
limit rejects points of a noisy image."""


@dataclass(frozen=True, slots=True, eq=False)
class RowOffsets:
    """dv_px (n,) = row in the right image - row in the left one, of left pixels uv (n, 2) with disparity d_px (n,).

    `tried` counts the textured points that were searched in the right image.
    """

    uv: Array
    d_px: Array
    dv_px: Array
    tried: int = 0

    @property
    def count(self) -> int:
        """Number of points found."""
        return len(self.dv_px)

    @property
    def median_px(self) -> float:
        """Median absolute row offset, pixels (the epipolar residual); NaN without points."""
        return float(np.median(np.abs(self.dv_px))) if self.count else math.nan


@dataclass(frozen=True, slots=True)
class RowFit:
    """Explanation of row offsets: time offset of the right camera, and its pitch and roll relative to the calibration.

    Sigmas are inf where the motion or the points determine nothing; `residual_px` is the rms that remains.
    """

    time_offset_s: float
    time_offset_sigma_s: float
    pitch_rad: float
    pitch_sigma_rad: float
    roll_rad: float
    roll_sigma_rad: float
    residual_px: float
    count: int


def without_rotation(offsets: RowOffsets, pinhole: Pinhole, fit: RowFit) -> RowOffsets:
    """Return row offsets minus those that the pitch and roll of `fit` cause (first order)."""
    turn = np.array([fit.pitch_rad, 0.0, fit.roll_rad])
    return replace(offsets, dv_px=offsets.dv_px - _rotation_columns(offsets, pinhole) @ turn)


def row_offsets(left: Image, right: Image, disparity_px: FloatMap) -> RowOffsets:
    """Return the row offsets of a rectified grey pair (H, W) with its disparity map (H, W) pixels, NaN unknown.

    Points are tracked from left to right and back, starting at the disparity and free in both directions: restricted
    to the row direction, an oblique texture would trade columns for rows.
    """
    uv = _textured_points(left, disparity_px)
    d = disparity_px[uv[:, 1], uv[:, 0]]
    inside = (uv[:, 0] - d >= _MARGIN_PX) & (uv[:, 0] - d < left.shape[1] - _MARGIN_PX)
    start, d = uv[inside].astype(np.float64), d[inside].astype(np.float64)
    if not len(start):
        return RowOffsets(np.empty((0, 2)), np.empty(0), np.empty(0))
    expected = start - np.stack([d, np.zeros_like(d)], axis=1)
    found, good = _TRACKER.track(left, right, start, expected)
    aside, down = (found - expected).T
    good &= (np.abs(aside) < DISPARITY_REACH_PX) & (np.abs(down) < ROW_REACH_PX)
    return RowOffsets(start[good], (d - aside)[good], down[good], len(start))


def _textured_points(left: Image, disparity_px: FloatMap) -> NDArray[np.intp]:
    """Return the pixel (n, 2) of each cell with the strongest vertical gradient among those with a disparity."""
    margin = _MARGIN_PX
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
class RowOffsetEstimator:
    """Recursive least squares over frames with exponential forgetting: evidence fades by `memory` per frame.

    Outliers of each frame's own fit are rejected. `expected_time_offset_s` is assumed until the time offset is
    measured (`time_offset_known`); the rotation estimated until then is discarded.
    """

    memory: float = 0.9
    expected_time_offset_s: float = 0.0
    time_offset_known: bool = False
    _known_time_offset_s: tuple[float, float] | None = None
    _time_offset_moment: float = 0.0
    _time_offset_information: float = 0.0
    _rotation_moment: Array = field(default_factory=lambda: np.zeros(2))
    _rotation_information: Array = field(default_factory=lambda: np.zeros((2, 2)))
    _square: float = 0.0
    _count: float = 0.0

    def add(
        self,
        offsets: RowOffsets,
        pinhole: Pinhole,
        translation_px_s: Array | None = None,
        rotation_px_s: Array | None = None,
    ) -> RowFit:
        """Add the offsets of one frame and return the updated explanation.

        `translation_px_s` and `rotation_px_s` (n,) are the row rates of the points in the right image by the rig's
        translation and rotation (`camera_motion.row_rates`); None for a stationary rig.
        """
        self._fade()
        translation, turning = (
            np.zeros(offsets.count) if rate is None else rate for rate in (translation_px_s, rotation_px_s)
        )
        columns = np.column_stack([translation, _rotation_columns(offsets, pinhole)])
        kept = _consistent(columns, offsets.dv_px)
        if kept.any():
            columns, dv = columns[kept], offsets.dv_px[kept]
            remaining = dv - columns @ _least_squares(columns, dv)
            noise_px = NOISE_INFLATION * max(float(remaining.std()), _NOISE_FLOOR_PX)
            self._square += float(remaining @ remaining)
            self._count += len(dv)
            self._add_time_offset(columns[:, 0], columns[:, 1:], dv, noise_px)
            time_offset_s, offset_sigma_s = self._time_offset_to_use()
            rest = dv - time_offset_s * (columns[:, 0] + turning[kept])
            self._add_rotation(columns[:, [1, 3]], rest, noise_px, math.hypot(time_offset_s, offset_sigma_s))
        return self._fit()

    def reset_rotation(self) -> None:
        """Discard the evidence on pitch and roll, for a rig that was corrected; that on the time offset stays."""
        self._rotation_moment, self._rotation_information = np.zeros(2), np.zeros((2, 2))

    def _time_offset_to_use(self) -> tuple[float, float]:
        """Return the time offset to correct by and its sigma, s: the last measured one, else the expected one."""
        time_offset_s, sigma_s = self._measured_time_offset()
        if sigma_s < TIME_OFFSET_SIGMA_S:
            if not self.time_offset_known:
                self.reset_rotation()
            self.time_offset_known, self._known_time_offset_s = True, (time_offset_s, sigma_s)
        return self._known_time_offset_s or (self.expected_time_offset_s, self.expected_time_offset_s)

    def _fade(self) -> None:
        self._time_offset_moment *= self.memory
        self._time_offset_information *= self.memory
        self._rotation_moment = self.memory * self._rotation_moment
        self._rotation_information = self.memory * self._rotation_information
        self._square *= self.memory
        self._count *= self.memory

    def _add_time_offset(self, translation: Array, turns: Array, dv: Array, noise_px: float) -> None:
        """Regress on the part of the translation's row rates that is orthogonal to every rotation of this frame."""
        basis, _ = np.linalg.qr(turns)
        translation = translation - basis @ (basis.T @ translation)
        self._time_offset_moment += float(translation @ dv) / noise_px**2
        self._time_offset_information += float(translation @ translation) / noise_px**2

    def _add_rotation(self, columns: Array, dv: Array, noise_px: float, time_offset_s: float) -> None:
        """Add pitch and roll of this frame, weighted by the noise of its points and by the unknown rotation of the rig
        within the time offset."""
        information = columns.T @ columns / noise_px**2 + _REGULARISATION * np.eye(2)
        turn = np.linalg.solve(information, columns.T @ dv / noise_px**2)
        by_time = (time_offset_s * TURN_RATE_SIGMA_RAD_S) ** 2 * np.eye(2)
        weight = np.linalg.inv(np.linalg.inv(information) + by_time)
        self._rotation_moment = self._rotation_moment + weight @ turn
        self._rotation_information = self._rotation_information + weight

    def _measured_time_offset(self) -> tuple[float, float]:
        if self._time_offset_information < 1e-3:
            return 0.0, math.inf
        return self._time_offset_moment / self._time_offset_information, 1.0 / math.sqrt(self._time_offset_information)

    def _fit(self) -> RowFit:
        time_offset_s, time_offset_sigma_s = self._measured_time_offset()
        if self._count < MIN_POINTS or not self._rotation_information.any():
            return RowFit(0.0, math.inf, 0.0, math.inf, 0.0, math.inf, math.nan, 0)
        pitch, roll = (float(angle) for angle in np.linalg.solve(self._rotation_information, self._rotation_moment))
        pitch_sigma, roll_sigma = (float(s) for s in np.sqrt(np.diag(np.linalg.inv(self._rotation_information))))
        residual_px = math.sqrt(self._square / self._count)
        return RowFit(
            time_offset_s, time_offset_sigma_s, pitch, pitch_sigma, roll, roll_sigma, residual_px, round(self._count)
        )


def _rotation_columns(offsets: RowOffsets, pinhole: Pinhole) -> Array:
    """Return the derivative of the rows (n, 3) by pitch, yaw and roll of the right camera, pixels/rad."""
    x = (offsets.uv[:, 0] - offsets.d_px - pinhole.cx_px) / pinhole.f_px
    y = (offsets.uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    return np.asarray(pinhole.f_px * np.stack([1.0 + y * y, -x * y, -x], axis=1))


def _least_squares(columns: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(columns, values, rcond=1e-9)[0])


def _consistent(columns: Array, values: Array) -> NDArray[np.bool_]:
    """Return the inliers (n,) of a least-squares fit, by repeated rejection; none with fewer than MIN_POINTS."""
    kept = np.ones(len(values), dtype=np.bool_)
    for _ in range(_ROUNDS):
        if kept.sum() < MIN_POINTS:
            return np.zeros(len(values), dtype=np.bool_)
        residual = np.abs(values - columns @ _least_squares(columns[kept], values[kept]))
        kept = residual <= max(_OUTLIER_FLOOR_PX, _OUTLIER_SIGMAS * 1.4826 * float(np.median(residual)))
    return kept
