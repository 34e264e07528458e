"""Where in the image boards were seen, how near and how tilted: what a calibration can have learned at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.transforms import Array

CELLS = (8, 6)
"""Cells of the coverage map, columns and rows."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Corners counted per image cell (rows, columns) of each camera, and the share of cells with any."""

    left: NDArray[np.int64]
    right: NDArray[np.int64]

    @property
    def share(self) -> float:
        """Share of cells that hold corners, in the camera that has fewer."""
        return float(min(np.mean(self.left > 0), np.mean(self.right > 0)))


def coverage(observations: Observations) -> Coverage:
    """Return where both cameras saw corners over all views."""
    size = observations.size
    return Coverage(count_cells(observations.left, size), count_cells(observations.right, size))


def count_cells(pixels: Array, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return how many of the pixels (..., 2) fall in each cell (rows, columns); NaN falls in none."""
    flat = pixels.reshape(-1, 2)
    column, row = cell_of(flat[np.isfinite(flat[:, 0])], size)
    counts = np.zeros((CELLS[1], CELLS[0]), dtype=np.int64)
    np.add.at(counts, (row, column), 1)
    return counts


def cell_of(pixels: Array, size: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the column and row of the cell that each pixel (n, 2) is in."""
    place = (pixels + 0.5) / np.array(size) * np.array(CELLS)
    column = np.clip(place[:, 0].astype(np.intp), 0, CELLS[0] - 1)
    row = np.clip(place[:, 1].astype(np.intp), 0, CELLS[1] - 1)
    return column, row


def empty_corners(counts: NDArray[np.int64]) -> list[str]:
    """Return which corners of the image (two by two cells each) hold no corner of a board."""
    places = {
        "top left": counts[:2, :2],
        "top right": counts[:2, -2:],
        "bottom left": counts[-2:, :2],
        "bottom right": counts[-2:, -2:],
    }
    return [name for name, cells in places.items() if cells.sum() == 0]
