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
from pydantic import Field

from morpheyes_daemon.config import Section
from morpheyes_daemon.simulation import meshes, textures
from morpheyes_daemon.simulation.scene import GROUND_OBJECT, SKY_OBJECT, Bgr, Light, Material, Mesh, Scene

Array = NDArray[np.float64]

LIGHT_MAP_PX = 2048
FAR_GROUND_M = 600.0

NEAR, MIDDLE, FAR = (0.0, 16.0), (16.0, 42.0), (42.0, 130.0)


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


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """A tapered trunk from `base` to `top` (ned) and what it carries."""

    base: Array
    top: Array
    radius_m: float
    top_radius_m: float
    conifer: bool
    seed: int

    @property
    def height_m(self) -> float:
        """Length of the trunk."""
        return float(np.linalg.norm(self.top - self.base))


def plant(world: ForestWorld, seed: int) -> list[Tree]:
    """Place the trees one after the other where they keep `gap_m` to those that stand already."""
    rng = np.random.default_rng([seed, 100])
    x_low, x_high = -world.run_in_m, world.course_m + world.run_out_m
    wanted = round(world.trees_per_ha * (x_high - x_low) * 2 * world.half_width_m / 1e4)
    lean_rad = math.radians(world.max_lean_deg)
    # leaning trunks keep the gap up to 3 m above the ground
    gap = world.gap_m + 2 * 3.0 * math.tan(lean_rad)
    places = np.empty((wanted, 3))
    trees: list[Tree] = []
    for _ in range(100 * wanted):
        if len(trees) == wanted:
            break
        x, y = rng.uniform(x_low, x_high), rng.uniform(-world.half_width_m, world.half_width_m)
        radius = rng.uniform(world.radius_min_m, world.radius_max_m)
        distance = np.hypot(places[: len(trees), 0] - x, places[: len(trees), 1] - y)
        free = bool(np.all(distance - places[: len(trees), 2] - radius >= gap))
        from_ends = min(math.hypot(x, y), math.hypot(x - world.course_m, y)) - radius
        if free and from_ends >= world.clearing_m:
            places[len(trees)] = x, y, radius
            trees.append(_grow(rng, world, x, y, radius, lean_rad, seed=len(trees)))
    return trees


def _grow(
    rng: np.random.Generator, world: ForestWorld, x: float, y: float, radius: float, lean_rad: float, seed: int
) -> Tree:
    height = rng.uniform(9.0, 13.0) + 14.0 * radius
    lean, towards = lean_rad * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
    tilt = np.array([math.sin(lean) * math.cos(towards), math.sin(lean) * math.sin(towards), -math.cos(lean)])
    base = np.array([x, y, 0.0])
    return Tree(base, base + height * tilt, radius, 0.25 * radius, bool(rng.random() < world.conifers), seed)


@dataclass(frozen=True, slots=True, eq=False)
class Crown:
    """One ellipsoid of foliage with vertical axis: centre (ned) and radii (across, across, up)."""

    centre: Array
    radii: Array


def crowns(tree: Tree) -> list[Crown]:
    """Return the foliage of a tree; conifers are described by one slender ellipsoid."""
    rng = np.random.default_rng([tree.seed, 101])
    up = (tree.top - tree.base) / tree.height_m
    spread = 1.1 + 3.0 * tree.radius_m
    if tree.conifer:
        low = rng.uniform(3.2, 4.6)
        half = 0.5 * (tree.height_m + 0.8 - low)
        return [Crown(tree.base + up * (low + half), np.array([spread, spread, half]))]
    low = rng.uniform(4.2, 6.0)
    found = []
    for k in range(6):
        along = rng.uniform(low + 1.0, tree.height_m)
        angle = 2 * math.pi * (k / 6 + 0.1 * rng.random())
        out = spread * rng.uniform(0.35, 0.9) * (1.0 if k else 0.0)
        centre = tree.base + up * along + np.array([out * math.cos(angle), out * math.sin(angle), 0.0])
        width = spread * rng.uniform(0.6, 0.9)
        found.append(Crown(centre, np.array([width, width, min(0.7 * width, along - low + 0.6)])))
    return found


