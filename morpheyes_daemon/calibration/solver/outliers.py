"""Rejection of outlier pictures, named by file: a blurred board, a wrong picture, a camera that moved.

The two pictures of a view share one board pose, so a bad picture increases the residuals of both; the bad one is
identified by fitting the board to each alone.
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
"""Rms of a suspect view over the median of all views ..."""
_LEAST_PX = 0.15
"""... and least difference from it, pixels; both chosen: lower ones reject good pictures of a precise set."""
_FEWEST_CORNERS = 8
"""Corners below which a picture is dropped; chosen: twice those that determine a pose."""
_STRAY_SIGMAS = 8.0
"""Residual of a stray corner, in sigmas; chosen: beyond any noise, a border or reflection was detected."""
_STRAY_SHARE = 0.1
"""Share of stray corners from which the picture, not the corner, is the outlier."""
_MISREAD_SQUARES, _MISREAD_CORNERS = 0.5, 2
"""The same for so many corners off by so many squares: the grid was detected wrongly; all chosen."""


@dataclass(frozen=True)
class Outlier:
    """A picture removed from the solve: view, side (0 left, 1 right), file, and its rms in pixels."""

    view: int
    side: int
    name: str
    rms_px: float


def view_rms_px(residual_px: Array) -> Array:
    """Return the rms per view and camera (V, 2) of residuals (V, 2, N, 2), NaN where that camera saw no corner.

    As OpenCV counts it: the root of the mean squared length of the two-dimensional residuals.
    """
    squared = np.sum(residual_px**2, axis=-1)
    seen = np.isfinite(squared)
    count = seen.sum(axis=-1)
    total = np.where(seen, squared, 0.0).sum(axis=-1)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def find_outliers(observations: Observations, solution: Solution) -> list[Outlier]:
    """Return the pictures whose rms exceeds that of the rest; of a view both when neither fits alone."""
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
    """Return the observations without stray corners, and the number of these.

    A picture with many of them, or with several off by half a square, is left to `find_outliers`.
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
    """Return the observations without those pictures, and which views (V,) still have one."""
    left, right = observations.left.copy(), observations.right.copy()
    for outlier in outliers:
        (left, right)[outlier.side][outlier.view] = np.nan
    seen = np.isfinite(left[..., 0]).sum(axis=1), np.isfinite(right[..., 0]).sum(axis=1)
    kept = np.maximum(*seen) >= _FEWEST_CORNERS
    return replace(observations, left=left, right=right).subset(kept), kept


def _squares_px(observations: Observations) -> Array:
    """Return the distance of each corner to its neighbours (V, 2, N), pixels, NaN where unseen."""
    pictures = np.stack([observations.left, observations.right], axis=1)
    return np.array([[spacing_px(corners, observations.board) for corners in view] for view in pictures])


def _pictures_to_remove(
    observations: Observations, solution: Solution, view: int, rms: Array, limit: float
) -> list[int]:
    """Return the sides (0 left, 1 right) of a suspect view to remove."""
    both = [side for side in (0, 1) if np.isfinite(rms[side])]
    alone = [_rms_alone(observations, solution, view, side) for side in both]
    bad = [side for side, error in zip(both, alone, strict=True) if error > limit]
    return bad or both


def _rms_alone(observations: Observations, solution: Solution, view: int, side: int) -> float:
    """Return the rms in pixels of one picture with a board pose of its own."""
    camera = camera_from_vector(solution.state.cameras[side], observations.size)
    T_cam_board = board_pose((observations.left, observations.right)[side][view], observations.board, camera)
    if T_cam_board is None:
        return np.inf
    p_cam = observations.board.points_m @ T_cam_board[:3, :3].T + T_cam_board[:3, 3]
    residual = (observations.left, observations.right)[side][view] - camera.project(p_cam)
    return float(np.sqrt(np.nanmean(np.sum(residual**2, axis=-1))))
