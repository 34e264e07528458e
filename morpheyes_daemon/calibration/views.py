"""Reading a folder of board pictures: which files belong together, and the corners seen in them.

One sub-folder per baseline, named by its length (`100mm`, `122.2mm`), or a folder of pictures alone for a fixed
rig. A picture that cannot be used is named with a remedy and left out; the rest is kept. Detected corners are
remembered in a file beside the result, so a second run over the same pictures starts at once.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from morpheyes_daemon.calibration.boards import Board, aligned, find_corners
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages import Image
from morpheyes_daemon.transforms import Array

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}
_SIDE_BY_SIDE_ASPECT = 1.9
"""Width over height from which a picture must hold both eyes."""
_FEWEST_VIEWS = 3
"""Views of the board below which one baseline alone says too little to be of use."""

Progress = Callable[[str, int, int], None]
"""Told what is being done, how much is done, and of how much."""


def silent(_what: str, _done: int, _total: int) -> None:
    """Show no progress."""


@dataclass(frozen=True)
class PairFiles:
    """The files of one stereo picture; one path twice means side by side, None that this eye is missing."""

    left: Path | None
    right: Path | None

    @property
    def side_by_side(self) -> bool:
        """Both eyes are in one file."""
        return self.left is not None and self.left == self.right


@dataclass(frozen=True)
class BaselineFolder:
    """The pictures taken at one baseline; `nominal_m` is None for a fixed rig whose folder names no length."""

    nominal_m: float | None
    folder: Path
    pairs: tuple[PairFiles, ...]


@dataclass(frozen=True, eq=False)
class Observations:
    """Corners of one board seen by both eyes in V views at M baselines.

    `left`, `right` (V, N, 2) are pixels, NaN where that eye did not see the corner; `baseline` (V,) counts into
    `nominal_m` (M,), which grows (NaN for a fixed rig of unknown length); `names` are the file names of each view.
    """

    board: Board
    size: tuple[int, int]
    nominal_m: Array
    baseline: np.ndarray[tuple[int], np.dtype[np.intp]]
    names: tuple[tuple[str, str], ...]
    left: Array
    right: Array
    problems: tuple[str, ...] = ()

    @property
    def view_count(self) -> int:
        """V, the number of views."""
        return len(self.baseline)

    def subset(self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Observations:
        """Return the chosen views (V,) only; baselines keep their numbers."""
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        return Observations(
            self.board,
            self.size,
            self.nominal_m,
            self.baseline[keep],
            names,
            self.left[keep],
            self.right[keep],
            self.problems,
        )

    def at_baselines(self, chosen: list[int]) -> Observations:
        """Return only the views of the chosen baselines, which are numbered anew."""
        kept = self.subset(np.isin(self.baseline, chosen))
        renumbered = np.searchsorted(np.array(chosen), kept.baseline)
        return Observations(
            self.board,
            self.size,
            self.nominal_m[chosen],
            renumbered,
            kept.names,
            kept.left,
            kept.right,
            self.problems,
        )


def read_folder(root: Path) -> tuple[list[BaselineFolder], list[str]]:
    """Return the baseline folders under `root` in growing order, and a sentence on everything left out.

    Raises InputError when there is nothing to calibrate from, or two folders claim the same baseline.
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


def nominal_from_name(path: Path) -> float | None:
    """Return the baseline in metres that a folder's name tells, None when it is no such folder."""
    return _length_m(path.name) if path.is_dir() else None


def observe(
    folders: list[BaselineFolder],
    board: Board,
    cache: CornerCache | None = None,
    progress: Progress = silent,
    problems: list[str] | None = None,
) -> Observations:
    """Find the board in every picture; what cannot be used is named in the result's `problems`.

    Raises InputError when no baseline is left with enough views.
    """
    notes = [] if problems is None else problems
    jobs = [(number, pair) for number, folder in enumerate(folders) for pair in folder.pairs]
    seen = list(_detect(jobs, board, cache or CornerCache(None), progress))
    size = _common_size(seen, notes)
    views = [view for view in seen if view.size == size and view.found]
    _note_blind(folders, seen, views, board, notes)
    return _assembled(folders, board, size, views, notes)


@dataclass
class CornerCache:
    """Corners found before, by content of the picture and board; `path` None remembers nothing."""

    path: Path | None
    found: dict[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path is None or not self.path.exists():
            return
        try:
            with np.load(self.path) as stored:
                self.found = {key: stored[key] for key in stored.files}
        except (OSError, ValueError, EOFError, KeyError):
            self.found = {}

    def save(self) -> None:
        """Write what is known; a place that cannot be written only costs the next run its time."""
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


def _length_m(name: str) -> float | None:
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?mm", name.strip().lower())
    return float(match[1]) / 1e3 if match and float(match[1]) > 0 else None


def _refuse_duplicates(named: list[tuple[float, Path]]) -> None:
    by_length: dict[int, Path] = {}
    for length, path in named:
        twin = by_length.setdefault(round(length * 1e5), path)
        if twin != path:
            raise InputError(
                f"{path}: claims the same baseline as {twin.name}; keep one of them, or rename it to its own length."
            )


def _baseline_folder(folder: Path, nominal_m: float | None, problems: list[str]) -> BaselineFolder:
    files = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in IMAGE_SUFFIXES)
    sided = [path for path in files if path.name.lower().startswith(("left", "right"))]
    pairs = _left_right(sided, problems) if sided else _side_by_side(files)
    if not pairs:
        problems.append(f"{folder}: holds no stereo pictures; take them at this baseline, or remove the folder.")
    elif all(pair.right is None for pair in pairs) or all(pair.left is None for pair in pairs):
        eye = "right" if pairs[0].right is None else "left"
        raise InputError(f"{folder}: has no {eye} picture at all; copy the {eye}*.png files there.")
    return BaselineFolder(nominal_m, folder, tuple(pairs))


