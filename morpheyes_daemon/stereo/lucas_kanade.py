"""Points followed from one image to another, by Lucas and Kanade's method on image pyramids (Bouguet 2001)."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.transforms import Array


def follow(
    first: Image,
    second: Image,
    uv: Array,
    guess: Array,
    *,
    window_px: int,
    levels: int,
    least_texture: float = 1e-4,
    rounds: int = 30,
    return_px: float | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Return where points (n, 2) of the first grey image are in the second, beginning at `guess`, and which were found.

    `levels` halvings of the images beside themselves; `least_texture` is the smallest eigenvalue of a window's
    gradients, per pixel, below which a point is not found; `rounds` of improvement on each level at most. With
    `return_px` only those count as found that the way back leads home to within so much.
    """
    step = partial(
        cv2.calcOpticalFlowPyrLK,
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, rounds, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=least_texture,
    )
    points = _points(uv)
    there, status, _ = step(first, second, points, _points(guess))
    found, good = there.reshape(-1, 2), status.ravel() == 1
    if return_px is not None:
        back, status, _ = step(second, first, there, points.copy())
        off = np.abs(back.reshape(-1, 2) - uv).max(axis=1, initial=0.0)
        good &= (status.ravel() == 1) & (off < return_px)
    return found.astype(np.float64), good


def _points(uv: Array) -> NDArray[np.float32]:
    """Return pixels (n, 2) as OpenCV takes them; a copy, since it writes the result over a guess."""
    return np.array(uv, dtype=np.float32).reshape(-1, 1, 2)
