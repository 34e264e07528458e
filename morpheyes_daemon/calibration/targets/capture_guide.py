"""Guidance of a person with a board: selects the pairs to keep, and advises where to hold the board next.

A pair is kept when both cameras see the board, the board is still, and the pair adds other parts of the image, another
distance or another tilt. Pictures are taken by `rig_capture`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.targets.boards import Board, aligned, find_corners, spacing_px
from morpheyes_daemon.calibration.targets.coverage import CELLS, cell_of, count_cells, empty_corners
from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.transforms import Array

BASELINE_VIEWS = 12
"""Pairs that complete a baseline; chosen: more take longer, fewer leave gaps in the coverage."""

_STILL_PX = 0.7
"""Largest motion of a corner between two frames, pixels; chosen: more blurs, and the cameras are not synchronous."""
_NEW_CELLS = 3
"""Newly covered cells that make a pair worth keeping."""
_NEW_DISTANCE, _NEW_SHIFT_SQUARES, _NEW_TILT = 1.2, 3.0, 0.12
"""Ratio of the square sizes, shift in squares, and difference of log side ratios (`_Seen.tilt`) by which a view differs
from the kept ones; all chosen: smaller ones keep more redundant pairs."""
_FAR_SQUARE_PX, _NEAR_SHARE = 14.0, 0.55
"""Square in pixels that counts as far, and share of the largest possible square that counts as near; chosen: the lens
and the scale need both ends."""
_ADVICE_FROM = 2
"""Kept pairs from which empty corners of the image are named."""


@dataclass(frozen=True)
class Hint:
    """Result of one pair: whether it is kept, and the advice to the person."""

    kept: bool
    text: str


@dataclass(frozen=True, eq=False)
class _Seen:
    """One detected board: corners (n, 2) in both images, mean square in pixels, and `tilt` (3,), the logarithms of the
    ratios of its opposite sides and of its axes."""

    left: Array
    right: Array
    square_px: float
    tilt: Array


@dataclass
class CaptureGuide:
    """Selects pairs at one baseline until `wanted` are kept; `size` (w, h) of the images in pixels."""

    board: Board
    size: tuple[int, int]
    wanted: int = BASELINE_VIEWS
    _kept: list[_Seen] = field(default_factory=list)
    _last: Array | None = None

    @property
    def kept(self) -> int:
        """Number of pairs kept."""
        return len(self._kept)

    @property
    def complete(self) -> bool:
        """Whether enough pairs are kept."""
        return self.kept >= self.wanted

    def covered(self, side: int) -> NDArray[np.int64]:
        """Return the number of kept corners per cell (rows, columns) of the left (0) or right (1) image."""
        pixels = [(one.left, one.right)[side] for one in self._kept]
        return count_cells(np.array(pixels), self.size) if pixels else np.zeros(CELLS[::-1], dtype=np.int64)

    def consider(self, left: Image, right: Image) -> Hint:
        """Evaluate one raw pair (H, W) or (H, W, 3) and keep it when it adds information."""
        seen_left, seen_right = find_corners(left, self.board), find_corners(right, self.board)
        if seen_left is None or seen_right is None:
            self._last = None
            return Hint(False, self._no_board_text(seen_left is not None, seen_right is not None))
        still = self._last is not None and float(np.nanmax(np.abs(seen_left - self._last))) < _STILL_PX
        self._last = seen_left
        if not still:
            return Hint(False, "hold the board still")
        seen = _describe(seen_left, aligned(seen_left, seen_right, self.board), self.board)
        if not self._adds_information(seen):
            return Hint(False, self.advice())
        self._kept.append(seen)
        return Hint(True, "kept" if not self.complete else "kept; this baseline is complete")

    def advice(self) -> str:
        """Return where to hold the board next."""
        for side, name in ((0, "left"), (1, "right")):
            empty = empty_corners(self.covered(side))
            if self.kept >= _ADVICE_FROM and empty:
                return f"move the board to the {empty[0]} of the {name} picture"
        squares = [one.square_px for one in self._kept]
        width = self.size[0] / (self.board.columns + 1)
        if squares and max(squares) < _NEAR_SHARE * width:
            return "bring the board nearer"
        if squares and min(squares) > _FAR_SQUARE_PX:
            return "take the board farther away"
        return "tilt the board differently or move it to a new place"

    def _no_board_text(self, left: bool, right: bool) -> str:
        if left or right:
            return f"only the {'left' if left else 'right'} camera sees the complete board"
        return "no board is found"

    def _adds_information(self, seen: _Seen) -> bool:
        if not self._kept:
            return True
        if _new_cells(seen.left, self.covered(0), self.size) >= _NEW_CELLS:
            return True
        if _new_cells(seen.right, self.covered(1), self.size) >= _NEW_CELLS:
            return True
        return not any(_similar(seen, other) for other in self._kept)


def _describe(left: Array, right: Array, board: Board) -> _Seen:
    grid = left.reshape(board.rows, board.columns, 2)
    down = np.linalg.norm(np.diff(grid, axis=0), axis=-1)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    half_row, half_column = board.rows // 2, board.columns // 2
    tilt = [
        np.log(np.nanmean(along[:half_row]) / np.nanmean(along[half_row:])),
        np.log(np.nanmean(down[:, :half_column]) / np.nanmean(down[:, half_column:])),
        np.log(np.nanmean(along) / np.nanmean(down)),
    ]
    return _Seen(left, right, float(np.nanmean(spacing_px(left, board))), np.array(tilt))


def _similar(one: _Seen, other: _Seen) -> bool:
    near = 1 / _NEW_DISTANCE < one.square_px / other.square_px < _NEW_DISTANCE
    moved = float(np.linalg.norm(np.nanmean(one.left - other.left, axis=0)))
    return bool(
        near and moved < _NEW_SHIFT_SQUARES * one.square_px and np.all(np.abs(one.tilt - other.tilt) < _NEW_TILT)
    )


def _new_cells(pixels: Array, counts: NDArray[np.int64], size: tuple[int, int]) -> int:
    column, row = cell_of(pixels[np.isfinite(pixels[:, 0])], size)
    return len({(int(r), int(c)) for r, c in zip(row, column, strict=True) if counts[r, c] == 0})
