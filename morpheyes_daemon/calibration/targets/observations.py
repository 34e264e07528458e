"""The corners of one board in many stereo views at many baselines: the input of a solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.transforms import Array


@dataclass(frozen=True, eq=False)
class Observations:
    """Corners of one board seen by both cameras in V views at M baselines.

    `left`, `right` (V, N, 2) are pixels, NaN where that camera did not see the corner; `baseline` (V,) indexes
    `nominal_m` (M,), which is increasing (NaN for a fixed rig of unknown baseline); `names` are the files of each view.
    `problems` are sentences on pictures left out, `lost` those on whole baselines.
    """

    board: Board
    size: tuple[int, int]
    nominal_m: Array
    baseline: NDArray[np.intp]
    names: tuple[tuple[str, str], ...]
    left: Array
    right: Array
    problems: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()

    @property
    def view_count(self) -> int:
        """V, the number of views."""
        return len(self.baseline)

    def subset(self, keep: NDArray[np.bool_]) -> Observations:
        """Return the views with a True in `keep` (V,); baselines keep their indices."""
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
            self.lost,
        )

    def at_baselines(self, chosen: list[int]) -> Observations:
        """Return the views of the baselines with the indices `chosen`, which are renumbered from 0."""
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
            self.lost,
        )
