"""What a world is made of, piece by piece: things to see with the solids that stand for them in collisions.

Forest, gap and room each give `WorldContents`; `worlds` adds them up, so a mixed course is a sum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from morpheyes_daemon.simulation.rendering.meshes import Surface
from morpheyes_daemon.simulation.rendering.scene import Bgr, Material, Mesh, MovingObject
from morpheyes_daemon.simulation.rendering.textures import Texture
from morpheyes_daemon.simulation.worlds.collision import MovingObstacles, Solid
from morpheyes_daemon.simulation.worlds.ground import LEVEL, Ground
from morpheyes_daemon.simulation.worlds.trajectories import PoseAt
from morpheyes_daemon.transforms import Array

FLYING_HEIGHT_M = 1.5
"""Height of start and goal over the ground."""

START_ROOM_M = 0.3
"""Half the width of a vehicle with its eyes apart: this near to the start and the goal nothing may stand."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A round obstacle on the map: a trunk at flying height."""

    x_m: float
    y_m: float
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class GapTruth:
    """A wall with openings: outlines (n, 2) = y, z in the wall's frame, whose pose is `T_ned_wall(t_s)`.

    It reaches `half_width_m` to either side of its frame's middle.
    """

    outlines: tuple[Array, ...]
    T_ned_wall: PoseAt
    thickness_m: float
    half_width_m: float


@dataclass(frozen=True, slots=True, eq=False)
class WorldContents:
    """Some things of a world; adding two gives both, on the ground of the first."""

    meshes: tuple[Mesh, ...] = ()
    solids: tuple[Solid, ...] = ()
    moving: tuple[MovingObject, ...] = ()
    obstacles: tuple[MovingObstacles, ...] = ()
    discs: tuple[Disc, ...] = ()
    gaps: tuple[GapTruth, ...] = ()
    materials: Mapping[str, Material] = field(default_factory=dict)
    textures: Mapping[str, Texture] = field(default_factory=dict)
    ground: Ground = LEVEL

    def __add__(self, other: WorldContents) -> WorldContents:
        return WorldContents(
            self.meshes + other.meshes,
            self.solids + other.solids,
            self.moving + other.moving,
            self.obstacles + other.obstacles,
            self.discs + other.discs,
            self.gaps + other.gaps,
            {**self.materials, **other.materials},
            {**self.textures, **other.textures},
            self.ground,
        )


def lit(
    surface: Surface, material: str, object_id: int, towards_sun: Array, tint: Bgr = (1.0, 1.0, 1.0),
    two_sided: bool = False,
) -> Mesh:  # fmt: skip
    """Make a mesh of a surface that the sun shines on."""
    vertices, uv, normals, triangles = surface
    share = np.clip(normals @ towards_sun, 0.0, 1.0)
    return Mesh(vertices, uv, share, triangles, material, object_id, tint, two_sided=two_sided)
