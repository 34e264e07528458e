"""Clustering of tracklets by motion together with depth (paper, section V-C).

Two tracklets are linked when they are close in the image at their depth and their image motion is similar; a cluster
is a connected component. Whether a cluster is an object is confirmed over several frames by `tracker`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.messages.core import Mask
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.strategies.imo.tracklets import MovingTracklets
from morpheyes_daemon.transforms import Array

LINK_M, LINK_PX = 0.12, 14.0
"""Largest distance of linked tracklets: metres at their depth plus pixels at 640 px of image width.

Chosen: the spacing of corners plus a hand's breadth; larger joins objects, smaller splits them."""

DRIFT_PX, DRIFT_SHARE = 1.0, 0.35
"""Largest difference of image motion between linked tracklets, over the comparison and as a share.

Unit: px, none. Chosen: noise, and the different motion of the parts of a turning object; larger joins neighbours."""

DISPARITY_PX, DISPARITY_SHARE = 1.0, 0.08
"""Largest difference of disparity between linked tracklets, absolute and as a share. Unit: px, none.

Chosen: matching error plus the depth of an object; larger joins it with its background."""

MIN_TRACKLETS = 3
"""Certainly moving tracklets that make a cluster. Unit: tracklets.

Chosen: two agree by chance every few frames; more lose small objects."""

RADIUS_PERCENTILE, RADIUS_MARGIN_M = 80, 0.03
"""Percentile of the distances from the centre that is the radius, and what is added. Unit: %, m.

Chosen: corners lie inside the contour, and single wrong members outside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Tracklets that move together: centre (3,), metres, and velocity (3,), m/s, in rect, and radius.

    `members` (M,) marks its tracklets, `count` is the number of them that certainly move.
    """

    members: Mask
    count: int
    p_rect: Array
    v_rect_m_s: Array
    radius_m: float


def cluster_tracklets(moving: MovingTracklets, frame: RectifiedFrame) -> list[Cluster]:
    """Return the clusters of moving tracklets, the largest first."""
    if moving.certain.sum() < MIN_TRACKLETS:
        return []
    labels = _components(_linked(moving, frame))
    found = [_cluster(moving, labels == label) for label in range(labels.max() + 1)]
    return sorted((c for c in found if c.count >= MIN_TRACKLETS), key=lambda c: -c.count)


def _linked(moving: MovingTracklets, frame: RectifiedFrame) -> Mask:
    uv, d = moving.uvd[:, :2], moving.uvd[:, 2]
    reach = LINK_PX * frame.scale + LINK_M * d / frame.baseline_m
    apart = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    drift = moving.drift_px_s
    drift_difference = np.linalg.norm(drift[:, None] - drift[None], axis=2)
    size = np.linalg.norm(drift, axis=1)
    noise = DRIFT_PX / moving.span_s
    allowed = np.maximum(noise[:, None], noise[None]) + DRIFT_SHARE * np.maximum(size[:, None], size[None])
    disparity_difference = np.abs(d[:, None] - d[None])
    same_depth = disparity_difference < DISPARITY_PX + DISPARITY_SHARE * np.maximum(d[:, None], d[None])
    return np.asarray((apart < np.minimum(reach[:, None], reach[None])) & (drift_difference < allowed) & same_depth)


def _components(linked: Mask) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return a label (N,) per connected component of a symmetric adjacency (N, N)."""
    labels = np.full(len(linked), -1, dtype=np.int64)
    for seed in range(len(linked)):
        if labels[seed] >= 0:
            continue
        label, front = int(labels.max()) + 1, [seed]
        labels[seed] = label
        while front:
            fresh = np.flatnonzero(linked[front.pop()] & (labels < 0))
            labels[fresh] = label
            front.extend(fresh.tolist())
    return labels


def _cluster(moving: MovingTracklets, members: Mask) -> Cluster:
    p = moving.p_rect[members]
    centre = np.median(p, axis=0)
    across = np.linalg.norm(p[:, :2] - centre[:2], axis=1)
    radius = float(np.percentile(across, RADIUS_PERCENTILE)) + RADIUS_MARGIN_M
    count = int((members & moving.certain).sum())
    return Cluster(members, count, centre, np.median(moving.v_rect_m_s[members], axis=0), radius)
