"""Calibration boards before the camera twin: a flat board at one pose after the other, lit evenly, before a wall.

It stands in for the world's renderer, so lens, misalignment, noise and vignetting are the camera twin's own. Board
poses are drawn so that a good operator could have held them: near and far, tilted, all over the image, always whole
in both eyes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Mount
from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole, RawPair
from morpheyes_daemon.simulation.camera.stereo_camera import CameraTwin, Sensor
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.simulation.rendering.renderer import Rendered, Renderer
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.transforms import R_FRD_CAM, Array, R_from_rotvec, inverse, pose

_INK, _PAPER = 0.03, 0.62
"""Reflectance of black and white; white stays clear of the sensor's limit."""
_OVERSAMPLING = 3
_SPOT_PX = 0.6
"""Sigma of the lens's spot: diffraction at f/2.6 and a little defocus on 2.8 um pixels."""
_MARGIN_PX = 6.0
_NEAREST_FILL = 0.92
"""The nearest board spans this share of what both eyes see, the farthest one still has squares that can be found."""
_TILT_RAD = 0.6
_ROLL_RAD, _HAND_ROLL_RAD = 0.2, 0.7
"""One sigma about the line of sight: of a board that is held upright, and of a vehicle that is turned onto its sides."""
_GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))


class FlatBoard(Protocol):
    """What the twin must know of a board: its outline, and a picture of it with the place of its corners."""

    @property
    def square_m(self) -> float:
        """Side of a square."""

    @property
    def least_square_px(self) -> float:
        """How wide a square must be in the image to be found."""

    @property
    def points_m(self) -> Array:
        """Inner corners (n, 3) on the board."""

    def picture(self, pixels_per_square: int) -> tuple[Image, Array]:
        """Return a picture of the board and the pixel of every inner corner in it."""


