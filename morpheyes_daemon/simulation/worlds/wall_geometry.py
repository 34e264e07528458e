"""A wall with openings as something to see and to hit: cut into convex pieces along horizontal lines.

The wall's own frame has ned axes: x through the wall, y to the right, z down, its middle plane at x = 0. Outlines of
openings are (n, 2) = y, z. Shapes may be as ragged as they like; they must not touch each other or the wall's edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from morpheyes_daemon.simulation.rendering.meshes import Surface, joined, quad_triangles
from morpheyes_daemon.simulation.worlds.collision import Solid, prism_solid
from morpheyes_daemon.transforms import Array, pose

Quads = Array
"""(n, 4, 2): corners y, z of convex quadrilaterals, clockwise as seen along x."""

R_WALL_PLANE: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Plane axes (y, z of the wall, then through it) in the wall's frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """A plate between y, z corners `low` and `high` (2,) with holes, so thick along x."""

    low: Array
    high: Array
    outlines: tuple[Array, ...]
    thickness_m: float

    def quads(self) -> Quads:
        """Return the plate cut into convex pieces."""
        rims = np.concatenate(self.outlines)
        inner_low, inner_high = rims.min(axis=0), rims.max(axis=0)
        around = [
            _box(self.low[0], self.high[0], self.low[1], inner_low[1]),
            _box(self.low[0], self.high[0], inner_high[1], self.high[1]),
            _box(self.low[0], inner_low[0], inner_low[1], inner_high[1]),
            _box(inner_high[0], self.high[0], inner_low[1], inner_high[1]),
        ]
        return np.array(around + self._slabs(float(inner_low[0]), float(inner_high[0])))

    def _slabs(self, left: float, right: float) -> list[Array]:
        """Cut what is between the openings at the height of every corner, so that only trapezoids are left."""
        starts = np.concatenate(self.outlines)
        ends = np.concatenate([np.roll(outline, -1, axis=0) for outline in self.outlines])
        heights = np.unique(np.round(starts[:, 1], 9))
        pieces = []
        for top, bottom in pairwise(heights):
            middle = 0.5 * (top + bottom)
            above = np.minimum(starts[:, 1], ends[:, 1]) < middle
            below = np.maximum(starts[:, 1], ends[:, 1]) > middle
            a, b = starts[above & below], ends[above & below]
            slope = (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
            at_top, at_bottom = (a[:, 0] + (z - a[:, 1]) * slope for z in (top, bottom))
            order = np.argsort(at_top + at_bottom)
            upper = [left, *at_top[order], right]
            lower = [left, *at_bottom[order], right]
            for k in range(0, len(upper), 2):
                pieces.append(
                    np.array([[upper[k], top], [upper[k + 1], top], [lower[k + 1], bottom], [lower[k], bottom]])
                )
        return [piece for piece in pieces if np.ptp(piece[:, 0]) > 1e-9]

    def faces(self) -> Surface:
        """Return both faces of the plate; texture coordinates are y and z."""
        quads = self.quads()
        half = 0.5 * self.thickness_m
        back, front = (_quad_surface(_at_depth(quads, x), np.array([x / half, 0, 0])) for x in (half, -half))
        front = (front[0], front[1], front[2], np.ascontiguousarray(front[3][:, ::-1]))
        return joined([front, back])

    def rims(self) -> Surface:
        """Return the cut edges of openings and of the plate itself, to be seen from both sides."""
        plate = _box(self.low[0], self.high[0], self.low[1], self.high[1])
        edges = []
        for outline in (*self.outlines, plate):
            near, far = (_at_depth(outline, x) for x in (-0.5 * self.thickness_m, 0.5 * self.thickness_m))
            edges.append(np.stack([near, np.roll(near, -1, axis=0), np.roll(far, -1, axis=0), far], axis=1))
        return _quad_surface(np.concatenate(edges), np.array([-1.0, 0, 0]))

    def solids(self) -> list[Solid]:
        """Return the plate as convex bodies in its own frame."""
        T = pose(R_WALL_PLANE, np.zeros(3))
        return [prism_solid(T, quad, self.thickness_m) for quad in self.quads()]


def _box(left: float, right: float, top: float, bottom: float) -> Array:
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def _at_depth(corners: Array, x: float) -> Array:
    return np.concatenate([np.full((*corners.shape[:-1], 1), x), corners], axis=-1)


def _quad_surface(quads: Array, normal: Array) -> Surface:
    """Return quadrilaterals (n, 4, 3) as triangles with texture coordinates y + x and z."""
    n = len(quads)
    vertices = quads.reshape(-1, 3)
    uv = np.column_stack([vertices[:, 1] + vertices[:, 0], vertices[:, 2]])
    return vertices, uv, np.broadcast_to(normal, vertices.shape).copy(), quad_triangles(n)
