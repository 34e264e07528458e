"""Plausibility of the solved scale: baselines against the folders' names, squares against their given size.

No picture shows the size of a square, so a wrong one scales the whole rig without any residual. It is detected by the
other length that is given: the folders' names. Exchanged or misnamed folders are detected as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.calibration.solver.cross_validation import geometry_at
from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry
from morpheyes_daemon.calibration.solver.solver import Calibration
from morpheyes_daemon.transforms import Array

SCALE_TOLERANCE = 0.03
"""Relative difference of solved and nominal changes of the baseline; chosen: three times a 1 % stroke error."""
ONE_LENGTH_TOLERANCE = 0.10
"""The same for a single baseline; chosen: a rig is labelled by the distance of its housings."""
NAME_TOLERANCE_M = 8e-3
"""Largest deviation of one baseline from the line through the others, metres; chosen: four times the paper's 1.83 mm."""


@dataclass(frozen=True)
class ScaleCheck:
    """Squares of the board as triangulated, and solved baselines against nominal ones.

    `length_ratio` is solved over nominal change of baseline (plain ratio for one baseline), None without names.
    `square_mm` is the mean measured square, `square_scatter_mm` one sigma over board rows.
    """

    square_mm: float
    square_scatter_mm: float
    length_ratio: float | None
    baselines: int = 1

    @property
    def disagrees(self) -> bool:
        """Whether square size and folder names contradict each other."""
        limit = SCALE_TOLERANCE if self.baselines > 1 else ONE_LENGTH_TOLERANCE
        return self.length_ratio is not None and abs(self.length_ratio - 1.0) > limit


def scale_check(calibration: Calibration) -> ScaleCheck:
    """Return the scale check of a calibration."""
    squares = np.concatenate([_squares_m(calibration, index) for index in range(len(calibration.nominal_m))])
    ratio = length_ratio(calibration.observations.nominal_m, calibration.lengths_m)
    return ScaleCheck(float(np.mean(squares) * 1e3), float(np.std(squares) * 1e3), ratio, len(calibration.nominal_m))


def length_ratio(nominal_m: Array, lengths_m: Array) -> float | None:
    """Return the slope of the solved baselines (M,) over the nominal ones (M,), robust to misnamed folders (Theil-Sen).

    The plain ratio for one baseline, None without names.
    """
    if not np.all(np.isfinite(nominal_m)):
        return None
    if len(nominal_m) == 1:
        return float(lengths_m[0] / nominal_m[0])
    first, second = np.triu_indices(len(nominal_m), 1)
    return float(np.median((lengths_m[second] - lengths_m[first]) / (nominal_m[second] - nominal_m[first])))


def misnamed(nominal_m: Array, lengths_m: Array) -> list[int]:
    """Return the indices of baselines (M,) that deviate from the line through the others by NAME_TOLERANCE_M."""
    if len(nominal_m) < 4 or not np.all(np.isfinite(nominal_m)):
        return []
    slope = length_ratio(nominal_m, lengths_m)
    away = lengths_m - (1.0 if slope is None else slope) * nominal_m
    return np.flatnonzero(np.abs(away - np.median(away)) > NAME_TOLERANCE_M).tolist()


def triangulate(geometry: StereoGeometry, left: Array, right: Array) -> Array:
    """Return the points (..., 3), metres in rect axes, of raw pixels (..., 2) in both images: Z = b f / d."""
    rect_left, rect_right = geometry.rectified(left, right)
    depth = geometry.length_m * geometry.f_px / (rect_left[..., 0] - rect_right[..., 0])
    rows = (rect_left[..., 1] + rect_right[..., 1]) / 2
    return np.stack([rect_left[..., 0] * depth, rows * depth, geometry.f_px * depth], axis=-1) / geometry.f_px


def _squares_m(calibration: Calibration, index: int) -> Array:
    """Return the square size (n,) in metres along every complete row of the board at one baseline."""
    observations, board = calibration.observations, calibration.observations.board
    views = observations.baseline == index
    points = triangulate(geometry_at(calibration, index), observations.left[views], observations.right[views])
    grid = points.reshape(-1, board.rows, board.columns, 3)
    across = np.linalg.norm(grid[:, :, -1] - grid[:, :, 0], axis=-1).ravel() / (board.columns - 1)
    return np.asarray(across[np.isfinite(across)])
