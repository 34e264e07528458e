"""Candidate: a track being confirmed or followed, with its filter, its radius and its evidence of motion."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from morpheyes_daemon.messages.core import DepthMap
from morpheyes_daemon.strategies.imo.clusters import Cluster
from morpheyes_daemon.strategies.imo.kalman import ObjectFilter, StereoGeometry, measurement_covariance
from morpheyes_daemon.strategies.imo.object_segmentation import Detection, PredictedObject
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.strategies.imo.tracklets import MOTION_HISTORY_FRAMES
from morpheyes_daemon.transforms import Array, inverse

CONFIRM_HITS, CONFIRM_FRAMES = 3, 5
"""M-of-N confirmation: visible motion in 3 of the last 5 frames. Unit: frames.

Chosen: fewer admit mismatches, more find an object later."""

LARGEST_M, SMALLEST_M = 1.5, 0.04
"""Radii of what is taken for an object.

Chosen: people and small balls; larger is a part of the scene, smaller has no pixels."""

RADIUS_GAIN = 0.15
"""Gain with which the radius follows that of the detection. Unit: none.

Chosen: averages over seven frames; higher follows errors of the mask."""

GROWTH, GROWTH_TO_M = 1.3, 0.3
"""Growth of the radius per frame, up to a size, while the object continues beyond it. Unit: none, m.

Chosen: the few corners by which an object is found cover a part of it; faster grows into the scene."""

CONTINUOUS = 0.5
"""Depth continuity from which a detection is a part of a larger surface. Unit: none.

Chosen: half of an opposite pair of sectors; lower rejects objects near others, higher accepts pieces of walls."""

OCCLUDED = 0.1
"""Share of the surroundings that is nearer from which a part of the object may be hidden. Unit: none.

Chosen: a sector of the ring; lower reacts to mismatches, higher lets an occluder shift the centre."""

INITIAL_RADII = 0.3
"""One sigma of a new object's position, in its radii. Unit: none.

Chosen: the corners by which it is found may lie on one side of it."""

INITIAL_SPEED_SHARE = 0.5
"""Share of a cluster's velocity with which the filter starts. Unit: none.

Chosen: a cluster's velocity is noisy; all of it overshoots, none of it starts late."""


@dataclass(slots=True, eq=False)
class Candidate:
    """A track: its filter, the object's radius, and in how many of the last frames it was seen to move.

    `hits` holds up to 2 per frame; `corner_frames` counts the frames in which its corners moved; `positions` are
    detections (3,), rect metres, with the time of their frames. `detection` is None in a frame without one.
    """

    id: int
    filter: ObjectFilter
    radius_m: float
    born_ns: int
    hits: deque[int] = field(default_factory=lambda: deque(maxlen=CONFIRM_FRAMES))
    corner_frames: int = 0
    confirmed: bool = False
    seen_ns: int = 0
    moved_ns: int = 0
    detection: Detection | None = None
    positions: deque[tuple[int, Array]] = field(default_factory=lambda: deque(maxlen=MOTION_HISTORY_FRAMES))

    @classmethod
    def of(cls, cluster: Cluster, number: int, frame: RectifiedFrame, depth: DepthMap) -> Candidate:
        """Return a new candidate for a cluster."""
        covariance = _in_ned(frame, measurement_covariance(cluster.p_rect, cluster.radius_m, _stereo(depth)))
        v_ned = frame.T_ned_rect[:3, :3] @ cluster.v_rect_m_s
        radius_m = max(cluster.radius_m, SMALLEST_M)
        covariance = covariance + np.eye(3) * (INITIAL_RADII * radius_m) ** 2
        state = ObjectFilter(to_ned(frame, cluster.p_rect), covariance, INITIAL_SPEED_SHARE * v_ned)
        return cls(number, state, radius_m, frame.t_ns, seen_ns=frame.t_ns, moved_ns=frame.t_ns)

    def predicted(self, frame: RectifiedFrame) -> PredictedObject:
        """Return where the filter predicts the object in a frame."""
        P_rect = frame.T_ned_rect[:3, :3].T @ self.filter.P[:3, :3] @ frame.T_ned_rect[:3, :3]
        p_rect = to_rect(frame, self.filter.p_ned_m)
        across_m, along_m = float(np.sqrt(max(P_rect[0, 0], P_rect[1, 1]))), float(np.sqrt(P_rect[2, 2]))
        return PredictedObject(p_rect, across_m, along_m, self.radius_m)

    def owns(self, p_ned: Array, cluster: Cluster) -> bool:
        """Return whether a cluster at p_ned (3,), metres, belongs to this candidate."""
        reach = self.radius_m + cluster.radius_m + 3.0 * float(np.sqrt(self.filter.P[:3, :3].trace()))
        return float(np.linalg.norm(p_ned - self.filter.p_ned_m)) < reach

    def is_isolated(self) -> bool:
        """Return whether it is detected as an isolated object."""
        return self.detection is not None and self.detection.continuity < CONTINUOUS

    def grow_to(self, cluster: Cluster) -> None:
        """Enlarge the radius to that of a cluster: what moves together belongs together."""
        self.radius_m = max(self.radius_m, min(cluster.radius_m, LARGEST_M))

    def update_radius(self, detection: Detection) -> None:
        """Let the radius follow that of a detection, or grow while an unconfirmed object continues beyond it."""
        if detection.continuity >= CONTINUOUS and not self.confirmed:
            self.radius_m = max(self.radius_m, min(GROWTH * self.radius_m, GROWTH_TO_M))
        elif detection.inside and detection.occluded < OCCLUDED:
            seen_m = min(max(detection.radius_m, SMALLEST_M), LARGEST_M)
            self.radius_m += RADIUS_GAIN * (seen_m - self.radius_m)


def measured_position(
    detection: Detection, radius_m: float, frame: RectifiedFrame, depth: DepthMap
) -> tuple[Array, Array]:
    """Return the position (3,), ned metres, and covariance (3, 3) of a detection of an object of radius `radius_m`.

    The centre of a partly hidden object may be off by what is hidden, across the line of sight.
    """
    covariance = measurement_covariance(detection.p_rect, detection.radius_m, _stereo(depth))
    if detection.occluded >= OCCLUDED:
        hidden_m = 2.0 * radius_m * max(0.0, 1.0 - (detection.radius_m / radius_m) ** 2)
        covariance = covariance + np.diag([1.0, 1.0, 0.0]) * hidden_m**2
    return to_ned(frame, detection.p_rect), _in_ned(frame, covariance)


def to_ned(frame: RectifiedFrame, p_rect: Array) -> Array:
    """Return a point (3,), rect metres, in ned metres."""
    return np.asarray(frame.T_ned_rect[:3, :3] @ p_rect + frame.T_ned_rect[:3, 3])


def to_rect(frame: RectifiedFrame, p_ned: Array) -> Array:
    """Return a point (3,), ned metres, in rect metres."""
    T = inverse(frame.T_ned_rect)
    return np.asarray(T[:3, :3] @ p_ned + T[:3, 3])


def _in_ned(frame: RectifiedFrame, covariance: Array) -> Array:
    R = frame.T_ned_rect[:3, :3]
    return np.asarray(R @ covariance @ R.T)


def _stereo(depth: DepthMap) -> StereoGeometry:
    return StereoGeometry(depth.baseline_m, depth.pinhole.f_px, depth.baseline_sigma_m)
