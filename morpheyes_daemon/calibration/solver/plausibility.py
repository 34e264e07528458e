"""Do the solved lengths agree with what the person said, and the boards with their own squares?

No picture tells the size of a square, so a wrong one scales the whole rig without any residual. What can notice it
is the second size a person has given: the folders' names. Swapped or misnamed folders show here too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.calibration.solver.cross_validation import geometry_at
from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry
from morpheyes_daemon.calibration.solver.solver import Calibration
from morpheyes_daemon.transforms import Array

SCALE_TOLERANCE = 0.03
"""Linear servos with a 1 % stroke error and a ruler's reading stay well within this of the names."""
ONE_LENGTH_TOLERANCE = 0.10
"""For a single baseline: what is written on a rig is the distance of its lenses' housings, give or take."""
NAME_TOLERANCE_M = 8e-3
"""How far one baseline may lie from where its name puts it among the others; the paper's rail is within 1.83 mm."""


@dataclass(frozen=True)
class ScaleCheck:
    """The board's own squares, measured by triangulation, and the solved lengths against the nominal ones.

    `length_ratio` is solved over nominal change of baseline (plain ratio for one baseline), None without names.
    `square_mm` is the mean measured square, `square_scatter_mm` one sigma over board rows.
    """

    square_mm: float
    square_scatter_mm: float
    length_ratio: float | None
    baselines: int = 1

    @property
    def disagrees(self) -> bool:
        """The square size and the folders' names cannot both be right."""
        limit = SCALE_TOLERANCE if self.baselines > 1 else ONE_LENGTH_TOLERANCE
        return self.length_ratio is not None and abs(self.length_ratio - 1.0) > limit


def scale_check(calibration: Calibration) -> ScaleCheck:
    """Return both scale checks of a calibration."""
    squares = np.concatenate([_squares_m(calibration, index) for index in range(len(calibration.nominal_m))])
    ratio = length_ratio(calibration.observations.nominal_m, calibration.lengths_m)
    return ScaleCheck(float(np.mean(squares) * 1e3), float(np.std(squares) * 1e3), ratio, len(calibration.nominal_m))


def length_ratio(nominal_m: Array, lengths_m: Array) -> float | None:
    """Return by what the lengths (M,) grow per nominal metre, unmoved by a few misnamed folders (Theil-Sen)."""
    if not np.all(np.isfinite(nominal_m)):
        return None
    if len(nominal_m) == 1:
        return float(lengths_m[0] / nominal_m[0])
    first, second = np.triu_indices(len(nominal_m), 1)
    return float(np.median((lengths_m[second] - lengths_m[first]) / (nominal_m[second] - nominal_m[first])))


def misnamed(nominal_m: Array, lengths_m: Array) -> list[int]:
    """Return which baselines lie far from where the others say their names belong."""
    if len(nominal_m) < 4 or not np.all(np.isfinite(nominal_m)):
        return []
    slope = length_ratio(nominal_m, lengths_m)
    away = lengths_m - (1.0 if slope is None else slope) * nominal_m
    return np.flatnonzero(np.abs(away - np.median(away)) > NAME_TOLERANCE_M).tolist()


def triangulate(geometry: StereoGeometry, left: Array, right: Array) -> Array:
    """Return the points (..., 3) in the rectified frame of raw pixels (..., 2) of both cameras."""
    rect_left, rect_right = geometry.rectified(left, right)
    depth = geometry.length_m * geometry.f_px / (rect_left[..., 0] - rect_right[..., 0])
    rows = (rect_left[..., 1] + rect_right[..., 1]) / 2
    return np.stack([rect_left[..., 0] * depth, rows * depth, geometry.f_px * depth], axis=-1) / geometry.f_px


def _squares_m(calibration: Calibration, index: int) -> Array:
    """Return the square size measured along every full row of the board at one baseline."""
    observations, board = calibration.observations, calibration.observations.board
    views = observations.baseline == index
    points = triangulate(geometry_at(calibration, index), observations.left[views], observations.right[views])
    grid = points.reshape(-1, board.rows, board.columns, 3)
    across = np.linalg.norm(grid[:, :, -1] - grid[:, :, 0], axis=-1).ravel() / (board.columns - 1)
    return np.asarray(across[np.isfinite(across)])
