"""A few seconds of obstacle points, so that a tree which has left the view can not be flown into.

Not a map: points are kept in the autopilot's local frame, dropped after `keep_s`, and dropped at once where the
present view looks through them. The views of that time are kept beside them: where there is no depth now (the nose up
in braking, the shadow of a trunk), what one of them looked through is still free.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.obstacles.polar_profile import Floats, ObstacleProfile

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]

STEP_M = 0.5
"""Free space is looked up in such steps."""

APART_NS = S // 10
"""Views nearer to each other tell the same; looking through hundreds would hold up the event loop."""


class ObstacleMemory:
    """Obstacle points (N, 2), ned metres, and views of the last `keep_s`."""

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = round(keep_s * S)
        self._points: Floats = np.empty((0, 2))
        self._born_ns: np.ndarray[tuple[int], np.dtype[np.int64]] = np.empty(0, dtype=np.int64)
        self._views: deque[ObstacleProfile] = deque()

    @property
    def points_ned_m(self) -> Floats:
        """Everything remembered, the newest profile included."""
        return self._points

    def add(self, profile: ObstacleProfile) -> None:
        """Take in a profile: forget the old and the contradicted, keep the rest."""
        keep = (self._born_ns > profile.t_ns - self._keep_ns) & ~self._seen_through(profile)
        born = np.full(len(profile.points_ned_m), profile.t_ns, dtype=np.int64)
        self._points = np.concatenate([self._points[keep], profile.points_ned_m])
        self._born_ns = np.concatenate([self._born_ns[keep], born])
        if len(self._views) > 1 and self._views[-1].t_ns - self._views[-2].t_ns < APART_NS:
            self._views.pop()
        self._views.append(profile)
        while self._views[0].t_ns <= profile.t_ns - self._keep_ns:
            self._views.popleft()

    def clear(self) -> None:
        """Forget everything."""
        self._points, self._born_ns = self._points[:0], self._born_ns[:0]
        self._views.clear()

    def seen_free_m(self, profile: ObstacleProfile, bins: Indices, from_m: float, to_m: float) -> Floats:
        """Return (K,) how far the azimuth `bins` (K,) of a profile are known to be free, between `from_m` and `to_m`.

        A place is free when any view that is remembered looked through it; what is nearer than `from_m` is taken to be.
        """
        ranges = np.arange(from_m, to_m, STEP_M) + STEP_M
        angle = profile.azimuth_rad[bins, None]
        x = profile.origin_ned_m[0] + ranges * np.cos(angle)
        y = profile.origin_ned_m[1] + ranges * np.sin(angle)
        free = np.zeros(x.shape, dtype=np.bool_)
        for view in self._views:
            free |= _looks_through(view, x, y)
        return np.asarray(from_m + STEP_M * np.logical_and.accumulate(free, axis=1).sum(axis=1))

    def _seen_through(self, profile: ObstacleProfile) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return _looks_through(profile, self._points[:, 0], self._points[:, 1])


def _looks_through(view: ObstacleProfile, x_m: Floats, y_m: Floats) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return for places (any shape) north and east whether a view had a depth well behind them."""
    x, y = x_m - view.origin_ned_m[0], y_m - view.origin_ned_m[1]
    width = view.azimuth_rad[1] - view.azimuth_rad[0]
    left = view.azimuth_rad[0] - width / 2
    index = np.floor(((np.arctan2(y, x) - left) % (2 * math.pi)) / width).astype(np.int64)
    known = np.where(view.unknown | view.near, -np.inf, view.range_m)
    known = np.append(np.minimum(known * 0.9 - 0.3, view.trust_m), -np.inf)
    range_m = np.hypot(x, y)
    return np.asarray((range_m < known[np.minimum(index, len(known) - 1)]) & (range_m > 1.15 * view.near_limit_m))
