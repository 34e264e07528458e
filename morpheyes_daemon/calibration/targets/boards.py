"""Calibration boards: geometry, rendering, and corner detection in an image.

Chessboards and ChArUco boards. Corners are in the board's own order, which for a chessboard in a single image is known
only up to a rotation of the board; `aligned` makes it the same in both images, which is all a stereo solve needs. The
size of a square must be given: no picture shows it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from morpheyes_daemon.calibration.targets.subpixel import saddle_points
from morpheyes_daemon.errors import UsageError
from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.stereo.depth import grey
from morpheyes_daemon.transforms import Array

_WINDOW_SHARE = 0.3
"""Half width of the sub-pixel window over the distance to the nearest corner; chosen: excludes the next edge."""
_WINDOW_LIMITS_PX = (2, 11)
"""Least and largest half width of that window, pixels; chosen: fewer pixels are noisy, more see lens distortion."""
_REFINE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
"""Termination of cv2.cornerSubPix: iterations and step in pixels; chosen: it only starts `saddle_points`."""
_SQUARE_LIMITS_M = (0.001, 1.0)
"""Accepted side of a square, metres; chosen: catches a wrong unit."""
_CORNER_LIMITS = (3, 60)
"""Accepted inner corners per side; chosen: what fits into an image."""
_MARKER_SHARE = 0.75
"""Marker side over square side of a ChArUco board when it is not given; chosen: usual for printed boards."""
_FEWEST_CHARUCO_CORNERS = 8
"""Corners of a ChArUco board that count as found; chosen: twice those that determine a pose."""
_LEAST_SQUARE_PX = {"chessboard": 9.0, "charuco": 22.0}
"""Width of a square in the image that can be detected, pixels; chosen: the bits of a marker need about 2 px each."""


@dataclass(frozen=True)
class Board:
    """A flat board: `columns` x `rows` inner corners, `square_m` apart.

    A ChArUco board of (columns + 1) x (rows + 1) squares has the same inner corners; `dictionary` and
    `marker_share` (marker side over square side) describe the markers in its white squares.
    Raises UsageError on an impossible board.
    """

    columns: int
    rows: int
    square_m: float
    kind: Literal["chessboard", "charuco"] = "chessboard"
    dictionary: str = "5X5_1000"
    marker_share: float = _MARKER_SHARE

    def __post_init__(self) -> None:
        low, high = _SQUARE_LIMITS_M
        fewest, most = _CORNER_LIMITS
        if min(self.columns, self.rows) < fewest or max(self.columns, self.rows) > most:
            raise UsageError(
                f"A board of {self.columns}x{self.rows} inner corners cannot be used; give {fewest} to {most}."
            )
        if not (math.isfinite(self.square_m) and low <= self.square_m <= high):
            raise UsageError(
                f"A square of {self.square_m * 1e3:g} mm is out of range; "
                f"measure one on the board and give 1 to 1000 mm."
            )
        if self.kind == "charuco" and not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise UsageError(f"There is no marker dictionary {self.dictionary!r}; use one such as 5X5_1000.")

    @property
    def corner_count(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def points_m(self) -> Array:
        """Inner corners (n, 3), n = columns * rows, in the board's frame, metres, row by row, z = 0."""
        v, u = np.mgrid[0 : self.rows, 0 : self.columns]
        flat = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=-1)
        return np.asarray(flat * self.square_m, dtype=np.float64)

    @property
    def clear_share(self) -> float:
        """Half width, over the square, of the area around a corner without markers."""
        return min(_WINDOW_SHARE, (1.0 - self.marker_share) / 2) if self.kind == "charuco" else _WINDOW_SHARE

    @property
    def least_square_px(self) -> float:
        """Width of a square in the image, pixels, from which it is detected."""
        return _LEAST_SQUARE_PX[self.kind]

    @property
    def label(self) -> str:
        """The board in the syntax of `--board`."""
        if self.kind == "charuco":
            return f"charuco:{self.columns + 1}x{self.rows + 1}:{self.dictionary}"
        return f"{self.columns}x{self.rows}"

    def picture(self, pixels_per_square: int, margin_squares: float = 1.0) -> tuple[Image, Array]:
        """Return an image (H, W) uint8 of the board and the pixels (columns * rows, 2) of its inner corners.

        The margin is white. Used for rendering and for printing.
        """
        margin = round(margin_squares * pixels_per_square)
        columns, rows = self.columns + 1, self.rows + 1
        if self.kind == "charuco":
            size = (columns * pixels_per_square, rows * pixels_per_square)
            inner = np.asarray(_charuco(self).generateImage(size), dtype=np.uint8)
        else:
            dark = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0
            inner = np.where(np.kron(dark, np.ones((pixels_per_square,) * 2)), 0, 255).astype(np.uint8)
        picture = np.pad(inner, margin, constant_values=255)
        corners = (self.points_m[:, :2] / self.square_m + 1.0) * pixels_per_square + margin - 0.5
        return picture, corners


