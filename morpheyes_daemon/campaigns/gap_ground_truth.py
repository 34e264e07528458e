"""Where an opening really is in an image: the judge's contour, to hold a seen one against.

Uses the twin's true poses and lenses; the daemon never sees any of it.
"""

from __future__ import annotations

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Mask, Pinhole
from morpheyes_daemon.simulation.worlds.world import GapTruth
from morpheyes_daemon.stereo.rectify import Rectification
from morpheyes_daemon.transforms import Array, inverse

FRACTION_BITS = 4


def true_masks(gap: GapTruth, T_ned_wall: Array, T_ned_cam0: Array, rectified: Rectification) -> list[Mask]:
    """Return for each opening the pixels (H, W) of the rectified left image through which one sees to the other side.

    `T_ned_cam0` is the true pose of the left eye. An opening that is partly behind the eye gives an empty mask.
    """
    T_cam0_wall = inverse(T_ned_cam0) @ T_ned_wall
    return [_see_through(outline, gap.thickness_m, T_cam0_wall, rectified) for outline in gap.outlines]


def iou(a: Mask, b: Mask) -> float:
    """Return intersection over union of two masks, 0 when both are empty."""
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 0.0


def filled(contour_px: FloatMap, pinhole: Pinhole) -> Mask:
    """Return the pixels (H, W) of a closed contour (n, 2), its own pixels included."""
    mask = np.zeros((pinhole.height, pinhole.width), np.uint8)
    cv2.fillPoly(mask, [np.rint(contour_px).astype(np.int32)], 1)
    return mask.view(np.bool_)


def _see_through(outline: Array, thickness_m: float, T_cam0_wall: Array, rectified: Rectification) -> Mask:
    """A hole in a plate is what both of its faces leave open."""
    pinhole = rectified.pinhole
    mask = np.ones((pinhole.height, pinhole.width), np.uint8)
    for x in (-thickness_m / 2, thickness_m / 2):
        corners = np.column_stack([np.full(len(outline), x), outline]) @ T_cam0_wall[:3, :3].T + T_cam0_wall[:3, 3]
        p = corners @ rectified.cam0.R_rect_cam.T
        if p[:, 2].min() < 0.05:
            return np.zeros(mask.shape, np.bool_)
        uv = p[:, :2] / p[:, 2:] * pinhole.f_px + (pinhole.cx_px, pinhole.cy_px)
        face = np.zeros_like(mask)
        scaled = np.rint(np.clip(uv, -4e3, 4e3) * 2**FRACTION_BITS).astype(np.int32)
        cv2.fillPoly(face, [scaled], 1, cv2.LINE_8, FRACTION_BITS)
        mask &= face
    return mask.view(np.bool_)
