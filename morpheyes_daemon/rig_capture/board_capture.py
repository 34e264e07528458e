"""Capture of board pictures at every baseline with a hand-held board: moves the servo, guides, and keeps pairs.

Every kept pair is written at once, so an interrupted capture can be continued.
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
from morpheyes_daemon.config.yaml_reader import parse_yaml, read_text
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.rig_capture.rig_session import RigSession


@dataclass(frozen=True)
class CaptureStatus:
    """State of the capture, to be shown to the person."""

    nominal_m: float
    guide: CaptureGuide
    hint: Hint


Show = Callable[[CaptureStatus], None]
"""Called after every pair."""


@dataclass(frozen=True, slots=True)
class BoardFolder:
    """A folder of pictures and the board they show."""

    path: Path
    board: Board

    def at(self, nominal_m: float) -> BoardFolder:
        """Return the sub-folder of a nominal baseline."""
        return BoardFolder(self.path / f"{nominal_m * 1e3:g}mm", self.board)


async def capture_boards(
    session: RigSession, out: BoardFolder, nominal_m: Sequence[float], wanted: int, show: Show
) -> dict[str, int]:
    """Take `wanted` pairs at each nominal baseline; return the number of pairs in each folder.

    Raises DeviceError when camera or servo fail, InputError when `out` holds another board or cannot be written.
    """
    note_board(out)
    counts = {}
    for nominal in nominal_m:
        folder = out.at(nominal)
        counts[folder.path.name] = await _one_baseline(session, folder, nominal, wanted, show)
    return counts


async def capture_visits(
    session: RigSession, out: BoardFolder, nominal_m: Sequence[float], visits: int, show: Show
) -> dict[str, int]:
    """Visit all baselines `visits` times and take one pair of a fixed board each time; raises as `capture_boards`."""
    note_board(out)
    counts: dict[str, int] = {}
    for _ in range(visits):
        for nominal in nominal_m:
            folder = out.at(nominal)
            counts[folder.path.name] = await _one_visit(session, folder, nominal, show)
    return counts


def note_board(out: BoardFolder) -> None:
    """Write board.yaml; raises InputError when the folder holds pictures of another board or cannot be written."""
    board = out.board
    content = {"board": board.label, "square_mm": board.square_m * 1e3}
    if board.kind == "charuco":
        content["marker_mm"] = board.square_m * board.marker_share * 1e3
    path = out.path / "board.yaml"
    try:
        out.path.mkdir(parents=True, exist_ok=True)
        known = parse_yaml(read_text(path), str(path))[0] if path.is_file() else content
    except OSError as error:
        raise InputError(f"{out.path}: cannot be written ({error.strerror}); name another folder.") from None
    if not isinstance(known, dict) or {key: known.get(key) for key in content} != content:
        raise InputError(f"{path}: describes another board; name a new folder or give the same board.")
    path.write_text(yaml.safe_dump({**known, **content}, sort_keys=False), encoding="utf-8")


async def _one_baseline(session: RigSession, folder: BoardFolder, nominal_m: float, wanted: int, show: Show) -> int:
    number = _last_number(folder.path)
    if number >= wanted:
        return number
    await session.place(nominal_m)
    guide: CaptureGuide | None = None
    while number < wanted:
        pair = await session.pair()
        guide = guide or CaptureGuide(folder.board, (pair.left.shape[1], pair.left.shape[0]), wanted - number)
        hint = guide.consider(pair.left, pair.right)
        if hint.kept:
            number += 1
            write_pair(folder.path, number, pair)
        show(CaptureStatus(nominal_m, guide, hint))
    return number


async def _one_visit(session: RigSession, folder: BoardFolder, nominal_m: float, show: Show) -> int:
    await session.place(nominal_m)
    number = _last_number(folder.path)
    while True:
        pair = await session.pair()
        guide = CaptureGuide(folder.board, (pair.left.shape[1], pair.left.shape[0]), 1)
        guide.consider(pair.left, pair.right)
        again = await session.pair()
        hint = guide.consider(again.left, again.right)
        show(CaptureStatus(nominal_m, guide, hint))
        if hint.kept:
            write_pair(folder.path, number + 1, again)
            return number + 1


def write_pair(folder: Path, number: int, pair: RawPair) -> None:
    """Write a raw pair as left and right PNG files with a number, each through a temporary file.

    Raises InputError when the folder cannot be written.
    """
    try:
        folder.mkdir(exist_ok=True)
        for side, image in (("left", pair.left), ("right", pair.right)):
            temporary = folder / f".{side}.part.png"
            cv2.imwrite(str(temporary), image)
            temporary.replace(folder / f"{side}{number:02d}.png")
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written ({error.strerror}); free some space and run the command again."
        ) from None


def _last_number(folder: Path) -> int:
    """Return the highest number of a complete pair in the folder, 0 for none."""
    names = {path.name for path in folder.glob("*.png")} if folder.is_dir() else set()
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"left(\d+)\.png", name))]
    return max((number for number in numbers if f"right{number:02d}.png" in names), default=0)
