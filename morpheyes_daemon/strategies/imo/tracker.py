"""Object tracker: finds a moving object and follows it.

Clusters of moving tracklets become candidates; a candidate that moved in several frames is confirmed. From then on the
object's pixels are detected where its filter predicts them, so that it is followed while it is slow, small or very
near. Without a detection the filter coasts and the search widens; after `coast_s` the track is dropped.
"""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import DepthMap, Track
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.imo.candidate import (
    CONFIRM_HITS,
    CONTINUOUS,
    LARGEST_M,
    Candidate,
    measured_position,
    to_ned,
    to_rect,
)
from morpheyes_daemon.strategies.imo.clusters import Cluster, cluster_tracklets
from morpheyes_daemon.strategies.imo.kalman import CENTRE_SHIFT_SHARE, DISPARITY_SIGMA_PX
from morpheyes_daemon.strategies.imo.object_segmentation import Detection, PredictedObject, detect_object
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.strategies.imo.tracklets import Tracklets
from morpheyes_daemon.transforms import Array

LARGE_CLUSTER = 12
"""Tracklets of one cluster that count as motion in two frames. Unit: tracklets.

Chosen: so many seldom agree by chance; lower confirms mismatches."""

MAX_CANDIDATES = 4
"""Candidates followed at the same time. Unit: candidates.

Chosen: time in the vision worker; the mission follows one object."""

STATIC_S = 4.0
"""A confirmed track without evidence of motion for this long is part of the scene.

Chosen: shorter loses objects that stop for a moment, longer follows false ones."""

TRIAL_S = 1.0
"""Time after which an unconfirmed candidate is dropped; twice that while there is evidence of motion.

Chosen: CONFIRM_FRAMES at 5 Hz."""

GATE_MAHALANOBIS2, REACQUIRE_MAHALANOBIS2 = 30.0, 12.0
"""Squared Mahalanobis distance up to which a detection is the track's; the second after a loss. Unit: none.

Chosen: wide, since a manoeuvre is larger than the filter's acceleration; narrower after a loss, when others may be
near."""

MOVED_SIGMAS, CERTAINLY_MOVED_SIGMAS = 2.0, 4.0
"""Displacement, in its tolerances, that shows motion; the second on trial or when the corners are static. Unit: none.

Chosen: lower takes errors of the camera motion for motion, higher drops slow objects."""

CORNER_FRAMES = 2
"""Frames in which corners must have moved before the displacement of the centre counts. Unit: frames.

Chosen: the centre of a trunk's pixels moves along it; more find objects later."""

MIN_STATIC_CORNERS, STATIC_SHARE = 4, 0.7
"""Number of corners, and share of them, that must be static for an object to be static.

Unit: corners, none. Chosen: fewer are decided by one mismatch."""

FRAGMENT_RADII = 0.5
"""Radius, relative to the object's, below which a nearer detection is something else. Unit: none.

Chosen: half; lower takes leaves and twigs before the object for it."""

MAX_BASELINE_SIGMA = 0.03
"""Relative sigma of the baseline above which the tracker is reset. Unit: none.

Chosen: while the scale is uncertain everything seems to move; lower resets during every change of baseline."""

CENTRE_PX = 3.0
"""Tolerance of the centre of an object's pixels, at 640 px of image width.

Chosen: changes of the mask between frames; lower takes them for motion."""

TOLERANCE_SIGMAS, DISPARITY_SHARE = 3.0, 0.01
"""Tolerance of the disparity: sigmas of the averaged disparity, and share of it. Unit: none.

Chosen: 3 sigma, and the systematic error of the camera motion along the line of sight."""

MIN_POSITIONS, MIN_DISPLACEMENT_NS = 3, S // 2
"""Detections, and time between two of them, from which their displacement is evaluated. Unit: detections, ns.

Chosen: shorter compares noise."""