def _left_right(files: list[Path], problems: list[str]) -> list[PairFiles]:
    eyes: dict[str, dict[int, Path]] = {"left": {}, "right": {}}
    for path in files:
        eye = "left" if path.name.lower().startswith("left") else "right"
        number = int(digits[-1]) if (digits := re.findall(r"\d+", path.stem)) else -1
        if number in eyes[eye]:
            problems.append(f"{path}: has the same number as {eyes[eye][number].name} and is left out; renumber it.")
            continue
        eyes[eye][number] = path
    pairs = []
    for number in sorted(eyes["left"].keys() | eyes["right"].keys()):
        left, right = eyes["left"].get(number), eyes["right"].get(number)
        if left is None or right is None:
            alone, other = (left, "right") if right is None else (right, "left")
            problems.append(f"{alone}: has no {other} picture of the same number; copy it there or retake the pair.")
        pairs.append(PairFiles(left, right))
    return pairs


def _side_by_side(files: list[Path]) -> list[PairFiles]:
    pairs = []
    for path in files:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is not None and image.shape[1] >= _SIDE_BY_SIDE_ASPECT * image.shape[0]:
            pairs.append(PairFiles(path, path))
    return pairs


def _detect(
    jobs: list[tuple[int, PairFiles]], board: Board, cache: CornerCache, progress: Progress
) -> Iterator[_View]:
    """Yield the views in order; two threads, since OpenCV leaves the interpreter while it looks."""
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 1) as pool:
        for done, view in enumerate(pool.map(lambda job: _see(job[0], job[1], board, cache), jobs), start=1):
            progress("looking for the board", done, len(jobs))
            yield view
    cache.save()


def _see(baseline: int, pair: PairFiles, board: Board, cache: CornerCache) -> _View:
    found: dict[str, Array | None] = {"left": None, "right": None}
    sizes = []
    for eye, path in (("left", pair.left), ("right", pair.right)):
        if path is None:
            continue
        half = eye if pair.side_by_side else ""
        corners, size, problem = _corners_in(path, half, board, cache)
        if problem:
            return _View(baseline, pair, None, None, None, problem)
        found[eye] = corners
        sizes.append((size, path))
    if len({size for size, _ in sizes}) > 1:
        (a, _), (b, path) = sizes
        text = f"{path}: is {b[0]}x{b[1]} px but its left eye {a[0]}x{a[1]}; take the pair again at one size."
        return _View(baseline, pair, None, None, None, text)
    left, right = found["left"], found["right"]
    if left is not None and right is not None:
        right = aligned(left, right, board)
    return _View(baseline, pair, sizes[0][0], left, right)


def _corners_in(
    path: Path, half: str, board: Board, cache: CornerCache
) -> tuple[Array | None, tuple[int, int], str | None]:
    """Return the corners, the size of one eye's picture, and a sentence when it cannot be read."""
    try:
        content = path.read_bytes()
    except OSError as error:
        return None, (0, 0), f"{path}: cannot be read ({error.strerror}); copy it again or remove it."
    key = hashlib.sha256(content + f"{board.label}{half}".encode()).hexdigest()
    if key in cache.found:
        stored = cache.found[key]
        size = (int(stored[-1, 0]), int(stored[-1, 1]))
        return (stored[:-1] if len(stored) > 1 else None), size, None
    image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_GRAYSCALE) if content else None
    if image is None:
        return None, (0, 0), f"{path}: is not a readable picture; copy it again or remove it."
    eye = _half(np.asarray(image, dtype=np.uint8), half)
    size = (eye.shape[1], eye.shape[0])
    corners = find_corners(eye, board)
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


def _note_blind(
    folders: list[BaselineFolder], seen: list[_View], views: list[_View], board: Board, problems: list[str]
) -> None:
    for view in seen:
        if view.size is not None and not view.found:
            path = view.pair.left or view.pair.right
            problems.append(f"{path}: no {board.label} board is found; retake it, the whole board sharp and lit.")
    counts = Counter(view.baseline for view in views if view.left is not None and view.right is not None)
    for number, folder in enumerate(folders):
        if counts[number] < _FEWEST_VIEWS:
            problems.append(
                f"{folder.folder}: the {board.label} board is found in only {counts[number]} pairs; this baseline is "
                "left out, check --board and take at least ten pairs there."
            )


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
    )


def _names(view: _View, root: Path) -> tuple[str, str]:
    left, right = (
        str(path.relative_to(root)) if path is not None else "" for path in (view.pair.left, view.pair.right)
    )
    return (f"{left} (left half)", f"{right} (right half)") if view.pair.side_by_side else (left, right)
