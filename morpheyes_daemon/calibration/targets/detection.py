"""Detection of the board in every picture of a folder: views with corners, and a sentence on each picture without.

An unusable picture is named with a remedy and left out. Corners are cached in a file beside the result, so a second
run over the same pictures is fast.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from morpheyes_daemon.calibration.targets.boards import Board, aligned, find_corners
from morpheyes_daemon.calibration.targets.image_pairs import BaselineFolder, PairFiles
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.stereo.image_files import decode_picture
from morpheyes_daemon.transforms import Array

_FEWEST_VIEWS = 3
"""Stereo views below which a baseline is left out; chosen: fewer poses hardly average the noise of its extrinsics."""


def observe(
    folders: list[BaselineFolder],
    board: Board,
    cache: CornerCache | None = None,
    progress: Progress = silent,
    problems: list[str] | None = None,
) -> Observations:
    """Return the corners of `board` in every picture; unusable pictures are named in the result's `problems`.

    Raises InputError when no picture can be read or no baseline has enough views.
    """
    notes = [] if problems is None else problems
    jobs = [(number, pair) for number, folder in enumerate(folders) for pair in folder.pairs]
    seen = list(_detect(jobs, board, cache or CornerCache(None), progress))
    size = _common_size(seen, notes)
    views = [view for view in seen if view.size == size and view.found]
    _note_missing_boards(seen, board, notes)
    return _assembled(folders, board, size, views, notes)


@dataclass
class CornerCache:
    """Corners (n, 2) by hash of picture and board; stored in the file `path`, None for none."""

    path: Path | None
    found: dict[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path is None or not self.path.exists():
            return
        try:
            with np.load(self.path) as stored:
                self.found = {key: stored[key] for key in stored.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            self.found = {}

    def save(self) -> None:
        """Write the cache; a failure is ignored, since it only slows the next run."""
        if self.path is None:
            return
        temporary = self.path.with_name(self.path.name + ".part")
        try:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, **self.found)  # type: ignore[arg-type]
            os.replace(temporary, self.path)
        except OSError:
            temporary.unlink(missing_ok=True)


@dataclass(frozen=True, eq=False)
class _View:
    baseline: int
    pair: PairFiles
    size: tuple[int, int] | None
    left: Array | None
    right: Array | None
    problem: str | None = None

    @property
    def found(self) -> bool:
        return self.left is not None or self.right is not None


def _detect(jobs: list[tuple[int, PairFiles]], board: Board, cache: CornerCache, progress: Progress) -> Iterator[_View]:
    """Yield the views in order; in threads, since OpenCV releases the interpreter lock."""
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 1) as pool:
        for done, view in enumerate(pool.map(lambda job: _detect_pair(job[0], job[1], board, cache), jobs), start=1):
            progress("looking for the board", done, len(jobs))
            yield view
    cache.save()


def _detect_pair(baseline: int, pair: PairFiles, board: Board, cache: CornerCache) -> _View:
    found: dict[str, Array | None] = {"left": None, "right": None}
    sizes = []
    for side, path in (("left", pair.left), ("right", pair.right)):
        if path is None:
            continue
        half = side if pair.side_by_side else ""
        corners, size, problem = _corners_in(path, half, board, cache)
        if problem:
            return _View(baseline, pair, None, None, None, problem)
        found[side] = corners
        sizes.append((size, path))
    if len({size for size, _ in sizes}) > 1:
        (a, _), (b, path) = sizes
        text = f"{path}: is {b[0]}x{b[1]} px but its left picture {a[0]}x{a[1]}; take the pair again at one size."
        return _View(baseline, pair, None, None, None, text)
    left, right = found["left"], found["right"]
    if left is not None and right is not None:
        right = aligned(left, right, board)
    return _View(baseline, pair, sizes[0][0], left, right)


def _corners_in(
    path: Path, half: str, board: Board, cache: CornerCache
) -> tuple[Array | None, tuple[int, int], str | None]:
    """Return corners, size (w, h) of one camera's image, and a sentence when the picture cannot be read."""
    try:
        content = path.read_bytes()
    except OSError as error:
        return None, (0, 0), f"{path}: cannot be read ({error.strerror}); copy it again or remove it."
    key = hashlib.sha256(content + f"{board.label}{half}".encode()).hexdigest()
    if key in cache.found:
        stored = cache.found[key]
        size = (int(stored[-1, 0]), int(stored[-1, 1]))
        return (stored[:-1] if len(stored) > 1 else None), size, None
    try:
        picture = _half(decode_picture(content, str(path), cv2.IMREAD_GRAYSCALE), half)
    except InputError as error:
        return None, (0, 0), f"{error} Copy it again or remove it."
    size = (picture.shape[1], picture.shape[0])
    corners = find_corners(picture, board)
    cache.found[key] = np.vstack([np.empty((0, 2)) if corners is None else corners, [size]])
    return corners, size, None


