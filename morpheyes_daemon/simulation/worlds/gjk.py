"""Distance between convex solids: the Gilbert-Johnson-Keerthi algorithm on support functions.

Source: Gilbert, Johnson, Keerthi (IEEE J. Robotics and Automation, 1988); the closest points of simplices as in
Ericson, Real-Time Collision Detection (2005), chapter 5. Exact to 0.1 mm for separated solids. Overlap is measured
along a fixed fan of directions, so its depth is an upper estimate; its sign is right.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from morpheyes_daemon.simulation.rendering.jit import allocating

FRUSTUM, CYLINDER, ELLIPSOID, BOX, PRISM = range(5)
"""Kinds of solid; what `size` (9,) means in the solid's own frame, centred at the origin:

FRUSTUM radius at -z, radius at +z, half height; CYLINDER (elliptic) half axes x, y, half height; ELLIPSOID half axes;
BOX half edges; PRISM four corners x, y of a convex quadrilateral (two may coincide), half thickness along z.
"""

TOLERANCE_M = 2e-5
MAX_ITERATIONS = 200


@allocating
def _support_local(kind: int, size: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point of the solid that is farthest along (x, y, z), in its own frame."""
    if kind == FRUSTUM:
        across = math.sqrt(x * x + y * y)
        radius, end = size[0], -size[2]
        if size[1] * across + size[2] * z > size[0] * across - size[2] * z:
            radius, end = size[1], size[2]
        if across < 1e-12:
            return 0.0, 0.0, end
        return radius * x / across, radius * y / across, end
    if kind == CYLINDER:
        norm = math.sqrt((size[0] * x) ** 2 + (size[1] * y) ** 2)
        end = size[2] if z >= 0.0 else -size[2]
        if norm < 1e-12:
            return 0.0, 0.0, end
        return size[0] * size[0] * x / norm, size[1] * size[1] * y / norm, end
    if kind == ELLIPSOID:
        norm = math.sqrt((size[0] * x) ** 2 + (size[1] * y) ** 2 + (size[2] * z) ** 2)
        return size[0] * size[0] * x / norm, size[1] * size[1] * y / norm, size[2] * size[2] * z / norm
    if kind == BOX:
        return math.copysign(size[0], x), math.copysign(size[1], y), math.copysign(size[2], z)
    best = 0
    for k in range(1, 4):
        if size[2 * k] * x + size[2 * k + 1] * y > size[2 * best] * x + size[2 * best + 1] * y:
            best = k
    return size[2 * best], size[2 * best + 1], math.copysign(size[8], z)


@allocating
def _support(kind: int, frame: Any, size: Any, d: Any, sign: float, out: Any) -> None:
    """Add `sign` times the support point along sign * d to `out`; frame (3, 4) is rotation and centre."""
    x, y, z = sign * d[0], sign * d[1], sign * d[2]
    lx = frame[0, 0] * x + frame[1, 0] * y + frame[2, 0] * z
    ly = frame[0, 1] * x + frame[1, 1] * y + frame[2, 1] * z
    lz = frame[0, 2] * x + frame[1, 2] * y + frame[2, 2] * z
    px, py, pz = _support_local(kind, size, lx, ly, lz)
    for i in range(3):
        out[i] += sign * (frame[i, 0] * px + frame[i, 1] * py + frame[i, 2] * pz + frame[i, 3])


@allocating
def _difference(
    kind_a: int, frame_a: Any, size_a: Any, kind_b: int, frame_b: Any, size_b: Any, d: Any, out: Any
) -> None:
    """Write the support point of A - B along d."""
    out[:] = 0.0
    _support(kind_a, frame_a, size_a, d, 1.0, out)
    _support(kind_b, frame_b, size_b, d, -1.0, out)


@allocating
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@allocating
def _closest_on_segment(s: Any, i: int, j: int, weights: Any) -> None:
    a, ab = s[i], s[j] - s[i]
    length2 = _dot(ab, ab)
    t = -_dot(a, ab) / length2 if length2 > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    weights[:] = 0.0
    weights[i], weights[j] = 1.0 - t, t


@allocating
def _closest_on_triangle(s: Any, i: int, j: int, k: int, weights: Any) -> None:
    """Barycentric weights of the triangle's point nearest to the origin (Ericson 5.1.5)."""
    a, b, c = s[i], s[j], s[k]
    ab, ac = b - a, c - a
    d1, d2 = -_dot(ab, a), -_dot(ac, a)
    d3, d4 = -_dot(ab, b), -_dot(ac, b)
    d5, d6 = -_dot(ab, c), -_dot(ac, c)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    weights[:] = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        weights[i] = 1.0
    elif d3 >= 0.0 and d4 <= d3:
        weights[j] = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        _closest_on_segment(s, i, j, weights)
    elif d6 >= 0.0 and d5 <= d6:
        weights[k] = 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        _closest_on_segment(s, i, k, weights)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        _closest_on_segment(s, j, k, weights)
    else:
        total = va + vb + vc
        weights[i], weights[j], weights[k] = va / total, vb / total, vc / total


