"""The calibration file that simulated flights use: solved from boards of the same twin rig, made once and kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from morpheyes_daemon.calibration.mount import orientations, solve_mount
from morpheyes_daemon.calibration.solver.result import rig_model
from morpheyes_daemon.calibration.solver.solver import calibrate
from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Mount
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.flights.sim_boards import DEFAULT_BOARD, observe_mount, observe_twin, twin_name
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.simulation.rendering.texture_cache import cache_folder
from morpheyes_daemon.stereo.calibration_file import read_calibration, write_calibration
from morpheyes_daemon.stereo.rig import RigModel

_SIZE = (640, 480)
_VIEWS = 8
_METHOD = _MOUNT_METHOD = 1
"""Raised whenever boards, detection or solver change, so that files made before are not used again."""


def solved_rig_file(seed: int, cache_dir: Path | None = None, progress: Progress = silent) -> Path:
    """Return a calibration file of the twin rig of `seed` at 640x480, solved on the first call and kept.

    The rig model serves other sizes of the same shape. A file that is damaged is made again.
    """
    folder = cache_folder("calibration") if cache_dir is None else cache_dir
    path = folder / f"{twin_name(seed, _SIZE)}-v{_METHOD}.yaml"
    if not _readable(path):
        write_calibration(solve_twin(seed, progress), path)
    return path


def mounted_rig_file(seed: int, cache_dir: Path | None = None, progress: Progress = silent) -> Path:
    """Return the same file with the mount of the left eye measured as well, made on the first call and kept."""
    solved = solved_rig_file(seed, cache_dir, progress)
    path = solved.with_name(f"{solved.stem}-mounted-v{_MOUNT_METHOD}.yaml")
    if not _readable(path):
        rig = read_calibration(solved)
        found = solve_mount(
            observe_mount(seed, rig.cam0, progress), T_frd_rig(Mount())[:3, :3], orientations(DEFAULT_BOARD)
        )
        write_calibration(replace(rig, mount=found.mount), path)
    return path


def solve_twin(seed: int, progress: Progress = silent) -> RigModel:
    """Render boards before the twin rig of `seed`, find their corners and solve."""
    observations = observe_twin(seed, views=_VIEWS, board=DEFAULT_BOARD, size=_SIZE, progress=progress)
    details = {
        "rig": twin_name(seed, _SIZE),
        "board": {"board": DEFAULT_BOARD.label, "square_mm": DEFAULT_BOARD.square_m * 1e3},
    }
    return rig_model(calibrate(observations, progress), details)


def _readable(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        read_calibration(path)
    except CalibrationError:
        return False
    return True
