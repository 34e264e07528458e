"""Tracklets: features tracked over some frames, each with its depth, and tested against the static scene.

A tracklet keeps its points of the last frames. With the camera motion since, each of them predicts where the feature
would be now if it were static; the residual and its age separate moving features from static ones and give their
velocity.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Mask
from morpheyes_daemon.strategies.imo.features import (
    depth_map_disparity,
    detect_corners,
    disparity_along_row,
    stereo_disparity,
    track_features,
)
from morpheyes_daemon.strategies.imo.frame_differencing import changed_pixels
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.strategies.imo.visual_odometry import (
    CameraMotion,
    PastView,
    autopilot_motion,
    refine_motion,
    static_residuals,
)
from morpheyes_daemon.transforms import Array

MAX_LAG_FRAMES = 5
"""Frames back to which a tracklet is compared. Unit: frames.

Chosen: a slow object has moved visibly after a second; more cost time and lose more tracklets."""

MOTION_HISTORY_FRAMES = 20
"""Frames back to which the camera motion is kept, for objects that are slower still. Unit: frames.

Chosen: four seconds at 5 Hz; the chained covariance grows with them."""

MIN_STATIC_AGE = 3
"""Frames for which a feature must have been tracked before it is counted as static or not. Unit: frames.

Chosen: several comparisons; fewer judge by the noise of one."""

MAX_CORNERS = 350
"""Features that are tracked, about. Unit: features.

Chosen: time in the vision worker against objects with few features."""

MAX_WATCHED_CORNERS, MAX_CHANGED_CORNERS = 40, 60
"""New features within the tracked object, and where the image changed. Unit: features.

Chosen: time in the vision worker against small objects with few features."""

SPACING_PX = 12.0
"""Spacing of features at 640 px of image width.

Chosen: covers the image with MAX_CORNERS."""

FINE_SPACING_PX, MIN_SPACING_PX = 4.0, 2.0
"""Spacing of features within the tracked object and where the image changed, at 640 px of width, and its least value.

Chosen: the fewest pixels at which windows differ; larger gives small objects too few features."""

BORDER_PX = 3.0
"""Margin of the image within which features are dropped.

Chosen: a quarter of the matching window; their windows leave the image."""

MOVING_MAHALANOBIS2 = 30.0
"""Squared Mahalanobis distance (3 degrees of freedom) from which a feature certainly moves. Unit: none.

Chosen: one false in a million by noise alone; lower admits mismatches, higher loses slow objects."""

CANDIDATE_MAHALANOBIS2 = 10.0
"""Squared Mahalanobis distance from which a feature moves if it does so along with certain ones. Unit: none.

Chosen: hysteresis as in Canny's edge detector; 2 % of static features exceed it."""