class ObjectTracker:
    """Follows one object at a time, as the paper does; call `step` once per frame, in order."""

    def __init__(self, coast_s: float = 2.0) -> None:
        self._coast_ns = round(coast_s * S)
        self.tracklets = Tracklets()
        self._before: RectifiedFrame | None = None
        self._candidates: list[Candidate] = []
        self._next_id = 1
        self.clusters: list[Cluster] = []

    def step(self, view: View) -> Track | None:
        """Return the track as of this frame, None while no confirmed object is followed."""
        frame = RectifiedFrame.of(view)
        if frame.baseline_sigma_m > MAX_BASELINE_SIGMA * frame.baseline_m:
            self._reset()
            return None
        best = self._candidates[0] if self._candidates else None
        watched = best.detection.mask if best and best.detection else None
        moving = self.tracklets.step(frame, self._predicted_shift(frame, best), watched)
        self.clusters = cluster_tracklets(moving, frame)
        dt_s = (frame.t_ns - self._before.t_ns) / S if self._before else 0.0
        for candidate in self._candidates:
            self._update_candidate(candidate, frame, view.depth, dt_s)
        self._assign_clusters(frame, view.depth)
        self._prune_tracks(frame.t_ns)
        best = self._candidates[0] if self._candidates else None
        self.tracklets.replenish(frame, best.detection.mask if best and best.detection else None)
        if self._before is not None and not (best and best.confirmed):
            self.tracklets.add_changed_corners(self._before, frame)
        self._before = frame
        return _track(best, frame, view.depth) if best and best.confirmed else None

    def _reset(self) -> None:
        """Start over: while the baseline is uncertain, everything seems to move."""
        self.tracklets = Tracklets()
        self._before, self._candidates, self.clusters = None, [], []

    def _predicted_shift(self, frame: RectifiedFrame, best: Candidate | None) -> Array | None:
        """Return the object's predicted motion (3,) since the frame before, present rect, metres.

        None for unconfirmed ones: corners searched where a moving object's would be are found there, if the texture
        repeats.
        """
        if best is None or not best.confirmed or self._before is None:
            return None
        dt_s = (frame.t_ns - self._before.t_ns) / S
        return np.asarray(frame.T_ned_rect[:3, :3].T @ best.filter.v_ned_m_s * dt_s)

    def _update_candidate(self, candidate: Candidate, frame: RectifiedFrame, depth: DepthMap, dt_s: float) -> None:
        """Predict a candidate to a frame, and update it with its detection there."""
        candidate.filter.predict(dt_s)
        lost = candidate.detection is None
        detection = candidate.detection = self._detection(candidate, frame, lost)
        if detection is None:
            return
        p_ned, covariance = measured_position(detection, candidate.radius_m, frame, depth)
        gate = REACQUIRE_MAHALANOBIS2 if lost else GATE_MAHALANOBIS2
        if candidate.filter.mahalanobis2(p_ned, covariance) >= gate:
            candidate.detection = None
            return
        candidate.filter.update(p_ned, covariance)
        candidate.seen_ns = frame.t_ns
        candidate.update_radius(detection)

    def _detection(self, candidate: Candidate, frame: RectifiedFrame, lost: bool) -> Detection | None:
        """Return the candidate in a frame; a confirmed one also behind something nearer at its place."""
        predicted = candidate.predicted(frame)
        detection = detect_object(frame, predicted)
        if detection is None or not candidate.confirmed or not self._is_other(detection, predicted, lost):
            return detection
        behind = detect_object(frame, predicted, detection.depth_m + predicted.radius_m)
        return None if behind is None or self._is_other(behind, predicted, lost) else behind

    def _is_other(self, detection: Detection, predicted: PredictedObject, lost: bool) -> bool:
        """Return whether a detection is something else: part of a larger surface or a fragment, nearer by a diameter.

        A lost object is found again only as an isolated object that is not static.
        """
        continuous = detection.continuity >= CONTINUOUS
        if lost and (continuous or self._is_static(detection)):
            return True
        nearer = predicted.p_rect[2] - detection.p_rect[2] > 2.0 * predicted.radius_m
        return bool(nearer) and (continuous or detection.radius_m < FRAGMENT_RADII * predicted.radius_m)

    def _assign_clusters(self, frame: RectifiedFrame, depth: DepthMap) -> None:
        """Assign clusters to candidates, make new candidates of the others, and confirm those that moved."""
        moved: dict[int, int] = {}
        for cluster in self.clusters:
            p_ned = to_ned(frame, cluster.p_rect)
            owner = next((c for c in self._candidates if c.owns(p_ned, cluster)), None)
            if owner is not None:
                owner.grow_to(cluster)
            elif cluster.radius_m < LARGEST_M and len(self._candidates) < MAX_CANDIDATES:
                owner = self._add_candidate(cluster, frame, depth)
            if owner is not None:
                moved[owner.id] = moved.get(owner.id, 0) + (2 if cluster.count >= LARGE_CLUSTER else 1)
        for candidate in self._candidates:
            hits = self._motion_evidence(candidate, frame, moved.get(candidate.id, 0))
            candidate.hits.append(min(hits, 2))
            if hits:
                candidate.moved_ns = frame.t_ns
            if candidate.detection is not None:
                candidate.positions.append((frame.t_ns, candidate.detection.p_rect))
            candidate.confirmed |= sum(candidate.hits) >= CONFIRM_HITS

    def _motion_evidence(self, candidate: Candidate, frame: RectifiedFrame, clustered: int) -> int:
        """Return the evidence of motion in this frame, counted in frames: 0 to 2.

        For an unconfirmed candidate nothing counts while its corners are static, nor the displacement of its centre
        before corners have moved in CORNER_FRAMES.
        """
        if not candidate.is_isolated():
            return 0
        static, on_trial = self._is_static(candidate.detection), not candidate.confirmed
        candidate.corner_frames += clustered > 0 and not static
        if on_trial and (static or candidate.corner_frames < CORNER_FRAMES):
            return 0 if static else clustered
        sigmas = CERTAINLY_MOVED_SIGMAS if static or on_trial else MOVED_SIGMAS
        return clustered or int(self._is_displaced(candidate, frame, sigmas))

    def _is_static(self, detection: Detection | None) -> bool:
        """Return whether the corners on a detection agree with the static scene."""
        if detection is None:
            return False
        static = self.tracklets.static_within(detection.mask)
        return static.size >= MIN_STATIC_CORNERS and float(static.mean()) > STATIC_SHARE

    def _is_displaced(self, candidate: Candidate, frame: RectifiedFrame, sigmas: float) -> bool:
        """Return whether the object is elsewhere than some seconds ago, given the refined camera motion since."""
        if candidate.detection is None or len(candidate.positions) < MIN_POSITIONS:
            return False
        now = frame.project(candidate.detection.p_rect)
        for t_ns, p_then in candidate.positions:
            past = self.tracklets.since(t_ns)
            if past is not None and frame.t_ns - t_ns > MIN_DISPLACEMENT_NS:
                static = frame.project(past.T_now_then[:3, :3] @ p_then + past.T_now_then[:3, 3])
                shift_px = CENTRE_PX * frame.scale + CENTRE_SHIFT_SHARE * candidate.radius_m * now[2] / frame.baseline_m
                depth_px = TOLERANCE_SIGMAS * DISPARITY_SIGMA_PX + DISPARITY_SHARE * now[2]
                if (np.abs(now - static) > sigmas * np.array([shift_px, shift_px, depth_px])).any():
                    return True
        return False

    def _add_candidate(self, cluster: Cluster, frame: RectifiedFrame, depth: DepthMap) -> Candidate:
        candidate = Candidate.of(cluster, self._next_id, frame, depth)
        candidate.detection = detect_object(frame, candidate.predicted(frame))
        self._next_id += 1
        self._candidates.append(candidate)
        return candidate

    def _prune_tracks(self, t_ns: int) -> None:
        """Drop candidates that are lost, static or never confirmed; sort the rest, the best first."""
        kept = [c for c in self._candidates if self._is_alive(c, t_ns)]
        kept.sort(key=lambda c: (not c.confirmed, -sum(c.hits), c.born_ns))
        confirmed = [c for c in kept if c.confirmed]
        self._candidates = confirmed[:1] + [c for c in kept if not c.confirmed]

    def _is_alive(self, candidate: Candidate, t_ns: int) -> bool:
        if not candidate.confirmed:
            age_ns, trial_ns = t_ns - candidate.born_ns, round(TRIAL_S * S)
            return age_ns <= trial_ns or (age_ns <= 2 * trial_ns and any(candidate.hits))
        return t_ns - candidate.seen_ns <= self._coast_ns and t_ns - candidate.moved_ns <= STATIC_S * S


def _track(candidate: Candidate, frame: RectifiedFrame, depth: DepthMap) -> Track:
    detection = candidate.detection
    x = candidate.filter.x
    return Track(
        seq=depth.seq,
        t_ns=frame.t_ns,
        id=candidate.id,
        seen=detection is not None,
        p_ned_m=(float(x[0]), float(x[1]), float(x[2])),
        v_ned_m_s=(float(x[3]), float(x[4]), float(x[5])),
        covariance=candidate.filter.P.copy(),
        p_rect_m=_triple(detection.p_rect if detection else to_rect(frame, candidate.filter.p_ned_m)),
        radius_m=candidate.radius_m,
        pixels=int(detection.mask.sum()) if detection else 0,
        baseline_m=depth.baseline_m,
    )


def _triple(p: Array) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])
