"""The forest: trees planted by a seed, as things to see and as things to hit.

Nothing is carved out for the course: trees stand where the seed puts them, except within a small clearing around
the start and the goal. The planted area is wider than the belt that flights use, so the forest looks endless.
"""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.simulation.rendering import meshes, textures
from morpheyes_daemon.simulation.rendering.scene import GROUND_OBJECT, Light, Material, Mesh
from morpheyes_daemon.simulation.worlds.ground import Ground, GroundShape, lay
from morpheyes_daemon.simulation.worlds.species import BROADLEAVES, CONIFERS, broadleaf, conifer
from morpheyes_daemon.simulation.worlds.trees import Tree, tree_meshes
from morpheyes_daemon.simulation.worlds.undergrowth import Area, Glades, Undergrowth, bushes, with_branches, with_bushes
from morpheyes_daemon.simulation.worlds.world import START_ROOM_M, WorldContents
from morpheyes_daemon.transforms import Array

LIGHT_MAP_PX = 2048

MAP_HEIGHT_M = 1.5
"""Height at which trunks are drawn on maps."""

GROUND_STEP_M = 2.0
"""Between the grid lines of ground that is not level; the mesh is within 5 cm of waves of 1.5 m in 25 m."""

ROW_STEP_M, ROW_RADIUS_M = 0.5, 0.2
"""Trunks of a row; 10 cm are free between two."""

JAMMED = 0.547
"""Share of a plane that circles placed at random cover when no more fit in between (random sequential addition)."""

_AROUND = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))

FAR_GROUND_M = 110.0
"""The ground goes on this far past the trees; from there on the woods of the sky take over."""


class ForestWorld(Section):
    """What a forest file may say."""

    kind: Literal["forest"]
    course_m: float = Field(80.0, ge=10, le=500, description="from the start at (0, 0) to the goal, along x")
    goal: bool = Field(True, description="off where a flight is over when the mission says so, wherever that is")
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
    heading_deg: float = Field(0.0, ge=-180, le=180, description="of the vehicle at the start, from the course")
    undergrowth: Undergrowth = Undergrowth()
    relief: GroundShape = GroundShape()
    rows: tuple[tuple[float, float, float, float], ...] = Field(
        (), description="x, y to x, y: trunks so close that nothing flies through"
    )

    @model_validator(mode="after")
    def _ordered(self) -> ForestWorld:
        if self.radius_min_m > self.radius_max_m:
            raise ValueError("radius_min_m must not be greater than radius_max_m")
        return self

    @model_validator(mode="after")
    def _room_for_all_trees(self) -> ForestWorld:
        circle_m = self.radius_min_m + 0.5 * _apart_m(self)
        room_m2 = (_length(self) + 2 * circle_m) * 2 * (self.half_width_m + circle_m)
        if _wanted(self) * math.pi * circle_m**2 > JAMMED * room_m2:
            raise ValueError(
                f"{self.trees_per_ha:g} trees per hectare cannot stand {self.gap_m:g} m apart; ask for fewer trees or a "
                "smaller gap_m"
            )
        return self

    @model_validator(mode="after")
    def _rows_beside_the_ends(self) -> ForestWorld:
        x0, x1, y0, y1 = area_of(self)
        places = {"start": (0.0, 0.0), **({"goal": (self.course_m, 0.0)} if self.goal else {})}
        for row in self.rows:
            a, b = np.array(row[:2]), np.array(row[2:])
            if not all(x0 <= x <= x1 and y0 <= y <= y1 for x, y in (a, b)):
                extent = f"from {x0:g} to {x1:g} m along x and {y1:g} m to both sides"
                raise ValueError(f"the row {list(row)} leaves the forest, which reaches {extent}")
            for name, place in places.items():
                if _beside_m(np.array(place), a, b) < ROW_RADIUS_M + START_ROOM_M:
                    raise ValueError(f"the row {list(row)} stands on the {name}")
        return self


def _beside_m(p: Array, a: Array, b: Array) -> float:
    """Return the distance of a point from the line between two, all (2,)."""
    along = (p - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-9)
    return float(np.linalg.norm(p - a - np.clip(along, 0.0, 1.0) * (b - a)))


def _wanted(world: ForestWorld) -> int:
    return round(world.trees_per_ha * _length(world) * 2 * world.half_width_m / 1e4)


def _apart_m(world: ForestWorld) -> float:
    """Between two trunks at the ground, so that leaning ones keep the gap up to 3 m above it."""
    return world.gap_m + 2 * 3.0 * math.tan(math.radians(world.max_lean_deg))


def plant(world: ForestWorld, seed: int, glades: Glades = ()) -> list[Tree]:
    """Place the trees one after the other where they keep `gap_m` to those that stand already."""
    rng = np.random.default_rng([seed, 100])
    x_low, x_high = -world.run_in_m, world.course_m + world.run_out_m
    wanted, gap = _wanted(world), _apart_m(world)
    lean_rad = math.radians(world.max_lean_deg)
    kept = (*_ends(world), *glades)
    places = np.empty((wanted, 3))
    ground = lay(world.relief, seed)
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
            trees.append(_grow(rng, world, ground, x, y, radius, lean_rad))
    return trees


