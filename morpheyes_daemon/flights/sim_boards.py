"""Boards of the camera twin: as folders of pictures that `calibrate solve` takes, or as corners straight away.

The rig's truth is not written anywhere: a seed makes the same twin again, and only its name goes into the folder.
Each baseline stands where the servo put it that time, repeatability included.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import yaml

from morpheyes_daemon.calibration.mount import ATTITUDES, COLUMNS, MOUNT_VIEWS, MountViews, board_rotation
from morpheyes_daemon.calibration.targets.boards import Board, aligned, find_corners
from morpheyes_daemon.calibration.targets.capture_guide import BASELINE_VIEWS
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.config.vehicle import ServoMotion
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.simulation.autopilot.ekf import EstimatorNoise
from morpheyes_daemon.simulation.camera.calibration_boards import BoardTwin
from morpheyes_daemon.simulation.camera.true_rig import RANGE_M, RigTwin
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.transforms import Array, R_from_rpy, rpy_from_R

DEFAULT_BOARD = Board(9, 6, 0.025)
DEFAULT_BASELINES_M = tuple(round(float(b), 4) for b in np.linspace(*RANGE_M, 10))
"""Ten equally spaced baselines (paper, section III-B), to a tenth of a millimetre as the folders name them."""
_WORKERS = 2

T = TypeVar("T")


def twin_name(seed: int, size: tuple[int, int]) -> str:
    """Return the name of a twin rig, from which `twin_from_name` makes it again."""
    return f"twin-{seed}-{size[0]}x{size[1]}"


def twin_from_name(name: str) -> RigTwin | None:
    """Return the twin rig of a name, None for any other rig."""
    match = re.fullmatch(r"twin-(\d+)-(\d+)x(\d+)", name)
    return RigTwin(int(match[2]), int(match[3]), seed=int(match[1])) if match else None


def settled_m(twin: RigTwin, seed: int, nominal_m: Sequence[float], views: int, visits: bool) -> Array:
    """Return the true baselines (M, views) at which the servo came to rest: anew for each view, or once for all."""
    rng = np.random.default_rng([seed, 520])
    sigma_m = ServoMotion().repeatability_sigma_mm / 1e3
    error_m = sigma_m * rng.standard_normal((len(nominal_m), views if visits else 1))
    actual_m = np.array([[twin.actual_m(nominal)] for nominal in nominal_m])
    return np.asarray(np.broadcast_to(actual_m + error_m, (len(nominal_m), views)))


def render_folder(
    out: Path,
    seed: int,
    nominal_m: Sequence[float] = DEFAULT_BASELINES_M,
    views: int = BASELINE_VIEWS,
    board: Board = DEFAULT_BOARD,
    size: tuple[int, int] = (640, 480),
    visits: bool = False,
    progress: Progress = silent,
) -> None:
    """Write left and right PNGs per baseline, and board.yaml with what a person would have measured.

    With `visits` the servo goes away and comes back before every pair. Raises InputError when the folder is not
    empty.
    """
    _refuse_full(out)
    twin = RigTwin(*size, seed=seed)
    true_m = settled_m(twin, seed, nominal_m, views, visits)
    out.mkdir(parents=True, exist_ok=True)
    drawn = _drawn(twin, seed, true_m, board, lambda pair: pair)
    for done, (index, view, pair) in enumerate(drawn, start=1):
        folder = out / f"{nominal_m[index] * 1e3:g}mm"
        folder.mkdir(exist_ok=True)
        for eye, image in (("left", pair.left), ("right", pair.right)):
            cv2.imwrite(str(folder / f"{eye}{view + 1:02d}.png"), image)
        progress("rendering boards", done, len(nominal_m) * views)
    content = {"board": board.label, "square_mm": board.square_m * 1e3, "rig": twin_name(seed, size)}
    (out / "board.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def render_mount_folder(
    out: Path,
    seed: int,
    views: int = MOUNT_VIEWS,
    board: Board = DEFAULT_BOARD,
    size: tuple[int, int] = (640, 480),
    progress: Progress = silent,
) -> None:
    """Write what `calibrate capture --mount` would: pictures of a board on a wall, and what the autopilot said.

    Raises InputError when the folder is not empty.
    """
    _refuse_full(out)
    out.mkdir(parents=True, exist_ok=True)
    lines = [",".join(COLUMNS)]
    for view, (pair, R_ned_frd) in enumerate(_hand_turned(RigTwin(*size, seed=seed), seed, views, board), start=1):
        for eye, image in (("left", pair.left), ("right", pair.right)):
            cv2.imwrite(str(out / f"{eye}{view:02d}.png"), image)
        angles = (f"{np.degrees(angle):.4f}" for angle in rpy_from_R(R_ned_frd))
        lines.append(f"left{view:02d}.png,{','.join(angles)}")
        progress("rendering boards", view, views)
    (out / ATTITUDES).write_text("\n".join(lines) + "\n", encoding="utf-8")
    content = {"board": board.label, "square_mm": board.square_m * 1e3, "rig": twin_name(seed, size)}
    (out / "board.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def observe_mount(seed: int, cam0: CameraIntrinsics, progress: Progress = silent) -> MountViews:
    """Return the views that `render_mount_folder` and `read_mount_folder` would give, without the files between."""
    names, attitudes, boards = [], [], []
    turned = _hand_turned(RigTwin(cam0.width, cam0.height, seed=seed), seed, MOUNT_VIEWS, DEFAULT_BOARD)
    for view, (pair, R_ned_frd) in enumerate(turned, start=1):
        seen = board_rotation(pair.left, DEFAULT_BOARD, cam0)
        if seen is not None:
            names.append(f"left{view:02d}.png")
            attitudes.append(R_ned_frd)
            boards.append(seen)
        progress("measuring the eyes' mount", view, MOUNT_VIEWS)
    return MountViews(tuple(names), np.array(attitudes), np.array(boards))


def _hand_turned(twin: RigTwin, seed: int, views: int, board: Board) -> Iterator[tuple[RawPair, Array]]:
    """Yield pairs at the smallest baseline, and attitudes R_ned_frd (3, 3) with the autopilot's errors."""
    rng = np.random.default_rng([seed, 540])
    for pair, R_ned_frd in BoardTwin(twin, board, seed).hand_turned(twin.actual_m(RANGE_M[0]), views):
        error = EstimatorNoise().attitude_rad * rng.standard_normal(3)
        yield pair, R_from_rpy(*(np.array(rpy_from_R(R_ned_frd)) + error).tolist())


