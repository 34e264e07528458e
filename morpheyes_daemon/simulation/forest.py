"""The forest: trees planted by a seed, as things to see and as things to hit.

Nothing is carved out for the course: trees stand where the seed puts them, except within a small clearing around
the start and the goal. The planted area is wider than the belt that flights use, so the forest looks endless.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from morpheyes_daemon.config import Section
from morpheyes_daemon.simulation import meshes, textures
from morpheyes_daemon.simulation.collision import Solid, ellipsoid_solid, frustum_solid
from morpheyes_daemon.simulation.contents import Contents, Disc
from morpheyes_daemon.simulation.scene import GROUND_OBJECT, Bgr, Light, Material, Mesh
from morpheyes_daemon.simulation.species import BROADLEAVES, CONIFERS, Layer, Species, broadleaf, conifer
from morpheyes_daemon.transforms import Array

LIGHT_MAP_PX = 2048

MAP_HEIGHT_M = 1.5
"""Height at which trunks are drawn on maps."""

FAR_GROUND_M = 110.0
"""The ground goes on this far past the trees; from there on the woods of the sky take over."""

RANGES = ((0.0, 16.0), (16.0, 40.0), (40.0, 110.0))
"""Distances in metres at which the levels of detail of foliage are drawn."""

TRUNK_SIDES = ((20, (0.0, 5.0)), (12, (5.0, 14.0)), (8, (14.0, 32.0)), (6, (32.0, 110.0)))
"""Sides of the prism that stands for a trunk, within half a pixel of it at f = 740 px, by distance in metres."""


class ForestWorld(Section):
    """What a forest file may say."""

    kind: Literal["forest"]
    course_m: float = Field(80.0, ge=10, le=500, description="from the start at (0, 0) to the goal, along x")
    trees_per_ha: float = Field(400.0, ge=0, le=1500)
    radius_min_m: float = Field(0.10, ge=0.03, le=1.0, description="of the trunk at the ground")
    radius_max_m: float = Field(0.40, ge=0.03, le=1.0)
    gap_m: float = Field(0.8, ge=0, le=5, description="smallest free distance between two trunks")
    clearing_m: float = Field(1.5, ge=0.5, le=10, description="no trunk this near to the start and the goal")
    half_width_m: float = Field(45.0, ge=10, le=200, description="trees are planted this far to both sides")
    run_out_m: float = Field(45.0, ge=5, le=200, description="trees are planted this far past the goal")
    run_in_m: float = Field(15.0, ge=2, le=100, description="trees are planted this far behind the start")
    max_lean_deg: float = Field(2.0, ge=0, le=10)
    conifers: float = Field(0.4, ge=0, le=1, description="share of trees")

    @model_validator(mode="after")
    def _ordered(self) -> ForestWorld:
        if self.radius_min_m > self.radius_max_m:
            raise ValueError("radius_min_m must not be greater than radius_max_m")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """A tapered trunk from `base` to `top` (ned) and the foliage it carries, turned about the trunk."""

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

    @property
    def height_m(self) -> float:
        """Length of the trunk."""
        return float(np.linalg.norm(self.top - self.base))

    def radius_at_m(self, height_m: float) -> float:
        """Return the trunk's radius at a height above its base."""
        return self.radius_m + height_m / self.height_m * (self.top_radius_m - self.radius_m)

    def disc_at(self, height_m: float) -> Disc:
        """Return the trunk's section at a height."""
        middle = self.base + height_m / self.height_m * (self.top - self.base)
        return Disc(float(middle[0]), float(middle[1]), self.radius_at_m(height_m))

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


Glades = tuple[tuple[float, float, float], ...]
"""Places kept free of trees: x, y, radius in metres."""


