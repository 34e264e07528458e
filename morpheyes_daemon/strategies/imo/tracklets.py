"""Corners followed over some frames, each with its depth, and judged against the static scene.

A tracklet keeps where it was seen in the last frames. With the chain of the vehicle's own motion each of these
sightings says where it would be seen now if it stood still; how far off that is, and for how long, tells moving
things from standing ones and gives their velocity.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.imo.features import (
    Mask,
    corners,
    disparity_along_row,
    disparity_at,
    followed,
    seen_by_both,
)
from morpheyes_daemon.strategies.imo.frame_differencing import unexplained
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.strategies.imo.visual_odometry import EgoMotion, refine, surprise, told_motion
from morpheyes_daemon.transforms import Array

LAGS = 5
"""Frames back to which a tracklet is compared: a slow object has moved visibly after a second."""

CHAIN = 20
"""Frames back to which the vehicle's own motion is kept, for objects that are slower still."""

MOST_ATTENTIVE = 60
"""Corners looked for where the image is not what the static scene would show."""

CORNERS = 350
SPACING_PX = 12.0
FINE_SPACING_PX = 4.0
"""Between corners in general and within the object that is being watched, at 640 px of image width."""

SURPRISING = 30.0
"""Squared Mahalanobis length (3 degrees of freedom) from which a sighting is not one of a standing thing."""

RESTLESS = 10.0
"""From here on one that goes on with surprising ones moves with them."""

FEWEST_PX = 1.0
"""And so many pixels at least."""


@dataclass(frozen=True, slots=True, eq=False)
class Movers:
    """Tracklets that move by themselves: pixel and disparity (M, 3), point (M, 3) and velocity (M, 3) in rect axes,

    pixels per second (M, 2) relative to the static scene, the age (M,) in seconds of the comparison, and which are
    `sure` (M,) to move; the others do if they move along with those."""

    uvd: Array
    p_rect: Array
    v_rect_m_s: Array
    drift_px_s: Array
    span_s: Array
    sure: Mask

    def __len__(self) -> int:
        return len(self.uvd)


@dataclass(slots=True, eq=False)
class FeatureHistory:
    """A former frame: its time, and the motion since with its covariance."""

    t_ns: int
    T_now_then: Array
    covariance: Array


