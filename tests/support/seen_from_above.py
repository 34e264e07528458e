"""What a mission is shown in the unit tests of strategies: a craft, and profiles made of walls that one can write."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.messages.core import DepthSummary
from morpheyes_daemon.strategies.base import Craft
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile
from morpheyes_daemon.transforms import R_FRD_CAM, pose

CRAFT = Craft(Footprint(), pose(R_FRD_CAM, np.array([0.09, 0.0, -0.02])), (0.1, 0.3), 0.2, 3.0, 0.2)
SUMMARY = DepthSummary(1, 0, 0, 0.1, 0.0, 740.0, 0.8, 0.25, 0.5, 1.0, 0.0, 2.0, 0.1, "")
HALF_VIEW_RAD, BINS = 0.6, 121


def empty_profile(t_s: float = 1.0, north_m: float = 0.0, east_m: float = 0.0, yaw_rad: float = 0.0) -> ObstacleProfile:
    """Nothing in sight, to 12 m, by a vehicle 1.5 m above the start."""
    bins = yaw_rad + np.linspace(-HALF_VIEW_RAD, HALF_VIEW_RAD, BINS)
    free, no = np.full(BINS, np.inf), np.zeros(BINS, dtype=np.bool_)
    place, empty = (north_m, east_m), np.empty((0, 2))
    return ObstacleProfile(round(t_s * S), (*place, -1.5), place, bins, free, no, free * np.nan, no, empty, 12.0, 0.5)


def with_points(profile: ObstacleProfile, ned_m: list[tuple[float, float]]) -> ObstacleProfile:
    """The same with obstacles at places north and east, each in its own bin."""
    points = np.array(ned_m, dtype=np.float64).reshape(-1, 2)
    ranges = profile.range_m.copy()
    for north, east in points - profile.origin_ned_m:
        nearest = int(np.argmin(np.abs(profile.azimuth_rad - math.atan2(east, north))))
        ranges[nearest] = min(ranges[nearest], math.hypot(north, east))
    return replace(profile, points_ned_m=points, range_m=ranges)


def blind(profile: ObstacleProfile, from_rad: float = -math.inf, to_rad: float = math.inf) -> ObstacleProfile:
    """The same without depth between two directions."""
    unknown = (profile.azimuth_rad >= from_rad) & (profile.azimuth_rad <= to_rad)
    return replace(profile, unknown=unknown, range_m=np.where(unknown, np.inf, profile.range_m))
