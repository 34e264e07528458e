"""Depth of a small window by plane sweep: what dense matching of the whole image smooths away, looked for on its own.

Semi-global matching likes large surfaces and forgets patches of a dozen pixels before a far wall. Here every pixel of
a window takes the disparity at which a small block around it fits best; nothing is smoothed.
"""

from __future__ import annotations

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap
from morpheyes_daemon.strategies.imo.rectified_frame import Frame

BLOCK_PX = 5
BRIGHTNESS_PX = 15
"""Blocks are compared without the mean brightness over so many pixels: the eyes differ in gain."""


def swept_depth(frame: Frame, box: tuple[slice, slice], nearest_m: float, farthest_m: float) -> FloatMap:
    """Return depth (h, w) metres of the window `box` (rows, columns) of the left eye, within the given range.

    NaN where the right eye cannot see it at any of the disparities.
    """
    rows, columns = box
    low = max(0, int(frame.bf_m_px / farthest_m))
    high = min(columns.stop, int(np.ceil(frame.bf_m_px / nearest_m)) + 1)
    pad = BRIGHTNESS_PX
    top, bottom = max(0, rows.start - pad), min(frame.pinhole.height, rows.stop + pad)
    left, right = max(0, columns.start - pad), min(frame.pinhole.width, columns.stop + pad)
    a = _flat(frame.left[top:bottom, left:right])
    first = max(0, left - high)
    b = _flat(frame.right[top:bottom, first:right])
    costs = np.full((high + 1 - low, *a.shape), np.inf, dtype=np.float32)
    for d, cost in enumerate(costs, start=low):
        shift = left - d - first
        start = max(0, -shift)
        difference = np.abs(a[:, start:] - b[:, shift + start : shift + a.shape[1]])
        cost[:, start:] = cv2.blur(difference, (BLOCK_PX, BLOCK_PX))
    disparity = low + _lowest(costs)
    inner = disparity[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return np.asarray(frame.bf_m_px / np.where(inner > 0, inner, np.nan), dtype=np.float32)


def _flat(image: np.ndarray[tuple[int, int], np.dtype[np.uint8]]) -> FloatMap:
    """Return the image without its local mean."""
    grey = image.astype(np.float32)
    return np.asarray(grey - cv2.blur(grey, (BRIGHTNESS_PX, BRIGHTNESS_PX)))


def _lowest(costs: FloatMap) -> FloatMap:
    """Return where along the first axis costs (N, h, w) are least, to a fraction of a step; NaN where none is known.

    Absolute differences fall and rise in straight lines, so two of equal slope are laid through the least and its
    neighbours.
    """
    at = np.argmin(costs, axis=0)
    padded = np.pad(costs, ((1, 1), (0, 0), (0, 0)), constant_values=np.inf)
    before, least, after = (np.take_along_axis(padded, (at + k)[None], axis=0)[0] for k in range(3))
    with np.errstate(invalid="ignore"):
        steeper = np.maximum(before, after) - least
        fraction = 0.5 * (before - after) / np.where(np.isfinite(steeper) & (steeper > 0.0), steeper, np.inf)
    fraction = np.where(np.isfinite(before) & np.isfinite(after), fraction, 0.0)
    return np.where(np.isfinite(least), at + fraction, np.nan).astype(np.float32)
