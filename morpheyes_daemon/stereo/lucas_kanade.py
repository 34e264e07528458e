"""Sparse point tracking between two images: Lucas and Kanade's method on image pyramids.

OpenCV's implementation (Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", 2001), with
an optional forward-backward check.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Image, Mask
from morpheyes_daemon.transforms import Array

_STEP_PX = 0.01
"""Step in pixels below which a point has converged; chosen: smaller costs iterations."""


@dataclass(frozen=True, slots=True)
class LucasKanade:
    """A tracker: side of the window in pixels, and number of pyramid levels besides the full image."""

    window_px: int
    levels: int
    min_eigenvalue: float = 1e-4
    """Smallest eigenvalue of the gradient matrix, per pixel of the window, from which a point counts as found."""
    iterations: int = 30
    """Most iterations on each level."""
    return_px: float | None = None
    """Largest error in pixels of tracking back to the first image (forward-backward check); None: not checked."""

    def track(self, first: Image, second: Image, uv: Array, guess: Array) -> tuple[Array, Mask]:
        """Return the pixels (n, 2) in `second` of the points `uv` (n, 2) of `first`, and which (n,) were found.

        Both images are grey (H, W) uint8; the search begins at the pixels `guess` (n, 2).
        """
        step = partial(
            cv2.calcOpticalFlowPyrLK,
            winSize=(self.window_px, self.window_px),
            maxLevel=self.levels,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, self.iterations, _STEP_PX),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=self.min_eigenvalue,
        )
        points = _points(uv)
        there, status, _ = step(first, second, points, _points(guess))
        found, good = there.reshape(-1, 2), status.ravel() == 1
        if self.return_px is not None:
            back, status, _ = step(second, first, there, points.copy())
            error_px = np.abs(back.reshape(-1, 2) - uv).max(axis=1, initial=0.0)
            good &= (status.ravel() == 1) & (error_px < self.return_px)
        return found.astype(np.float64), good


def _points(uv: Array) -> NDArray[np.float32]:
    """Return pixels (n, 2) as OpenCV takes them; a copy, since it writes the result over a guess."""
    return np.array(uv, dtype=np.float32).reshape(-1, 1, 2)
