"""Grouping of the files of a folder: one sub-folder per baseline, left and right by name and number.

Sub-folders are named `100mm`, `122.2mm` and so on; a folder of pictures alone is a fixed rig. Side-by-side pictures
are recognized by their aspect ratio. Unusable files are named with a remedy and left out. Boards are not searched here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.stereo.image_files import read_picture

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}
_SIDE_BY_SIDE_ASPECT = 1.9
"""Aspect ratio from which a picture is side by side; chosen: twice 4:3 is 2.67, a single 16:9 picture 1.78."""


@dataclass(frozen=True)
class PairFiles:
    """The files of one stereo pair; the same path twice for a side-by-side picture, None for a missing one."""

    left: Path | None
    right: Path | None

    @property
    def side_by_side(self) -> bool:
        """Whether both images are in one file."""
        return self.left is not None and self.left == self.right


@dataclass(frozen=True)
class BaselineFolder:
    """The pictures of one baseline; `nominal_m` is None for a fixed rig whose folder names no baseline."""

    nominal_m: float | None
    folder: Path
    pairs: tuple[PairFiles, ...]


def read_folder(root: Path) -> tuple[list[BaselineFolder], list[str]]:
    """Return the baseline folders under `root`, sorted by baseline, and a sentence on everything left out.

    Raises InputError when there are no pairs, a camera has no picture, or two folders have the same baseline.
    """
    if not root.is_dir():
        raise InputError(f"{root}: is not a folder; give the folder that holds the board pictures.")
    named = [(length, path) for path in sorted(root.iterdir()) if (length := nominal_from_name(path)) is not None]
    _refuse_duplicates(named)
    problems: list[str] = []
    if named:
        folders = [_baseline_folder(path, length, problems) for length, path in sorted(named)]
    else:
        folders = [_baseline_folder(root, _length_m(root.name), problems)]
    usable = [folder for folder in folders if folder.pairs]
    if not usable:
        raise InputError(
            f"{root}: holds no left/right or side-by-side pictures; put them in one folder per baseline such as "
            "100mm, named left01.png, right01.png and so on."
        )
    return usable, problems


def read_pair(files: PairFiles) -> tuple[Image, Image]:
    """Return both images (H, W, 3) BGR of a pair; raises InputError naming the file that cannot be read."""
    pictures = []
    for path in (files.left, files.right):
        if path is None:
            raise InputError(f"{files.left or files.right}: the other camera's picture is missing; copy or remove it.")
        pictures.append(read_picture(path))
    if not files.side_by_side:
        return pictures[0], pictures[1]
    middle = pictures[0].shape[1] // 2
    return pictures[0][:, :middle].copy(), pictures[0][:, middle : 2 * middle].copy()


def nominal_from_name(path: Path) -> float | None:
    """Return the baseline in metres of a folder named like `100mm`, None for any other path."""
    return _length_m(path.name) if path.is_dir() else None


def _length_m(name: str) -> float | None:
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?mm", name.strip().lower())
    return float(match[1]) / 1e3 if match and float(match[1]) > 0 else None


def _refuse_duplicates(named: list[tuple[float, Path]]) -> None:
    by_length: dict[int, Path] = {}
    for length, path in named:
        twin = by_length.setdefault(round(length * 1e5), path)
        if twin != path:
            raise InputError(
                f"{path}: has the same baseline as {twin.name}; keep one of them, or rename it to its own baseline."
            )


def _baseline_folder(folder: Path, nominal_m: float | None, problems: list[str]) -> BaselineFolder:
    files = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in IMAGE_SUFFIXES)
    sided = [path for path in files if path.name.lower().startswith(("left", "right"))]
    pairs = _left_right(sided, problems) if sided else _side_by_side(files)
    if not pairs:
        problems.append(f"{folder}: holds no stereo pictures; take them at this baseline, or remove the folder.")
    elif all(pair.right is None for pair in pairs) or all(pair.left is None for pair in pairs):
        side = "right" if pairs[0].right is None else "left"
        raise InputError(f"{folder}: has no {side} picture at all; copy the {side}*.png files there.")
    return BaselineFolder(nominal_m, folder, tuple(pairs))


def _left_right(files: list[Path], problems: list[str]) -> list[PairFiles]:
    found: dict[str, dict[int, Path]] = {"left": {}, "right": {}}
    for path in files:
        side = "left" if path.name.lower().startswith("left") else "right"
        number = int(digits[-1]) if (digits := re.findall(r"\d+", path.stem)) else -1
        if number in found[side]:
            problems.append(f"{path}: has the same number as {found[side][number].name} and is left out; renumber it.")
            continue
        found[side][number] = path
    pairs = []
    for number in sorted(found["left"].keys() | found["right"].keys()):
        left, right = found["left"].get(number), found["right"].get(number)
        if left is None or right is None:
            alone, other = (left, "right") if right is None else (right, "left")
            problems.append(f"{alone}: has no {other} picture of the same number; copy it there or retake the pair.")
        pairs.append(PairFiles(left, right))
    return pairs


def _side_by_side(files: list[Path]) -> list[PairFiles]:
    pairs = []
    for path in files:
        try:
            height, width = read_picture(path, cv2.IMREAD_GRAYSCALE).shape
        except InputError:
            continue
        if width >= _SIDE_BY_SIDE_ASPECT * height:
            pairs.append(PairFiles(path, path))
    return pairs
