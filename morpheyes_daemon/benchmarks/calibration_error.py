"""A solved calibration against the twin's truth, by sending noise-free true projections through its rectification.

What is measured is what a flight would suffer: rows that differ, a baseline of the wrong length, and a disparity
that points at infinity show. The servo's own repeatability is left aside: truth stands where the servo should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from morpheyes_daemon.calibration.solver.rectification_residuals import (
    StereoGeometry,
    image_grid,
    infinity_px,
    row_error_px,
)
from morpheyes_daemon.calibration.solver.result import rig_model
from morpheyes_daemon.calibration.solver.solver import solve_separately
from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.calibration.targets.detection import observe
from morpheyes_daemon.calibration.targets.image_pairs import read_folder
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.flights.sim_boards import twin_from_name
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.simulation.camera.true_rig import RANGE_M, RigTwin
from morpheyes_daemon.stereo.rectify import homogeneous
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array

BASELINES = 41
_DEPTHS_M = (0.7, 1.0, 2.0, 5.0, 20.0)


@dataclass(frozen=True)
class BaselineTruth:
    """Errors at one nominal baseline: rows (median, 95 %), length, disparity at infinity, where the left eye points."""

    nominal_mm: float
    epipolar_median_px: float
    epipolar_p95_px: float
    baseline_error_mm: float
    disparity_bias_px: float
    pointing_error_deg: float


@dataclass(frozen=True)
class RigTruth:
    """Errors over the whole range; the row errors of all baselines count together."""

    epipolar_median_px: float
    epipolar_p95_px: float
    rows: tuple[BaselineTruth, ...]

    @property
    def baseline_error_max_mm(self) -> float:
        """Largest error of the length."""
        return max(abs(row.baseline_error_mm) for row in self.rows)

    @property
    def disparity_bias_max_px(self) -> float:
        """Largest disparity of points at infinity, median over the image."""
        return max(abs(row.disparity_bias_px) for row in self.rows)

    @property
    def pointing_error_deg(self) -> tuple[float, float]:
        """How far off the left eye is believed to point on the vehicle, at the smallest and the largest baseline."""
        return self.rows[0].pointing_error_deg, self.rows[-1].pointing_error_deg

    def figures(self) -> dict[str, Any]:
        """Return what `calibrate evaluate --json` prints."""
        near, far = self.pointing_error_deg
        return {
            "epipolar_median_px": round(self.epipolar_median_px, 4),
            "epipolar_p95_px": round(self.epipolar_p95_px, 4),
            "baseline_error_max_mm": round(self.baseline_error_max_mm, 4),
            "disparity_bias_max_px": round(self.disparity_bias_max_px, 4),
            "pointing_error_deg": [round(near, 4), round(far, 4)],
        }


def evaluate_rig(rig: RigModel, twin: RigTwin, nominal_m: Sequence[float] | None = None) -> RigTruth:
    """Return the errors of `rig` at nominal baselines, by default 41 over the twin's whole range.

    Raises CalibrationError when the file is of another image size or does not cover the range.
    """
    if rig.size != (twin.cam0.width, twin.cam0.height):
        raise CalibrationError(f"The calibration is for {rig.size[0]}x{rig.size[1]} px, the twin has another size.")
    chosen = np.linspace(*RANGE_M, BASELINES) if nominal_m is None else np.asarray(nominal_m)
    measured = [_at(rig, twin, float(nominal)) for nominal in chosen]
    errors = np.concatenate([np.abs(row_px) for _, row_px in measured])
    return RigTruth(float(np.median(errors)), float(np.percentile(errors, 95)), tuple(row for row, _ in measured))


def _at(rig: RigModel, twin: RigTwin, nominal_m: float) -> tuple[BaselineTruth, Array]:
    believed = StereoGeometry(rig.cam0, rig.cam1, rig.T_cam0_cam1(nominal_m))
    true = StereoGeometry(twin.cam0, twin.cam1, twin.T_cam0_cam1(twin.actual_m(nominal_m)))
    left, right = true_projections(true)
    row_px = row_error_px(believed, left, right)
    points = rig.R_rig_cam0[:, 2], twin.T_rig_eye(0, twin.actual_m(nominal_m))[:3, 2]
    truth = BaselineTruth(
        nominal_mm=nominal_m * 1e3,
        epipolar_median_px=float(np.median(np.abs(row_px))),
        epipolar_p95_px=float(np.percentile(np.abs(row_px), 95)),
        baseline_error_mm=(believed.length_m - true.length_m) * 1e3,
        disparity_bias_px=float(np.median(infinity_px(believed, true))),
        pointing_error_deg=float(np.degrees(np.linalg.norm(np.cross(*points)))),
    )
    return truth, row_px


def true_projections(true: StereoGeometry) -> tuple[Array, Array]:
    """Return pixels (n, 2) of points all over the left image and at many depths, as both eyes truly see them."""
    left = image_grid(true.cam0)
    rays = homogeneous(true.cam0.normalised_from_pixels(left))
    lefts, rights = [], []
    for depth in _DEPTHS_M:
        p_cam1 = (rays * depth - true.T_cam0_cam1[:3, 3]) @ true.T_cam0_cam1[:3, :3]
        right = true.cam1.project(p_cam1)
        inside = np.all((right >= 0) & (right <= [true.cam1.width - 1, true.cam1.height - 1]), axis=1)
        lefts.append(left[inside])
        rights.append(right[inside])
    return np.concatenate(lefts), np.concatenate(rights)


def twin_of(rig: RigModel, seed: int | None, file: Path) -> RigTwin:
    """Return the twin that `rig` was solved from: of the given seed, or the one its file names."""
    if seed is not None:
        return RigTwin(*rig.size, seed=seed)
    twin = twin_from_name(str(rig.details.get("rig", "")))
    if twin is None:
        raise CalibrationError(f"{file}: was not solved from a twin's boards; name the twin with --seed.")
    return twin


def compare_separate(
    folder: Path, board: Board, rig: RigModel, twin: RigTwin, progress: Progress = silent
) -> dict[str, dict[str, float]]:
    """Return the figures at the calibrated baselines only, of the joint solve and of one solve for each baseline."""
    folders, problems = read_folder(folder)
    observations = observe(folders, board, None, progress, problems)
    separate = [evaluate_rig(rig_model(one), twin, one.nominal_m.tolist()) for one in solve_separately(observations)]
    joint = evaluate_rig(rig, twin, observations.nominal_m.tolist())
    return {
        "joint": joint.figures(),
        "separate": {
            "epipolar_median_px": round(float(np.median([one.epipolar_median_px for one in separate])), 4),
            "epipolar_p95_px": round(float(np.percentile([one.epipolar_p95_px for one in separate], 95)), 4),
            "baseline_error_max_mm": round(max(one.baseline_error_max_mm for one in separate), 4),
            "disparity_bias_max_px": round(max(one.disparity_bias_max_px for one in separate), 4),
        },
    }