MIN_RESIDUAL_PX = 1.0
"""Smallest residual of a moving feature.

Chosen: matching errors of low-contrast features; larger loses slow objects."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingTracklets:
    """Tracklets that move in the static scene: observation (M, 3), px; point (M, 3), metres, and velocity (M, 3), m/s,
    in rect; image motion (M, 2), px/s, relative to the static scene; the time (M,), s, of the comparison.

    `certain` (M,) ones move; the others do if they move along with those.
    """

    uvd: Array
    p_rect: Array
    v_rect_m_s: Array
    drift_px_s: Array
    span_s: Array
    certain: Mask

    def __len__(self) -> int:
        return len(self.uvd)


@dataclass(slots=True, eq=False)
class PastFrame:
    """A past frame: its time, and the camera motion (4, 4) since then with its covariance (6, 6)."""

    t_ns: int
    T_now_then: Array
    covariance: Array


class Tracklets:
    """All features being tracked; `step` once per frame.

    `uvd` (N, 3) their observations, px; `static` (N,) which agree with the static scene; `camera_motion` the last one.
    """

    def __init__(self) -> None:
        self._frame: RectifiedFrame | None = None
        self._past: deque[PastFrame] = deque(maxlen=MOTION_HISTORY_FRAMES)
        self.uvd: Array = np.empty((0, 3))
        self._then: Array = np.empty((0, MAX_LAG_FRAMES, 3))
        self.camera_motion: CameraMotion | None = None
        self.static: Mask = np.zeros(0, dtype=np.bool_)

    def step(
        self, frame: RectifiedFrame, shift_rect_m: Array | None = None, watched: Mask | None = None
    ) -> MovingTracklets:
        """Track all features into `frame` and return those that move.

        `watched` (H, W) marks the tracked object in the frame before, and `shift_rect_m` (3,), rect metres, is its
        predicted motion: the search for its features starts there. Raises nothing.
        """
        before, self._frame = self._frame, frame
        moving = _NONE
        if before is not None and len(self.uvd):
            self._track(before, frame, shift_rect_m, watched)
            moving = self._moving(frame)
        elif before is not None:
            self._add_motion(before, CameraMotion(autopilot_motion(before, frame), np.eye(6), self.static[:0]))
        return moving

    def since(self, t_ns: int) -> PastFrame | None:
        """Return the camera motion since the frame of `t_ns`, None when it is no longer kept."""
        return next((past for past in self._past if past.t_ns == t_ns), None)

    def static_within(self, mask: Mask) -> Mask:
        """Return (K,) bool, unitless: whether each feature within `mask` (H, W), tracked for some frames, is static."""
        count = len(self.static)
        old = np.isfinite(self._then[:count, min(MIN_STATIC_AGE, MAX_LAG_FRAMES) - 1, 0])
        return self.static[old & _inside(mask, self.uvd[:count, :2])]

    def replenish(self, frame: RectifiedFrame, watched: Mask | None) -> None:
        """Detect new features where there are none; closer together within `watched` (H, W) bool, unitless."""
        free = np.full(frame.left.shape, 255, dtype=np.uint8)
        scale = frame.scale
        _block(free, self.uvd[:, :2], SPACING_PX * scale)
        self._add(frame, detect_corners(frame.left, MAX_CORNERS - len(self.uvd), SPACING_PX * scale, free))
        if watched is not None and watched.any():
            inside = watched.astype(np.uint8) * np.uint8(255)
            _block(inside, self.uvd[:, :2], FINE_SPACING_PX * scale)
            spacing_px = max(MIN_SPACING_PX, FINE_SPACING_PX * scale)
            self._add(frame, detect_corners(frame.left, MAX_WATCHED_CORNERS, spacing_px, inside))

    def add_changed_corners(self, before: RectifiedFrame, now: RectifiedFrame) -> None:
        """Detect new features where the image changed, so that small objects are not missed."""
        if self.camera_motion is None:
            return
        changed = changed_pixels(before, now, self.camera_motion.T_now_before)
        _block(changed, self.uvd[:, :2], FINE_SPACING_PX * now.scale)
        spacing_px = max(MIN_SPACING_PX, FINE_SPACING_PX * now.scale)
        uv = detect_corners(now.left, MAX_CHANGED_CORNERS, spacing_px, changed)
        self._add(now, uv, disparity_along_row(now, uv))

    def _add(self, frame: RectifiedFrame, uv: Array, d_guess: Array | None = None) -> None:
        d, good = stereo_disparity(frame, uv, depth_map_disparity(frame, uv) if d_guess is None else d_guess)
        fresh = np.concatenate([uv, d[:, None]], axis=1)[good]
        self.uvd = np.concatenate([self.uvd, fresh])
        self._then = np.concatenate([self._then, np.full((len(fresh), MAX_LAG_FRAMES, 3), np.nan)])

    def _track(self, before: RectifiedFrame, now: RectifiedFrame, shift: Array | None, watched: Mask | None) -> None:
        prior = autopilot_motion(before, now)
        p_before = before.points(self.uvd)
        p_guess = p_before @ prior[:3, :3].T + prior[:3, 3]
        if shift is not None and watched is not None:
            p_guess = p_guess + shift * _inside(watched, self.uvd[:, :2])[:, None]
        guess = now.project(p_guess)
        uv, found = track_features(before.left, now.left, self.uvd[:, :2], guess[:, :2])
        found &= now.contains(uv, BORDER_PX)
        uv, p_before, then = uv[found], p_before[found], self._then[found]
        d, good = stereo_disparity(now, uv, guess[found, 2])
        self.uvd = np.concatenate([uv, d[:, None]], axis=1)[good]
        p_before = p_before[good]
        self._then = np.concatenate([p_before[:, None], then[good, :-1]], axis=1)
        dt_s = (now.t_ns - before.t_ns) / S
        self._add_motion(before, refine_motion(prior, dt_s, p_before, self.uvd, now))

    def _add_motion(self, before: RectifiedFrame, motion: CameraMotion) -> None:
        self.camera_motion, self.static = motion, motion.static
        for past in self._past:
            past.T_now_then = motion.T_now_before @ past.T_now_then
            past.covariance = past.covariance + motion.covariance
        self._past.appendleft(PastFrame(before.t_ns, motion.T_now_before, motion.covariance))

    def _moving(self, now: RectifiedFrame) -> MovingTracklets:
        """Compare with every past frame; the longest comparison with a significant residual gives the velocity."""
        count = len(self.uvd)
        certain, moving = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        v, drift, span = np.zeros((count, 3)), np.zeros((count, 2)), np.zeros(count)
        p_now = now.points(self.uvd)
        for lag, past in enumerate(list(self._past)[:MAX_LAG_FRAMES]):
            p_then = self._then[:, lag]
            view = PastView(p_then, past.T_now_then, past.covariance, lag + 1)
            residual, distance2 = static_residuals(view, self.uvd, now, self.static)
            new = (distance2 > CANDIDATE_MAHALANOBIS2) & (np.linalg.norm(residual, axis=1) > MIN_RESIDUAL_PX)
            dt_s = (now.t_ns - past.t_ns) / S
            static = p_then @ past.T_now_then[:3, :3].T + past.T_now_then[:3, 3]
            moving |= new
            certain |= new & (distance2 > MOVING_MAHALANOBIS2)
            v[new], drift[new], span[new] = ((p_now - static) / dt_s)[new], (residual[:, :2] / dt_s)[new], dt_s
        self.static = self.static & ~certain
        return MovingTracklets(self.uvd[moving], p_now[moving], v[moving], drift[moving], span[moving], certain[moving])


_NONE = MovingTracklets(*(np.empty((0, 3)),) * 3, np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.bool_))
"""No moving tracklets. Unit: tracklets. Source: equation, M = 0."""


def _block(free: NDArray[np.uint8], uv: Array, radius_px: float) -> None:
    """Set discs of `free` around pixels to zero."""
    for u, v in uv:
        cv2.circle(free, (round(u), round(v)), max(1, round(radius_px)), 0, -1)


def _inside(mask: Mask, uv: Array) -> Mask:
    column = np.clip(np.rint(uv[:, 0]).astype(np.intp), 0, mask.shape[1] - 1)
    row = np.clip(np.rint(uv[:, 1]).astype(np.intp), 0, mask.shape[0] - 1)
    return np.asarray(mask[row, column])
