"""Coverage of the image by board corners: where a lens model is determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.transforms import Array

CELLS = (8, 6)
"""Columns and rows of the coverage map; chosen: a cell of 80 px at 640x480, about three squares of a board."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Number of corners per cell (rows, columns) in the image of each camera."""

    left: NDArray[np.int64]
    right: NDArray[np.int64]

    @property
    def share(self) -> float:
        """Fraction of cells with corners, of the camera with fewer."""
        return float(min(np.mean(self.left > 0), np.mean(self.right > 0)))


def coverage(observations: Observations) -> Coverage:
    """Return the coverage of both cameras over all views."""
    size = observations.size
    return Coverage(count_cells(observations.left, size), count_cells(observations.right, size))


def count_cells(pixels: Array, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number of pixels (..., 2) in each cell (rows, columns) of an image of `size` (w, h); NaN in none."""
    flat = pixels.reshape(-1, 2)
    column, row = cell_of(flat[np.isfinite(flat[:, 0])], size)
    counts = np.zeros((CELLS[1], CELLS[0]), dtype=np.int64)
    np.add.at(counts, (row, column), 1)
    return counts


def cell_of(pixels: Array, size: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the column (n,) and row (n,) of the cell of each pixel (n, 2) in an image of `size` (w, h)."""
    place = (pixels + 0.5) / np.array(size) * np.array(CELLS)
    column = np.clip(place[:, 0].astype(np.intp), 0, CELLS[0] - 1)
    row = np.clip(place[:, 1].astype(np.intp), 0, CELLS[1] - 1)
    return column, row


def empty_corners(counts: NDArray[np.int64]) -> list[str]:
    """Return the names of the image corners (two by two cells of `counts` (rows, columns)) without board corners."""
    places = {
        "top left": counts[:2, :2],
        "top right": counts[:2, -2:],
        "bottom left": counts[-2:, :2],
        "bottom right": counts[-2:, -2:],
    }
    return [name for name, cells in places.items() if cells.sum() == 0]