def plant(world: ForestWorld, seed: int, glades: Glades = ()) -> list[Tree]:
    """Place the trees one after the other where they keep `gap_m` to those that stand already."""
    rng = np.random.default_rng([seed, 100])
    x_low, x_high = -world.run_in_m, world.course_m + world.run_out_m
    wanted = round(world.trees_per_ha * (x_high - x_low) * 2 * world.half_width_m / 1e4)
    lean_rad = math.radians(world.max_lean_deg)
    # leaning trunks keep the gap up to 3 m above the ground
    gap = world.gap_m + 2 * 3.0 * math.tan(lean_rad)
    kept = [(0.0, 0.0, world.clearing_m), (world.course_m, 0.0, world.clearing_m), *glades]
    places = np.empty((wanted, 3))
    trees: list[Tree] = []
    for _ in range(100 * wanted):
        if len(trees) == wanted:
            break
        x, y = rng.uniform(x_low, x_high), rng.uniform(-world.half_width_m, world.half_width_m)
        radius = rng.uniform(world.radius_min_m, world.radius_max_m)
        distance = np.hypot(places[: len(trees), 0] - x, places[: len(trees), 1] - y)
        free = bool(np.all(distance - places[: len(trees), 2] - radius >= gap))
        if free and all(math.hypot(x - gx, y - gy) - radius >= r for gx, gy, r in kept):
            places[len(trees)] = x, y, radius
            trees.append(_grow(rng, world, x, y, radius, lean_rad))
    return trees


def _grow(rng: np.random.Generator, world: ForestWorld, x: float, y: float, radius: float, lean_rad: float) -> Tree:
    height = rng.uniform(9.0, 13.0) + 14.0 * radius
    lean, towards = lean_rad * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
    tilt = np.array([math.sin(lean) * math.cos(towards), math.sin(lean) * math.sin(towards), -math.cos(lean)])
    base = np.array([x, y, 0.0])
    is_conifer = bool(rng.random() < world.conifers)
    number = int(rng.integers(0, 1 << 30))
    green = rng.uniform(0.55, 0.9) * np.array([0.8, 0.85, 0.6]) if is_conifer else _leaf_green(rng)
    return Tree(
        base, base + height * tilt, radius, 0.25 * radius,
        conifer(number % CONIFERS) if is_conifer else broadleaf(number % BROADLEAVES), is_conifer,
        width_m=1.1 + 3.0 * radius, turn_rad=rng.uniform(0, 2 * math.pi),
        bark=f"bark{2 if is_conifer else number % 2}", tone=rng.uniform(0.75, 1.2),
        tint=(float(green[0]), float(green[1]), float(green[2])),
    )  # fmt: skip


def _leaf_green(rng: np.random.Generator) -> Array:
    return np.asarray(np.array([0.75, 1.0, 0.95]) * rng.uniform(0.7, 1.25, 3) * rng.uniform(0.8, 1.2))


def forest_contents(world: ForestWorld, seed: int, light: Light, glades: Glades = ()) -> Contents:
    """Return trees and ground; no tree stands in a glade."""
    trees = plant(world, seed, glades)
    parts = [ground(world)]
    solids: list[Solid] = []
    for i, tree in enumerate(trees):
        parts += tree_meshes(tree, i + 1, light)
        solids.append(frustum_solid(tree.base, tree.top, tree.radius_m, tree.top_radius_m))
        solids += [ellipsoid_solid(centre, radii) for centre, radii in tree.crowns()]
    across = (1.0 / _length(world), 1.0 / (2 * world.half_width_m))
    return Contents(
        meshes=tuple(parts),
        solids=tuple(solids),
        discs=tuple(tree.disc_at(MAP_HEIGHT_M) for tree in trees),
        materials={"ground": Material("grass", (0.4, 0.4), "light_map", across)},
        textures={"light_map": light_map(world, trees, light, seed)},
    )


def _length(world: ForestWorld) -> float:
    return world.run_in_m + world.course_m + world.run_out_m