def plant_rows(world: ForestWorld, seed: int) -> list[Tree]:
    """Place upright trunks along the rows."""
    rng, ground = np.random.default_rng([seed, 105]), lay(world.relief, seed)
    trees = []
    for x0, y0, x1, y1 in world.rows:
        count = math.ceil(math.hypot(x1 - x0, y1 - y0) / ROW_STEP_M)
        for part in np.linspace(0.0, 1.0, count + 1).tolist():
            trees.append(_grow(rng, world, ground, x0 + part * (x1 - x0), y0 + part * (y1 - y0), ROW_RADIUS_M, 0.0))
    return trees


def _grow(
    rng: np.random.Generator, world: ForestWorld, ground: Ground, x: float, y: float, radius: float, lean_rad: float
) -> Tree:
    height = rng.uniform(9.0, 13.0) + 14.0 * radius
    lean, towards = lean_rad * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
    tilt = np.array([math.sin(lean) * math.cos(towards), math.sin(lean) * math.sin(towards), -math.cos(lean)])
    # as deep as the ground lies on the lower side of the trunk
    base = np.array([x, y, -min(ground.height_m(x + radius * n, y + radius * e) for n, e in _AROUND)])
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


def forest_contents(world: ForestWorld, seed: int, light: Light, glades: Glades = ()) -> WorldContents:
    """Return trees and ground; no tree stands in a glade."""
    land = lay(world.relief, seed)
    standing = with_branches(plant_rows(world, seed) + plant(world, seed, glades), world.undergrowth, seed)
    low = bushes(world.undergrowth, area_of(world), land, seed, (*_ends(world), *glades))
    trees = standing + low
    parts = [ground(world, land, light)]
    for i, tree in enumerate(trees):
        parts += tree_meshes(tree, i + 1, light)
    across = (1.0 / _length(world), 1.0 / (2 * world.half_width_m))
    return WorldContents(
        meshes=tuple(parts),
        solids=tuple(solid for tree in trees for solid in tree.solids()),
        discs=tuple(tree.disc_at(MAP_HEIGHT_M) for tree in trees if tree.height_m > MAP_HEIGHT_M),
        materials={"ground": Material("grass", (0.4, 0.4), "light_map", across)},
        textures={"light_map": light_map(world, trees, light, seed)},
        ground=with_bushes(land, low),
    )


def _length(world: ForestWorld) -> float:
    return world.run_in_m + world.course_m + world.run_out_m


def area_of(world: ForestWorld) -> Area:
    """Return the planted area: x from, x to, y from, y to."""
    return -world.run_in_m, world.course_m + world.run_out_m, -world.half_width_m, world.half_width_m


def _ends(world: ForestWorld) -> Glades:
    return (0.0, 0.0, world.clearing_m), (world.course_m, 0.0, world.clearing_m)


def ground(world: ForestWorld, land: Ground, light: Light) -> Mesh:
    """Return the ground; its texture coordinates start at the corner of the planted area."""
    x0, x1, y0, y1 = area_of(world)
    if land.level:
        x, y = np.array([x0 - FAR_GROUND_M, x1 + FAR_GROUND_M]), np.array([y0 - FAR_GROUND_M, y1 + FAR_GROUND_M])
    else:
        x, y = _grid(x0, x1), _grid(y0, y1)
    height = np.array([[land.height_m(north, east) for east in y.tolist()] for north in x.tolist()])
    vertices, uv, normals, triangles = meshes.terrain(x, y, height)
    uv = uv + np.array([world.run_in_m, world.half_width_m])
    # what lies level has all of the sun that the light map leaves it
    share = np.clip(normals @ light.direction / -light.direction[2], 0.0, 1.0)
    return Mesh(vertices, uv, share, triangles, "ground", GROUND_OBJECT)


def _grid(low: float, high: float) -> Array:
    """Grid lines, close where things stand and flights go."""
    near = np.linspace(low, high, math.ceil((high - low) / GROUND_STEP_M) + 1)
    far = np.linspace(0.0, FAR_GROUND_M, 8)[1:]
    return np.concatenate([low - far[::-1], near, high + far])


def light_map(world: ForestWorld, trees: list[Tree], light: Light, seed: int) -> textures.Texture:
    """Paint the shadows of trunks and crowns and the patches of colour on the ground; one tile is the whole area."""
    rng = np.random.default_rng([seed, 103])
    n = LIGHT_MAP_PX
    scale = np.array([n / _length(world), n / (2 * world.half_width_m)])
    origin = np.array([-world.run_in_m, -world.half_width_m])
    sun = light.direction
    slide = sun[:2] / sun[2]  # how far north and east a shadow falls per metre of height, since z points down

    def pixel(p: Array, foot: Array) -> Array:
        """Where the shadow of a point falls, the ground taken as level from its tree's foot on."""
        return np.asarray((p[:2] - (p[2] - foot[2]) * slide - origin) * scale)

    trunks = np.zeros((n, n), np.uint8)
    foliage = np.zeros((n, n), np.uint8)
    for tree in trees:
        a, b = pixel(tree.base, tree.base), pixel(tree.top, tree.base)
        side = np.array([-slide[1], slide[0]]) / np.hypot(*slide) * scale
        low, high = tree.radius_m * side, tree.top_radius_m * side
        corners = np.rint(16 * np.array([a + low, a - low, b - high, b + high]))
        cv2.fillConvexPoly(trunks, corners.astype(np.int32), 255, cv2.LINE_AA, 4)
        for crown, radii in tree.crowns():
            along = math.hypot(radii[0], radii[2] * float(np.hypot(*slide)))
            axes = np.rint(16 * np.array([along, radii[1]]) * scale.mean()).astype(int)
            centre = np.rint(16 * pixel(crown, tree.base)).astype(int)
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
