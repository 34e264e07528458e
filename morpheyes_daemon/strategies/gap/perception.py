"""Perception of the gap mission: the wall ahead, its openings, and how certain lengths are, from one frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.gap.openings import (
    CrossingPoint,
    Opening,
    Silhouette,
    crossing_frame,
    find_openings,
)
from morpheyes_daemon.strategies.gap.wall_segmentation import segment_wall
from morpheyes_daemon.transforms import Array

SAME_OPENING_M = 0.5
"""Distance from the tracked position up to which an opening is the tracked one.

Chosen: an opening moves 0.1 m between frames; larger confuses neighbouring openings."""

ALONG_SHARE = 0.4
"""Weight of a distance along the wall's normal, relative to one across it. Unit: none.

Chosen: range is measured with about that much less certainty than direction at the stand-off."""

EQUAL_M, LARGER_M = 0.005, 0.02
"""Clearance by which a point may be worse and still count as equal, and by which an opening is larger.

Chosen: half a pixel and two pixels at the stand-off; smaller alternates between openings."""

MIN_RANGE_M = 0.1
"""Smallest range by which a direction is divided.

Chosen: only avoids the division by zero at the wall."""


@dataclass(frozen=True, slots=True, eq=False)
class GapPercept:
    """What one frame shows of wall and openings. `range_m` to the wall along its normal and the normal's heading
    `yaw_rad` are NaN without a wall; `separation` is Ashman's D of the two depth clusters, `bimodal` whether there
    are two. `scale_sigma` is the relative sigma of every length, from the baseline's. `origin_ned_m` is the camera.
    """

    t_ns: int
    bimodal: bool
    separation: float
    range_m: float
    yaw_rad: float
    near_limit_m: float
    scale_sigma: float
    origin_ned_m: tuple[float, float, float]
    silhouette: Silhouette
    openings: tuple[Opening, ...]


def gap_percept(view: View, silhouette: Silhouette) -> GapPercept:
    """Return the wall and its openings in a view; without a wall there are none."""
    depth, T_ned_rect = view.depth, view.T_ned_rect
    found = segment_wall(depth)
    frame = crossing_frame(found.plane, depth.pinhole, T_ned_rect) if found else None
    openings = find_openings(depth, found, frame, silhouette) if found and frame else ()
    north, east, down = (float(x) for x in T_ned_rect[:3, 3])
    return GapPercept(
        t_ns=depth.t_ns,
        bimodal=found.bimodal if found else False,
        separation=found.separation if found else 0.0,
        range_m=frame.range_m if frame else math.nan,
        yaw_rad=frame.yaw_rad if frame else math.nan,
        near_limit_m=depth.near_limit_m,
        scale_sigma=depth.baseline_sigma_m / depth.baseline_m,
        origin_ned_m=(north, east, down),
        silhouette=silhouette,
        openings=openings,
    )


def match_tracked_opening(
    openings: Sequence[Opening], expected_ned_m: Array, ahead: Array, range_known: bool
) -> tuple[Opening, CrossingPoint] | None:
    """Return the opening, and the crossing point in it, nearest to `expected_ned_m` (3,), metres; None for none.

    `ahead` (3,) is the unit normal through the wall; distances along it are ignored unless the range is known. The
    paper's x_s is one of the points where its clearance equals the largest.
    """

    def distance_m(point: CrossingPoint) -> float:
        apart = np.array(point.p_ned_m) - expected_ned_m
        along_m = float(apart @ ahead)
        across_m = float(np.linalg.norm(apart - along_m * ahead))
        return math.hypot(across_m, ALONG_SHARE * along_m if range_known else 0.0)

    near = [(distance_m(point), opening, point) for opening in openings for point in _points(opening)]
    nearest_m, opening, point = min(near, key=lambda row: row[0])
    return (opening, point) if nearest_m < SAME_OPENING_M else None


def at_known_range(known_ned_m: Array, p_ned_m: Array, percept: GapPercept, ahead: Array) -> Array:
    """Return a place (3,), ned metres, in the direction of `p_ned_m` (3,), at the range of `known_ned_m` (3,).

    The range is along the unit normal `ahead` (3,).
    """
    origin = np.array(percept.origin_ned_m)
    known_m, seen_m = float((known_ned_m - origin) @ ahead), float((p_ned_m - origin) @ ahead)
    return np.asarray(origin + (p_ned_m - origin) * known_m / max(MIN_RANGE_M, seen_m))


class LargerOpeningVote:
    """Confirms over consecutive frames that another opening is larger: from afar the largest may not be apparent."""

    def __init__(self, frames: int) -> None:
        self._frames, self._count = frames, 0

    def update(self, others: Sequence[Opening], followed: CrossingPoint) -> bool:
        """Return whether one of the others had LARGER_M more clearance in `frames` consecutive frames."""
        largest_m = max((other.crossing_points[0].clearance_m for other in others if not other.cut), default=-math.inf)
        self._count = self._count + 1 if largest_m > followed.clearance_m + LARGER_M else 0
        return self._count >= self._frames


def _points(opening: Opening) -> tuple[CrossingPoint, ...]:
    equal = opening.safe_point.clearance_m > opening.crossing_points[0].clearance_m - EQUAL_M
    return (*opening.crossing_points, opening.safe_point) if equal else opening.crossing_points
