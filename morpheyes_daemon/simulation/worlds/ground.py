"""The lie of the land: level, sloping or rolling ground, and the bushes that a rangefinder takes for it.

Height is 0 at the start of the course. What stands on it is the forest's business, how it looks `forest`'s, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.transforms import Array

WAVES = 3


class GroundShape(Section):
    """How a world's ground lies; level by default."""

    slope_deg: float = Field(0.0, ge=-20, le=20, description="rise along the course")
    across_deg: float = Field(0.0, ge=-20, le=20, description="rise to the right of the course")
    rolling_m: float = Field(0.0, ge=0, le=5, description="how far waves go above and below the slope at most")
    rolling_length_m: float = Field(40.0, ge=10, le=500, description="from crest to crest")


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Rise per metre north and east, and waves: wave number north and east (rad/m), phase (rad), height (m).

    `bushes` (N, 6): ellipsoids, centre (ned) and radii.
    """

    rise: tuple[float, float] = (0.0, 0.0)
    waves: tuple[tuple[float, float, float, float], ...] = ()
    bushes: Array | None = None

    @property
    def level(self) -> bool:
        """The height is 0 everywhere."""
        return self.rise == (0.0, 0.0) and not self.waves

    def height_m(self, north_m: float, east_m: float) -> float:
        """Return the height over the start of the course."""
        if self.level:
            return 0.0
        height = self.rise[0] * north_m + self.rise[1] * east_m
        for k_north, k_east, phase, size in self.waves:
            height += size * (math.sin(k_north * north_m + k_east * east_m + phase) - math.sin(phase))
        return height

    def range_m(self, p_ned_m: tuple[float, float, float], direction_ned: tuple[float, float, float]) -> float:
        """Return how far ground or bush is along a direction (unit vector) that points well downwards."""
        (north, east, down), (dn, de, dd) = p_ned_m, direction_ned
        distance = (-self.height_m(north, east) - down) / dd
        if not self.level:
            for _ in range(4):  # the slope times the tangent of the lean is far below 1
                distance = (-self.height_m(north + distance * dn, east + distance * de) - down) / dd
        if self.bushes is None:
            return distance
        return min(distance, _to_ellipsoids_m(self.bushes, np.array(p_ned_m), np.array(direction_ned)))


LEVEL = Ground()


def lay(relief: GroundShape, seed: int) -> Ground:
    """Return the ground that a relief and a seed make."""
    rise = math.tan(math.radians(relief.slope_deg)), math.tan(math.radians(relief.across_deg))
    if relief.rolling_m == 0.0:
        return Ground(rise)
    rng = np.random.default_rng([seed, 107])
    waves = []
    for towards, phase in rng.uniform(0.0, 2.0 * math.pi, (WAVES, 2)).tolist():
        k = 2.0 * math.pi / relief.rolling_length_m
        waves.append((k * math.cos(towards), k * math.sin(towards), phase, relief.rolling_m / WAVES))
    return Ground(rise, tuple(waves))


def _to_ellipsoids_m(ellipsoids: Array, p: Array, direction: Array) -> float:
    """Return the distance along a ray to the nearest ellipsoid ahead, inf where it meets none."""
    radii = ellipsoids[:, 3:]
    start, step = (p - ellipsoids[:, :3]) / radii, direction / radii
    a, b, c = (step * step).sum(axis=1), (start * step).sum(axis=1), (start * start).sum(axis=1) - 1.0
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    near = np.where((b * b > a * c) & (root - b > 0.0), np.maximum((-b - root) / a, 0.0), np.inf)
    return float(near.min(initial=np.inf))
