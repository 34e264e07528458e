"""Obstacle memory: a few seconds of obstacle points, so that the vehicle avoids a tree that has left the view.

Not a map: points are kept in the autopilot's local frame, dropped after `keep_s`, and dropped at once where the
present view sees through them. The profiles of that time are kept as well: where there is no depth now (nose up while
braking, behind a trunk), space that one of them saw through still counts as free.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Mask
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile
from morpheyes_daemon.transforms import Array

RANGE_STEP_M = 0.5
"""Step in which free space is looked up.

Chosen: about a vehicle's length; a smaller step costs time in the event loop."""

MIN_KEEP_FRAMES = 10
"""Frame periods for which points are kept at least, whatever `memory_s`. Unit: frames.

Chosen: at 1 Hz trees that left the view are still in reach for 10 s; fewer forget them, more remember mismatches."""

MIN_SPACING_NS = S // 10
"""Smallest time between remembered profiles; of closer ones only the newest is kept.

Chosen: at the vehicle's speeds nearer ones see the same; hundreds of them would delay the event loop."""

RANGE_SHARE, RANGE_MARGIN_M = 0.9, 0.3
"""Space is seen through up to this share of the range of what stands there, less the margin. Unit: none, m.

Chosen: depth error within trusted range; closer to the obstacle, mismatches would erase it."""

NEAR_FACTOR = 1.15
"""Space nearer than the near limit times this is never seen through. Unit: none.

Chosen: an obstacle at the near limit has no reliable depth; larger forgets less near by."""


class ObstacleMemory:
    """Obstacle points (N, 2), ned metres, and obstacle profiles of the last `keep_s`."""

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = round(keep_s * S)
        self._points: Array = np.empty((0, 2))
        self._seen_ns: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._profiles: deque[ObstacleProfile] = deque()

    @property
    def points_ned_m(self) -> Array:
        """All remembered points (N, 2), metres north and east, the newest profile's included."""
        return self._points

    def add(self, profile: ObstacleProfile) -> None:
        """Add a profile; drop points that are too old or that it sees through."""
        keep = (self._seen_ns > profile.t_ns - self._keep_ns) & ~self._contradicted(profile)
        seen = np.full(len(profile.points_ned_m), profile.t_ns, dtype=np.int64)
        self._points = np.concatenate([self._points[keep], profile.points_ned_m])
        self._seen_ns = np.concatenate([self._seen_ns[keep], seen])
        if len(self._profiles) > 1 and self._profiles[-1].t_ns - self._profiles[-2].t_ns < MIN_SPACING_NS:
            self._profiles.pop()
        self._profiles.append(profile)
        while self._profiles[0].t_ns <= profile.t_ns - self._keep_ns:
            self._profiles.popleft()

    def clear(self) -> None:
        """Drop all points and profiles."""
        self._points, self._seen_ns = self._points[:0], self._seen_ns[:0]
        self._profiles.clear()

    def seen_free_m(self, profile: ObstacleProfile, bins: NDArray[np.intp], from_m: float, to_m: float) -> Array:
        """Return (K,) metres up to which azimuth `bins` (K,) of a profile are known to be free, `from_m` to `to_m`.

        A place is free when any remembered profile saw through it; places nearer than `from_m` are taken as free.
        """
        ranges = np.arange(from_m, to_m, RANGE_STEP_M) + RANGE_STEP_M
        angle = profile.azimuth_rad[bins, None]
        x = profile.origin_ned_m[0] + ranges * np.cos(angle)
        y = profile.origin_ned_m[1] + ranges * np.sin(angle)
        free = np.zeros(x.shape, dtype=np.bool_)
        for past in self._profiles:
            free |= _seen_through(past, x, y)
        return np.asarray(from_m + RANGE_STEP_M * np.logical_and.accumulate(free, axis=1).sum(axis=1))

    def _contradicted(self, profile: ObstacleProfile) -> Mask:
        return _seen_through(profile, self._points[:, 0], self._points[:, 1])


def _seen_through(profile: ObstacleProfile, x_m: Array, y_m: Array) -> Mask:
    """Return for places north and east (any shape) whether a profile has a depth well behind them."""
    x, y = x_m - profile.origin_ned_m[0], y_m - profile.origin_ned_m[1]
    width = profile.azimuth_rad[1] - profile.azimuth_rad[0]
    left = profile.azimuth_rad[0] - width / 2
    index = np.floor(((np.arctan2(y, x) - left) % (2 * math.pi)) / width).astype(np.int64)
    known = np.where(profile.unknown | profile.near, -np.inf, profile.range_m)
    known = np.append(np.minimum(known * RANGE_SHARE - RANGE_MARGIN_M, profile.trust_m), -np.inf)
    range_m = np.hypot(x, y)
    nearest_m = NEAR_FACTOR * profile.near_limit_m
    return np.asarray((range_m < known[np.minimum(index, len(known) - 1)]) & (range_m > nearest_m))
