"""The room: four textured walls and a cube that moves along waypoints, to be watched, followed or dodged."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config import Section
from morpheyes_daemon.simulation import meshes
from morpheyes_daemon.simulation.collision import MovingObstacles, Obstacles, box_solid
from morpheyes_daemon.simulation.contents import Contents, lit
from morpheyes_daemon.simulation.motion import along_waypoints
from morpheyes_daemon.simulation.scene import GROUND_OBJECT, Light, MovingObject
from morpheyes_daemon.transforms import Array, pose

CUBE_OBJECT, ROOM_OBJECT = 1, 2
PLATE_M = 0.2
"""Thickness of walls, floor and ceiling."""


class Cube(Section):
    """A textured cube; between waypoints [t_s, x_m, y_m, height_m] it moves smoothly, before and after it rests."""

    edge_mm: float = Field(300.0, ge=50, le=2000)
    waypoints: tuple[tuple[float, float, float, float], ...] = Field(min_length=2)
    spin_deg_s: float = Field(25.0, ge=-360, le=360)
    scatter: float = Field(
        0.0, ge=0, le=0.3, description="each waypoint is moved by the seed: sideways by this share of x, half in height"
    )

    @model_validator(mode="after")
    def _in_order(self) -> Cube:
        times = [waypoint[0] for waypoint in self.waypoints]
        if any(later <= earlier for earlier, later in pairwise(times)):
            raise ValueError("the times of the waypoints must grow from one to the next")
        return self


class RoomWorld(Section):
    """What a room file may say; the start is (0, 0), the room reaches from `behind_m` behind it along x."""

    kind: Literal["room"]
    behind_m: float = Field(3.0, ge=1, le=50)
    length_m: float = Field(24.0, ge=4, le=200)
    width_m: float = Field(9.0, ge=2, le=100)
    height_m: float = Field(4.0, ge=2, le=20)
    pillars: tuple[tuple[float, float, float], ...] = Field((), description="x_m, y_m and edge_m of square columns")
    cube: Cube | None = None


LAMPS = Light(
    towards_sun=(-0.35, -0.25, -0.9),
    sun=(1.0, 1.15, 1.2),
    sky=(0.7, 0.72, 0.72),
    haze=(0.5, 0.5, 0.5),
    haze_range_m=1e4,
)
"""Light indoors: lamps at the ceiling, bright walls, no haze."""

LAMPS_APART_M, LAMPS_BELOW_M = 8.0, 0.02
"""From one lamp to the next along the room, and how far below the ceiling they hang."""


def room_light(world: RoomWorld) -> Light:
    """Return the light of a room, with a row of lamps."""
    count = max(1, round(world.length_m / LAMPS_APART_M))
    along_m = [(k + 0.5) * world.length_m / count - world.behind_m for k in range(count)]
    return replace(LAMPS, lamps_ned_m=tuple((x_m, 0.0, LAMPS_BELOW_M - world.height_m) for x_m in along_m))


def room_contents(world: RoomWorld, light: Light, seed: int = 0) -> Contents:
    """Return the room and its cube, whose way depends on the seed if it is scattered."""
    x0, x1 = -world.behind_m, world.length_m - world.behind_m
    middle, half, top = 0.5 * (x0 + x1), 0.5 * world.width_m, world.height_m
    length, width = world.length_m + 2 * PLATE_M, world.width_m + 2 * PLATE_M
    plates = (
        ("plaster0", (x0 - PLATE_M / 2, 0.0, -top / 2), (PLATE_M, width, top)),
        ("mural", (x1 + PLATE_M / 2, 0.0, -top / 2), (PLATE_M, width, top)),
        ("plaster1", (middle, -half - PLATE_M / 2, -top / 2), (length, PLATE_M, top)),
        ("plaster1", (middle, half + PLATE_M / 2, -top / 2), (length, PLATE_M, top)),
        ("plaster0", (middle, 0.0, -top - PLATE_M / 2), (length, width, PLATE_M)),
        *(("patchwork", (x, y, -top / 2), (edge, edge, top)) for x, y, edge in world.pillars),
    )
    found = [(material, pose(np.eye(3), np.array(place)), edges) for material, place, edges in plates]
    floor = meshes.box(pose(np.eye(3), np.array([middle, 0.0, PLATE_M / 2])), (length, width, PLATE_M))
    walls = tuple(lit(meshes.box(T, edges), material, ROOM_OBJECT, light.direction) for material, T, edges in found)
    room = Contents(
        meshes=(*walls, lit(floor, "planks", GROUND_OBJECT, light.direction)),
        solids=tuple(box_solid(T, edges) for _, T, edges in found),
    )
    return room if world.cube is None else room + cube_contents(world.cube, light, seed)


def cube_contents(cube: Cube, light: Light, seed: int = 0) -> Contents:
    """Return the moving cube."""
    edges = (cube.edge_mm / 1e3,) * 3
    T_ned_cube = along_waypoints(_scattered(cube, seed), math.radians(cube.spin_deg_s))
    mesh = lit(meshes.box(np.eye(4), edges), "patchwork", CUBE_OBJECT, light.direction)
    return Contents(
        moving=(MovingObject((mesh,), T_ned_cube, "cube"),),
        obstacles=(MovingObstacles(Obstacles([box_solid(np.eye(4), edges)]), T_ned_cube),),
    )


def _scattered(cube: Cube, seed: int) -> Array:
    """Return the waypoints (N, 4), moved by the seed; the cube stays off the floor."""
    waypoints = np.array(cube.waypoints)
    shift = np.random.default_rng([seed, 500]).uniform(-1.0, 1.0, (len(waypoints), 2))
    waypoints[:, 2:] += cube.scatter * waypoints[:, 1:2] * shift * (1.0, 0.5)
    waypoints[:, 3] = np.maximum(waypoints[:, 3], 2.0 * cube.edge_mm / 1e3)
    return waypoints
