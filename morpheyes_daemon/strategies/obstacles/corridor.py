"""Free distance along a corridor as wide as the vehicle, for many headings at once."""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.transforms import Array


def free_distance_m(points_m: Array, headings_rad: Array, half_width_m: float, reach_m: float) -> Array:
    """Return (M,) how far a disc of radius `half_width_m` can move from the origin along each heading, metres.

    points_m: (N, 2) obstacle points relative to the disc's centre, metres north and east. headings_rad: (M,). The
    result is at most `reach_m`. A point already inside the disc blocks the headings that approach it and no others.
    """
    free = np.full(headings_rad.shape, reach_m)
    near = points_m[np.hypot(points_m[:, 0], points_m[:, 1]) < reach_m + half_width_m]
    if not len(near):
        return free
    cos, sin = np.cos(headings_rad)[:, None], np.sin(headings_rad)[:, None]
    along = near[:, 0] * cos + near[:, 1] * sin
    across = near[:, 1] * cos - near[:, 0] * sin
    hit = (np.abs(across) < half_width_m) & (along > 0.0)
    chord = np.sqrt(np.maximum(half_width_m**2 - across**2, 0.0))
    distance = np.where(hit, np.maximum(along - chord, 0.0), reach_m)
    return np.asarray(np.minimum(free, distance.min(axis=1)))
