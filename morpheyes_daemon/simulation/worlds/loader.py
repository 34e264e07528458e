"""Worlds by name or path: YAML files into scenes to look at and obstacles to hit.

The daemon never imports this; it is the truth of the simulator. A world file says what kind of world it is and gives
that kind's parameters; the seed plants it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.config.yaml_errors import load_model
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.simulation.rendering import meshes, textures
from morpheyes_daemon.simulation.rendering.materials import materials_of, textures_of
from morpheyes_daemon.simulation.rendering.scene import SKY_OBJECT, Bgr, Light, Mesh, Scene
from morpheyes_daemon.simulation.worlds.collision import CollisionWorld, VehicleShape
from morpheyes_daemon.simulation.worlds.forest_world import ForestWorld, forest_contents
from morpheyes_daemon.simulation.worlds.gap_world import GapWorld, gap_contents
from morpheyes_daemon.simulation.worlds.ground import LEVEL, Ground, GroundShape
from morpheyes_daemon.simulation.worlds.room_world import Cube, RoomWorld, cube_contents, room_contents, room_light
from morpheyes_daemon.simulation.worlds.world import FLYING_HEIGHT_M, START_ROOM_M, Disc, GapTruth, WorldContents
from morpheyes_daemon.transforms import Array

FOLDER = Path(__file__).parent


class MixedWorld(Section):
    """A forest, a wall with an opening in a glade of it, and a cube that crosses behind."""

    kind: Literal["mixed"]
    forest: ForestWorld
    gap: GapWorld
    cube: Cube | None = None

    @model_validator(mode="after")
    def _level(self) -> MixedWorld:
        if self.forest.relief != GroundShape():
            raise ValueError("the ground of a mixed course must be level, since the wall stands on it")
        return self

    @model_validator(mode="after")
    def _wall_on_the_course(self) -> MixedWorld:
        course_m, wall_m = self.forest.course_m, self.gap.distance_m
        mural_m = wall_m + self.gap.mural_m
        if wall_m > course_m - START_ROOM_M:
            raise ValueError(f"the wall at {wall_m:g} m must stand on the course, which ends at {course_m:g} m")
        if self.forest.goal and abs(mural_m - course_m) < START_ROOM_M:
            raise ValueError(f"the mural at {mural_m:g} m stands on the goal at {course_m:g} m; change mural_m")
        return self


AnyWorld = Annotated[ForestWorld | GapWorld | RoomWorld | MixedWorld, Field(discriminator="kind")]


class Daylight(Section):
    """Where the sun stands and how much of its light and the sky's comes through."""

    sun_bearing_deg: float = Field(230.7, ge=-360, le=360, description="clockwise from the course")
    sun_elevation_deg: float = Field(44.6, ge=10, le=90)
    sun: float = Field(1.0, ge=0, le=3, description="times a clear day's")
    sky: float = Field(1.0, ge=0.02, le=3, description="times a clear day's")
    haze_range_m: float = Field(90.0, ge=10, le=1e4)
    unsteady: float = Field(0.0, ge=0, le=0.9, description="by how much the exposure misses the light as clouds move")

    def light(self) -> Light:
        """Return it as the scene has it."""
        up, towards = math.radians(self.sun_elevation_deg), math.radians(self.sun_bearing_deg)
        clear = Light()
        return Light(
            (math.cos(up) * math.cos(towards), math.cos(up) * math.sin(towards), -math.sin(up)),
            _times(clear.sun, self.sun), _times(clear.sky, self.sky), _times(clear.haze, self.sky), self.haze_range_m,
        )  # fmt: skip


def _times(colour: Bgr, factor: float) -> Bgr:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


