"""Finds a moving object and keeps it: clusters of moving tracklets become tracks, tracks are seen again in each frame.

A track is confirmed when it was seen and moved in several frames; from then on its own pixels are looked for where
the filter expects them, so that it is kept while it is slow, tiny or very near. While it is not seen the filter
coasts and the search widens; after `coast_s` it is given up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import DepthMap, Track
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.imo.clusters import Cluster, clusters
from morpheyes_daemon.strategies.imo.kalman import (
    REGISTERED_PX,
    SHAPE_SHARE,
    Eyes,
    ObjectFilter,
    measurement_covariance,
)
from morpheyes_daemon.strategies.imo.object_segmentation import Expected, Sighting, sight
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.strategies.imo.tracklets import CHAIN, Tracklets
from morpheyes_daemon.transforms import Array, inverse

HITS, OF = 3, 5
"""A track is confirmed when it moved visibly in so many of so many frames."""

MANY = 12
"""So many tracklets that move together in one frame count as two frames."""

STILL_S = 4.0
"""A track without any sign of own motion for so long is part of the scene."""

GATE, LOST_GATE = 30.0, 12.0
"""Squared Mahalanobis length up to which a sighting belongs to the track; the second when it was out of sight."""

LARGEST_M, SMALLEST_M = 1.5, 0.04
"""Radii of what is taken for an object."""

RADIUS_GAIN = 0.15

ENLARGED, ENLARGED_TO_M = 1.3, 0.3
"""What goes on beyond its radius may be larger than the few corners that gave it away: by so much a frame, so far."""

LIKELY, SURELY = 2.0, 4.0
"""Sigmas off its former place from which an object goes on moving; the second on trial or when its corners stand."""

CORNER_FRAMES = 2
"""Frames in which corners must have moved before the object's middle may tell of motion."""

FEWEST_STANDING, STANDING_SHARE = 4, 0.7
"""So many corners, and this share of them, make an object one that seems to stand."""

JOINED = 0.5
"""An object whose surroundings are as far away on both sides for more than this share is a piece of something."""

COVERED = 0.1
"""With a larger share of what is around it nearer, a part of an object may be hidden."""

SCRAP = 0.5
"""What has less than this of an object's radius is a scrap of it, or of something else."""

UNSURE_SHARE = 0.03
"""Of the baseline: with a larger sigma of it nothing is concluded."""

MIDDLE_PX = 3.0
"""By how much the middle of an object's pixels wanders without its moving, at 640 px of image width."""


@dataclass(slots=True, eq=False)
class _Candidate:
    """A track on its way: its filter, the object's radius, and how clearly it was seen to move in the last frames."""

    id: int
    filter: ObjectFilter
    radius_m: float
    born_ns: int
    moved: deque[int] = field(default_factory=lambda: deque(maxlen=OF))
    corner_frames: int = 0
    confirmed: bool = False
    seen_ns: int = 0
    moved_ns: int = 0
    sighting: Sighting | None = None
    places: deque[tuple[int, Array]] = field(default_factory=lambda: deque(maxlen=CHAIN))