def observe_twin(
    seed: int,
    nominal_m: Sequence[float] = DEFAULT_BASELINES_M,
    views: int = BASELINE_VIEWS,
    board: Board = DEFAULT_BOARD,
    size: tuple[int, int] = (640, 480),
    progress: Progress = silent,
) -> Observations:
    """Return the corners that `render_folder` and `detection.observe` would give, without the files between."""
    twin = RigTwin(*size, seed=seed)
    names, baselines, seen = [], [], []
    true_m = settled_m(twin, seed, nominal_m, views, visits=False)
    drawn = _drawn(twin, seed, true_m, board, lambda pair: _both(pair, board))
    for done, (index, view, corners) in enumerate(drawn, start=1):
        progress("calibrating on rendered boards", done, len(nominal_m) * views)
        if corners is not None:
            folder = f"{nominal_m[index] * 1e3:g}mm"
            names.append((f"{folder}/left{view + 1:02d}.png", f"{folder}/right{view + 1:02d}.png"))
            baselines.append(index)
            seen.append(corners)
    left, right = (np.array([corners[eye] for corners in seen]) for eye in (0, 1))
    return Observations(board, size, np.array(nominal_m), np.array(baselines), tuple(names), left, right)


def _drawn(
    twin: RigTwin, seed: int, true_m: Array, board: Board, use: Callable[[RawPair], T]
) -> Iterator[tuple[int, int, T]]:
    """Yield (baseline, view, what `use` makes of the pair) in order; two threads draw, with the same bits as one."""
    cameras = [BoardTwin(twin, board, seed) for _ in range(_WORKERS)]

    def draw(worker: int, index: int) -> list[T]:
        return [use(pair) for pair in cameras[worker].pairs(true_m[index].tolist())]

    with ThreadPoolExecutor(_WORKERS) as pool:
        for first in range(0, len(true_m), _WORKERS):
            indices = range(first, min(first + _WORKERS, len(true_m)))
            for index, results in zip(indices, pool.map(draw, range(len(indices)), indices), strict=True):
                yield from ((index, view, result) for view, result in enumerate(results))


def _both(pair: RawPair, board: Board) -> tuple[Array, Array] | None:
    left, right = find_corners(pair.left, board), find_corners(pair.right, board)
    if left is None or right is None:
        return None
    return left, aligned(left, right, board)


def _refuse_full(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder to render into.")
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty; name a new folder, so that old and new pictures do not mix.")
