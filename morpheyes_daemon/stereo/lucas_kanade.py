"""Points followed from one image to another, by Lucas and Kanade's method on image pyramids (Bouguet 2001)."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages import Image
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
    step = partial(_step, window_px=window_px, levels=levels, least_texture=least_texture, rounds=rounds)
    found, good = step(first, second, uv, guess)
    if return_px is not None:
        back, home = step(second, first, found, uv)
        good &= home & (np.abs(back - uv).max(axis=1, initial=0.0) < return_px)
    return found, good


def _step(
    first: Image,
    second: Image,
    uv: Array,
    guess: Array,
    window_px: int,
    levels: int,
    least_texture: float,
    rounds: int,
) -> tuple[Array, NDArray[np.bool_]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        np.ascontiguousarray(uv, dtype=np.float32).reshape(-1, 1, 2),
        np.array(guess, dtype=np.float32).reshape(-1, 1, 2),
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, rounds, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=least_texture,
    )
    return np.asarray(found, dtype=np.float64).reshape(-1, 2), np.asarray(status).ravel() == 1
