"""What grows below the crowns: bushes between the trees, and bare branches low on the trunks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.simulation.worlds.ground import Ground
from morpheyes_daemon.simulation.worlds.species import BUSHES, bush
from morpheyes_daemon.simulation.worlds.trees import Branch, Tree
from morpheyes_daemon.transforms import Array

Glades = tuple[tuple[float, float, float], ...]
"""Places kept free of trees: x, y, radius in metres."""

Area = tuple[float, float, float, float]
"""x from, x to, y from, y to."""

BRANCHES_FROM_M, BRANCHES_TO_M = 0.6, 2.8
"""Heights at which bare branches leave the trunk."""


class Undergrowth(Section):
    """How much grows below the crowns; nothing by default."""

    bushes_per_ha: float = Field(0.0, ge=0, le=2000)
    bush_height_min_m: float = Field(0.5, ge=0.2, le=4)
    bush_height_max_m: float = Field(2.2, ge=0.2, le=4)
    branches_per_tree: float = Field(0.0, ge=0, le=20, description="mean number")
    branch_length_m: float = Field(0.6, ge=0.1, le=2, description="the longest, from the bark")
    branch_radius_mm: float = Field(18.0, ge=4, le=60, description="at the trunk, the thickest")

    @model_validator(mode="after")
    def _ordered(self) -> Undergrowth:
        if self.bush_height_min_m > self.bush_height_max_m:
            raise ValueError("bush_height_min_m must not be greater than bush_height_max_m")
        return self


def bushes(undergrowth: Undergrowth, area: Area, ground: Ground, seed: int, glades: Glades) -> list[Tree]:
    """Place bushes anywhere but in glades; they may touch each other and lean on trunks."""
    rng = np.random.default_rng([seed, 104])
    x0, x1, y0, y1 = area
    found = []
    for _ in range(round(undergrowth.bushes_per_ha * (x1 - x0) * (y1 - y0) / 1e4)):
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        one = _bush(rng, undergrowth, np.array([x, y, -ground.height_m(x, y)]))
        if all(math.hypot(x - gx, y - gy) - one.width_m >= r for gx, gy, r in glades):
            found.append(one)
    return found


def _bush(rng: np.random.Generator, undergrowth: Undergrowth, base: Array) -> Tree:
    height = rng.uniform(undergrowth.bush_height_min_m, undergrowth.bush_height_max_m)
    green = np.array([0.75, 1.0, 0.95]) * rng.uniform(0.6, 1.2, 3) * rng.uniform(0.7, 1.2)
    return Tree(
        base, base - (0.0, 0.0, height), 0.0, 0.0, bush(int(rng.integers(BUSHES))), conifer=False,
        width_m=height * rng.uniform(0.3, 0.55), turn_rad=rng.uniform(0, 2 * math.pi), bark="bark0", tone=1.0,
        tint=(float(green[0]), float(green[1]), float(green[2])), bush=True,
    )  # fmt: skip


def with_bushes(ground: Ground, low: list[Tree]) -> Ground:
    """Return the ground with the bushes that a rangefinder sees instead of it."""
    crowns = [np.concatenate([centre, radii]) for tree in low for centre, radii in tree.crowns()]
    return replace(ground, bushes=np.array(crowns)) if crowns else ground


def with_branches(trees: list[Tree], undergrowth: Undergrowth, seed: int) -> list[Tree]:
    """Return the trees with bare branches on their trunks."""
    if undergrowth.branches_per_tree == 0.0:
        return trees
    rng = np.random.default_rng([seed, 106])
    return [replace(tree, branches=_branches(rng, tree, undergrowth)) for tree in trees]


def _branches(rng: np.random.Generator, tree: Tree, undergrowth: Undergrowth) -> tuple[Branch, ...]:
    count = int(rng.poisson(undergrowth.branches_per_tree))
    return tuple(_branch(rng, tree, undergrowth) for _ in range(count))


def _branch(rng: np.random.Generator, tree: Tree, undergrowth: Undergrowth) -> Branch:
    up_m = rng.uniform(BRANCHES_FROM_M, BRANCHES_TO_M)
    towards, rise = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(-10, 40))
    length = tree.radius_at_m(up_m) + undergrowth.branch_length_m * rng.uniform(0.3, 1.0)
    base = tree.base + up_m / tree.height_m * (tree.top - tree.base)
    way: Array = np.array([math.cos(towards) * math.cos(rise), math.sin(towards) * math.cos(rise), -math.sin(rise)])
    return Branch(base, base + length * way, undergrowth.branch_radius_mm / 1e3 * rng.uniform(0.5, 1.0))
