"""A gap detector by optical flow in the manner of GapFlyt, to be compared with: what the paper calls 80 times slower.

GapFlyt (Sanket et al. 2018, sections III-A and III-B) moves sideways before the wall, stacks the flow from one frame
to several others, takes its mean magnitude as inverse depth (temporally stacked spatial parallax), and finds the
contour where it changes most. Their flow was FlowNet2's; here it is OpenCV's dense inverse search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Image, Mask

STACK = 4
"""Frames beside the reference, as in their figure 4."""


def stacked_flow(reference: Image, others: Sequence[Image]) -> FloatMap:
    """Return the mean magnitude (H, W) float32 of the flow from a grey image (H, W) to others, in pixels.

    The others lie ever farther away; each flow counts by its share of the way.
    """
    flow = dis_flow()
    total = np.zeros(reference.shape, np.float32)
    for number, other in enumerate(others, start=1):
        moved = flow.calc(reference, other, None)
        total += cv2.magnitude(moved[..., 0], moved[..., 1]) / np.float32(number)
    return total / np.float32(len(others))


def dis_flow() -> Any:
    """Return OpenCV's dense inverse search, medium preset."""
    return cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)


def flow_gap(magnitude: FloatMap) -> Mask:
    """Return the opening (H, W) in a stacked flow: the largest slow region that the fast wall encloses."""
    smooth = cv2.medianBlur(magnitude, 5)
    low, high = (float(x) for x in np.percentile(smooth, (0.5, 99.5)))
    levels = np.clip((smooth - low) / max(high - low, 1e-6) * 255, 0, 255).astype(np.uint8)
    _, slow = cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    return enclosed(slow.view(np.bool_))


def enclosed(mask: Mask) -> Mask:
    """Return the largest piece (H, W) of a mask that does not touch the image's edge; none when there is none."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    height, width = mask.shape
    best, area = 0, 0
    for label in range(1, count):
        x, y, w, h, size = (int(value) for value in stats[label])
        inside = x > 0 and y > 0 and x + w < width and y + h < height
        if inside and size > area:
            best, area = label, size
    return np.asarray(labels == best) if best else np.zeros(mask.shape, np.bool_)
