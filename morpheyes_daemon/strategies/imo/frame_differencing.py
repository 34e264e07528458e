"""Frame differencing: pixels that differ from the last image warped by depth and camera motion.

Candidates for new corners, not detections: background that an edge uncovers differs as well.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.transforms import Array, inverse

STRIDE = 2
"""Every n-th row and column is compared. Unit: px.

Chosen: time in the vision worker against objects of one or two pixels."""

NOISE_GREY = 3.0
"""Difference, averaged over 3 by 3 pixels, that noise, sampling and exposure explain. Unit: grey levels.

Chosen: about twice the noise of the sensor; smaller marks noise, larger misses objects of low contrast."""

GRADIENT_SHARE = 0.2
"""Difference that a warp error of a fraction of a pixel explains, as a share of the local contrast. Unit: none.

Chosen: a fifth of a pixel; smaller marks all edges, larger misses objects along them."""

CHANGED_PCT = 98.5
"""Percentile of the differences above which pixels are marked at most.

Chosen: bounds the corners that are searched; lower adds corners of the static scene."""

FILL_PX = 41
"""Window over which pixels without depth take the mean disparity of their surroundings.

Chosen: larger than holes of the matching; larger still mixes foreground and background."""

MIN_KNOWN_SHARE, MIN_INVERSE_DEPTH_1_M = 0.01, 1e-4
"""Share of a window that must have a depth, and the smallest inverse depth that is used. Unit: none, 1/m.

Chosen: only exclude windows without information and the division by zero."""

MIN_DEPTH_M = 0.1
"""Depth below which a warped point is discarded.

Chosen: nearer than the near limit of every baseline."""


def changed_pixels(before: RectifiedFrame, now: RectifiedFrame, T_now_before: Array) -> NDArray[np.uint8]:
    """Return (H, W) uint8, unitless: 255 where `now` differs from `before` warped as a static scene, else 0.

    T_now_before: camera motion (4, 4), rect to rect, metres.
    """
    depth = _filled(now.depth_m[::STRIDE, ::STRIDE])
    current = cv2.resize(now.left, depth.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    warped = _warped(before, now, depth, T_now_before)
    known = np.isfinite(warped)
    difference = np.where(known, current - np.where(known, warped, 0.0), 0.0).astype(np.float32)
    difference -= np.float32(np.median(difference[known])) if known.any() else np.float32(0.0)
    strength = cv2.blur(np.abs(np.where(known, difference, 0.0)).astype(np.float32), (3, 3))
    low, high = cv2.erode(current, np.ones((3, 3))), cv2.dilate(current, np.ones((3, 3)))
    strength = strength / (NOISE_GREY + GRADIENT_SHARE * (high - low))
    changed = strength > max(1.0, float(np.percentile(strength, CHANGED_PCT)))
    grown = cv2.dilate(changed.astype(np.uint8) * np.uint8(255), np.ones((3, 3)))
    size = now.left.shape[1], now.left.shape[0]
    return np.asarray(cv2.resize(grown, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _filled(depth: FloatMap) -> FloatMap:
    """Return depth (h, w) with holes filled by the mean inverse depth around them; NaN where no depth is near."""
    known = np.isfinite(depth)
    inverse_depth = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0).astype(np.float32)
    weight = cv2.blur(known.astype(np.float32), (FILL_PX, FILL_PX))
    mean = cv2.blur(inverse_depth, (FILL_PX, FILL_PX)) / np.maximum(weight, 1e-6)
    usable = (weight > MIN_KNOWN_SHARE) & (mean > MIN_INVERSE_DEPTH_1_M)
    filled = np.where(usable, 1.0 / np.maximum(mean, MIN_INVERSE_DEPTH_1_M), np.nan)
    return np.where(known, depth, filled).astype(np.float32)


def _warped(before: RectifiedFrame, now: RectifiedFrame, depth: FloatMap, T_now_before: Array) -> FloatMap:
    """Return the grey levels (h, w) of `before` at every pixel of the sampled `depth` (h, w), NaN outside its view."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32) * STRIDE + np.float32((STRIDE - 1) / 2)
    x = (u - np.float32(now.pinhole.cx_px)) / np.float32(now.pinhole.f_px) * depth
    y = (v - np.float32(now.pinhole.cy_px)) / np.float32(now.pinhole.f_px) * depth
    T = inverse(T_now_before).astype(np.float32)
    p = [T[i, 0] * x + T[i, 1] * y + T[i, 2] * depth + T[i, 3] for i in range(3)]
    z = np.where(p[2] > MIN_DEPTH_M, p[2], np.nan)
    pinhole = before.pinhole
    u0 = (pinhole.f_px * p[0] / z + pinhole.cx_px).astype(np.float32)
    v0 = (pinhole.f_px * p[1] / z + pinhole.cy_px).astype(np.float32)
    inside = (u0 >= 0) & (u0 <= pinhole.width - 1) & (v0 >= 0) & (v0 <= pinhole.height - 1)
    blurred = cv2.blur(before.left, (STRIDE, STRIDE))
    shift = np.float32((STRIDE - 1) / 2)  # an even block's mean lies between pixels
    seen = cv2.remap(blurred, np.nan_to_num(u0) + shift, np.nan_to_num(v0) + shift, cv2.INTER_LINEAR)
    return np.where(inside, seen.astype(np.float32), np.float32(np.nan))
