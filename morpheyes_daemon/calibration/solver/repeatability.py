"""Repeatability of the servo: target against achieved baseline, mean and scatter over many visits.

The paper shows this as the accuracy of its rig (section II, the figure of target against achieved baseline: ten samples
for each position, mean and 10 sigma band, largest error 1.83 mm). Each visit is one picture pair of a board; with
cameras and directions known from a calibration, only the board's pose and the baseline are solved for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from morpheyes_daemon.calibration.solver import bundle_adjustment as bundle
from morpheyes_daemon.calibration.solver.bundle_adjustment import CAMERA_UNKNOWNS, POSE_UNKNOWNS, Prior, RigState
from morpheyes_daemon.calibration.solver.initial_guess import board_pose
from morpheyes_daemon.calibration.solver.projection import camera_vector
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array, rotvec_from_R

_TURN_SIGMA_RAD = _SHIFT_SIGMA_M = 1e-5
"""Prior sigmas of rotation (rad) and of the translation across the rail (m); chosen: practically fixed."""
_LENGTH_SIGMA_M = 0.05
"""Prior sigma of the baseline, metres; chosen: practically free."""
_CORNER_SIGMA_PX = 0.1
"""Noise of a corner coordinate, pixels; chosen: it only scales the Huber loss."""
_BAND_SIGMAS = 10.0
"""Half width of the drawn band in sigmas (paper, section II, figure of the achieved baseline)."""
PAPER_LARGEST_ERROR_MM = 1.83
"""Largest error of the paper's rig (section II)."""


@dataclass(frozen=True, eq=False)
class Position:
    """Achieved baselines (n,) of all visits to one target, metres."""

    target_m: float
    achieved_m: Array

    @property
    def mean_m(self) -> float:
        """Mean of the achieved baselines, metres."""
        return float(np.mean(self.achieved_m))

    @property
    def sigma_m(self) -> float:
        """One sigma of the achieved baselines, metres; 0 for a single visit."""
        return float(np.std(self.achieved_m, ddof=1)) if len(self.achieved_m) > 1 else 0.0

    @property
    def largest_error_m(self) -> float:
        """Largest difference between target and achieved baseline, metres."""
        return float(np.max(np.abs(self.achieved_m - self.target_m)))


def positions(rig: RigModel, observations: Observations, progress: Progress = silent) -> list[Position]:
    """Return every target with the baseline achieved at each visit (one view per visit).

    Raises InputError when the folders name no baselines, CalibrationError outside the rig's range (paper, section II).
    """
    if not np.all(np.isfinite(observations.nominal_m)):
        raise InputError("The folder names no baselines; put the visits to each target in a folder such as 150mm.")
    found = []
    for index, target in enumerate(observations.nominal_m):
        progress("measuring achieved baselines", index, len(observations.nominal_m))
        views = np.flatnonzero(observations.baseline == index)
        lengths = [_length_m(rig, observations, int(view), float(target)) for view in views]
        achieved = np.array([length for length in lengths if length is not None])
        if len(achieved):
            found.append(Position(float(target), achieved))
    progress("measuring achieved baselines", len(observations.nominal_m), len(observations.nominal_m))
    return found


def figures(found: list[Position]) -> dict[str, Any]:
    """Return the output of `calibrate repeatability --json`."""
    worst = max(found, key=lambda position: position.largest_error_m)
    return {
        "positions": [
            {
                "target_mm": round(position.target_m * 1e3, 4),
                "mean_mm": round(position.mean_m * 1e3, 4),
                "sigma_mm": round(position.sigma_m * 1e3, 4),
                "samples": len(position.achieved_m),
            }
            for position in found
        ],
        "largest_error_mm": round(worst.largest_error_m * 1e3, 4),
        "largest_error_pct": round(worst.largest_error_m / worst.target_m * 100, 3),
        "sigma_mm": round(float(np.sqrt(np.mean([p.sigma_m**2 for p in found]))) * 1e3, 4),
        "paper_largest_error_mm": PAPER_LARGEST_ERROR_MM,
    }