def parse_board(text: str, square_m: float, marker_m: float | None = None) -> Board:
    """Return the board of `9x6` (inner corners) or `charuco:10x7[:5X5_1000]` (squares); raises UsageError.

    `marker_m` is the side of a marker, None for the usual share.
    """
    match = re.fullmatch(r"(?:(charuco):)?(\d+)x(\d+)(?::(\w+))?", text.strip())
    if not match or (match[4] and not match[1]):
        raise UsageError(
            f"The board {text!r} is not understood; give the inner corners such as 9x6, or charuco:10x7:5X5_1000."
        )
    columns, rows = int(match[2]), int(match[3])
    if not match[1]:
        return Board(columns, rows, square_m)
    share = _MARKER_SHARE if marker_m is None else marker_m / square_m
    if not 0.2 < share < 1.0:
        raise UsageError(f"A marker must be smaller than its square, not {share:.2f} of it; measure both.")
    return Board(columns - 1, rows - 1, square_m, "charuco", (match[4] or "5X5_1000").upper(), share)


def find_corners(image: Image, board: Board) -> Array | None:
    """Return the inner corners (columns * rows, 2) in pixels of an image (H, W) or (H, W, 3), None without a board.

    A chessboard is found completely or not at all; a ChArUco board may be partly hidden (NaN).
    """
    picture = grey(image)
    return _find_charuco(picture, board) if board.kind == "charuco" else _find_chessboard(picture, board)


def aligned(left: Array, right: Array, board: Board) -> Array:
    """Return the chessboard corners of the right image (n, 2) in the order of the left ones (n, 2).

    The cameras have the same orientation, so of the possible rotations of the board the one is chosen whose rows point
    in the same direction in both images. ChArUco corners are numbered and are returned unchanged.
    """
    if board.kind == "charuco":
        return right
    rotated = _rotations(right, board)
    axes = [_axis(corners, board) for corners in rotated]
    wanted = _axis(left, board)
    return rotated[int(np.argmax([axis @ wanted for axis in axes]))]


def _find_chessboard(picture: Image, board: Board) -> Array | None:
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
    if not found:
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    return _right_handed(_refined(picture, corners.reshape(-1, 2).astype(np.float64), board), board)


def _find_charuco(picture: Image, board: Board) -> Array | None:
    detector = cv2.aruco.CharucoDetector(_charuco(board))
    corners, numbers, _, _ = detector.detectBoard(picture)
    if numbers is None or len(numbers) < _FEWEST_CHARUCO_CORNERS:
        return None
    found = np.full((board.corner_count, 2), np.nan)
    found[numbers.ravel()] = corners.reshape(-1, 2)
    return _refined(picture, found, board)


def _charuco(board: Board) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    squares = (board.columns + 1, board.rows + 1)
    return cv2.aruco.CharucoBoard(squares, board.square_m, board.square_m * board.marker_share, dictionary)


def _refined(picture: Image, corners: Array, board: Board) -> Array:
    """Return the corners (n, 2) moved to their saddle points, in windows limited by neighbours and the border."""
    last = np.array([picture.shape[1] - 1, picture.shape[0] - 1])
    room = np.minimum(corners, last - corners).min(axis=1) - 1.0
    reach = board.clear_share * spacing_px(corners, board)
    half = np.clip(np.floor(np.minimum(reach, room)), *_WINDOW_LIMITS_PX)
    refined = corners.copy()
    for window in np.unique(half[np.isfinite(half)]).astype(int):
        chosen = half == window
        start = corners[chosen].astype(np.float32).reshape(-1, 1, 2)
        near = cv2.cornerSubPix(picture, start, (window, window), (-1, -1), _REFINE).reshape(-1, 2)
        refined[chosen], _ = saddle_points(picture, near.astype(np.float64), int(window))
    return refined


def spacing_px(corners: Array, board: Board) -> Array:
    """Return the distance (n,) in pixels of each corner (n, 2) to its nearest neighbour, NaN where unseen."""
    grid = corners.reshape(board.rows, board.columns, 2)
    nearest = np.full(grid.shape[:2], np.inf)
    for axis in (0, 1):
        gap = np.linalg.norm(np.diff(grid, axis=axis), axis=-1)
        gap = np.where(np.isfinite(gap), gap, np.inf)
        before, after = (nearest[1:], nearest[:-1]) if axis == 0 else (nearest[:, 1:], nearest[:, :-1])
        np.minimum(before, gap, out=before)
        np.minimum(after, gap, out=after)
    nearest[~np.isfinite(grid[..., 0])] = np.nan
    flat = nearest.ravel()
    return np.where(np.isinf(flat), _WINDOW_LIMITS_PX[0] / _WINDOW_SHARE, flat)


def _right_handed(corners: Array, board: Board) -> Array:
    """Return the corners (n, 2) in the order of a board seen from the front: rows clockwise from columns."""
    grid = corners.reshape(board.rows, board.columns, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    clockwise = along[0] * down[1] - along[1] * down[0] > 0
    return corners if clockwise else grid[::-1].reshape(-1, 2).copy()


def _rotations(corners: Array, board: Board) -> list[Array]:
    grid = corners.reshape(board.rows, board.columns, 2)
    quarters = (0, 1, 2, 3) if board.rows == board.columns else (0, 2)
    return [np.rot90(grid, quarter, axes=(0, 1)).reshape(-1, 2).copy() for quarter in quarters]


def _axis(corners: Array, board: Board) -> Array:
    grid = corners.reshape(board.rows, board.columns, 2)
    return np.asarray(np.mean(grid[:, -1] - grid[:, 0], axis=0))
