"""Worlds by name or path: YAML files into scenes to look at and obstacles to hit.

The daemon never imports this; it is the truth of the simulator. A world file says what kind of world it is and gives
that kind's parameters; the seed plants it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from morpheyes_daemon.config import Section
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.simulation import forest
from morpheyes_daemon.simulation.collision import CollisionWorld, Solid, VehicleShape, ellipsoid_solid, frustum_solid
from morpheyes_daemon.simulation.forest import ForestWorld
from morpheyes_daemon.simulation.scene import Scene
from morpheyes_daemon.transforms import Array
from morpheyes_daemon.yaml_source import load_model

FOLDER = Path(__file__).parent / "worlds"


class WorldFile(Section):
    """The whole of a world file."""

    description: str = ""
    world: ForestWorld


@dataclass(frozen=True, slots=True)
class Disc:
    """A round obstacle on the map: a trunk at flying height."""

    x_m: float
    y_m: float
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A planted world: what is seen, what is hit, where a flight starts and where it should end (ned)."""

    scene: Scene
    collisions: CollisionWorld
    start_ned_m: tuple[float, float, float]
    goal_ned_m: tuple[float, float, float]
    discs: tuple[Disc, ...]

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
    return _build_forest(file.world, seed)


def _build_forest(world: ForestWorld, seed: int, height_m: float = 1.5) -> World:
    scene, trees = forest.build_scene(world, seed)
    solids: list[Solid] = []
    for tree in trees:
        solids.append(frustum_solid(tree.base, tree.top, tree.radius_m, tree.top_radius_m))
        solids += [ellipsoid_solid(centre, radii) for centre, radii in tree.crowns()]
    discs = []
    for tree in trees:
        middle = tree.base + height_m / tree.height_m * (tree.top - tree.base)
        discs.append(Disc(float(middle[0]), float(middle[1]), tree.radius_at_m(height_m)))
    start, goal = (0.0, 0.0, -height_m), (world.course_m, 0.0, -height_m)
    return World(scene, CollisionWorld(solids), start, goal, tuple(discs))
