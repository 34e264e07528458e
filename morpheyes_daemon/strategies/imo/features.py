"""Features: corner detection, and matching in the next frame and in the right camera to a fraction of a pixel.

Pyramidal Lucas-Kanade of OpenCV, started at the position predicted by geometry, with a forward-backward check.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Image, Mask
from morpheyes_daemon.stereo.lucas_kanade import LucasKanade
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.transforms import Array

WINDOW_PX = 13
"""Side of the Lucas-Kanade window.

Chosen: the texture of small objects; larger mixes object and background, smaller finds less."""

LEVELS = 2
"""Halvings of the image in the pyramid. Unit: levels.

Chosen: errors of the predicted position up to about 25 px; more lose small objects."""

RETURN_PX = 0.5
"""Largest error of the forward-backward check.

Chosen: above the matching noise of 0.3 px; larger accepts features that were lost."""

ITERATIONS = 20
"""Iterations of Lucas-Kanade on each level. Unit: iterations.

Chosen: converges from a pixel in five to ten; more cost time in the vision worker."""

MIN_TEXTURE = 1e-3
"""Smallest eigenvalue of a window's gradients, per pixel, as OpenCV normalises it. Unit: none.

Chosen: lower accepts features on flat texture, which drift."""

ROW_PX = 1.2
"""Largest row offset of a match in a rectified pair.

Chosen: four sigmas of matching noise; larger accepts matches across rows."""

MIN_DISPARITY_PX = 0.3
"""Smallest disparity of a match.

Chosen: one sigma of its noise; at less the depth is unknown."""

QUALITY = 0.01
"""Quality of the weakest corner relative to the strongest. Unit: none.

Chosen: OpenCV's usual value; higher finds corners on high-contrast objects only."""

CORNER_BLOCK_PX = 5
"""Block over which the gradients of a corner are summed.

Chosen: larger rounds the corners of small objects, smaller responds to noise."""

BLOCK_PX = 11
"""Side of the block in the search along the row.

Chosen: smaller matches by chance, larger mixes object and background."""

MIN_CORRELATION = 0.85
"""Normalised cross-correlation from which a block in the search along the row matches. Unit: none.

Chosen: lower accepts chance matches, higher loses matches at different gain."""

NEAREST_M = 1.5
"""Nearest depth of the search along the row.

Chosen: what is nearer fills many pixels and is in the depth map; nearer searches cost time."""

MIN_KNOWN = 3
"""Known depths among 3 by 3 pixels from which their median is used. Unit: pixels.

Chosen: a third; fewer are mismatches at an edge."""


def detect_corners(image: Image, count: int, spacing_px: float, free: NDArray[np.uint8] | None = None) -> Array:
    """Return up to `count` corners (N, 2), px, of an image (H, W), `spacing_px` apart, where `free` (H, W) is not 0."""
    if count <= 0:
        return np.empty((0, 2))
    found = cv2.goodFeaturesToTrack(image, count, QUALITY, spacing_px, mask=free, blockSize=CORNER_BLOCK_PX)
    return np.empty((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)


def track_features(before: Image, now: Image, uv: Array, guess: Array) -> tuple[Array, Mask]:
    """Return pixels (N, 2) in image `now` of pixels uv (N, 2) in `before`, (H, W) both, and which (N,) were found.

    `guess` (N, 2), px, is where the search starts; NaN starts at uv.
    """
    if not len(uv):
        return np.empty((0, 2)), np.zeros(0, dtype=np.bool_)
    start = np.where(np.isfinite(guess), guess, uv)
    tracker = LucasKanade(WINDOW_PX, LEVELS, min_eigenvalue=MIN_TEXTURE, iterations=ITERATIONS, return_px=RETURN_PX)
    return tracker.track(before, now, uv, start)


def stereo_disparity(frame: RectifiedFrame, uv: Array, d_guess: Array) -> tuple[Array, Mask]:
    """Return disparities (N,), px, of pixels uv (N, 2) of the left image near `d_guess` (N,), and which were found."""
    guess = uv - np.stack([np.nan_to_num(d_guess), np.zeros(len(uv))], axis=1)
    right, good = track_features(frame.left, frame.right, uv, guess)
    offset = uv - right
    good &= np.isfinite(d_guess) & (np.abs(offset[:, 1]) < ROW_PX) & (offset[:, 0] > MIN_DISPARITY_PX)
    return offset[:, 0], good


def depth_map_disparity(frame: RectifiedFrame, uv: Array) -> Array:
    """Return disparities (N,), px, of the depth map at pixels uv (N, 2): the median of 3 by 3, NaN unknown."""
    column = np.clip(np.rint(uv[:, 0]).astype(np.intp), 1, frame.pinhole.width - 2)
    row = np.clip(np.rint(uv[:, 1]).astype(np.intp), 1, frame.pinhole.height - 2)
    around = np.stack([frame.depth_m[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=1)
    known = np.sort(around, axis=1)
    count = np.isfinite(around).sum(axis=1)
    middle = known[np.arange(len(uv)), np.maximum(count - 1, 0) // 2]
    return np.where(count >= MIN_KNOWN, frame.bf_m_px / middle, np.nan)


def disparity_along_row(frame: RectifiedFrame, uv: Array) -> Array:
    """Return disparities (N,), whole px, of the best match of a block around pixels uv (N, 2) in the right image.

    Normalised cross-correlation along the row; NaN where nothing matches. For small objects missing in the depth map.
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
        if fit[best] > MIN_CORRELATION:
            found[k] = u - half - first - best
    return found