class ObjectTracker:
    """One object at a time, as the paper has it; `step` once per frame, in order."""

    def __init__(self, coast_s: float = 2.0) -> None:
        self._coast_ns = round(coast_s * S)
        self.tracklets = Tracklets()
        self._before: Frame | None = None
        self._candidates: list[_Candidate] = []
        self._next_id = 1
        self.clusters: list[Cluster] = []

    def step(self, view: View) -> Track | None:
        """Return the track as of this frame, None while nothing confirmed is being followed."""
        frame = Frame.of(view)
        if frame.baseline_sigma_m > UNSURE_SHARE * frame.baseline_m:
            self._forget()
            return None
        best = self._candidates[0] if self._candidates else None
        watched = best.sighting.mask if best and best.sighting else None
        movers = self.tracklets.step(frame, self._own_shift(frame, best), watched)
        self.clusters = clusters(movers, frame)
        dt_s = (frame.t_ns - self._before.t_ns) / S if self._before else 0.0
        for candidate in self._candidates:
            self._see(candidate, frame, view.depth, dt_s)
        self._adopt(frame, view.depth)
        self._prune_tracks(frame.t_ns)
        best = self._candidates[0] if self._candidates else None
        self.tracklets.replenish(frame, best.sighting.mask if best and best.sighting else None)
        if self._before is not None and not (best and best.confirmed):
            self.tracklets.attend(self._before, frame)
        self._before = frame
        return self._track(best, frame, view.depth) if best and best.confirmed else None

    def _forget(self) -> None:
        """Start over: while nobody knows how far apart the eyes are, everything seems to move."""
        self.tracklets = Tracklets()
        self._before, self._candidates, self.clusters = None, [], []

    def _own_shift(self, frame: Frame, best: _Candidate | None) -> Array | None:
        """How far (3,) the object has moved by itself since the frame before, in the present rect axes.

        None on trial: corners that are looked for where a moving object's would be are found there, if its texture
        repeats itself.
        """
        if best is None or not best.confirmed or self._before is None:
            return None
        dt_s = (frame.t_ns - self._before.t_ns) / S
        return np.asarray(frame.T_ned_rect[:3, :3].T @ best.filter.v_ned_m_s * dt_s)

    def _see(self, candidate: _Candidate, frame: Frame, depth: DepthMap, dt_s: float) -> None:
        candidate.filter.predict(dt_s)
        lost = candidate.sighting is None
        sighting = candidate.sighting = self._sighted(candidate, frame, lost)
        if sighting is None:
            return
        p_ned, covariance = _measured(sighting, candidate.radius_m, frame, depth)
        if candidate.filter.surprise(p_ned, covariance) >= (LOST_GATE if lost else GATE):
            candidate.sighting = None
            return
        candidate.filter.update(p_ned, covariance)
        candidate.seen_ns = frame.t_ns
        if sighting.joined >= JOINED and not candidate.confirmed:
            candidate.radius_m = max(candidate.radius_m, min(ENLARGED * candidate.radius_m, ENLARGED_TO_M))
        elif sighting.whole and sighting.covered < COVERED:
            fresh = min(max(sighting.radius_m, SMALLEST_M), LARGEST_M)
            candidate.radius_m += RADIUS_GAIN * (fresh - candidate.radius_m)

    def _sighted(self, candidate: _Candidate, frame: Frame, lost: bool) -> Sighting | None:
        """Return the candidate as seen in a frame, a confirmed one also behind something nearer at its place."""
        expected = _expected(candidate, frame)
        sighting = sight(frame, expected)
        if sighting is None or not candidate.confirmed or not self._is_other(sighting, expected, lost):
            return sighting
        behind = sight(frame, expected, sighting.depth_m + expected.radius_m)
        return None if behind is None or self._is_other(behind, expected, lost) else behind

    def _is_other(self, sighting: Sighting, expected: Expected, lost: bool) -> bool:
        """Tell whether something else is seen: a piece of what is larger, or a scrap, nearer by the object's size.

        An object that was out of sight is found again only as a thing by itself that does not stand.
        """
        piece = sighting.joined >= JOINED
        if lost and (piece or self._stands(sighting)):
            return True
        nearer = expected.p_rect[2] - sighting.p_rect[2] > 2.0 * expected.radius_m
        return bool(nearer) and (piece or sighting.radius_m < SCRAP * expected.radius_m)

    def _adopt(self, frame: Frame, depth: DepthMap) -> None:
        """Tell candidates which clusters are theirs; make new candidates of the rest."""
        moved: dict[int, int] = {}
        for cluster in self.clusters:
            p_ned = _to_ned(frame, cluster.p_rect)
            owner = next((c for c in self._candidates if _owns(c, p_ned, cluster)), None)
            if owner is not None:
                owner.radius_m = _grown(owner.radius_m, cluster)
            elif cluster.radius_m < LARGEST_M and len(self._candidates) < 4:
                owner = self._begin(cluster, p_ned, frame, depth)
            if owner is not None:
                moved[owner.id] = moved.get(owner.id, 0) + (2 if cluster.count >= MANY else 1)
        for candidate in self._candidates:
            hit = self._evidence(candidate, frame, moved.get(candidate.id, 0))
            candidate.moved.append(min(hit, 2))
            if hit:
                candidate.moved_ns = frame.t_ns
            if candidate.sighting is not None:
                candidate.places.append((frame.t_ns, candidate.sighting.p_rect))
            candidate.confirmed |= sum(candidate.moved) >= HITS

    def _evidence(self, candidate: _Candidate, frame: Frame, clustered: int) -> int:
        """Return how clearly a candidate moves in this frame, in frames: 0 to 2.

        On trial nothing counts while its corners stand, nor the way of its middle before corners have moved in some
        frames: the middle of a trunk's pixels wanders along it.
        """
        if not _is_apart(candidate):
            return 0
        stands, on_trial = self._stands(candidate.sighting), not candidate.confirmed
        candidate.corner_frames += clustered > 0 and not stands
        if on_trial and (stands or candidate.corner_frames < CORNER_FRAMES):
            return 0 if stands else clustered
        return clustered or int(self._has_moved(candidate, frame, SURELY if stands or on_trial else LIKELY))

    def _stands(self, sighting: Sighting | None) -> bool:
        """Tell whether the corners on what is seen agree with a scene that stands."""
        if sighting is None:
            return False
        standing = self.tracklets.standing(sighting.mask)
        return standing.size >= FEWEST_STANDING and float(standing.mean()) > STANDING_SHARE

    def _has_moved(self, candidate: _Candidate, frame: Frame, sigmas: float) -> bool:
        """Tell whether the object is elsewhere than some seconds ago, by the vehicle's refined motion since."""
        if candidate.sighting is None or len(candidate.places) < 3:
            return False
        now = frame.project(candidate.sighting.p_rect)
        for t_ns, p_then in candidate.places:
            past = self.tracklets.since(t_ns)
            if past is not None and frame.t_ns - t_ns > S // 2:
                still = frame.project(past.T_now_then[:3, :3] @ p_then + past.T_now_then[:3, 3])
                wander_px = MIDDLE_PX * frame.scale + SHAPE_SHARE * candidate.radius_m * now[2] / frame.baseline_m
                allowed = np.array([wander_px, wander_px, 3.0 * REGISTERED_PX + 0.01 * now[2]])
                if (np.abs(now - still) > sigmas * allowed).any():
                    return True
        return False

    def _begin(self, cluster: Cluster, p_ned: Array, frame: Frame, depth: DepthMap) -> _Candidate:
        covariance = _in_ned(frame, measurement_covariance(cluster.p_rect, cluster.radius_m, _eyes(depth)))
        v_ned = frame.T_ned_rect[:3, :3] @ cluster.v_rect_m_s
        radius_m = max(cluster.radius_m, SMALLEST_M)
        covariance = covariance + np.eye(3) * (0.3 * radius_m) ** 2
        candidate = _Candidate(self._next_id, ObjectFilter(p_ned, covariance, 0.5 * v_ned), radius_m, frame.t_ns)
        candidate.sighting = sight(frame, _expected(candidate, frame))
        candidate.seen_ns = candidate.moved_ns = frame.t_ns
        self._next_id += 1
        self._candidates.append(candidate)
        return candidate

    def _prune_tracks(self, t_ns: int) -> None:
        """Drop what is gone, what stands still, and what never became a track; the best first."""
        kept = [c for c in self._candidates if self._lives(c, t_ns)]
        kept.sort(key=lambda c: (not c.confirmed, -sum(c.moved), c.born_ns))
        confirmed = [c for c in kept if c.confirmed]
        self._candidates = confirmed[:1] + [c for c in kept if not c.confirmed]

    def _lives(self, candidate: _Candidate, t_ns: int) -> bool:
        if not candidate.confirmed:
            age_ns = t_ns - candidate.born_ns
            return age_ns <= S or (age_ns <= 2 * S and any(candidate.moved))
        return t_ns - candidate.seen_ns <= self._coast_ns and t_ns - candidate.moved_ns <= STILL_S * S

    def _track(self, candidate: _Candidate, frame: Frame, depth: DepthMap) -> Track:
        sighting = candidate.sighting
        x = candidate.filter.x
        return Track(
            seq=depth.seq,
            t_ns=frame.t_ns,
            id=candidate.id,
            seen=sighting is not None,
            p_ned_m=(float(x[0]), float(x[1]), float(x[2])),
            v_ned_m_s=(float(x[3]), float(x[4]), float(x[5])),
            covariance=candidate.filter.P.copy(),
            p_rect_m=_triple(sighting.p_rect if sighting else _to_rect(frame, candidate.filter.p_ned_m)),
            radius_m=candidate.radius_m,
            pixels=int(sighting.mask.sum()) if sighting else 0,
            baseline_m=depth.baseline_m,
        )


