"""Shapes as triangles: trunks, crowns, ground, boxes. Pure geometry in ned axes; colours come with the material."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.transforms import Array, skew

Triangles = NDArray[np.int32]
Surface = tuple[Array, Array, Array, Triangles]
"""vertices_m (V, 3), uv_m (V, 2), outward unit normals (V, 3), triangles (T, 3)."""


def frustum(base: Array, top: Array, radius_base_m: float, radius_top_m: float, sides: int) -> Surface:
    """Return the side of a tapered cylinder from `base` to `top` (3,).

    The polygon's radius is enlarged so that it errs from the circle by as much inwards as outwards.
    """
    axis = top - base
    height = float(np.linalg.norm(axis))
    axis = axis / height
    across = skew(axis) @ ([1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    ring = _circle(sides) @ np.stack([across, skew(axis) @ across])
    grown = 2.0 / (1.0 + math.cos(math.pi / sides))
    vertices = np.concatenate([base + grown * radius_base_m * ring, top + grown * radius_top_m * ring])
    around = max(1.0, round(2.0 * math.pi * max(radius_base_m, radius_top_m))) * np.arange(sides + 1) / sides
    uv = np.concatenate([np.column_stack([around, np.full(sides + 1, v)]) for v in (0.0, height)])
    i = np.arange(sides, dtype=np.int32)
    low, high = i, i + sides + 1
    quads = np.concatenate([np.column_stack([low, low + 1, high]), np.column_stack([low + 1, high + 1, high])])
    return vertices, uv, np.concatenate([ring, ring]), quads.astype(np.int32)


@cache
def _circle(sides: int) -> Array:
    """Cosine and sine (sides + 1, 2) once around; the last is the first, to the bit."""
    angle = np.arange(sides + 1) % sides * (2.0 * math.pi / sides)
    return np.column_stack([np.cos(angle), np.sin(angle)])


@cache
def icosphere(subdivisions: int) -> tuple[Array, Triangles]:
    """Return unit vertices (V, 3) and triangles of a subdivided icosahedron; read-only: many ask."""
    phi = (1.0 + math.sqrt(5.0)) / 2.0
    corners = [(s * 1.0, t * phi, 0.0) for s in (-1, 1) for t in (-1, 1)]
    points = [np.roll(c, k) for k in range(3) for c in corners]
    vertices = np.array(points) / math.hypot(1.0, phi)
    triangles = _hull_of_icosahedron(vertices)
    for _ in range(subdivisions):
        vertices, triangles = _subdivide(vertices, triangles)
    vertices.flags.writeable = triangles.flags.writeable = False
    return vertices, triangles


def _hull_of_icosahedron(v: Array) -> Triangles:
    """Neighbours of an icosahedron are its closest pairs; faces are triples of neighbours, turned outwards."""
    near = np.linalg.norm(v[:, None] - v[None], axis=2) < 1.2
    faces = []
    for a in range(12):
        for b in range(a + 1, 12):
            for c in range(b + 1, 12):
                if near[a, b] and near[b, c] and near[a, c]:
                    outwards = np.dot(np.cross(v[b] - v[a], v[c] - v[a]), v[a]) > 0
                    faces.append((a, b, c) if outwards else (a, c, b))
    return np.array(faces, np.int32)


def _subdivide(vertices: Array, triangles: Triangles) -> tuple[Array, Triangles]:
    points = list(vertices)
    middle: dict[tuple[int, int], int] = {}

    def between(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in middle:
            m = points[a] + points[b]
            middle[key] = len(points)
            points.append(m / np.linalg.norm(m))
        return middle[key]

    faces = []
    for a, b, c in triangles.tolist():
        ab, bc, ca = between(a, b), between(b, c), between(c, a)
        faces += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.array(points), np.array(faces, np.int32)


def blob(rng: np.random.Generator, centre: Array, radii: Array, subdivisions: int, roughness: float) -> Surface:
    """Return an ellipsoid whose surface is pushed inwards at random by up to `roughness` of its radius."""
    unit, triangles = icosphere(subdivisions)
    pushed = unit * (1.0 - roughness * rng.random((len(unit), 1)))
    normals = unit / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return _mapped_flat(rng, centre + pushed * radii, normals, triangles)


def _mapped_flat(rng: np.random.Generator, vertices: Array, normals: Array, triangles: Triangles) -> Surface:
    """Give every triangle texture of its own, undistorted and turned at random, as leaves have no grain."""
    corners = vertices[triangles]
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(along, axis=1)
    x = np.einsum("ij,ij->i", along, other) / length
    y = np.linalg.norm(np.cross(along, other), axis=1) / length
    angle, zero = rng.uniform(0, 2 * math.pi, len(triangles)), np.zeros(len(triangles))
    c, s = np.cos(angle), np.sin(angle)
    u = np.stack([zero, length * c, x * c - y * s], axis=1) + rng.random((len(triangles), 1))
    v = np.stack([zero, length * s, x * s + y * c], axis=1) + rng.random((len(triangles), 1))
    loose = np.arange(triangles.size, dtype=np.int32).reshape(-1, 3)
    return corners.reshape(-1, 3), np.column_stack([u.ravel(), v.ravel()]), normals[triangles.ravel()], loose


def leaf_cards(rng: np.random.Generator, centre: Array, radii: Array, count: int, size_m: float) -> Surface:
    """Return `count` loose two-sided triangles in the outer half of an ellipsoid, as tufts of leaves."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = centre + direction * radii * rng.uniform(0.72, 1.0, (count, 1)) * 0.93
    spread = rng.standard_normal((count, 3, 3))
    spread /= np.linalg.norm(spread, axis=2, keepdims=True)
    corners = middle[:, None] + size_m * rng.uniform(0.5, 1.0, (count, 1, 1)) * spread
    # stay inside the ellipsoid that stands for the crown in collisions
    offset = (corners - centre) / radii
    length = np.linalg.norm(offset, axis=2, keepdims=True)
    corners = centre + offset / np.maximum(length, 1.0) * radii
    uv = (rng.random((count, 1, 2)) + size_m * rng.uniform(-0.8, 0.8, (count, 3, 2))).reshape(-1, 2)
    normals = np.repeat(direction, 3, axis=0)
    return corners.reshape(-1, 3), uv, normals, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def cone_tier(rng: np.random.Generator, base: Array, height_m: float, radius_m: float, points: int) -> Surface:
    """Return a drooping, ragged cone of needles with its tip `height_m` above `base`."""
    angle = (np.arange(2 * points) + 0.25 * rng.random(2 * points)) * (math.pi / points) + rng.random()
    reach = radius_m * np.where(np.arange(2 * points) % 2 == 0, rng.uniform(0.86, 1.0, 2 * points), 0.58)
    droop = height_m * np.where(np.arange(2 * points) % 2 == 0, 0.0, 0.22)
    rim = base + np.column_stack([reach * np.cos(angle), reach * np.sin(angle), -droop])
    tip = base + np.array([0.0, 0.0, -height_m])
    outwards = np.column_stack([np.cos(angle), np.sin(angle), np.full(2 * points, -0.6)])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    i = np.arange(2 * points, dtype=np.int32)
    triangles = np.column_stack([np.roll(i, -1), i, i + 2 * points]).astype(np.int32)
    vertices = np.concatenate([rim, np.repeat(tip[None], 2 * points, axis=0)])
    return _mapped_flat(rng, vertices, np.concatenate([outwards, outwards]), triangles)


