"""Tracklets clustered by motion together with depth: neighbours in space that move alike are one object.

Two tracklets are linked when they lie within a hand's breadth at their depth and drift alike; a cluster is what hangs
together. What an object is, and whether it is real, is decided over several frames by the track.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.strategies.imo.features import Mask
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.strategies.imo.tracklets import Movers
from morpheyes_daemon.transforms import Array

LINK_M, LINK_PX = 0.12, 14.0
"""Neighbours are at most this far apart in the image: at their depth, and in pixels at 640 px of width, added."""

ALIKE_PX, ALIKE_SHARE = 1.0, 0.35
"""Drifts of neighbours differ by no more, per frame of comparison and as a share of the drift; an object may turn."""

DEPTH_PX, DEPTH_SHARE = 1.0, 0.08
"""Disparities of neighbours differ by no more."""

FEWEST = 3
"""Tracklets that make an object."""


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Tracklets that move together: middle (3,) and velocity (3,) in rect axes, and half its size.

    `count` says how many of its members surely move.
    """

    members: Mask
    count: int
    p_rect: Array
    v_rect_m_s: Array
    radius_m: float


def clusters(movers: Movers, frame: Frame) -> list[Cluster]:
    """Return the objects among moving tracklets, the largest first."""
    if movers.sure.sum() < FEWEST:
        return []
    labels = _components(_linked(movers, frame))
    found = [_cluster(movers, labels == label) for label in range(labels.max() + 1)]
    return sorted((c for c in found if c.count >= FEWEST), key=lambda c: -c.count)


def _linked(movers: Movers, frame: Frame) -> Mask:
    uv, d = movers.uvd[:, :2], movers.uvd[:, 2]
    reach = LINK_PX * frame.scale + LINK_M * d / frame.baseline_m
    apart = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    drift = movers.drift_px_s
    unlike = np.linalg.norm(drift[:, None] - drift[None], axis=2)
    size = np.linalg.norm(drift, axis=1)
    noise = ALIKE_PX / movers.span_s
    allowed = np.maximum(noise[:, None], noise[None]) + ALIKE_SHARE * np.maximum(size[:, None], size[None])
    deeper = np.abs(d[:, None] - d[None])
    same_depth = deeper < DEPTH_PX + DEPTH_SHARE * np.maximum(d[:, None], d[None])
    return np.asarray((apart < np.minimum(reach[:, None], reach[None])) & (unlike < allowed) & same_depth)


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


def _cluster(movers: Movers, members: Mask) -> Cluster:
    p = movers.p_rect[members]
    middle = np.median(p, axis=0)
    across = np.linalg.norm(p[:, :2] - middle[:2], axis=1)
    radius = float(np.percentile(across, 80)) + 0.03
    sure = int((members & movers.sure).sum())
    return Cluster(members, sure, middle, np.median(movers.v_rect_m_s[members], axis=0), radius)