def build_scene(world: ForestWorld, seed: int) -> tuple[Scene, list[Tree]]:
    """Return what a camera sees of the forest, and its trees."""
    trees = plant(world, seed)
    light = Light()
    parts = [ground(world)]
    for i, tree in enumerate(trees):
        parts += tree_meshes(tree, i + 1, light)
    images = {
        "grass": textures.grass(0),
        "light_map": light_map(world, trees, light, seed),
        "dapple": textures.dapple(0),
        "sky": textures.sky(0),
        **{f"bark{k}": textures.bark(k) for k in range(3)},
        **{f"leaves{k}": textures.leaves(k) for k in range(2)},
    }
    across = (1.0 / _length(world), 1.0 / (2 * world.half_width_m))
    materials = {
        "ground": Material("grass", (0.4, 0.4), "light_map", across),
        **{f"bark{k}": Material(f"bark{k}", (1.0, 1.0), "dapple", (0.31, 0.13)) for k in range(3)},
        **{f"leaves{k}": Material(f"leaves{k}", (0.9, 0.9)) for k in range(2)},
        "sky": Material("sky", (1.0, 1.0), sky=True),
    }
    return Scene(parts, materials, images, light, sky_mesh()), trees


def _length(world: ForestWorld) -> float:
    return world.run_in_m + world.course_m + world.run_out_m


def sky_mesh() -> Mesh:
    """Return the dome that follows the eye."""
    vertices, uv, _, triangles = meshes.sky_dome()
    return Mesh(vertices, uv, np.ones(len(vertices)), triangles, "sky", SKY_OBJECT, two_sided=True)


def ground(world: ForestWorld) -> Mesh:
    """Return the ground plane; its texture coordinates start at the corner of the planted area."""
    end = np.array([-FAR_GROUND_M, FAR_GROUND_M])
    vertices, uv, _, triangles = meshes.terrain(end, end, np.zeros((2, 2)))
    uv = uv + (world.run_in_m, world.half_width_m)
    return Mesh(vertices, uv, np.ones(len(vertices)), triangles, "ground", GROUND_OBJECT)


def tree_meshes(tree: Tree, object_id: int, light: Light) -> list[Mesh]:
    """Return trunk and foliage of one tree, coarser for greater distances."""
    rng = np.random.default_rng([tree.seed, 102])
    tone, dark = rng.uniform(0.75, 1.2), rng.uniform(0.55, 0.9)
    tint = np.array([0.75, 1.0, 0.95]) * rng.uniform(0.7, 1.25, 3) * rng.uniform(0.8, 1.2)
    bark = f"bark{2 if tree.conifer else int(rng.integers(0, 2))}"
    parts = []
    for sides, span in ((20, NEAR), (10, (NEAR[1], FAR[1]))):
        trunk = meshes.frustum(tree.base, tree.top, tree.radius_m, tree.top_radius_m, sides)
        parts.append(_Part(trunk, bark, (tone, tone, tone), span, shift=7 * rng.random()))
    if tree.conifer:
        needles = (0.8 * dark, 0.85 * dark, 0.6 * dark)
        for tiers, points, span in ((7, 8, NEAR), (6, 5, MIDDLE), (4, 3, FAR)):
            surface = _needles(rng, tree, tiers, points)
            parts.append(_Part(surface, "leaves1", needles, span, wrap=0.4, two_sided=True))
    else:
        leaves: Bgr = (tint[0], tint[1], tint[2])
        inner: Bgr = (0.7 * tint[0], 0.7 * tint[1], 0.7 * tint[2])
        for crown in crowns(tree):
            body = meshes.blob(rng, crown.centre, 0.85 * crown.radii, 1, 0.25)
            cards = meshes.leaf_cards(rng, crown.centre, crown.radii, 60, 0.45)
            parts.append(_Part(body, "leaves0", inner, NEAR, wrap=0.3))
            parts.append(_Part(cards, "leaves0", leaves, NEAR, wrap=0.5, two_sided=True, loose=True))
        for subdivisions, span in ((1, MIDDLE), (0, FAR)):
            blobs = [meshes.blob(rng, c.centre, c.radii, subdivisions, 0.35) for c in crowns(tree)]
            parts.append(_Part(_joined(blobs), "leaves0", leaves, span, wrap=0.4))
    return [part.mesh(object_id, light.direction) for part in parts]


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A surface with its looks; `wrap` lets sun reach around, as it does through leaves."""

    surface: meshes.Surface
    material: str
    tint: Bgr
    draw_range_m: tuple[float, float]
    shift: float = 0.0
    wrap: float = 0.0
    two_sided: bool = False
    loose: bool = False

    def mesh(self, object_id: int, sun: Array) -> Mesh:
        vertices, uv, normals, triangles = self.surface
        share = np.clip((normals @ sun + self.wrap) / (1.0 + self.wrap), 0.0, 1.0)
        return Mesh(
            vertices, uv + self.shift, share, triangles, self.material, object_id, self.tint, 1.0,
            self.two_sided, self.loose, self.draw_range_m,
        )  # fmt: skip


def _needles(rng: np.random.Generator, tree: Tree, tiers: int, points: int) -> meshes.Surface:
    """Return the tiers of a conifer, narrowing upwards around the trunk's axis."""
    crown = crowns(tree)[0]
    low, height = crown.centre[2] + crown.radii[2], 2 * crown.radii[2]
    surfaces = []
    for k in range(tiers):
        share = k / tiers
        along = (tree.base[2] - (low - share * height)) / (tree.base[2] - tree.top[2])
        base = tree.base + along * (tree.top - tree.base)
        width = crown.radii[0] * (1.0 - 0.8 * share)
        surfaces.append(meshes.cone_tier(rng, base, height / tiers * 1.7, width, points))
    return _joined(surfaces)


