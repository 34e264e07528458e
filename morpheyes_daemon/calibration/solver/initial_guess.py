"""Initial values of the joint solve: each camera alone, a pose per view, the relative pose as the median of its views.

Computed by OpenCV; its lens model without skew is close enough for a start.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.solver.bundle_adjustment import RigState
from morpheyes_daemon.calibration.solver.projection import camera_from_vector, camera_vector
from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.transforms import Array, R_from_rotvec, inverse, pose, rotvec_from_R

_VIEWS_PER_CAMERA = 30
"""Views from which a camera is guessed; chosen: more take longer and hardly change a start."""
_FEWEST_CORNERS = 8
"""Corners that a board pose needs; chosen: twice those that determine it."""
_SUSPECT = 3.0
"""Error of a view over the median beyond which it is left out of the guess; chosen: blurred pictures exceed it."""


def first_guess(observations: Observations) -> tuple[RigState, NDArray[np.bool_]]:
    """Return the initial state of `bundle_adjustment.solve`, and which views (V,) have a usable pose.

    The state holds the usable views only. Raises InputError when a camera sees too few boards, or no view at a baseline
    shows the board to both cameras.
    """
    cameras = [_camera(observations, side) for side in (0, 1)]
    T_left = [board_pose(corners, observations.board, cameras[0]) for corners in observations.left]
    T_right = [board_pose(corners, observations.board, cameras[1]) for corners in observations.right]
    stereo_poses = np.array([_median_pose(observations, i, T_left, T_right) for i in range(len(observations.nominal_m))])
    poses: list[Array | None] = []
    for view, (left, right) in enumerate(zip(T_left, T_right, strict=True)):
        T_cam0_cam1 = _pose_of(stereo_poses[observations.baseline[view]])
        poses.append(left if left is not None else None if right is None else T_cam0_cam1 @ right)
    usable = np.array([T is not None for T in poses])
    boards = np.array([T for T in poses if T is not None])
    vectors = np.array([camera_vector(camera) for camera in cameras])
    return RigState(vectors, stereo_poses, boards[:, :3, :3], boards[:, :3, 3]), usable


def board_pose(pixels: Array, board: Board, camera: CameraIntrinsics) -> Array | None:
    """Return T_cam_board (4, 4) of corners (n, 2), NaN where unseen; None with too few corners (cv2.solvePnP)."""
    seen = np.isfinite(pixels[:, 0])
    if np.count_nonzero(seen) < _FEWEST_CORNERS:
        return None
    rays = camera.normalised_from_pixels(pixels[seen])
    points = board.points_m[seen]
    straight = np.isfinite(rays[:, 0])
    if np.count_nonzero(straight) < _FEWEST_CORNERS:
        return None
    flags = cv2.SOLVEPNP_ITERATIVE
    found, turn, shift = cv2.solvePnP(points[straight], rays[straight], np.eye(3), None, flags=flags)
    turn, shift = np.asarray(turn, dtype=np.float64).ravel(), np.asarray(shift, dtype=np.float64).ravel()
    if not found or shift[2] <= 0:
        return None
    return pose(R_from_rotvec(turn), shift)


def _camera(observations: Observations, side: int) -> CameraIntrinsics:
    pixels = (observations.left, observations.right)[side]
    counts = np.isfinite(pixels[..., 0]).sum(axis=1)
    good = np.flatnonzero(counts >= min(observations.board.corner_count, 2 * _FEWEST_CORNERS))
    if len(good) < 3:
        name = "left" if side == 0 else "right"
        raise InputError(f"The {name} camera sees the board in only {len(good)} pictures; take ten per baseline.")
    chosen = good[np.unique(np.linspace(0, len(good) - 1, _VIEWS_PER_CAMERA).round().astype(int))]
    camera, error = _opencv(observations, pixels, chosen)
    sound = error <= _SUSPECT * np.median(error)
    if not sound.all() and np.count_nonzero(sound) >= 3:
        camera, _ = _opencv(observations, pixels, chosen[sound])
    return camera


def _opencv(observations: Observations, pixels: Array, views: NDArray[np.intp]) -> tuple[CameraIntrinsics, Array]:
    seen = [np.isfinite(pixels[view, :, 0]) for view in views]
    points = [observations.board.points_m[mask].astype(np.float32) for mask in seen]
    corners = [pixels[view][mask].astype(np.float32) for view, mask in zip(views, seen, strict=True)]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    _, K, d, _, _, _, _, error = cv2.calibrateCameraExtended(
        points, corners, observations.size, np.eye(3), np.zeros(5), flags=flags
    )
    K, d, error = (np.asarray(a, dtype=np.float64) for a in (K, d, error))
    d = d.ravel()
    vector = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0.0, d[0], d[1], 0.0, 0.0, 0.0])
    return camera_from_vector(vector, observations.size), error.ravel()


def _median_pose(
    observations: Observations, baseline: int, T_left: list[Array | None], T_right: list[Array | None]
) -> Array:
    """Return T_cam0_cam1 of one baseline as (rotation vector, metres), the median over its views."""
    views = np.flatnonzero(observations.baseline == baseline)
    seen = [(T_left[view], T_right[view]) for view in views]
    poses = [left @ inverse(right) for left, right in seen if left is not None and right is not None]
    if not poses:
        raise InputError(
            f"At {observations.nominal_m[baseline] * 1e3:g} mm no pair shows the board to both cameras; retake them."
        )
    vectors = np.array([[*rotvec_from_R(T[:3, :3]), *T[:3, 3]] for T in poses])
    return np.asarray(np.median(vectors, axis=0))


def _pose_of(vector: Array) -> Array:
    return pose(R_from_rotvec(vector[:3]), vector[3:])