def ground(world: ForestWorld) -> Mesh:
    """Return the ground plane; its texture coordinates start at the corner of the planted area."""
    x = np.array([-world.run_in_m - FAR_GROUND_M, world.course_m + world.run_out_m + FAR_GROUND_M])
    y = np.array([-1.0, 1.0]) * (world.half_width_m + FAR_GROUND_M)
    vertices, uv, _, triangles = meshes.terrain(x, y, np.zeros((2, 2)))
    uv = uv + np.array([world.run_in_m, world.half_width_m])
    return Mesh(vertices, uv, np.ones(len(vertices)), triangles, "ground", GROUND_OBJECT)


def tree_meshes(tree: Tree, object_id: int, light: Light) -> list[Mesh]:
    """Return trunk and foliage of one tree, coarser for greater distances."""
    sun, parts = light.direction, []
    bark: Bgr = (tree.tone, tree.tone, tree.tone)
    for sides, span in TRUNK_SIDES:
        vertices, uv, normals, triangles = meshes.frustum(
            tree.base, tree.top, tree.radius_m, tree.top_radius_m, sides
        )
        share = np.clip(normals @ sun, 0.0, 1.0)
        uv = uv + 7.0 * tree.turn_rad
        parts.append(Mesh(vertices, uv, share, triangles, tree.bark, object_id, bark, draw_range_m=span))
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


def light_map(world: ForestWorld, trees: list[Tree], light: Light, seed: int) -> textures.Texture:
    """Paint the shadows of trunks and crowns and the patches of colour on the ground; one tile is the whole area."""
    rng = np.random.default_rng([seed, 103])
    n = LIGHT_MAP_PX
    scale = np.array([n / _length(world), n / (2 * world.half_width_m)])
    origin = np.array([-world.run_in_m, -world.half_width_m])
    sun = light.direction
    slide = sun[:2] / sun[2]  # how far north and east a shadow falls per metre of height, since z points down

    def pixel(p: Array) -> Array:
        return np.asarray((p[:2] - p[2] * slide - origin) * scale)

    trunks = np.zeros((n, n), np.uint8)
    foliage = np.zeros((n, n), np.uint8)
    for tree in trees:
        a, b = pixel(tree.base), pixel(tree.top)
        side = np.array([-slide[1], slide[0]]) / np.hypot(*slide) * scale
        low, high = tree.radius_m * side, tree.top_radius_m * side
        corners = np.rint(16 * np.array([a + low, a - low, b - high, b + high]))
        cv2.fillConvexPoly(trunks, corners.astype(np.int32), 255, cv2.LINE_AA, 4)
        for crown, radii in tree.crowns():
            along = math.hypot(radii[0], radii[2] * float(np.hypot(*slide)))
            axes = np.rint(16 * np.array([along, radii[1]]) * scale.mean()).astype(int)
            centre = np.rint(16 * pixel(crown)).astype(int)
            angle = math.degrees(math.atan2(slide[1], slide[0]))
            cv2.ellipse(foliage, centre.tolist(), axes.tolist(), angle, 0, 360, 255, -1, cv2.LINE_AA, 4)
    leafy = _field(rng, n, n // 2, 1.2)
    dark = np.float32(0.9 / 255) * cv2.GaussianBlur(foliage, (0, 0), 5) * np.clip(0.6 + 0.55 * leafy, 0, 1)
    sunny = (1 - dark) * (1 - np.float32(0.92 / 255) * cv2.GaussianBlur(trunks, (0, 0), 1.2))
    patches, dry = _field(rng, n, n // 8, 1.5), _field(rng, n, n // 8, 1.4)
    tone = np.stack([128 - 6 * dry, 128 + 7 * patches, 128 + 10 * dry + 3 * patches], axis=-1)
    return textures.finished(tone, 255 * sunny)


def _field(rng: np.random.Generator, size: int, detail: int, slope: float) -> NDArray[np.float32]:
    """Return noise made at `detail` px and enlarged."""
    small = textures.noise(rng, detail, slope=slope).astype(np.float32)
    return np.asarray(cv2.resize(small, (size, size), interpolation=cv2.INTER_CUBIC), dtype=np.float32)