@allocating
def _closest_on_tetrahedron(s: Any, weights: Any) -> bool:
    """Nearest point of a tetrahedron to the origin; True when the origin is inside."""
    faces = ((0, 1, 2, 3), (0, 1, 3, 2), (0, 2, 3, 1), (1, 2, 3, 0))
    best = np.inf
    trial = np.empty(4)
    outside = False
    for i, j, k, opposite in faces:
        ab, ac = s[j] - s[i], s[k] - s[i]
        nx, ny, nz = ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2], ab[0] * ac[1] - ab[1] * ac[0]
        to_origin = -(nx * s[i, 0] + ny * s[i, 1] + nz * s[i, 2])
        e = s[opposite] - s[i]
        if to_origin * (nx * e[0] + ny * e[1] + nz * e[2]) > 0.0:
            continue
        outside = True
        _closest_on_triangle(s, i, j, k, trial)
        d = 0.0
        for m in range(3):
            d += (trial[0] * s[0, m] + trial[1] * s[1, m] + trial[2] * s[2, m] + trial[3] * s[3, m]) ** 2
        if d < best:
            best = d
            weights[:] = trial
    return not outside


@allocating
def _overlap(kind_a: int, frame_a: Any, size_a: Any, kind_b: int, frame_b: Any, size_b: Any, directions: Any) -> float:
    """Return the smallest extent of A - B beyond the origin over a fan of directions."""
    best = np.inf
    point = np.empty(3)
    for k in range(directions.shape[0]):
        _difference(kind_a, frame_a, size_a, kind_b, frame_b, size_b, directions[k], point)
        best = min(best, _dot(point, directions[k]))
    return max(best, 0.0)


@allocating
def distance(kind_a: int, frame_a: Any, size_a: Any, kind_b: int, frame_b: Any, size_b: Any, directions: Any) -> float:
    """Return the signed distance between two solids: kind, frame (3, 4) as rotation and centre, size (9,).

    `directions` (n, 3) are unit vectors along which an overlap is measured.
    """
    s = np.zeros((4, 3))
    weights = np.zeros(4)
    d, v, w = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        v[i] = frame_a[i, 3] - frame_b[i, 3]
    if _dot(v, v) == 0.0:
        v[0] = 1.0
    n = 0
    for _ in range(MAX_ITERATIONS):
        for i in range(3):
            d[i] = -v[i]
        _difference(kind_a, frame_a, size_a, kind_b, frame_b, size_b, d, w)
        length = math.sqrt(_dot(v, v))
        if n > 0 and (length < TOLERANCE_M or length - _dot(v, w) / length < TOLERANCE_M):
            break
        s[n] = w
        n += 1
        if n == 1:
            weights[:] = 0.0
            weights[0] = 1.0
        elif n == 2:
            _closest_on_segment(s, 0, 1, weights)
        elif n == 3:
            _closest_on_triangle(s, 0, 1, 2, weights)
        elif _closest_on_tetrahedron(s, weights):
            return -_overlap(kind_a, frame_a, size_a, kind_b, frame_b, size_b, directions)
        kept = 0
        v[:] = 0.0
        for i in range(n):
            if weights[i] > 0.0:
                s[kept] = s[i]
                weights[kept] = weights[i]
                v += weights[kept] * s[kept]
                kept += 1
        n = kept
    length = math.sqrt(_dot(v, v))
    if length < TOLERANCE_M:
        return -_overlap(kind_a, frame_a, size_a, kind_b, frame_b, size_b, directions)
    return length


@allocating
def nearest(
    kinds: Any, frames: Any, sizes: Any, kind_b: int, frame_b: Any, size_b: Any, reach_b: float,
    capsules: Any, best: float, directions: Any,
) -> float:  # fmt: skip
    """Return the smaller of `best` and the signed distance from solid b to the nearest of many.

    capsules (n, 7) enclose the solids: both ends of an axis and a radius; `reach_b` is the radius of b.
    """
    bounds = np.empty(len(kinds))
    for k in range(len(kinds)):
        ax, ay, az = capsules[k, 3] - capsules[k, 0], capsules[k, 4] - capsules[k, 1], capsules[k, 5] - capsules[k, 2]
        px, py, pz = frame_b[0, 3] - capsules[k, 0], frame_b[1, 3] - capsules[k, 1], frame_b[2, 3] - capsules[k, 2]
        length2 = ax * ax + ay * ay + az * az
        u = (ax * px + ay * py + az * pz) / length2 if length2 > 0.0 else 0.0
        u = min(max(u, 0.0), 1.0)
        gap = math.sqrt((px - u * ax) ** 2 + (py - u * ay) ** 2 + (pz - u * az) ** 2)
        bounds[k] = gap - capsules[k, 6] - reach_b
    while True:
        k = int(np.argmin(bounds)) if len(bounds) else -1
        if k < 0 or bounds[k] >= best:
            return best
        bounds[k] = np.inf
        best = min(best, distance(kinds[k], frames[k], sizes[k], kind_b, frame_b, size_b, directions))
