"""What the gap mission takes from one frame: the wall ahead, its openings, and how far lengths can be believed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.gap.openings import Opening, Place, Silhouette, find_openings, passage
from morpheyes_daemon.strategies.gap.wall_segmentation import split
from morpheyes_daemon.transforms import Array

SAME_M = 0.5
"""An opening seen this near to where the tracked one should be is the same."""

ALONG_SHARE = 0.4
"""Of what counts across, along the way: range is seen worse."""

AS_GOOD_M, BETTER_M = 0.005, 0.02
"""A place with so little less room is as good, an opening with so much more is better."""


@dataclass(frozen=True, slots=True, eq=False)
class GapPercept:
    """What one frame shows of wall and openings. `range_m` to the wall along its normal and the normal's heading
    `yaw_rad` are NaN without a wall; `separation` is Ashman's D of the two depth clusters, `bimodal` whether there
    are two. `scale_sigma` is the relative doubt of every length, from the baseline's. `origin_ned_m` is the camera.
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
    """Return what a frame shows of a wall with openings; without a wall there are none."""
    depth, T_ned_rect = view.depth, view.T_ned_rect
    found = split(depth)
    way = passage(found.plane, depth.pinhole, T_ned_rect) if found else None
    openings = find_openings(depth, found, way, silhouette) if found and way else ()
    north, east, down = (float(x) for x in T_ned_rect[:3, 3])
    return GapPercept(
        t_ns=depth.t_ns,
        bimodal=found.bimodal if found else False,
        separation=found.separation if found else 0.0,
        range_m=way.range_m if way else math.nan,
        yaw_rad=way.yaw_rad if way else math.nan,
        near_limit_m=depth.near_limit_m,
        scale_sigma=depth.baseline_sigma_m / depth.baseline_m,
        origin_ned_m=(north, east, down),
        silhouette=silhouette,
        openings=openings,
    )


def tracked_place(
    openings: Sequence[Opening], at_ned_m: Array, ahead: Array, range_known: bool
) -> tuple[Opening, Place] | None:
    """Return which of some openings, and which place in it, is the one that should be at `at_ned_m`, None for none.

    `ahead` (3,) is the way through the wall; along it nothing counts unless the range is known. The paper's x_s is a
    place like others where it is as good as the roomiest.
    """

    def off(place: Place) -> float:
        apart = np.array(place.p_ned_m) - at_ned_m
        along_m = float(apart @ ahead)
        across_m = float(np.linalg.norm(apart - along_m * ahead))
        return math.hypot(across_m, ALONG_SHARE * along_m if range_known else 0.0)

    near = [(off(place), opening, place) for opening in openings for place in _places(opening)]
    off_m, opening, place = min(near, key=lambda row: row[0])
    return (opening, place) if off_m < SAME_M else None


def at_range_of(known_ned_m: Array, p_ned_m: Array, percept: GapPercept, ahead: Array) -> Array:
    """Return a place (3,) in the direction in which it was seen, as far along `ahead` (3,) as a known one."""
    origin = np.array(percept.origin_ned_m)
    known_m, seen_m = float((known_ned_m - origin) @ ahead), float((p_ned_m - origin) @ ahead)
    return np.asarray(origin + (p_ned_m - origin) * known_m / max(0.1, seen_m))


class PassedOver:
    """Whether the opening that is followed is the wrong one: from afar the roomiest may not be told."""

    def __init__(self, frames: int) -> None:
        self._frames, self._seen = frames, 0

    def more_room(self, others: Sequence[Opening], followed: Place) -> bool:
        """Tell whether one of the others has had clearly more room in `frames` frames in a row, up to this one."""
        roomiest_m = max((other.places[0].clearance_m for other in others if not other.cut), default=-math.inf)
        self._seen = self._seen + 1 if roomiest_m > followed.clearance_m + BETTER_M else 0
        return self._seen >= self._frames


def _places(opening: Opening) -> tuple[Place, ...]:
    as_good = opening.safest.clearance_m > opening.places[0].clearance_m - AS_GOOD_M
    return (*opening.places, opening.safest) if as_good else opening.places