def _expected(candidate: _Candidate, frame: Frame) -> Expected:
    P_rect = frame.T_ned_rect[:3, :3].T @ candidate.filter.P[:3, :3] @ frame.T_ned_rect[:3, :3]
    p_rect = _to_rect(frame, candidate.filter.p_ned_m)
    return Expected(
        p_rect, float(np.sqrt(max(P_rect[0, 0], P_rect[1, 1]))), float(np.sqrt(P_rect[2, 2])), candidate.radius_m
    )


def _measured(sighting: Sighting, radius_m: float, frame: Frame, depth: DepthMap) -> tuple[Array, Array]:
    """Return place (3,) in ned and covariance (3, 3); of an object half hidden, the middle of what is left is off."""
    covariance = measurement_covariance(sighting.p_rect, sighting.radius_m, _eyes(depth))
    if sighting.covered >= COVERED:
        hidden_m = 2.0 * radius_m * max(0.0, 1.0 - (sighting.radius_m / radius_m) ** 2)
        covariance = covariance + np.diag([1.0, 1.0, 0.0]) * hidden_m**2
    return _to_ned(frame, sighting.p_rect), _in_ned(frame, covariance)


def _eyes(depth: DepthMap) -> Eyes:
    return Eyes(depth.baseline_m, depth.pinhole.f_px, depth.baseline_sigma_m)


