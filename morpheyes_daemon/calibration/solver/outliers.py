"""Views that do not fit the rest, named by file: a blurred board, a wrong picture, a camera that moved in between.

A view of two pictures has one board pose, so a bad picture spoils its partner's residuals as well; which of the two
is to blame is told by fitting the board to each alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.solver.bundle_adjustment import Solution
from morpheyes_daemon.calibration.solver.initial_guess import board_pose
from morpheyes_daemon.calibration.solver.projection import camera_from_vector
from morpheyes_daemon.calibration.targets.boards import spacing_px
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.transforms import Array

_SUSPECT = 4.0
"""A view is looked at when its rms is this many times the median of all views ..."""
_LEAST_PX = 0.15
"""... and at least this much above it: with near-perfect pictures nothing is an outlier."""
_FEWEST_CORNERS = 8
_STRAY_SIGMAS = 8.0
"""A single corner this far off was drawn to something else, a border or a glint."""
_STRAY_SHARE = 0.1
_MISREAD_SQUARES = 0.5
_MISREAD_CORNERS = 2


@dataclass(frozen=True)
class Outlier:
    """A picture taken out of the solve; `rms_px` is how badly it fitted."""

    view: int
    side: int
    name: str
    rms_px: float


def view_rms_px(residual_px: Array) -> Array:
    """Return the rms per view and camera (V, 2) of the corner distance, NaN where that camera saw nothing.

    As OpenCV counts it: the root of the mean squared length of the two-dimensional residuals.
    """
    squared = np.sum(residual_px**2, axis=-1)
    seen = np.isfinite(squared)
    count = seen.sum(axis=-1)
    total = np.where(seen, squared, 0.0).sum(axis=-1)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def find_outliers(observations: Observations, solution: Solution) -> list[Outlier]:
    """Return the pictures that fit far worse than the rest, with the guilty camera named (both when neither fits)."""
    rms = view_rms_px(solution.residual_px)
    usual = float(np.nanmedian(rms))
    limit = max(_SUSPECT * usual, usual + _LEAST_PX)
    outliers = []
    for view in np.flatnonzero(np.nanmax(rms, axis=1) > limit):
        for side in _pictures_to_remove(observations, solution, int(view), rms[view], limit):
            name = observations.names[view][side]
            outliers.append(Outlier(int(view), side, name, float(rms[view, side])))
    return outliers


def reject_outliers(observations: Observations, solution: Solution) -> tuple[Observations, int]:
    """Return the observations without single corners that were drawn elsewhere, and how many those were.

    A picture with many of them, or with several off by half a square, was misread and is left as it is.
    """
    away = np.linalg.norm(solution.residual_px, axis=-1)
    stray = away > _STRAY_SIGMAS * solution.sigma_px
    far = stray & (away > _MISREAD_SQUARES * _squares_px(observations))
    misread = (far.sum(axis=-1) >= _MISREAD_CORNERS) | (stray.mean(axis=-1) > _STRAY_SHARE)
    stray &= ~misread[..., None]
    left = np.where(stray[:, 0, :, None], np.nan, observations.left)
    right = np.where(stray[:, 1, :, None], np.nan, observations.right)
    return replace(observations, left=left, right=right), int(np.count_nonzero(stray))


def without(observations: Observations, outliers: list[Outlier]) -> tuple[Observations, NDArray[np.bool_]]:
    """Return the observations with those pictures blanked, and which views (V,) still show a board to some camera."""
    left, right = observations.left.copy(), observations.right.copy()
    for outlier in outliers:
        (left, right)[outlier.side][outlier.view] = np.nan
    seen = np.isfinite(left[..., 0]).sum(axis=1), np.isfinite(right[..., 0]).sum(axis=1)
    kept = np.maximum(*seen) >= _FEWEST_CORNERS
    return replace(observations, left=left, right=right).subset(kept), kept


def _squares_px(observations: Observations) -> Array:
    """Return how far apart corners are around each (V, 2, N), NaN where unseen."""
    pictures = np.stack([observations.left, observations.right], axis=1)
    return np.array([[spacing_px(side, observations.board) for side in view] for view in pictures])


def _pictures_to_remove(
    observations: Observations, solution: Solution, view: int, rms: Array, limit: float
) -> list[int]:
    """Return the cameras of a suspect view to take out."""
    both = [side for side in (0, 1) if np.isfinite(rms[side])]
    alone = [_rms_alone(observations, solution, view, side) for side in both]
    bad = [side for side, error in zip(both, alone, strict=True) if error > limit]
    return bad or both


def _rms_alone(observations: Observations, solution: Solution, view: int, side: int) -> float:
    """Return the rms of one picture with a board pose of its own."""
    camera = camera_from_vector(solution.state.cameras[side], observations.size)
    T_cam_board = board_pose((observations.left, observations.right)[side][view], observations.board, camera)
    if T_cam_board is None:
        return np.inf
    p_cam = observations.board.points_m @ T_cam_board[:3, :3].T + T_cam_board[:3, 3]
    residual = (observations.left, observations.right)[side][view] - camera.project(p_cam)
    return float(np.sqrt(np.nanmean(np.sum(residual**2, axis=-1))))