def _joined(surfaces: list[meshes.Surface]) -> meshes.Surface:
    starts = np.cumsum([0, *(len(s[0]) for s in surfaces)])
    return (
        np.concatenate([s[0] for s in surfaces]),
        np.concatenate([s[1] for s in surfaces]),
        np.concatenate([s[2] for s in surfaces]),
        np.concatenate([s[3] + start for s, start in zip(surfaces, starts, strict=False)]).astype(np.int32),
    )


def light_map(world: ForestWorld, trees: list[Tree], light: Light, seed: int) -> textures.Texture:
    """Paint the shadows of trunks and crowns and the patches of colour on the ground; one tile is the whole area."""
    rng = np.random.default_rng([seed, 103])
    n = LIGHT_MAP_PX
    scale = np.array([n / _length(world), n / (2 * world.half_width_m)])
    origin = np.array([-world.run_in_m, -world.half_width_m])
    sun = light.direction
    slide = sun[:2] / sun[2]  # how far north and east a shadow falls per metre of height, since z points down

    def pixel(p: Array) -> Array:
        return (p[:2] - p[2] * slide - origin) * scale

    trunks = np.zeros((n, n), np.uint8)
    foliage = np.zeros((n, n), np.uint8)
    for tree in trees:
        a, b = pixel(tree.base), pixel(tree.top)
        side = np.array([-slide[1], slide[0]]) / np.hypot(*slide) * scale
        corners = [a + tree.radius_m * side, a - tree.radius_m * side, b - tree.top_radius_m * side, b + tree.top_radius_m * side]
        cv2.fillConvexPoly(trunks, np.rint(16 * np.array(corners)).astype(np.int32), 255, cv2.LINE_AA, 4)
        for crown in crowns(tree):
            along = math.hypot(crown.radii[0], crown.radii[2] * float(np.hypot(*slide)))
            axes = np.rint(16 * np.array([along, crown.radii[1]]) * scale.mean()).astype(int)
            centre = np.rint(16 * pixel(crown.centre)).astype(int)
            angle = math.degrees(math.atan2(slide[1], slide[0]))
            cv2.ellipse(foliage, centre.tolist(), axes.tolist(), angle, 0, 360, 255, -1, cv2.LINE_AA, 4)
    leafy = np.clip(0.6 + 0.55 * textures.noise(rng, n, slope=1.2), 0, 1)
    dark = 0.9 * cv2.GaussianBlur(foliage, (0, 0), 5).astype(np.float64) / 255 * leafy
    sunny = (1.0 - dark) * (1.0 - 0.92 * cv2.GaussianBlur(trunks, (0, 0), 1.2).astype(np.float64) / 255)
    patches = textures.noise(rng, n, slope=1.5)
    dry = textures.noise(rng, n, slope=1.4)
    tone = np.stack([128 - 6 * dry, 128 + 7 * patches, 128 + 10 * dry + 3 * patches], axis=-1)
    return textures.finished(tone, 255 * sunny)
