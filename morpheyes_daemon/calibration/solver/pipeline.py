"""Pipeline of `calibrate solve`: from a folder of board pictures to a calibration file and its figures.

Unusable pictures are left out and named in the file; only what invalidates the result raises. Detected corners are
cached beside the result, so they are kept then, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from morpheyes_daemon.calibration.solver.acceptance import Quality, judge
from morpheyes_daemon.calibration.solver.cross_validation import held_out, leave_one_out
from morpheyes_daemon.calibration.solver.plausibility import ScaleCheck, misnamed, scale_check
from morpheyes_daemon.calibration.solver.result import CalibrationResult, details, rig_model
from morpheyes_daemon.calibration.solver.solver import Calibration, calibrate
from morpheyes_daemon.calibration.solver.uncertainty import baseline_uncertainty
from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.calibration.targets.detection import CornerCache, observe
from morpheyes_daemon.calibration.targets.image_pairs import read_folder
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.config.yaml_reader import parse_yaml, read_text
from morpheyes_daemon.errors import CalibrationError, ConfigError
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.stereo.calibration_file import write_calibration

CORNERS_SUFFIX = ".corners.npz"


def solve_folder(
    root: Path, board: Board, out: Path | None, progress: Progress = silent, header: Mapping[str, Any] | None = None
) -> CalibrationResult:
    """Return the calibration from the pictures under `root`, and write it to `out` when given.

    `header` (date, name of the rig) comes first in the file's details. Raises InputError on unusable pictures,
    CalibrationError as `solve_observations` does and when `out` cannot be written.
    """
    folders, problems = read_folder(root)
    cache = CornerCache(None if out is None else out.with_suffix(CORNERS_SUFFIX))
    observations = observe(folders, board, cache, progress, problems)
    solved = solve_observations(observations, progress, header)
    if out is not None:
        write_calibration(solved.rig, out)
    return solved


def solve_observations(
    observations: Observations, progress: Progress = silent, header: Mapping[str, Any] | None = None
) -> CalibrationResult:
    """Return the calibration of observations with its quality and acceptance.

    Raises CalibrationError when square size and folder names contradict each other, InputError on too few views.
    """
    calibration, named = _without_misnamed(calibrate(observations, progress), progress)
    lost = observations.lost + named
    scale = scale_check(calibration)
    _refuse_scale(scale, observations.board)
    unseen = held_out(calibration, progress)
    left_out = leave_one_out(calibration, unseen, progress)
    uncertainty = [baseline_uncertainty(calibration, index) for index in range(len(calibration.nominal_m))]
    acceptance = judge(calibration, Quality(unseen, left_out, uncertainty, scale), lost)
    rig = rig_model(calibration)
    solved = CalibrationResult(
        calibration, unseen, left_out, uncertainty, scale, acceptance, observations.problems + lost, rig
    )
    return replace(solved, rig=replace(rig, details={**(header or {}), **details(solved)}))


def read_board_file(root: Path) -> Mapping[str, Any]:
    """Return the content of `board.yaml` in a folder (board, square_mm, marker_mm, rig), empty without one.

    Raises CalibrationError when it cannot be read.
    """
    path = root / "board.yaml"
    if not path.is_file():
        return {}
    try:
        content, _ = parse_yaml(read_text(path), str(path))
    except ConfigError:
        content = None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: cannot be read; write `board: 9x6` and `square_mm: 25` there, or delete it.")
    return content


def _without_misnamed(calibration: Calibration, progress: Progress) -> tuple[Calibration, tuple[str, ...]]:
    """Return the calibration without baselines that contradict their folder's name, and sentences on these."""
    observations = calibration.observations
    wrong = misnamed(observations.nominal_m, calibration.lengths_m)
    if not wrong:
        return calibration, ()
    named = tuple(
        f"{observations.nominal_m[i] * 1e3:g}mm: its pictures were taken at {calibration.lengths_m[i] * 1e3:.1f} mm, "
        "so it is left out; rename the folder or retake it."
        for i in wrong
    )
    rest = [i for i in range(len(observations.nominal_m)) if i not in wrong]
    if len(rest) < 2:
        raise CalibrationError(f"Most folders are misnamed: {named[0]}")
    kept = observations.at_baselines(rest)
    again = calibrate(kept, progress)
    return replace(again, outliers=calibration.outliers + again.outliers), named


def _refuse_scale(scale: ScaleCheck, board: Board) -> None:
    if scale.disagrees and scale.length_ratio is not None:
        square_mm = board.square_m * 1e3
        raise CalibrationError(
            f"The squares of {square_mm:g} mm and the folders' names disagree: the solved baselines are "
            f"{scale.length_ratio:.3f} of their names, as if a square were {square_mm / scale.length_ratio:.4g} mm; "
            "measure several squares with a ruler and give --square-mm, or rename the folders."
        )
