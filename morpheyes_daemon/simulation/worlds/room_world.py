"""The room: four textured walls and a cube that moves along waypoints, to be watched, followed or dodged."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.simulation.rendering import meshes
from morpheyes_daemon.simulation.rendering.scene import GROUND_OBJECT, Light, MovingObject
from morpheyes_daemon.simulation.worlds.collision import MovingObstacles, Obstacles, box_solid
from morpheyes_daemon.simulation.worlds.trajectories import along_waypoints
from morpheyes_daemon.simulation.worlds.world import FLYING_HEIGHT_M, START_ROOM_M, WorldContents, lit
from morpheyes_daemon.transforms import Array, pose

CUBE_OBJECT, ROOM_OBJECT = 1, 2
PLATE_M = 0.2
"""Thickness of walls, floor and ceiling."""
LOWEST_EDGES = 2.0
"""The cube's middle stays this many edges above the floor."""


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

    @model_validator(mode="after")
    def _above_ground(self) -> Cube:
        for t_s, _, _, height_m in self.waypoints:
            if height_m < 0.5 * self.edge_mm / 1e3:
                raise ValueError(f"the waypoint at {t_s:g} s has the cube in the ground; give the height of its middle")
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

    @property
    def x_range_m(self) -> tuple[float, float]:
        """Where the room begins and ends along the course."""
        return -self.behind_m, self.length_m - self.behind_m

    @model_validator(mode="after")
    def _start_is_free(self) -> RoomWorld:
        (x0, x1), half = self.x_range_m, 0.5 * self.width_m
        if x1 <= START_ROOM_M:
            raise ValueError("the start lies outside the room: behind_m must be less than length_m")
        for x, y, edge in self.pillars:
            if edge <= 0.0:
                raise ValueError(f"the pillar at {x:g}, {y:g} m needs an edge of more than 0 m")
            if not (x0 < x < x1 and abs(y) < half):
                raise ValueError(f"the pillar at {x:g}, {y:g} m stands outside the room, {self._extent}")
            if max(abs(x), abs(y)) < 0.5 * edge + START_ROOM_M:
                raise ValueError(f"the pillar at {x:g}, {y:g} m stands on the start, which is at 0, 0")
        return self

    @model_validator(mode="after")
    def _cube_has_room(self) -> RoomWorld:
        """The cube's waypoints, as far as the seed may move them, leave half an edge to everything."""
        if self.cube is None:
            return self
        (x0, x1), half, top = self.x_range_m, 0.5 * self.width_m, self.height_m
        edge = self.cube.edge_mm / 1e3
        reach = 0.5 * edge
        if LOWEST_EDGES * edge + reach > top:
            raise ValueError(f"a cube of {edge:g} m, which stays {LOWEST_EDGES * edge:g} m up, is too high for the room")
        for t_s, x, y, height in self.cube.waypoints:
            aside = self.cube.scatter * abs(x)
            inside = x0 + reach <= x <= x1 - reach and abs(y) + aside + reach <= half
            if not (inside and height + 0.5 * aside + reach <= top):
                raise ValueError(f"the waypoint at {t_s:g} s takes the cube out of the room, {self._extent}")
            if any(max(abs(x - px), abs(y - py)) < reach + 0.5 * thick for px, py, thick in self.pillars):
                raise ValueError(f"the waypoint at {t_s:g} s has the cube in a pillar")
        _, x, y, height = self.cube.waypoints[0]
        if max(abs(x), abs(y)) < reach + START_ROOM_M and height - reach < FLYING_HEIGHT_M + START_ROOM_M:
            raise ValueError("the cube waits for its first waypoint's time where the vehicle starts, at 0, 0")
        return self

    @property
    def _extent(self) -> str:
        x0, x1 = self.x_range_m
        sides = f"{0.5 * self.width_m:g} m to both sides"
        return f"which reaches from {x0:g} to {x1:g} m along x, {sides} and {self.height_m:g} m up"


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


def room_contents(world: RoomWorld, light: Light, seed: int = 0) -> WorldContents:
    """Return the room and its cube, whose way depends on the seed if it is scattered."""
    x0, x1 = world.x_range_m
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
    room = WorldContents(
        meshes=(*walls, lit(floor, "planks", GROUND_OBJECT, light.direction)),
        solids=tuple(box_solid(T, edges) for _, T, edges in found),
    )
    return room if world.cube is None else room + cube_contents(world.cube, light, seed)


def cube_contents(cube: Cube, light: Light, seed: int = 0) -> WorldContents:
    """Return the moving cube."""
    edges = (cube.edge_mm / 1e3,) * 3
    T_ned_cube = along_waypoints(_scattered(cube, seed), math.radians(cube.spin_deg_s))
    mesh = lit(meshes.box(np.eye(4), edges), "patchwork", CUBE_OBJECT, light.direction)
    return WorldContents(
        moving=(MovingObject((mesh,), T_ned_cube, "cube"),),
        obstacles=(MovingObstacles(Obstacles([box_solid(np.eye(4), edges)]), T_ned_cube),),
    )


def _scattered(cube: Cube, seed: int) -> Array:
    """Return the waypoints (N, 4), moved by the seed; the cube stays off the floor."""
    waypoints = np.array(cube.waypoints)
    shift = np.random.default_rng([seed, 500]).uniform(-1.0, 1.0, (len(waypoints), 2))
    waypoints[:, 2:] += cube.scatter * waypoints[:, 1:2] * shift * (1.0, 0.5)
    waypoints[:, 3] = np.maximum(waypoints[:, 3], LOWEST_EDGES * cube.edge_mm / 1e3)
    return waypoints