def _half(image: Image, half: str) -> Image:
    middle = image.shape[1] // 2
    chosen = {"": image, "left": image[:, :middle], "right": image[:, middle : 2 * middle]}[half]
    return np.ascontiguousarray(chosen)


def _common_size(seen: list[_View], problems: list[str]) -> tuple[int, int]:
    sizes = Counter(view.size for view in seen if view.size is not None)
    if not sizes:
        first = next((view.problem for view in seen if view.problem), "There are no pictures.")
        raise InputError(first)
    size = sizes.most_common(1)[0][0]
    for view in seen:
        if view.problem:
            problems.append(view.problem)
        elif view.size is not None and view.size != size:
            problems.append(
                f"{view.pair.left or view.pair.right}: is {view.size[0]}x{view.size[1]} px where most are "
                f"{size[0]}x{size[1]} and is left out; take all pictures at one size."
            )
    assert size is not None
    return size


def _note_missing_boards(seen: list[_View], board: Board, problems: list[str]) -> None:
    for view in seen:
        if view.size is not None and not view.found:
            path = view.pair.left or view.pair.right
            problems.append(f"{path}: no {board.label} board is found; retake it with the complete board sharp and lit.")


def _assembled(
    folders: list[BaselineFolder],
    board: Board,
    size: tuple[int, int],
    views: list[_View],
    problems: list[str],
) -> Observations:
    counts = Counter(view.baseline for view in views if view.left is not None and view.right is not None)
    chosen = [number for number in range(len(folders)) if counts[number] >= _FEWEST_VIEWS]
    root = folders[0].folder if len(folders) == 1 else folders[0].folder.parent
    if not chosen:
        raise InputError(
            f"{root}: the {board.label} board is found in too few pictures ({len(views)}); check the number of inner "
            "corners given by --board."
        )
    lost = [
        f"{folder.folder}: the {board.label} board is found in only {counts[number]} pairs, so this baseline is left "
        "out; take at least ten pairs there."
        for number, folder in enumerate(folders)
        if number not in chosen
    ]
    kept = [view for view in views if view.baseline in chosen]
    unseen = np.full((board.corner_count, 2), np.nan)
    nominal = [folders[number].nominal_m for number in chosen]
    return Observations(
        board=board,
        size=size,
        nominal_m=np.array([np.nan if length is None else length for length in nominal]),
        baseline=np.array([chosen.index(view.baseline) for view in kept], dtype=np.intp),
        names=tuple(_names(view, root) for view in kept),
        left=np.array([unseen if view.left is None else view.left for view in kept]),
        right=np.array([unseen if view.right is None else view.right for view in kept]),
        problems=tuple(problems),
        lost=tuple(lost),
    )


def _names(view: _View, root: Path) -> tuple[str, str]:
    left, right = (str(path.relative_to(root)) if path is not None else "" for path in (view.pair.left, view.pair.right))
    return (f"{left} (left half)", f"{right} (right half)") if view.pair.side_by_side else (left, right)
