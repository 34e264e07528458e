"""What stood around the flight, seen from above: only known in the simulator, or when somebody measured it.

Plain shapes in ned metres, so that the recorder needs no world model.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Disc:
    """A trunk or post: centre north and east, radius."""

    x_m: float
    y_m: float
    radius_m: float


Polygon = tuple[tuple[float, float], ...]
"""Corners (north, east) in metres of a wall or house."""


@dataclass(frozen=True, slots=True)
class ObstacleMap:
    """Obstacles, start and goal (north, east) in metres; each of them may be unknown."""

    discs: tuple[Disc, ...] = ()
    polygons: tuple[Polygon, ...] = ()
    start_m: tuple[float, float] | None = None
    goal_m: tuple[float, float] | None = None

    def disc_array(self) -> NDArray[np.float64]:
        """Return the discs as (N, 3): north, east, radius."""
        return np.array([(d.x_m, d.y_m, d.radius_m) for d in self.discs], dtype=np.float64).reshape(-1, 3)

    def as_json(self) -> str:
        """Return the scene as text, for the header of a log."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> ObstacleMap:
        """Return the scene of `as_json`."""
        plain = json.loads(text)
        start, goal = plain["start_m"], plain["goal_m"]
        return cls(
            discs=tuple(Disc(**disc) for disc in plain["discs"]),
            polygons=tuple(tuple((x, y) for x, y in corners) for corners in plain["polygons"]),
            start_m=None if start is None else (start[0], start[1]),
            goal_m=None if goal is None else (goal[0], goal[1]),
        )
