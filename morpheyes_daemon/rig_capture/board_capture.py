"""Taking board pictures at every baseline with a person holding the board: move, guide, keep what tells more.

Every kept pair is on disk at once, so stopping in the middle loses nothing and starting again goes on from there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import yaml

from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.calibration.targets.capture_guide import CaptureGuide, Hint
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.rig_capture.rig_session import RigSession


@dataclass(frozen=True)
class CaptureStatus:
    """What a person should see of the capture right now."""

    nominal_m: float
    guide: CaptureGuide
    hint: Hint


Show = Callable[[CaptureStatus], None]


async def capture_boards(
    stand: RigSession, out: Path, board: Board, nominal_m: Sequence[float], wanted: int, show: Show
) -> dict[str, int]:
    """Fill `out` with `wanted` pairs for each nominal baseline; returns how many each folder holds.

    Raises DeviceError when camera or servo fail, InputError when `out` cannot be written.
    """
    note_board(out, board)
    counts = {}
    for nominal in nominal_m:
        folder = out / f"{nominal * 1e3:g}mm"
        counts[folder.name] = await _one_baseline(stand, folder, board, nominal, wanted, show)
    return counts


async def capture_visits(
    stand: RigSession, out: Path, board: Board, nominal_m: Sequence[float], visits: int, show: Show
) -> dict[str, int]:
    """Go to every baseline `visits` times in turn and take one pair each time, the board standing still in view."""
    note_board(out, board)
    counts: dict[str, int] = {}
    for _ in range(visits):
        for nominal in nominal_m:
            folder = out / f"{nominal * 1e3:g}mm"
            counts[folder.name] = await _one_visit(stand, folder, board, nominal, show)
    return counts


def note_board(out: Path, board: Board) -> None:
    """Write board.yaml; raises InputError when the folder holds pictures of another board."""
    content = {"board": board.label, "square_mm": board.square_m * 1e3}
    if board.kind == "charuco":
        content["marker_mm"] = board.square_m * board.marker_share * 1e3
    path = out / "board.yaml"
    try:
        out.mkdir(parents=True, exist_ok=True)
        known = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else content
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); name another folder.") from None
    if {key: known.get(key) for key in content} != content:
        raise InputError(f"{path}: is of another board; name a new folder or give the same board.")
    path.write_text(yaml.safe_dump({**known, **content}, sort_keys=False), encoding="utf-8")


async def _one_baseline(stand: RigSession, folder: Path, board: Board, nominal_m: float, wanted: int, show: Show) -> int:
    number = _last_number(folder)
    if number >= wanted:
        return number
    await stand.place(nominal_m)
    guide: CaptureGuide | None = None
    while number < wanted:
        pair = await stand.pair()
        guide = guide or CaptureGuide(board, (pair.left.shape[1], pair.left.shape[0]), wanted - number)
        hint = guide.consider(pair.left, pair.right)
        if hint.kept:
            number += 1
            write_pair(folder, number, pair)
        show(CaptureStatus(nominal_m, guide, hint))
    return number


async def _one_visit(stand: RigSession, folder: Path, board: Board, nominal_m: float, show: Show) -> int:
    await stand.place(nominal_m)
    number = _last_number(folder)
    while True:
        pair = await stand.pair()
        guide = CaptureGuide(board, (pair.left.shape[1], pair.left.shape[0]), 1)
        guide.consider(pair.left, pair.right)
        again = await stand.pair()
        hint = guide.consider(again.left, again.right)
        show(CaptureStatus(nominal_m, guide, hint))
        if hint.kept:
            write_pair(folder, number + 1, again)
            return number + 1


def write_pair(folder: Path, number: int, pair: RawPair) -> None:
    """Write a pair as left and right pictures of a number, each whole or not at all."""
    try:
        folder.mkdir(exist_ok=True)
        for side, image in (("left", pair.left), ("right", pair.right)):
            temporary = folder / f".{side}.part.png"
            cv2.imwrite(str(temporary), image)
            temporary.replace(folder / f"{side}{number:02d}.png")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); free some space and go on.") from None


def _last_number(folder: Path) -> int:
    """Return the number of the newest whole pair in the folder, 0 for none."""
    names = {path.name for path in folder.glob("*.png")} if folder.is_dir() else set()
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"left(\d+)\.png", name))]
    return max((number for number in numbers if f"right{number:02d}.png" in names), default=0)
