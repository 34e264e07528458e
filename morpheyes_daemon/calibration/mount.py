"""Orientation of the left camera on the vehicle, from a fixed board in front of a vehicle that is rotated by hand.

Boards alone determine the cameras relative to each other; their direction on the body decides where an opening is
placed. The autopilot's attitude and the board's pose in the left camera rotate together, and the constant rotation
between them is the camera's orientation on the body (rotation part of robot-world hand-eye calibration, A X B = Y;
Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker product", 2013). No position is used.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morpheyes_daemon.calibration.solver.initial_guess import board_pose
from morpheyes_daemon.calibration.targets.boards import Board, find_corners
from morpheyes_daemon.errors import CalibrationError, InputError
from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.stereo.image_files import read_picture
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import CameraMount
from morpheyes_daemon.transforms import Array, R_from_rotvec, R_from_rpy, rotvec_from_R

ATTITUDES = "attitudes.csv"
COLUMNS = ("picture", "roll_deg", "pitch_deg", "yaw_deg")

MOUNT_VIEWS, FEWEST_VIEWS = 48, 10
"""Pictures to take, and the least to solve from; chosen: more take longer and average the attitude's noise."""

WORST_SIGMA_RAD = 4e-3
"""Largest accepted sigma of the orientation, rad; chosen: a camera mounted with care is as precise without it."""

_ROUNDS, _CONVERGED_RAD = 20, 1e-10
"""Most Gauss-Newton steps, and the step that ends them."""
_OUTLIER_FACTOR = 3.0
"""Residual of a view, in medians, from which Huber's loss is linear; chosen: smaller rejects noisy attitudes."""
_SINGULAR = 1e-6
"""Ratio of eigenvalues below which a rotation axis was not excited; chosen: far below that of any hand-held set."""


@dataclass(frozen=True, slots=True, eq=False)
class MountViews:
    """Attitudes R_ned_frd (n, 3, 3) of the vehicle and orientations R_cam0_board (n, 3, 3) of the board.

    `problems` are sentences on pictures that were left out.
    """

    names: tuple[str, ...]
    R_ned_frd: Array
    R_cam0_board: Array
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class MountSolution:
    """Orientation of the left camera on the bar; `rms_rad` is the residual between attitude and board per view."""

    mount: CameraMount
    rms_rad: float
    rotation_spread_rad: float
    """Rms rotation of the vehicle about the mean of its attitudes."""


def solve_mount(views: MountViews, R_frd_rig: Array, orientations: int) -> MountSolution:
    """Return the orientation of the left camera on a bar whose orientation on the body is `R_frd_rig` (3, 3).

    `orientations` is that of the board (`orientations(board)`). Gauss-Newton on rotation vectors with Huber weights
    (Shah 2013). Raises CalibrationError when there are too few views or the vehicle was hardly rotated.
    """
    if len(views.names) < FEWEST_VIEWS:
        raise CalibrationError(
            f"{len(views.names)} pictures show the board, {FEWEST_VIEWS} are needed: take more, from all sides."
        )
    A = views.R_ned_frd @ R_frd_rig
    B = _in_one_orientation(A, views.R_cam0_board, orientations)
    X, Y = np.eye(3), A[0] @ B[0]
    J = np.concatenate([B.transpose(0, 2, 1), np.broadcast_to(-np.eye(3), B.shape)], axis=2).reshape(-1, 6)
    for _ in range(_ROUNDS):
        residual = _residuals(A, X, B, Y)
        weight = np.repeat(np.sqrt(_huber(np.linalg.norm(residual, axis=1))), 3)
        step = np.linalg.lstsq(J * weight[:, None], -residual.ravel() * weight, rcond=None)[0]
        X, Y = X @ R_from_rotvec(step[:3]), Y @ R_from_rotvec(step[3:])
        if np.abs(step).max() < _CONVERGED_RAD:
            break
    rms = math.sqrt(float(((residual.ravel() * weight) ** 2).sum() / ((weight**2).sum() - 6)))
    sigma = rms * _sigmas((J * weight[:, None]).T @ (J * weight[:, None]))
    spread_rad = _rotation_spread_rad(A)
    if not sigma.max() <= WORST_SIGMA_RAD:
        raise CalibrationError(
            f"The camera's orientation is only known to {math.degrees(float(sigma.max())):.2f} degrees: "
            f"rotate the vehicle farther (these pictures: {math.degrees(spread_rad):.0f} degrees) "
            "about all three axes, and hold it still."
        )
    x = rotvec_from_R(X)
    mount = CameraMount((float(x[0]), float(x[1]), float(x[2])), (float(sigma[0]), float(sigma[1]), float(sigma[2])))
    return MountSolution(mount, rms, spread_rad)