class WorldFile(Section):
    """The whole of a world file."""

    description: str = ""
    world: AnyWorld
    light: Daylight | None = Field(None, description="out of doors; a clear day when left out")


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A planted world: what is seen, what is hit, where a flight starts and where it should end (ned).

    `discs` are trunks for the map, `gaps` the walls with openings. Where there is no place to reach (a room to watch
    something in) the goal is None, and a flight is over when the mission says so. `heading_rad` is the vehicle's at the
    start.
    """

    scene: Scene
    collisions: CollisionWorld
    start_ned_m: tuple[float, float, float]
    goal_ned_m: tuple[float, float, float] | None
    discs: tuple[Disc, ...] = ()
    gaps: tuple[GapTruth, ...] = ()
    ground: Ground = LEVEL
    heading_rad: float = 0.0

    def to_goal_m(self, p_ned_m: Sequence[float]) -> float:
        """Return the horizontal distance from a place to the goal, 0 where there is none."""
        goal = self.goal_ned_m
        return 0.0 if goal is None else math.hypot(p_ned_m[0] - goal[0], p_ned_m[1] - goal[1])

    def clearance_m(
        self, p_ned_m: Array, R_ned_frd: Array, shape: VehicleShape, baseline_m: float, t_s: float = 0.0
    ) -> float:
        """Return the signed distance from the vehicle to the nearest obstacle, ground aside; see `collision`."""
        return self.collisions.clearance_m(p_ned_m, R_ned_frd, shape, baseline_m, t_s)


def world_names() -> list[str]:
    """Return the names of the worlds that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_world(name: str) -> WorldFile:
    """Read a world by the name of a shipped one or by path; raises ConfigError."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return load_model(path, WorldFile)
    if name not in world_names():
        raise ConfigError(f"There is no world {name!r}; choose one of {', '.join(world_names())} or give a file.")
    return load_model(FOLDER / f"{name}.yaml", WorldFile)


def build_world(file: WorldFile, seed: int) -> World:
    """Plant a world by its seed."""
    world, light = file.world, Light() if file.light is None else file.light.light()
    match world:
        case ForestWorld():
            planted = _world(forest_contents(world, seed, light), light, world.course_m if world.goal else None)
            return replace(planted, heading_rad=math.radians(world.heading_deg))
        case GapWorld():
            return _world(gap_contents(world, seed, light), light, _behind_wall_m(world))
        case RoomWorld():
            light = room_light(world)
            return _world(room_contents(world, light, seed), light, None, with_sky=False)
        case MixedWorld():
            goal_m = world.forest.course_m if world.forest.goal else None
            planted = _world(_mixed(world, seed, light), light, goal_m)
            return replace(planted, heading_rad=math.radians(world.forest.heading_deg))


def _behind_wall_m(world: GapWorld) -> float:
    return world.distance_m + 0.5 * world.mural_m


def _mixed(world: MixedWorld, seed: int, light: Light) -> WorldContents:
    gap = world.gap.model_copy(update={"meadow": False})
    glade = (gap.distance_m + 0.5 * gap.mural_m, 0.0, gap.half_width_m + gap.mural_m + 2.0)
    found = forest_contents(world.forest, seed, light, (glade,)) + gap_contents(gap, seed, light)
    return found if world.cube is None else found + cube_contents(world.cube, light, seed)


def _world(contents: WorldContents, light: Light, goal_m: float | None, with_sky: bool = True) -> World:
    sky = sky_mesh() if with_sky else None
    shown = [*contents.meshes, *(mesh for body in contents.moving for mesh in body.meshes), *([sky] if sky else [])]
    materials = materials_of(shown, contents.materials)
    scene = Scene(
        contents.meshes, materials, textures_of(materials.values(), contents.textures), light, sky, contents.moving
    )
    collisions = CollisionWorld(contents.solids, contents.obstacles)
    start = (0.0, 0.0, -FLYING_HEIGHT_M)
    ground = contents.ground
    goal = None if goal_m is None else (goal_m, 0.0, -FLYING_HEIGHT_M - ground.height_m(goal_m, 0.0))
    return World(scene, collisions, start, goal, contents.discs, contents.gaps, ground)


def sky_mesh() -> Mesh:
    """Return the dome that follows the eye."""
    vertices, uv, _, triangles = meshes.sky_dome(math.radians(textures.SKY_LOWEST_DEG))
    return Mesh(vertices, uv, np.ones(len(vertices)), triangles, "sky", SKY_OBJECT, two_sided=True)
