"""A few seconds of obstacle points, so that a tree which has left the view can not be flown into.

Not a map: points are kept in the autopilot's local frame, dropped after `keep_s`, and dropped at once where the
present view looks through them. Beside them it remembers when each direction was last looked at, so that a moment
without depth (the nose up in braking, a blurred patch) is bridged by what was known just before.
"""

from __future__ import annotations

import math

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.profile import Floats, ObstacleProfile

DIRECTIONS = 600
"""Directions around the vehicle of which it is remembered when they were last seen."""


class ObstacleMemory:
    """Obstacle points (N, 2), ned metres, of the last `keep_s`; directions count as seen for `seen_s`."""

    def __init__(self, keep_s: float, seen_s: float) -> None:
        self._keep_ns = round(keep_s * S)
        self._seen_for_ns = round(seen_s * S)
        self._seen_ns: np.ndarray[tuple[int], np.dtype[np.int64]] = np.zeros(DIRECTIONS, dtype=np.int64)
        self._points: Floats = np.empty((0, 2))
        self._born_ns: np.ndarray[tuple[int], np.dtype[np.int64]] = np.empty(0, dtype=np.int64)

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
        self._seen_ns[_direction(profile.azimuth_rad[~profile.unknown])] = profile.t_ns

    def clear(self) -> None:
        """Forget everything."""
        self._points, self._born_ns = self._points[:0], self._born_ns[:0]
        self._seen_ns[:] = 0

    def seen_lately(self, profile: ObstacleProfile) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return (B,) which directions of `profile` had a depth not long before."""
        return np.asarray(self._seen_ns[_direction(profile.azimuth_rad)] > profile.t_ns - self._seen_for_ns)

    def nearest_along(self, profile: ObstacleProfile) -> Floats:
        """Return (B,) the nearest remembered range in each azimuth bin of `profile`, inf where none."""
        nearest = np.full(profile.azimuth_rad.shape, np.inf)
        index, range_m = self._in_bins(profile)
        inside = index >= 0
        np.minimum.at(nearest, index[inside], range_m[inside])
        return nearest

    def _seen_through(self, profile: ObstacleProfile) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        index, range_m = self._in_bins(profile)
        known = np.where(profile.unknown | profile.near, -np.inf, profile.range_m)
        limit = np.where(index >= 0, known[index], -np.inf)
        beyond = np.minimum(limit * 0.9 - 0.3, profile.trust_m)
        return np.asarray((range_m < beyond) & (range_m > 1.15 * profile.near_limit_m))

    def _in_bins(
        self, profile: ObstacleProfile
    ) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Floats]:
        """Azimuth bin (-1: outside the view) and range of every remembered point."""
        x = self._points[:, 0] - profile.origin_ned_m[0]
        y = self._points[:, 1] - profile.origin_ned_m[1]
        width = profile.azimuth_rad[1] - profile.azimuth_rad[0]
        left = profile.azimuth_rad[0] - width / 2
        turned = (np.arctan2(y, x) - left) % (2 * math.pi)
        index = np.floor(turned / width).astype(np.int64)
        return np.where(index < len(profile.azimuth_rad), index, -1), np.hypot(x, y)


def _direction(azimuth_rad: Floats) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.asarray(np.floor(azimuth_rad / (2 * math.pi) * DIRECTIONS).astype(np.int64) % DIRECTIONS)