def sky_dome(lowest_rad: float, rings: int = 12, segments: int = 24, radius_m: float = 1e5) -> Surface:
    """Return a sphere seen from inside, from the zenith (v = 0) down to `lowest_rad` (v = 1); u is azimuth / 2 pi."""
    v, u = np.meshgrid(np.linspace(0, 1, rings + 1), np.linspace(0, 1, segments + 1), indexing="ij")
    elevation, azimuth = math.pi / 2 + v * (lowest_rad - math.pi / 2), u * 2 * math.pi
    level = np.cos(elevation)
    unit = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)], axis=-1)
    unit[:, -1] = unit[:, 0]
    i = np.arange(rings * (segments + 1)).reshape(rings, segments + 1)[:, :-1].ravel()
    right, down = i + 1, i + segments + 1
    upper, lower = np.column_stack([i, right, down]), np.column_stack([right, down + 1, down])
    triangles = np.concatenate([upper, lower])
    unit = unit.reshape(-1, 3)
    return radius_m * unit, np.column_stack([u.ravel(), v.ravel()]), -unit, triangles.astype(np.int32)


def terrain(x_m: Array, y_m: Array, height_m: Array) -> Surface:
    """Return a height field over a grid; height_m (len(x), len(y)) is upwards. uv are x and y."""
    x, y = np.meshgrid(x_m, y_m, indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), -height_m.ravel()])
    dx, dy = np.gradient(height_m, x_m, y_m)
    normals = np.column_stack([-dx.ravel(), -dy.ravel(), -np.ones(x.size)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    i = np.arange(x.size).reshape(x.shape)[:-1, :-1].ravel()
    north, east = i + len(y_m), i + 1
    triangles = np.concatenate([np.column_stack([i, east, north]), np.column_stack([east, north + 1, north])])
    return vertices, vertices[:, :2].copy(), normals, triangles.astype(np.int32)


def joined(surfaces: list[Surface]) -> Surface:
    """Return several surfaces as one."""
    starts = np.cumsum([0, *(len(s[0]) for s in surfaces)])
    return (
        np.concatenate([s[0] for s in surfaces]),
        np.concatenate([s[1] for s in surfaces]),
        np.concatenate([s[2] for s in surfaces]),
        np.concatenate([s[3] + start for s, start in zip(surfaces, starts, strict=False)]).astype(np.int32),
    )


def box(T: Array, edges_m: tuple[float, float, float]) -> Surface:
    """Return a box of given edges at pose T (4, 4); texture coordinates are metres along its edges."""
    corners, uvs, normals = [], [], []
    half = 0.5 * np.array(edges_m)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            ring = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)][:: int(sign)], dtype=float)
            face = np.zeros((4, 3))
            face[:, axis], face[:, u], face[:, v] = sign * half[axis], ring[:, 0] * half[u], ring[:, 1] * half[v]
            corners.append(face)
            # the vertical axis of the box stays the vertical of its texture
            order = (v, u) if u == 2 else (u, v)
            uvs.append(face[:, order] + (axis + 0.5 * sign))
            normals.append(np.tile(sign * np.eye(3)[axis], (4, 1)))
    vertices = np.concatenate(corners) @ T[:3, :3].T + T[:3, 3]
    return vertices, np.concatenate(uvs), np.concatenate(normals) @ T[:3, :3].T, quad_triangles(6)


def quad_triangles(count: int) -> Triangles:
    """Return the two triangles of each of `count` quadrilaterals whose corners follow each other."""
    first = 4 * np.arange(count)[:, None]
    return np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(np.int32)