def _owns(candidate: _Candidate, p_ned: Array, cluster: Cluster) -> bool:
    reach = candidate.radius_m + cluster.radius_m + 3.0 * float(np.sqrt(candidate.filter.P[:3, :3].trace()))
    return float(np.linalg.norm(p_ned - candidate.filter.p_ned_m)) < reach


def _is_apart(candidate: _Candidate) -> bool:
    """Tell whether it is seen, and as a thing by itself."""
    return candidate.sighting is not None and candidate.sighting.joined < JOINED


def _grown(radius_m: float, cluster: Cluster) -> float:
    """Return the radius after a cluster that reaches further: what moves together belongs together."""
    return max(radius_m, min(cluster.radius_m, LARGEST_M))


def _in_ned(frame: Frame, covariance: Array) -> Array:
    R = frame.T_ned_rect[:3, :3]
    return np.asarray(R @ covariance @ R.T)


def _to_ned(frame: Frame, p_rect: Array) -> Array:
    return np.asarray(frame.T_ned_rect[:3, :3] @ p_rect + frame.T_ned_rect[:3, 3])


def _to_rect(frame: Frame, p_ned: Array) -> Array:
    T = inverse(frame.T_ned_rect)
    return np.asarray(T[:3, :3] @ p_ned + T[:3, 3])


def _triple(p: Array) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])
