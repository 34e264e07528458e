"""Where an image is not what the static scene would show: the one before, carried on by depth and own motion.

A place to look more closely, no proof of anything: edges that uncover what was hidden differ as well.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.transforms import Array, inverse

STRIDE = 2
"""Every second pixel is enough."""

NOISE = 3.0
"""Grey levels by which an explained pixel may differ, smoothed over a few pixels: noise, sampling, exposure."""

SLOPE_SHARE = 0.2
"""And by this share of the local contrast: a fraction of a pixel of misplacement."""

STRANGEST_PCT = 98.5
"""At most the rest is called strange: attention is for few places."""

FILL_PX = 41
"""Over how many (thinned) pixels what has no depth takes that of its surroundings."""


def unexplained(before: Frame, now: Frame, T_now_before: Array) -> NDArray[np.uint8]:
    """Return (H, W) uint8, 255 where `now` differs from `before` as a static scene would show it."""
    depth = _filled(now.depth_m[::STRIDE, ::STRIDE])
    current = cv2.resize(now.left, depth.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    carried = _carried(before, now, depth, T_now_before)
    known = np.isfinite(carried)
    difference = np.where(known, current - np.where(known, carried, 0.0), 0.0).astype(np.float32)
    difference -= np.float32(np.median(difference[known])) if known.any() else np.float32(0.0)
    strength = cv2.blur(np.abs(np.where(known, difference, 0.0)).astype(np.float32), (3, 3))
    low, high = cv2.erode(current, np.ones((3, 3))), cv2.dilate(current, np.ones((3, 3)))
    strength = strength / (NOISE + SLOPE_SHARE * (high - low))
    strange = strength > max(1.0, float(np.percentile(strength, STRANGEST_PCT)))
    grown = cv2.dilate(strange.astype(np.uint8) * np.uint8(255), np.ones((3, 3)))
    size = now.left.shape[1], now.left.shape[0]
    return np.asarray(cv2.resize(grown, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _filled(depth: FloatMap) -> FloatMap:
    """Return depth with its holes filled by the mean disparity around them; NaN where nothing is near."""
    known = np.isfinite(depth)
    inverse_depth = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0).astype(np.float32)
    weight = cv2.blur(known.astype(np.float32), (FILL_PX, FILL_PX))
    mean = cv2.blur(inverse_depth, (FILL_PX, FILL_PX)) / np.maximum(weight, 1e-6)
    filled = np.where((weight > 0.01) & (mean > 1e-4), 1.0 / np.maximum(mean, 1e-4), np.nan)
    return np.where(known, depth, filled).astype(np.float32)


def _carried(before: Frame, now: Frame, depth: FloatMap, T_now_before: Array) -> FloatMap:
    """Return what `before` shows at every pixel of the thinned `depth` (h, w), NaN where it shows nothing."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32) * STRIDE + np.float32((STRIDE - 1) / 2)
    x = (u - np.float32(now.pinhole.cx_px)) / np.float32(now.pinhole.f_px) * depth
    y = (v - np.float32(now.pinhole.cy_px)) / np.float32(now.pinhole.f_px) * depth
    T = inverse(T_now_before).astype(np.float32)
    p = [T[i, 0] * x + T[i, 1] * y + T[i, 2] * depth + T[i, 3] for i in range(3)]
    z = np.where(p[2] > 0.1, p[2], np.nan)
    pinhole = before.pinhole
    u0 = (pinhole.f_px * p[0] / z + pinhole.cx_px).astype(np.float32)
    v0 = (pinhole.f_px * p[1] / z + pinhole.cy_px).astype(np.float32)
    inside = (u0 >= 0) & (u0 <= pinhole.width - 1) & (v0 >= 0) & (v0 <= pinhole.height - 1)
    blurred = cv2.blur(before.left, (STRIDE, STRIDE))
    shift = np.float32((STRIDE - 1) / 2)  # an even block's mean lies between pixels
    seen = cv2.remap(blurred, np.nan_to_num(u0) + shift, np.nan_to_num(v0) + shift, cv2.INTER_LINEAR)
    return np.where(inside, seen.astype(np.float32), np.float32(np.nan))