def draw(found: list[Position]) -> Figure:
    """Return the paper's figure: achieved over target baseline with the 10 sigma band, and their difference."""
    figure = Figure(figsize=(6.4, 6.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    target = np.array([position.target_m for position in found]) * 1e3
    mean = np.array([position.mean_m for position in found]) * 1e3
    band = _BAND_SIGMAS * np.array([position.sigma_m for position in found]) * 1e3
    for ax, offset in ((above, np.zeros_like(target)), (below, target)):
        ax.fill_between(target, mean - offset - band, mean - offset + band, color="#2f6fde", alpha=0.25, lw=0)
        ax.plot(target, mean - offset, "o-", color="#1b3f87", ms=4)
        ax.grid(color="#e3e7ec")
        ax.spines[["top", "right"]].set_visible(False)
    for position in found:
        at = np.full(len(position.achieved_m), position.target_m * 1e3)
        below.plot(at, (position.achieved_m - position.target_m) * 1e3, ".", color="#66707f", ms=3)
    above.plot(target, target, "--", color="#9aa3af", lw=1, label="slope 1")
    above.set_ylabel("achieved baseline, mm")
    above.set_title("mean of the visits and 10 sigma band", loc="left", fontsize=10)
    above.legend(frameon=False)
    below.axhline(0.0, color="#9aa3af", lw=1, ls="--")
    below.set_ylabel("achieved - target, mm")
    below.set_xlabel("target baseline, mm")
    return figure


def _length_m(rig: RigModel, observations: Observations, view: int, target_m: float) -> float | None:
    """Return the baseline of one visit, metres; None when a camera does not see the board."""
    T_cam0_board = board_pose(observations.left[view], observations.board, rig.cam0)
    if T_cam0_board is None or not np.isfinite(observations.right[view, :, 0]).any():
        return None
    chosen = np.zeros(observations.view_count, dtype=np.bool_)
    chosen[view] = True
    one = replace(observations.subset(chosen), nominal_m=np.array([target_m]), baseline=np.zeros(1, dtype=np.intp))
    T_cam0_cam1 = rig.T_cam0_cam1(target_m)
    stereo_poses = np.concatenate([rotvec_from_R(T_cam0_cam1[:3, :3]), T_cam0_cam1[:3, 3]])
    cameras = np.stack([camera_vector(rig.cam0), camera_vector(rig.cam1)])
    state = RigState(cameras, stereo_poses[None], T_cam0_board[None, :3, :3], T_cam0_board[None, :3, 3])
    solved = bundle.solve(one, state, _known_but_for_length(state, T_cam0_cam1[:3, 3]), _CORNER_SIGMA_PX)
    return float(np.linalg.norm(solved.state.stereo_poses[0, 3:]))


def _known_but_for_length(state: RigState, t_cam0_cam1: Array) -> Prior:
    """Return the prior that fixes cameras and directions and leaves the length along the rail free."""
    along = t_cam0_cam1 / np.linalg.norm(t_cam0_cam1)
    information = np.zeros((CAMERA_UNKNOWNS + POSE_UNKNOWNS, CAMERA_UNKNOWNS + POSE_UNKNOWNS))
    scale = np.maximum(np.abs(state.shared[:CAMERA_UNKNOWNS]), 1e-3) * 1e-7
    information[:CAMERA_UNKNOWNS, :CAMERA_UNKNOWNS] = np.diag(1.0 / scale**2)
    information[CAMERA_UNKNOWNS : CAMERA_UNKNOWNS + 3, CAMERA_UNKNOWNS : CAMERA_UNKNOWNS + 3] = (
        np.eye(3) / _TURN_SIGMA_RAD**2
    )
    line = np.outer(along, along)
    information[CAMERA_UNKNOWNS + 3 :, CAMERA_UNKNOWNS + 3 :] = (
        line / _LENGTH_SIGMA_M**2 + (np.eye(3) - line) / _SHIFT_SIGMA_M**2
    )
    return Prior(state.shared, information)
