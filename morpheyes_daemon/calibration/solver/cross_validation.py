"""Cross-validation of a calibration on pictures that the solve did not use.

Held-out boards: every view is left out once, and its rows are compared after rectification by the solve of the other
views. Leave one baseline out: all views of an inner baseline are left out, its geometry is interpolated from its
neighbours as in flight, and compared with the full solve on the same boards (held out as well). Both start from the
full solution, so they converge in a few steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.solver.projection import camera_from_vector
from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry, infinity_px, row_error_px
from morpheyes_daemon.calibration.solver.solver import Calibration, resolve
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array

_FOLDS = 4
"""Folds of the held-out boards; chosen: more folds leave more views to each solve and take longer."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Row errors of all held-out corners that both cameras saw.

    `row_px` (n,), signed; `left_px` (n, 2) where in the left image; `baseline` (n,) which baseline; `median_px` and
    `p95_px` of the absolute row error.
    """

    row_px: Array
    left_px: Array
    baseline: NDArray[np.intp]

    @property
    def median_px(self) -> float:
        """Median of the absolute row error."""
        return float(np.median(np.abs(self.row_px)))

    @property
    def p95_px(self) -> float:
        """95th percentile of the absolute row error."""
        return float(np.percentile(np.abs(self.row_px), 95))


@dataclass(frozen=True)
class LeftOutBaseline:
    """Errors of one inner baseline predicted by the others, on that baseline's boards.

    `full_epipolar_median_px` is the row error of the full solve there, on held-out boards.
    """

    baseline_mm: float
    epipolar_median_px: float
    full_epipolar_median_px: float
    baseline_error_mm: float
    disparity_bias_px: float


def geometry_at(calibration: Calibration, index: int) -> StereoGeometry:
    """Return the solved geometry at the calibrated baseline of an index."""
    cameras, size = calibration.solution.state.cameras, calibration.observations.size
    cam0, cam1 = camera_from_vector(cameras[0], size), camera_from_vector(cameras[1], size)
    return StereoGeometry(cam0, cam1, calibration.poses[index])


def held_out(calibration: Calibration, progress: Progress = silent) -> HeldOut:
    """Return the row errors of every view under a solve without it (four-fold cross-validation)."""
    observations = calibration.observations
    fold = _folds(observations.baseline, len(observations.nominal_m))
    rows, places, baselines = [], [], []
    for number in range(_FOLDS):
        progress("held-out boards", number, _FOLDS)
        part = resolve(calibration, fold != number)
        for index, nominal in enumerate(part.observations.nominal_m):
            full = index if np.isnan(nominal) else int(np.flatnonzero(observations.nominal_m == nominal)[0])
            views = (fold == number) & (observations.baseline == full)
            row, left = _row_errors(calibration, views, geometry_at(part, index))
            rows.append(row)
            places.append(left)
            baselines.append(np.full(len(row), full, dtype=np.intp))
    progress("held-out boards", _FOLDS, _FOLDS)
    return HeldOut(np.concatenate(rows), np.concatenate(places), np.concatenate(baselines))


def leave_one_out(calibration: Calibration, unseen: HeldOut, progress: Progress = silent) -> list[LeftOutBaseline]:
    """Return the errors of each inner baseline predicted by the others; empty for fewer than three baselines.

    `unseen` are the held-out errors of the full solve.
    """
    count = len(calibration.nominal_m)
    results = []
    for index in range(1, count - 1):
        progress("leaving one baseline out", index - 1, count - 2)
        rows = np.abs(unseen.row_px[unseen.baseline == index])
        results.append(_left_out(calibration, index, float(np.median(rows))))
    if count > 2:
        progress("leaving one baseline out", count - 2, count - 2)
    return results


def _left_out(calibration: Calibration, index: int, full_median_px: float) -> LeftOutBaseline:
    views = calibration.observations.baseline == index
    rest = resolve(calibration, ~views)
    nominal_m = float(calibration.nominal_m[index])
    cameras = [camera_from_vector(vector, rest.observations.size) for vector in rest.solution.state.cameras]
    knots_m, poses = rest.knots()
    T = RigModel.from_poses(cameras[0], cameras[1], knots_m.tolist(), list(poses)).T_cam0_cam1(nominal_m)
    predicted, full = StereoGeometry(cameras[0], cameras[1], T), geometry_at(calibration, index)
    return LeftOutBaseline(
        baseline_mm=nominal_m * 1e3,
        epipolar_median_px=float(np.median(np.abs(_row_errors(calibration, views, predicted)[0]))),
        full_epipolar_median_px=full_median_px,
        baseline_error_mm=abs(predicted.length_m - full.length_m) * 1e3,
        disparity_bias_px=abs(float(np.median(infinity_px(predicted, full)))),
    )


def _row_errors(calibration: Calibration, views: NDArray[np.bool_], geometry: StereoGeometry) -> tuple[Array, Array]:
    """Return the row error (n,) and left pixel (n, 2) of all corners that both cameras saw in the chosen views."""
    left = calibration.observations.left[views].reshape(-1, 2)
    right = calibration.observations.right[views].reshape(-1, 2)
    seen = np.isfinite(left[:, 0]) & np.isfinite(right[:, 0])
    row = row_error_px(geometry, left[seen], right[seen])
    usable = np.isfinite(row)
    return row[usable], left[seen][usable]


def _folds(baseline: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return the fold (V,) of each view: the views of each baseline in turn, continued from baseline to baseline."""
    fold = np.empty(len(baseline), dtype=np.intp)
    assigned = 0
    for number in range(count):
        views = np.flatnonzero(baseline == number)
        fold[views] = (assigned + np.arange(len(views))) % _FOLDS
        assigned += len(views)
    return fold
