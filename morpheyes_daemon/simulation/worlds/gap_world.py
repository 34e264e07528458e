"""The gap: a wall with openings of unknown shape and place before a mural, standing still or swaying."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.simulation.rendering import meshes
from morpheyes_daemon.simulation.rendering.scene import GROUND_OBJECT, Light, Mesh, MovingObject
from morpheyes_daemon.simulation.worlds.collision import MovingObstacles, Obstacles, box_solid
from morpheyes_daemon.simulation.worlds.openings import Shape, outline
from morpheyes_daemon.simulation.worlds.trajectories import Motion, swaying
from morpheyes_daemon.simulation.worlds.wall_geometry import Wall
from morpheyes_daemon.simulation.worlds.world import GapTruth, WorldContents, lit
from morpheyes_daemon.transforms import Array, pose

WALL_OBJECT, MURAL_OBJECT = 1, 2
BELOW_GROUND_M = 1.2
"""How far the wall goes on below the ground, so that it may sway downwards and upwards."""

DRAWN_HEIGHT_M = (1.2, 1.8)
"""Between these the seed puts the middle of an opening whose height is not given."""

APART_M = 0.4
"""Of wall between two openings without a place of their own."""

BLOBS = 20
"""Different blobs among the shapes that `any` draws from."""


class Opening(Section):
    """One opening; what is left out is drawn by the seed.

    `any` takes the three named shapes and 20 blobs in turn, so that 23 seeds in a row see every one of them.
    """

    shape: Shape | Literal["any"] = "rectangle"
    slack: float = Field(1.0, ge=0.3, le=5, description="1: what the vehicle needs just fits in; less: to be refused")
    across_m: float | None = Field(None, ge=-3, le=3, description="to the right of the course line")
    height_m: float | None = Field(None, ge=0.8, le=2.4)


class GapWorld(Section):
    """What a gap file may say."""

    kind: Literal["gap"]
    distance_m: float = Field(7.0, ge=3, le=200, description="from the start at (0, 0) to the wall, along x")
    fit_width_mm: float = Field(
        417.0, ge=100, le=2000, description="what must fit in: width in crossing attitude and 40 mm on both sides"
    )
    fit_height_mm: float = Field(
        267.0, ge=80, le=2000, description="height of the hull leaning by 12 degrees and 40 mm on both sides"
    )
    openings: tuple[Opening, ...] = Field((Opening(),), min_length=1, max_length=4)
    motion: Motion = Motion()
    thickness_mm: float = Field(30.0, ge=5, le=300)
    half_width_m: float = Field(4.0, ge=1.5, le=20)
    top_m: float = Field(3.4, ge=2, le=10)
    mural_m: float = Field(5.0, ge=2, le=50, description="from the wall to the mural behind it")
    meadow: bool = Field(True, description="grass and sky around; off where another world has them")

    @property
    def passable(self) -> bool:
        """Whether there is an opening that what must fit in fits into; otherwise all are to be refused."""
        return any(opening.slack >= 1.0 for opening in self.openings)

    @model_validator(mode="after")
    def _openings_in_the_wall(self) -> GapWorld:
        """Refuse what no seed can build: whatever its shape, an opening is at least the rectangle that fits in."""
        boxes = [self._least(opening) for opening in self.openings]
        wide_m, top_m = 2 * self.half_width_m, self.top_m
        for number, box in enumerate(boxes, 1):
            above, below = box.low_m + 0.5 * box.height_m, box.high_m - 0.5 * box.height_m
            if box.width_m >= wide_m or above >= top_m or below <= -BELOW_GROUND_M:
                raise ValueError(
                    f"opening {number}, at least {box.width_m:.2f} x {box.height_m:.2f} m, reaches beyond the wall, "
                    f"{wide_m:g} m wide and from {BELOW_GROUND_M:g} m below the ground to {top_m:g} m above it"
                )
        if (span := _span_m(boxes)) >= wide_m:
            raise ValueError(f"the openings take at least {span:.2f} m side by side, and the wall is {wide_m:g} m wide")
        for (i, one), (j, other) in combinations(enumerate(boxes, 1), 2):
            if one.overlaps(other):
                raise ValueError(f"openings {i} and {j} overlap; set them further apart")
        return self

    @model_validator(mode="after")
    def _mural_out_of_reach(self) -> GapWorld:
        turn_rad = math.radians(self.motion.turn_deg if self.motion.kind != "none" else 0.0)
        swings_m = self.half_width_m * math.sin(turn_rad)
        if swings_m >= self.mural_m:
            raise ValueError(f"the wall turns {swings_m:.1f} m back, and the mural is {self.mural_m:g} m behind it")
        return self

    def _least(self, opening: Opening) -> _Box:
        low_m, high_m = DRAWN_HEIGHT_M if opening.height_m is None else (opening.height_m, opening.height_m)
        width_m, height_m = opening.slack * self.fit_width_mm / 1e3, opening.slack * self.fit_height_mm / 1e3
        return _Box(width_m, height_m, opening.across_m, low_m, high_m)


class _Box(NamedTuple):
    """The least that an opening can be in the world of any seed, and where its middle may lie, None: anywhere."""

    width_m: float
    height_m: float
    across_m: float | None
    low_m: float
    high_m: float

    def overlaps(self, other: _Box) -> bool:
        """Tell whether two openings touch wherever the seed puts them."""
        if self.across_m is None or other.across_m is None:
            return False
        beside_m = abs(self.across_m - other.across_m)
        above_m = max(self.high_m - other.low_m, other.high_m - self.low_m)
        return beside_m <= 0.5 * (self.width_m + other.width_m) and above_m <= 0.5 * (self.height_m + other.height_m)


def _span_m(boxes: list[_Box]) -> float:
    """Return how far openings reach from left to right at least, as far as that is known before the seed."""
    known = [(box.across_m, 0.5 * box.width_m) for box in boxes if box.across_m is not None]
    if known:
        return max(across + half for across, half in known) - min(across - half for across, half in known)
    return sum(box.width_m for box in boxes) + APART_M * (len(boxes) - 1)


def drawn_shape(shape: Shape | Literal["any"], seed: int) -> Shape:
    """Return the shape that an opening has in the world of a seed."""
    if shape != "any":
        return shape
    named: tuple[Shape, ...] = ("rectangle", "infinity", "goku")
    return named[seed % (BLOBS + 3)] if seed % (BLOBS + 3) < 3 else "blob"


def gap_truth(world: GapWorld, seed: int) -> GapTruth:
    """Return where the openings are and how the wall moves."""
    outlines, middle = _place(world, np.random.default_rng([seed, 500]), seed)
    T_ned_wall = swaying(world.motion, np.array([world.distance_m, middle, 0.0]), seed)
    return GapTruth(outlines, T_ned_wall, world.thickness_mm / 1e3, world.half_width_m)


def gap_contents(world: GapWorld, seed: int, light: Light) -> WorldContents:
    """Return wall, mural and ground."""
    truth = gap_truth(world, seed)
    T_ned_wall = truth.T_ned_wall
    wall = Wall(
        np.array([-world.half_width_m, -world.top_m]), np.array([world.half_width_m, BELOW_GROUND_M]),
        truth.outlines, truth.thickness_m,
    )  # fmt: skip
    sun = light.direction
    dark = (0.6, 0.6, 0.6)
    parts = (
        lit(wall.faces(), "newsprint", WALL_OBJECT, sun),
        lit(wall.rims(), "newsprint", WALL_OBJECT, sun, dark, two_sided=True),
    )
    standing = WorldContents(
        moving=(MovingObject(parts, T_ned_wall, "wall"),),
        obstacles=(MovingObstacles(Obstacles(wall.solids()), T_ned_wall),),
        gaps=(truth,),
    ) + _mural(world, light)
    return standing + meadow() if world.meadow else standing


def _place(world: GapWorld, rng: np.random.Generator, seed: int) -> tuple[tuple[Array, ...], float]:
    """Return the outlines in the wall's frame and where its origin is across the course.

    Several openings without a place of their own are spread over the wall, so that they cannot touch.
    """
    width, height = world.fit_width_mm / 1e3, world.fit_height_mm / 1e3
    blob = np.random.default_rng([seed % (BLOBS + 3), 501])
    shapes = [
        outline(drawn_shape(o.shape, seed), blob if o.shape == "any" else rng, width, height, o.slack)
        for o in world.openings
    ]
    widths = np.array([np.ptp(shape[:, 0]) for shape in shapes])
    lanes = np.cumsum(widths + APART_M) - 0.5 * (widths + APART_M)
    lanes -= lanes.mean() - rng.uniform(-0.6, 0.6)
    placed = []
    for opening, shape, lane in zip(world.openings, shapes, lanes, strict=True):
        across = float(lane) if opening.across_m is None else opening.across_m
        height = float(rng.uniform(*DRAWN_HEIGHT_M)) if opening.height_m is None else opening.height_m
        placed.append(shape + np.array([across, -height]))
    middle = float(np.mean([corners[:, 0].mean() for corners in placed]))
    return tuple(corners - np.array([middle, 0.0]) for corners in placed), middle


def _mural(world: GapWorld, light: Light) -> WorldContents:
    x, half, top = world.distance_m + world.mural_m, world.half_width_m + world.mural_m, world.top_m + 1.0
    T = pose(np.eye(3), np.array([x, 0.0, -0.5 * top]))
    edges = (0.2, 2 * half, top)
    mesh = lit(meshes.box(T, edges), "mural", MURAL_OBJECT, light.direction)
    return WorldContents(meshes=(mesh,), solids=(box_solid(T, edges),))


def meadow(reach_m: float = 140.0) -> WorldContents:
    """Return a flat ground of grass."""
    ends = np.array([-reach_m, reach_m])
    vertices, uv, _, triangles = meshes.terrain(ends, ends, np.zeros((2, 2)))
    return WorldContents(meshes=(Mesh(vertices, uv, np.ones(len(vertices)), triangles, "meadow", GROUND_OBJECT),))