def read_mount_folder(folder: Path, board: Board, cam0: CameraIntrinsics, progress: Progress = silent) -> MountViews:
    """Return the views of a folder with left pictures and `attitudes.csv`.

    Unusable pictures are left out and named in `problems`. Raises InputError when the file is missing or a row is
    invalid.
    """
    names, attitudes, boards, problems = [], [], [], []
    rows = list(attitude_rows(folder / ATTITUDES))
    for done, (name, attitude) in enumerate(rows, start=1):
        try:
            image = read_picture(folder / name)
        except InputError as error:
            problems.append(f"{error} Copy it again or delete its row.")
            continue
        if (seen := board_rotation(image, board, cam0)) is None:
            problems.append(f"{folder / name}: shows no complete board and is left out.")
        else:
            names.append(name)
            attitudes.append(attitude)
            boards.append(seen)
        progress("looking for the board", done, len(rows))
    R_ned_frd, R_cam0_board = (np.array(part, np.float64).reshape(-1, 3, 3) for part in (attitudes, boards))
    return MountViews(tuple(names), R_ned_frd, R_cam0_board, tuple(problems))


def board_rotation(image: Image, board: Board, cam0: CameraIntrinsics) -> Array | None:
    """Return R_cam0_board (3, 3) of the board in a picture (H, W[, 3]) of the left camera, None when it is not found."""
    corners = find_corners(image, board)
    if corners is None:
        return None
    height, width = image.shape[:2]
    T_cam0_board = board_pose(corners, board, cam0.rescaled(width, height))
    return None if T_cam0_board is None else T_cam0_board[:3, :3]


def orientations(board: Board) -> int:
    """Return the number of rotations about its normal under which the board looks the same: 1, 2 or 4."""
    if board.kind == "charuco":
        return 1
    return 4 if board.rows == board.columns else 2


def attitude_rows(path: Path) -> Iterator[tuple[str, Array]]:
    """Yield picture and R_ned_frd (3, 3) of every line of `attitudes.csv`; raises InputError naming the line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        raise InputError(
            f"{path}: cannot be read; take the pictures with `morpheyes calibrate capture --mount`."
        ) from None
    reader = csv.DictReader(lines)
    if reader.fieldnames is None or not set(COLUMNS) <= set(reader.fieldnames):
        raise InputError(f"{path}: needs the columns {', '.join(COLUMNS)}.")
    for number, row in enumerate(reader, start=2):
        try:
            angles = [math.radians(float(row[column])) for column in COLUMNS[1:]]
        except (TypeError, ValueError):
            angles = [math.nan]
        if not all(math.isfinite(angle) for angle in angles):
            raise InputError(f"{path}, line {number}: the angles are not numbers; correct or delete the line.")
        yield str(row["picture"]), R_from_rpy(*angles)


def _in_one_orientation(A: Array, B: Array, orientations: int) -> Array:
    """Return the board orientations B (n, 3, 3) resolved to one corner: the board is symmetric about its normal."""
    about = [R_from_rotvec(np.array([0.0, 0.0, 2 * math.pi * k / orientations])) for k in range(orientations)]
    ways = B[:, None] @ np.array(about)
    agreement = np.einsum("ij,nkij->nk", A[0] @ B[0], A[:, None] @ ways)
    return np.asarray(ways[np.arange(len(B)), agreement.argmax(axis=1)])


def _residuals(A: Array, X: Array, B: Array, Y: Array) -> Array:
    """Return the residuals (n, 3) of A X B = Y, rotation vectors in board axes."""
    return np.array([rotvec_from_R(R) for R in Y.T @ A @ X @ B])


def _huber(residual: Array) -> Array:
    limit = _OUTLIER_FACTOR * max(float(np.median(residual)), 1e-9)
    return np.asarray(np.minimum(1.0, limit / np.maximum(residual, 1e-12)))


def _sigmas(information: Array) -> Array:
    """Return one sigma (3,) of the orientation for unit noise; inf where the vehicle was not rotated."""
    values, vectors = np.linalg.eigh(information)
    if values[0] < _SINGULAR * values[-1]:
        return np.full(3, np.inf)
    return np.asarray(np.sqrt(np.diag(vectors / values @ vectors.T)[:3]))


def _rotation_spread_rad(A: Array) -> float:
    """Return the rms angle of the attitudes A (n, 3, 3) about their mean."""
    vectors = np.array([rotvec_from_R(A[0].T @ R) for R in A])
    return math.sqrt(float(((vectors - vectors.mean(axis=0)) ** 2).sum(axis=1).mean()))
