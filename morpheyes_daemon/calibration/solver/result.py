"""Result of a calibration: output of `--json`, and the rig model with the details of the file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from morpheyes_daemon.calibration.solver.acceptance import Acceptance
from morpheyes_daemon.calibration.solver.cross_validation import HeldOut, LeftOutBaseline
from morpheyes_daemon.calibration.solver.plausibility import ScaleCheck
from morpheyes_daemon.calibration.solver.projection import camera_from_vector
from morpheyes_daemon.calibration.solver.solver import Calibration
from morpheyes_daemon.calibration.solver.uncertainty import BaselineUncertainty, baseline_uncertainty, camera_uncertainty
from morpheyes_daemon.calibration.targets.coverage import CELLS, cell_of, coverage
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration with its errors on held-out data, uncertainty, scale check, acceptance, and rig model."""

    calibration: Calibration
    held_out: HeldOut
    left_out: list[LeftOutBaseline]
    uncertainty: list[BaselineUncertainty]
    scale: ScaleCheck
    acceptance: Acceptance
    problems: tuple[str, ...]
    rig: RigModel

    def figures(self) -> dict[str, Any]:
        """Return the output of `calibrate solve --json`."""
        calibration = self.calibration
        return {
            "nominal_mm": _rounded(calibration.nominal_m * 1e3, 4),
            "baselines_mm": _rounded(calibration.lengths_m * 1e3, 4),
            "rms_px": _rounded(calibration.rms_px, 4),
            "epipolar_median_px": round(self.held_out.median_px, 4),
            "epipolar_p95_px": round(self.held_out.p95_px, 4),
            "leave_one_out": [_left_out_row(one) for one in self.left_out],
            "leave_one_out_ratio": left_out_ratio(self.left_out),
            "outliers": [outlier.name for outlier in calibration.outliers],
            "verdict": self.acceptance.text,
            "retake": list(self.acceptance.retake),
            "problems": list(self.problems),
            "sigma_length_mm": _rounded([u.length_m * 1e3 for u in self.uncertainty], 4),
            "sigma_disparity_px": _rounded([u.disparity_px for u in self.uncertainty], 4),
            "sigma_yaw_deg": _rounded([np.degrees(u.yaw_rad) for u in self.uncertainty], 5),
            "square_measured_mm": round(self.scale.square_mm, 4),
            "length_ratio": None if self.scale.length_ratio is None else round(self.scale.length_ratio, 5),
            "corner_noise_px": round(calibration.solution.sigma_px, 4),
            "calibration_hash": calibration_hash(self.rig),
        }


def rig_model(calibration: Calibration, details: Mapping[str, Any] | None = None) -> RigModel:
    """Return the rig model of a calibration; baselines without rms are interpolated by the rail model."""
    state, size = calibration.solution.state, calibration.observations.size
    cam0, cam1 = (camera_from_vector(vector, size) for vector in state.cameras)
    rms = calibration.rms_px
    sigma = [baseline_uncertainty(calibration, index) for index in range(len(calibration.nominal_m))]
    lengths, yaws = [one.length_m for one in sigma], [one.yaw_rad for one in sigma]
    measured = {float(nominal): float(value) for nominal, value in zip(calibration.nominal_m, rms, strict=True)}
    baselines = []
    for nominal, T in zip(*calibration.knots(), strict=True):
        measures = {
            "rms_px": measured.get(float(nominal)),
            "sigma_length_m": float(np.interp(nominal, calibration.nominal_m, lengths)),
            "sigma_yaw_rad": float(np.interp(nominal, calibration.nominal_m, yaws)),
        }
        baselines.append(CalibratedBaseline.from_pose(float(nominal), T, **measures))
    return RigModel(cam0, cam1, tuple(baselines), "solved", details or {})


def details(solved: CalibrationResult) -> dict[str, Any]:
    """Return the `details` of the calibration file, for people and reports."""
    calibration, board = solved.calibration, solved.calibration.observations.board
    seen = coverage(calibration.observations)
    left, right = camera_uncertainty(calibration)
    return {
        "board": {"board": board.label, "square_mm": board.square_m * 1e3},
        "verdict": solved.acceptance.text,
        "retake": list(solved.acceptance.retake),
        "views": np.bincount(calibration.observations.baseline, minlength=len(calibration.nominal_m)).tolist(),
        "corner_noise_px": calibration.solution.sigma_px,
        "stray_corners": calibration.stray_corners,
        "outliers": [{"file": o.name, "rms_px": round(o.rms_px, 3)} for o in calibration.outliers],
        "problems": list(solved.problems),
        "sigma": {
            "cam0": left,
            "cam1": right,
            "disparity_px": [u.disparity_px for u in solved.uncertainty],
        },
        "rail": _rail_rows(calibration),
        "scale": {
            "square_mm": solved.scale.square_mm,
            "square_scatter_mm": solved.scale.square_scatter_mm,
            "length_ratio": solved.scale.length_ratio,
        },
        "held_out": {
            "median_px": solved.held_out.median_px,
            "p95_px": solved.held_out.p95_px,
            "median_by_baseline_px": _by_baseline(solved),
            "median_by_cell_px": _by_cell(solved),
        },
        "leave_one_out": [_left_out_row(one) for one in solved.left_out],
        "coverage": {"share": seen.share, "left": seen.left.tolist(), "right": seen.right.tolist()},
    }


def _rail_rows(calibration: Calibration) -> list[dict[str, Any]]:
    if calibration.rail is None:
        return []
    return [{"component": c.name, "order": c.order, "scatter": c.scatter} for c in calibration.rail.components]


def _by_baseline(solved: CalibrationResult) -> list[float | None]:
    rows, baseline = np.abs(solved.held_out.row_px), solved.held_out.baseline
    return [_median(rows[baseline == index]) for index in range(len(solved.calibration.nominal_m))]


def _by_cell(solved: CalibrationResult) -> list[list[float | None]]:
    rows = np.abs(solved.held_out.row_px)
    column, row = cell_of(solved.held_out.left_px, solved.calibration.observations.size)
    cells = range(CELLS[1]), range(CELLS[0])
    return [[_median(rows[(row == r) & (column == c)]) for c in cells[1]] for r in cells[0]]


def _median(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return round(float(np.median(values)), 4) if len(values) else None


def left_out_ratio(left_out: list[LeftOutBaseline]) -> float | None:
    """Return the mean row error of left-out baselines over that of the full solve there; None without any."""
    if not left_out:
        return None
    full = sum(one.full_epipolar_median_px for one in left_out)
    return round(sum(one.epipolar_median_px for one in left_out) / full, 3)


def _left_out_row(one: LeftOutBaseline) -> dict[str, float]:
    return {
        "baseline_mm": round(one.baseline_mm, 4),
        "epipolar_median_px": round(one.epipolar_median_px, 4),
        "full_epipolar_median_px": round(one.full_epipolar_median_px, 4),
        "baseline_error_mm": round(one.baseline_error_mm, 4),
        "disparity_bias_px": round(one.disparity_bias_px, 4),
    }


def _rounded(values: Iterable[float], digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]
