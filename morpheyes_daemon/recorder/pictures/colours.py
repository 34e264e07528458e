"""The colours all pictures share: baselines in jet as in the paper, depth from warm (near) to cold (far)."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from morpheyes_daemon.messages import FloatMap, Image

MIN_BASELINE_M = 0.1
MAX_BASELINE_M = 0.3
"""The ends of the jet scale: blue 100 mm, red 300 mm (paper, figure 1)."""

NEAR_M = 0.5
FAR_M = 30.0
UNKNOWN_BGR = (38, 34, 32)


@cache
def _palette(colormap: int) -> Image:
    ramp = np.arange(256, dtype=np.uint8).reshape(256, 1)
    return np.asarray(cv2.applyColorMap(ramp, colormap), dtype=np.uint8).reshape(256, 3)


def baseline_bgr(baseline_m: float) -> tuple[int, int, int]:
    """Return the jet colour of a baseline."""
    share = (baseline_m - MIN_BASELINE_M) / (MAX_BASELINE_M - MIN_BASELINE_M)
    index = int(np.clip(np.nan_to_num(share) * 255.0, 0, 255))
    b, g, r = _palette(cv2.COLORMAP_JET)[index]
    return int(b), int(g), int(r)


def colour_depth(depth_m: FloatMap, near_m: float = NEAR_M, far_m: float = FAR_M) -> Image:
    """Return (H, W, 3) BGR of a depth map in metres, NaN unknown; equal ratios of depth are equal steps of colour."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.log(far_m / depth_m) / np.log(far_m / near_m)
    known = np.isfinite(share)
    index = np.where(known, np.clip(share, 0.0, 1.0) * 255.0, 0.0).astype(np.uint8)
    picture = _palette(cv2.COLORMAP_TURBO)[index]
    picture[~known] = UNKNOWN_BGR
    return picture
