"""Plane sweep: depth of a small window whose object dense matching of the whole image may smooth away.

Semi-global matching prefers large surfaces and loses patches of a dozen pixels before a far wall. Here every pixel of
a window takes the disparity of the best matching block around it, without smoothing.
"""

from __future__ import annotations

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame

BLOCK_PX = 5
"""Side of the compared block.

Chosen: smaller matches noise, larger rounds objects of a dozen pixels."""

BRIGHTNESS_PX = 15
"""Window whose mean is subtracted before blocks are compared, since the cameras differ in gain.

Chosen: three blocks; smaller removes the texture itself."""


def plane_sweep_depth(frame: RectifiedFrame, box: tuple[slice, slice], nearest_m: float, farthest_m: float) -> FloatMap:
    """Return depth (h, w), metres, of the window `box` (rows, columns) of the left image, within the given range.

    NaN where the right image does not contain any of the disparities.
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
    """Return the image (h, w) minus its local mean."""
    grey = image.astype(np.float32)
    return np.asarray(grey - cv2.blur(grey, (BRIGHTNESS_PX, BRIGHTNESS_PX)))


def _lowest(costs: FloatMap) -> FloatMap:
    """Return the index (h, w) of the minimum of costs (N, h, w) along the first axis, with a fraction; NaN without any.

    Absolute differences are piecewise linear, so two lines of equal slope are fitted to the minimum and its neighbours.
    """
    at = np.argmin(costs, axis=0)
    padded = np.pad(costs, ((1, 1), (0, 0), (0, 0)), constant_values=np.inf)
    before, least, after = (np.take_along_axis(padded, (at + k)[None], axis=0)[0] for k in range(3))
    with np.errstate(invalid="ignore"):
        steeper = np.maximum(before, after) - least
        fraction = 0.5 * (before - after) / np.where(np.isfinite(steeper) & (steeper > 0.0), steeper, np.inf)
    fraction = np.where(np.isfinite(before) & np.isfinite(after), fraction, 0.0)
    return np.where(np.isfinite(least), at + fraction, np.nan).astype(np.float32)
