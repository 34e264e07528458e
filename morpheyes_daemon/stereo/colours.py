"""Colour scales of all figures: baselines in jet as in the paper, depth in turbo from warm (near) to cold (far)."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Image

MIN_BASELINE_M = 0.1
MAX_BASELINE_M = 0.3
"""The ends of the jet scale: blue 100 mm, red 300 mm (paper, figure 1)."""

NEAR_M, FAR_M = 0.5, 30.0
"""Ends of the depth scale, metres; chosen: wider ones leave fewer colours to near obstacles."""
FARTHEST = 18
"""Index of the turbo map at the far end, of 255; chosen: lower ones are as dark as unknown pixels."""
UNKNOWN_BGR = (38, 34, 32)
"""Colour of pixels without depth."""


@cache
def _jet() -> list[tuple[int, int, int]]:
    ramp = np.arange(256, dtype=np.uint8).reshape(256, 1)
    return [(int(b), int(g), int(r)) for b, g, r in cv2.applyColorMap(ramp, cv2.COLORMAP_JET).reshape(256, 3)]


def baseline_bgr(baseline_m: float) -> tuple[int, int, int]:
    """Return the jet colour (b, g, r) of a baseline; NaN gives that of the smallest one."""
    share = (baseline_m - MIN_BASELINE_M) / (MAX_BASELINE_M - MIN_BASELINE_M)
    return _jet()[0 if math.isnan(share) else round(255 * min(1.0, max(0.0, share)))]


def colour_depth(depth_m: FloatMap, near_m: float = NEAR_M, far_m: float = FAR_M) -> Image:
    """Return the BGR image (H, W, 3) uint8 of a depth map (H, W) in metres, NaN unknown, on a logarithmic scale."""
    known = depth_m > 0.0
    scale = (255 - FARTHEST) / math.log(far_m / near_m)
    index = np.log(np.where(known, depth_m, far_m), dtype=np.float32)
    index = np.clip(255.0 - scale * (index - math.log(near_m)), FARTHEST, 255.0)
    picture = np.asarray(cv2.applyColorMap(index.astype(np.uint8), cv2.COLORMAP_TURBO), dtype=np.uint8)
    picture[~known] = UNKNOWN_BGR
    return picture
