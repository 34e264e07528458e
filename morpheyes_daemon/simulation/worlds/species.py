"""Kinds of trees: foliage made once at unit size, then turned, scaled and set on every trunk.

In unit space x and y are in crown widths and z is upwards in tree heights, with the trunk along z from 0 to 1. An
ellipsoid with vertical axis stays one when it is scaled, so foliage and what it is in collisions agree. Three levels
of detail; the ellipsoids enclose the nearest one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from morpheyes_daemon.simulation.rendering import meshes
from morpheyes_daemon.simulation.rendering.meshes import Surface
from morpheyes_daemon.transforms import Array

CONIFERS, BROADLEAVES, BUSHES = 6, 10, 6
"""How many different ones there are of each."""

ASPECT, BUSH_ASPECT = 8.0, 2.4
"""Height over crown width that the unit shapes are made for, so that leaves come out about as wide as high."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Foliage at one level of detail. `dark` layers lie inside a crown; triangles of a `loose` one are leaves."""

    surface: Surface
    level: int
    dark: bool = False
    loose: bool = False
    two_sided: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Species:
    """Foliage of one kind of tree: crowns (n, 6) are ellipsoids, centre x, y, z and radii, in unit space."""

    crowns: Array
    layers: tuple[Layer, ...]


@cache
def conifer(number: int) -> Species:
    """Return a slender tree of drooping tiers."""
    rng = np.random.default_rng([number, 110])
    low, top = rng.uniform(0.27, 0.36), 1.06
    layers = []
    for level, (tiers, points) in enumerate(((7, 8), (6, 5), (3, 4))):
        height = (top - low) / tiers * 1.7
        surfaces = []
        for k in range(tiers):
            base = np.array([0.0, 0.0, -(low + k / tiers * (top - low)) * ASPECT])
            width = 1.0 - 0.8 * k / tiers
            surfaces.append(meshes.cone_tier(rng, base, min(height, top - low) * ASPECT, width, points))
        layers.append(Layer(_unit(meshes.joined(surfaces)), level, two_sided=True))
    middle, half = 0.5 * (low + top), 0.5 * (top - low)
    return Species(np.array([[0.0, 0.0, middle, 1.0, 1.0, 1.25 * half]]), tuple(layers))


@cache
def broadleaf(number: int) -> Species:
    """Return a tree of several round crowns."""
    rng = np.random.default_rng([number, 111])
    low = rng.uniform(0.36, 0.46)
    crowns = []
    for k in range(6):
        up = rng.uniform(low + 0.1, 1.0)
        angle, out = 2 * math.pi * (k / 6 + 0.1 * rng.random()), (rng.uniform(0.35, 0.9) if k else 0.0)
        width = rng.uniform(0.6, 0.9)
        half = min(0.75 * width / ASPECT, up - low)
        crowns.append((out * math.cos(angle), out * math.sin(angle), up, width, width, half))
    return _leafy(rng, np.array(crowns), ASPECT, far_every=2)


@cache
def bush(number: int) -> Species:
    """Return a bush of several round heads that reach down to the ground."""
    rng = np.random.default_rng([number, 112])
    crowns = [(0.0, 0.0, 0.5, 0.75, 0.75, 0.5)]
    for k in range(3):
        angle, top = 2 * math.pi * (k / 3 + 0.2 * rng.random()), rng.uniform(0.55, 0.9)
        crowns.append((0.45 * math.cos(angle), 0.45 * math.sin(angle), top / 2, 0.55, 0.55, top / 2))
    return _leafy(rng, np.array(crowns), BUSH_ASPECT, far_every=1)


def _leafy(rng: np.random.Generator, made: Array, aspect: float, far_every: int) -> Species:
    """Return foliage around ellipsoids; its meshes are made in ned axes at `aspect` widths of height."""
    centres = made[:, :3] * (1.0, 1.0, -aspect)
    radii = made[:, 3:] * (1.0, 1.0, aspect)
    pairs = list(zip(centres, radii, strict=True))
    bodies = [meshes.blob(rng, c, 0.85 * r, 1, 0.25) for c, r in pairs]
    cards = [meshes.leaf_cards(rng, c, r, 60, 0.24) for c, r in pairs]
    near = (
        Layer(_unit(meshes.joined(bodies), aspect), 0, dark=True),
        Layer(_unit(meshes.joined(cards), aspect), 0, loose=True, two_sided=True),
    )
    middle = Layer(_unit(meshes.joined([meshes.blob(rng, c, r, 1, 0.35) for c, r in pairs]), aspect), 1)
    far = Layer(_unit(meshes.joined([meshes.blob(rng, c, r, 0, 0.3) for c, r in pairs[::far_every]]), aspect), 2)
    return Species(made, (*near, middle, far))


def _unit(surface: Surface, aspect: float = ASPECT) -> Surface:
    vertices, uv, normals, triangles = surface
    return vertices / (1.0, 1.0, -aspect), uv, normals, triangles
