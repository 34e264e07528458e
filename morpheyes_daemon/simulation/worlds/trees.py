"""A tree or a bush: what it shows and what of it can be hit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.simulation.rendering import meshes
from morpheyes_daemon.simulation.rendering.scene import Bgr, Light, Mesh
from morpheyes_daemon.simulation.worlds.collision import Solid, ellipsoid_solid, frustum_solid
from morpheyes_daemon.simulation.worlds.species import Layer, Species
from morpheyes_daemon.simulation.worlds.world import Disc
from morpheyes_daemon.transforms import Array

RANGES = ((0.0, 16.0), (16.0, 40.0), (40.0, 110.0))
"""Distances in metres at which the levels of detail of foliage are drawn."""

TRUNK_SIDES = ((20, (0.0, 5.0)), (12, (5.0, 14.0)), (8, (14.0, 32.0)), (6, (32.0, 110.0)))
"""Sides of the prism that stands for a trunk, within half a pixel of it at f = 740 px, by distance in metres."""

BRANCH_SIDES = ((6, (0.0, 8.0)), (3, (8.0, 32.0)))
"""The same of a branch, which is too thin to be seen from further away."""


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """A bare branch from the middle of a trunk to its tip (ned)."""

    base: Array
    tip: Array
    radius_m: float

    @property
    def tip_radius_m(self) -> float:
        """Radius at the tip."""
        return 0.4 * self.radius_m


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """A tapered trunk from `base` to `top` (ned) and the foliage it carries, turned about the trunk.

    A bush shows no trunk; its `base` and `top` are how high it stands.
    """

    base: Array
    top: Array
    radius_m: float
    top_radius_m: float
    species: Species
    conifer: bool
    width_m: float
    turn_rad: float
    bark: str
    tone: float
    tint: Bgr
    branches: tuple[Branch, ...] = ()
    bush: bool = False

    @property
    def height_m(self) -> float:
        """Length of the trunk."""
        return float(np.linalg.norm(self.top - self.base))

    def radius_at_m(self, height_m: float) -> float:
        """Return the trunk's radius at a height above its base."""
        return self.radius_m + height_m / self.height_m * (self.top_radius_m - self.radius_m)

    def disc_at(self, height_m: float) -> Disc:
        """Return the trunk's section at a height, or all of a bush."""
        middle = self.base + height_m / self.height_m * (self.top - self.base)
        radius_m = self.width_m if self.bush else self.radius_at_m(height_m)
        return Disc(float(middle[0]), float(middle[1]), radius_m)

    def placed(self, unit: Array) -> Array:
        """Return unit-space points (n, 3) of the species in ned: turned, widened, carried along the trunk."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        across = self.width_m * np.array([[c, s, 0.0], [-s, c, 0.0]])
        return np.asarray(self.base + unit @ np.vstack([across, self.top - self.base]))

    def crowns(self) -> list[tuple[Array, Array]]:
        """Return the ellipsoids of foliage: centre (ned) and radii (across, across, up)."""
        centres = self.placed(self.species.crowns[:, :3])
        radii = self.species.crowns[:, 3:] * (self.width_m, self.width_m, self.height_m)
        return list(zip(centres, radii, strict=True))

    def solids(self) -> list[Solid]:
        """Return what of it can be hit."""
        trunk = [] if self.bush else [frustum_solid(self.base, self.top, self.radius_m, self.top_radius_m)]
        branches = [frustum_solid(b.base, b.tip, b.radius_m, b.tip_radius_m) for b in self.branches]
        return trunk + [ellipsoid_solid(centre, radii) for centre, radii in self.crowns()] + branches


def tree_meshes(tree: Tree, object_id: int, light: Light) -> list[Mesh]:
    """Return trunk and foliage of one tree, coarser for greater distances."""
    sun, parts = light.direction, []
    bark: Bgr = (tree.tone, tree.tone, tree.tone)
    for sides, span in () if tree.bush else TRUNK_SIDES:
        vertices, uv, normals, triangles = meshes.frustum(tree.base, tree.top, tree.radius_m, tree.top_radius_m, sides)
        share = np.clip(normals @ sun, 0.0, 1.0)
        uv = uv + 7.0 * tree.turn_rad
        parts.append(Mesh(vertices, uv, share, triangles, tree.bark, object_id, bark, draw_range_m=span))
    for sides, span in BRANCH_SIDES if tree.branches else ():
        joined = meshes.joined([meshes.frustum(b.base, b.tip, b.radius_m, b.tip_radius_m, sides) for b in tree.branches])
        share = np.clip(joined[2] @ sun, 0.0, 1.0)
        parts.append(Mesh(joined[0], joined[1], share, joined[3], tree.bark, object_id, bark, draw_range_m=span))
    return parts + [_foliage(tree, layer, object_id, sun) for layer in tree.species.layers]


def _foliage(tree: Tree, layer: Layer, object_id: int, sun: Array) -> Mesh:
    """Set one layer of the species on the tree; sun reaches around leaves."""
    vertices, uv, normals, triangles = layer.surface
    c, s = math.cos(tree.turn_rad), math.sin(tree.turn_rad)
    sun_unit = np.array([c * sun[0] + s * sun[1], c * sun[1] - s * sun[0], sun[2]])
    share = np.clip((normals @ sun_unit + 0.45) / 1.45, 0.0, 1.0)
    depth = 0.7 if layer.dark else 1.0
    tint: Bgr = (depth * tree.tint[0], depth * tree.tint[1], depth * tree.tint[2])
    return Mesh(
        tree.placed(vertices), uv * tree.width_m, share, triangles, "leaves1" if tree.conifer else "leaves0",
        object_id, tint, 1.0, layer.two_sided, layer.loose, RANGES[layer.level],
    )  # fmt: skip