class BoardScene:
    """Draws the board for the camera twin; at second k it stands at the k-th of `T_ned_board`."""

    def __init__(self, board: FlatBoard, seed: int) -> None:
        self.T_ned_board: list[Array] = []
        self._board = board
        self._pictures: dict[int, tuple[FloatMap, Array]] = {}
        wall = np.random.default_rng([seed, 500]).random((12, 16), dtype=np.float32)
        self._wall = 0.10 + 0.12 * wall

    def sibling(self) -> BoardScene:
        """Return itself: it keeps nothing that two threads could spoil."""
        return self

    def render(self, T_ned_cam: Array, pinhole: Pinhole, t_s: float = 0.0, eye_ned: Array | None = None) -> Rendered:
        """Render the board of second `t_s` before the wall."""
        T_cam_board = inverse(T_ned_cam) @ self.T_ned_board[round(t_s)]
        size = (pinhole.width, pinhole.height)
        grey = cv2.resize(self._wall, size, interpolation=cv2.INTER_CUBIC).astype(np.float32)
        self._paste(grey, T_cam_board, pinhole)
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), _SPOT_PX), np.float32)
        depth = np.full(grey.shape, T_cam_board[2, 3], np.float32)
        return Rendered(np.repeat(grey[..., None], 3, axis=2), depth, np.zeros(grey.shape, np.int32))

    def _paste(self, grey: FloatMap, T_cam_board: Array, pinhole: Pinhole) -> None:
        """Draw the board over `grey`, oversampled and averaged, within its bounding box only."""
        texture, corners = self._picture(_OVERSAMPLING * pinhole.f_px * self._board.square_m / T_cam_board[2, 3])
        height, width = texture.shape
        image = _project(self._board.points_m, T_cam_board, pinhole)
        onto = cv2.findHomography(corners, image)[0]
        outline = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
        edge = cv2.perspectiveTransform(outline[None], onto)[0]
        low = np.maximum(np.floor(edge.min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(edge.max(axis=0)).astype(int) + 2, [pinhole.width, pinhole.height])
        if np.any(high <= low):
            return
        s = _OVERSAMPLING
        finer = np.array([[s, 0, (0.5 - low[0]) * s - 0.5], [0, s, (0.5 - low[1]) * s - 0.5], [0, 0, 1.0]])
        box = ((high[0] - low[0]) * s, (high[1] - low[1]) * s)
        drawn = cv2.warpPerspective(texture, finer @ onto, box, flags=cv2.INTER_LINEAR, borderValue=0.0)
        cover = cv2.warpPerspective(np.ones_like(texture), finer @ onto, box, flags=cv2.INTER_LINEAR, borderValue=0.0)
        smaller = (high[0] - low[0], high[1] - low[1])
        drawn, cover = (cv2.resize(layer, smaller, interpolation=cv2.INTER_AREA) for layer in (drawn, cover))
        patch = grey[low[1] : high[1], low[0] : high[0]]
        patch[:] = drawn + (1.0 - cover) * patch

    def _picture(self, wanted_px: float) -> tuple[FloatMap, Array]:
        """Return the board's reflectance at about the asked pixels per square, so that little is lost or aliased."""
        per_square = int(2 ** np.clip(np.ceil(np.log2(wanted_px)), 4, 7))
        if per_square not in self._pictures:
            picture, corners = self._board.picture(per_square)
            light = _INK + (_PAPER - _INK) / 255.0 * picture.astype(np.float32)
            self._pictures[per_square] = (light.astype(np.float32), corners)
        return self._pictures[per_square]


class BoardTwin:
    """A person with a board before the rig twin: raw pairs at any true baseline, the same for the same seed."""

    def __init__(self, rig: RigTwin, board: FlatBoard, seed: int, sensor: Sensor | None = None) -> None:
        self._rig, self._board, self._seed = rig, board, seed
        self._mount = Mount()
        self._scene = BoardScene(board, seed)
        still = Sensor(auto_exposure=False) if sensor is None else sensor
        self._camera = CameraTwin(cast(Renderer, self._scene), rig, self._mount, still, seed=seed)

    def pairs(self, baselines_true_m: Sequence[float]) -> Iterator[RawPair]:
        """Yield raw pairs (BGR) of the board at drawn poses, one for each true baseline (all about the same)."""
        yield from self._before_the_bar(self._poses(baselines_true_m, 510), baselines_true_m)

    def hand_turned(self, baseline_true_m: float, views: int) -> Iterator[tuple[RawPair, Array]]:
        """Yield raw pairs (BGR) of a board on a wall and the true R_ned_frd (3, 3) of the vehicle held before it."""
        poses = self._poses([baseline_true_m] * views, 530, _HAND_ROLL_RAD)
        attitudes = [R_FRD_CAM @ (T_frd_rig(self._mount) @ T)[:3, :3].T for T in poses]
        yield from zip(self._before_the_bar(poses, [baseline_true_m] * views), attitudes, strict=True)

    def _poses(self, baselines_true_m: Sequence[float], stream: int, roll_rad: float = _ROLL_RAD) -> list[Array]:
        rng = np.random.default_rng([self._seed, stream, round(baselines_true_m[0] * 1e9)])
        return draw_poses(self._rig, self._board, max(baselines_true_m), len(baselines_true_m), rng, roll_rad)

    def _before_the_bar(self, poses: Sequence[Array], baselines_true_m: Sequence[float]) -> Iterator[RawPair]:
        """Yield raw pairs of the board at T_rig_board (4, 4)."""
        first = len(self._scene.T_ned_board)
        self._scene.T_ned_board += [T_frd_rig(self._mount) @ T for T in poses]
        for view, true_m in enumerate(baselines_true_m):
            noise = 1000 * round(true_m * 1e7) + view
            yield self._camera.render_pair((first + view) * S, noise, lambda _: np.eye(4), true_m)


def draw_poses(
    rig: RigTwin,
    board: FlatBoard,
    baseline_true_m: float,
    views: int,
    rng: np.random.Generator,
    roll_rad: float = _ROLL_RAD,
) -> list[Array]:
    """Return T_rig_board (4, 4) of poses at which both eyes see the whole board.

    Distances are spread evenly in 1/Z; every other board is moved to the edge of what both eyes see.
    """
    eyes = [(camera, inverse(rig.T_rig_eye(eye, baseline_true_m))) for eye, camera in enumerate((rig.cam0, rig.cam1))]
    middle = board.points_m.mean(axis=0)
    points = board.points_m - middle
    near, far = _distances(rig.cam0, board, baseline_true_m)
    turn = rng.uniform(0, 2 * math.pi)
    drawn: list[Array] = []
    for place, slot in enumerate(rng.permutation(views)):
        inverse_z = 1.0 / far + (slot + 0.5) / views * (1.0 / near - 1.0 / far)
        R = _tilt(rng, roll_rad)
        angle = turn + _GOLDEN_RAD * place
        share = 1.0 if place % 2 == 0 else float(rng.uniform(0.0, 1.0))
        centre = _centre(eyes, points @ R.T, 1.0 / inverse_z, angle, share)
        drawn.append(pose(R, centre - R @ middle))
    return drawn


def _tilt(rng: np.random.Generator, roll_rad: float) -> Array:
    about = rng.uniform(-_TILT_RAD, _TILT_RAD, 2)
    return R_from_rotvec(np.array([*about, 0.0])) @ R_from_rotvec(np.array([0.0, 0.0, rng.normal(0, roll_rad)]))


def _centre(eyes: list[tuple[CameraIntrinsics, Array]], points: Array, z: float, angle: float, share: float) -> Array:
    """Return where the board's middle is held: that share of the way from the axis to where an eye loses it.

    Farther away than `z` when the board does not even fit in the middle.
    """
    ahead = np.array([0.0, 0.0, 1.0])
    while not _seen(eyes, points + z * ahead):
        z *= 1.05
    direction = np.array([math.cos(angle), math.sin(angle), 0.0]) * z
    inside, outside = 0.0, 1.0
    for _ in range(12):
        halfway = (inside + outside) / 2
        if _seen(eyes, points + z * ahead + halfway * direction):
            inside = halfway
        else:
            outside = halfway
    return np.asarray(share * inside * direction + z * ahead)


def _seen(eyes: list[tuple[CameraIntrinsics, Array]], p_rig: Array) -> bool:
    return all(_whole(camera, T_eye_rig, p_rig) for camera, T_eye_rig in eyes)


def _whole(camera: CameraIntrinsics, T_eye_rig: Array, p_rig: Array) -> bool:
    p_eye = p_rig @ T_eye_rig[:3, :3].T + T_eye_rig[:3, 3]
    if np.any(p_eye[:, 2] < 0.05):
        return False
    uv = camera.project(p_eye)
    return bool(np.all((uv > _MARGIN_PX) & (uv < [camera.width - 1 - _MARGIN_PX, camera.height - 1 - _MARGIN_PX])))


def _distances(camera: CameraIntrinsics, board: FlatBoard, baseline_m: float) -> tuple[float, float]:
    """Return the nearest distance at which both eyes can see the board whole, and the farthest worth taking."""
    extent = np.ptp(board.points_m, axis=0) + 2 * board.square_m
    near = max(
        (extent[0] / _NEAREST_FILL + baseline_m) * camera.fx / camera.width,
        extent[1] / _NEAREST_FILL * camera.fy / camera.height,
    )
    return near, max(camera.fx * board.square_m / board.least_square_px, 1.2 * near)


def _project(points_m: Array, T_cam_board: Array, pinhole: Pinhole) -> NDArray[np.float64]:
    p = points_m @ T_cam_board[:3, :3].T + T_cam_board[:3, 3]
    return np.asarray(p[:, :2] / p[:, 2:] * pinhole.f_px + [pinhole.cx_px, pinhole.cy_px])
