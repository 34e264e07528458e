"""Corners, and finding them again: in the next frame and in the other eye, to a fraction of a pixel.

Pyramidal Lucas-Kanade of OpenCV, started from where geometry expects the corner and checked by going back.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.stereo.lucas_kanade import LucasKanade
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.transforms import Array

Mask = NDArray[np.bool_]

WINDOW_PX = 13
LEVELS = 2
BACK_PX = 0.5
"""A corner that does not come back to within this was not found."""

ROW_PX = 1.2
"""Rows of a rectified pair agree to within this."""

QUALITY = 0.01

BLOCK_PX, FITS, NEAREST_M = 11, 0.85, 1.5
"""Of the search along the row: the block, the correlation that counts, and how near it looks."""

ROUNDS = 20


def corners(image: Image, count: int, spacing_px: float, free: NDArray[np.uint8] | None = None) -> Array:
    """Return up to `count` corners (N, 2) at least `spacing_px` apart where `free` (H, W) is not zero."""
    if count <= 0:
        return np.empty((0, 2))
    found = cv2.goodFeaturesToTrack(image, count, QUALITY, spacing_px, mask=free, blockSize=5)
    return np.empty((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)


def followed(before: Image, now: Image, uv: Array, guess: Array) -> tuple[Array, Mask]:
    """Return where pixels uv (N, 2) of `before` are in `now`, and which were found; NaN guesses start at uv."""
    if not len(uv):
        return np.empty((0, 2)), np.zeros(0, dtype=np.bool_)
    start = np.where(np.isfinite(guess), guess, uv)
    tracker = LucasKanade(WINDOW_PX, LEVELS, min_eigenvalue=1e-3, iterations=ROUNDS, return_px=BACK_PX)
    return tracker.track(before, now, uv, start)


def seen_by_both(frame: Frame, uv: Array, d_guess: Array) -> tuple[Array, Mask]:
    """Return the disparities (N,) of pixels uv (N, 2) of the left eye near `d_guess` (N,), and which were found."""
    guess = uv - np.stack([np.nan_to_num(d_guess), np.zeros(len(uv))], axis=1)
    there, good = followed(frame.left, frame.right, uv, guess)
    offset = uv - there
    good &= np.isfinite(d_guess) & (np.abs(offset[:, 1]) < ROW_PX) & (offset[:, 0] > 0.3)
    return offset[:, 0], good


def disparity_at(frame: Frame, uv: Array) -> Array:
    """Return the disparities (N,) that the depth map has around pixels uv (N, 2): the median of 3 by 3, NaN unknown."""
    column = np.clip(np.rint(uv[:, 0]).astype(np.intp), 1, frame.pinhole.width - 2)
    row = np.clip(np.rint(uv[:, 1]).astype(np.intp), 1, frame.pinhole.height - 2)
    around = np.stack([frame.depth_m[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=1)
    known = np.sort(around, axis=1)
    count = np.isfinite(around).sum(axis=1)
    middle = known[np.arange(len(uv)), np.maximum(count - 1, 0) // 2]
    return np.where(count >= 3, frame.bf_m_px / middle, np.nan)


def disparity_along_row(frame: Frame, uv: Array) -> Array:
    """Return the disparities (N,) at which a small block around pixels uv (N, 2) fits the right eye best.

    Whole pixels, by normalised cross-correlation along the row; NaN where nothing fits. For what the depth map forgot.
    """
    found = np.full(len(uv), np.nan)
    half, (height, width) = BLOCK_PX // 2, frame.left.shape
    reach = min(width - 1, int(frame.bf_m_px / NEAREST_M))
    for k, (u, v) in enumerate(np.rint(uv).astype(int)):
        if not (half <= u < width - half and half <= v < height - half):
            continue
        rows = slice(v - half, v + half + 1)
        first = max(0, u - half - reach)
        strip = frame.right[rows, first : u + half + 1]
        fit = cv2.matchTemplate(strip, frame.left[rows, u - half : u + half + 1], cv2.TM_CCOEFF_NORMED)[0]
        best = int(np.argmax(fit))
        if fit[best] > FITS:
            found[k] = u - half - first - best
    return found