class Tracklets:
    """All corners being followed; `step` once per frame."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._past: deque[FeatureHistory] = deque(maxlen=CHAIN)
        self.uvd: Array = np.empty((0, 3))
        self._then: Array = np.empty((0, LAGS, 3))
        self.ego: EgoMotion | None = None
        self.static: Mask = np.zeros(0, dtype=np.bool_)

    def step(self, frame: Frame, shift_rect_m: Array | None = None, watched: Mask | None = None) -> Movers:
        """Follow everything into `frame` and return what moves by itself.

        `watched` (H, W) marks, in the frame before, the object being tracked, and `shift_rect_m` (3,) how far it is
        expected to have moved by itself: the search for its corners starts there. Raises nothing.
        """
        before, self._frame = self._frame, frame
        movers = _NONE
        if before is not None and len(self.uvd):
            self._follow(before, frame, shift_rect_m, watched)
            movers = self._movers(frame)
        elif before is not None:
            self._remember(before, frame, EgoMotion(told_motion(before, frame), np.eye(6), self.static[:0]))
        return movers

    def since(self, t_ns: int) -> FeatureHistory | None:
        """Return the vehicle's own motion since the frame of `t_ns`, None when that is forgotten."""
        return next((past for past in self._past if past.t_ns == t_ns), None)

    def standing(self, mask: Mask) -> Mask:
        """Return, for every corner within `mask` (H, W) that was followed for some frames, whether it stands."""
        count = len(self.static)
        old = np.isfinite(self._then[:count, min(2, LAGS - 1), 0])
        return self.static[old & _inside(mask, self.uvd[:count, :2])]

    def replenish(self, frame: Frame, watched: Mask | None) -> None:
        """Look for new corners where there are none; closer together within `watched` (H, W)."""
        free = np.full(frame.left.shape, 255, dtype=np.uint8)
        scale = frame.scale
        _block(free, self.uvd[:, :2], SPACING_PX * scale)
        self._add(frame, corners(frame.left, CORNERS - len(self.uvd), SPACING_PX * scale, free))
        if watched is not None and watched.any():
            inside = watched.astype(np.uint8) * np.uint8(255)
            _block(inside, self.uvd[:, :2], FINE_SPACING_PX * scale)
            self._add(frame, corners(frame.left, 40, max(2.0, FINE_SPACING_PX * scale), inside))

    def attend(self, before: Frame, now: Frame) -> None:
        """Look for corners where `now` is not what a static scene would show, so that small things are not missed."""
        if self.ego is None:
            return
        strange = unexplained(before, now, self.ego.T_now_before)
        _block(strange, self.uvd[:, :2], FINE_SPACING_PX * now.scale)
        uv = corners(now.left, MOST_ATTENTIVE, max(2.0, FINE_SPACING_PX * now.scale), strange)
        self._add(now, uv, disparity_along_row(now, uv))

    def _add(self, frame: Frame, uv: Array, d_guess: Array | None = None) -> None:
        d, good = seen_by_both(frame, uv, disparity_at(frame, uv) if d_guess is None else d_guess)
        fresh = np.concatenate([uv, d[:, None]], axis=1)[good]
        self.uvd = np.concatenate([self.uvd, fresh])
        self._then = np.concatenate([self._then, np.full((len(fresh), LAGS, 3), np.nan)])

    def _follow(self, before: Frame, now: Frame, shift: Array | None, watched: Mask | None) -> None:
        told = told_motion(before, now)
        p_before = before.points(self.uvd)
        p_guess = p_before @ told[:3, :3].T + told[:3, 3]
        if shift is not None and watched is not None:
            p_guess = p_guess + shift * _inside(watched, self.uvd[:, :2])[:, None]
        guess = now.project(p_guess)
        uv, found = followed(before.left, now.left, self.uvd[:, :2], guess[:, :2])
        found &= now.holds(uv, 3.0)
        uv, p_before, then = uv[found], p_before[found], self._then[found]
        d, good = seen_by_both(now, uv, guess[found, 2])
        self.uvd = np.concatenate([uv, d[:, None]], axis=1)[good]
        p_before = p_before[good]
        self._then = np.concatenate([p_before[:, None], then[good, :-1]], axis=1)
        dt_s = (now.t_ns - before.t_ns) / S
        self._remember(before, now, refine(told, dt_s, p_before, self.uvd, now))

    def _remember(self, before: Frame, now: Frame, ego: EgoMotion) -> None:
        self.ego, self.static = ego, ego.static
        for past in self._past:
            past.T_now_then = ego.T_now_before @ past.T_now_then
            past.covariance = past.covariance + ego.covariance
        self._past.appendleft(FeatureHistory(before.t_ns, ego.T_now_before, ego.covariance))

    def _movers(self, now: Frame) -> Movers:
        """Compare with every former frame; the longest comparison that surprises gives the velocity."""
        count = len(self.uvd)
        sure, moving = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        v, drift, span = np.zeros((count, 3)), np.zeros((count, 2)), np.zeros(count)
        p_now = now.points(self.uvd)
        for lag, past in enumerate(list(self._past)[:LAGS]):
            p_then = self._then[:, lag]
            residual, length = surprise(past.T_now_then, past.covariance, lag + 1, p_then, self.uvd, now, self.static)
            new = (length > RESTLESS) & (np.linalg.norm(residual, axis=1) > FEWEST_PX)
            dt_s = (now.t_ns - past.t_ns) / S
            still = p_then @ past.T_now_then[:3, :3].T + past.T_now_then[:3, 3]
            moving |= new
            sure |= new & (length > SURPRISING)
            v[new], drift[new], span[new] = ((p_now - still) / dt_s)[new], (residual[:, :2] / dt_s)[new], dt_s
        self.static = self.static & ~sure
        return Movers(self.uvd[moving], p_now[moving], v[moving], drift[moving], span[moving], sure[moving])


_NONE = Movers(*(np.empty((0, 3)),) * 3, np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.bool_))


def _block(free: NDArray[np.uint8], uv: Array, radius_px: float) -> None:
    """Clear discs of `free` around pixels."""
    for u, v in uv:
        cv2.circle(free, (round(u), round(v)), max(1, round(radius_px)), 0, -1)


def _inside(mask: Mask, uv: Array) -> Mask:
    column = np.clip(np.rint(uv[:, 0]).astype(np.intp), 0, mask.shape[1] - 1)
    row = np.clip(np.rint(uv[:, 1]).astype(np.intp), 0, mask.shape[0] - 1)
    return np.asarray(mask[row, column])
