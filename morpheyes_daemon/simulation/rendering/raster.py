"""Which triangle every sample sees: culling, near clipping and scan conversion into a visibility buffer.

Per sample the buffer keeps one number, the bits of 1/z above the index of a set-up record, so that the largest is the
nearest; from the record `shading` computes everything else.
Spans are half-open between edge crossings that do not depend on the direction an edge is walked in, so meshes
that share vertices have neither cracks nor double hits. Plane equations come from the unclipped triangle in
homogeneous coordinates (Olano and Greer, Triangle Scan Conversion using 2D Homogeneous Coordinates, 1997).
Nothing here knows textures or light.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.simulation.rendering.jit import allocating, inlined, kernel

NEAR_M = 0.05

SAMPLES: NDArray[np.float64] = np.array([[0.0, 0.0], [-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])
"""Offsets (x, y) in pixels of the samples of a pixel: its centre, then a rotated grid."""

COUNT = len(SAMPLES)

REACH_PX = 0.375
"""Farthest that a sample lies from the centre, along x or y."""

TILE = 8
"""Edge in pixels of the tiles for which the farthest sample is known."""

REFRESH_TRIANGLES = 300
"""Triangles drawn until the tiles are looked at again."""

PLANES = 12
"""Columns of a set-up record: the planes (x, y, 1) of 1/z, u/z, v/z and sun/z over the image."""


@inlined
def _sphere_is_seen(
    x: float, y: float, z: float, radius: float, f: float, cx: float, cy: float, width: int, height: int
) -> bool:
    """Tell whether a sphere in camera coordinates reaches into the frustum."""
    if z + radius < NEAR_M:
        return False
    left, right = (cx + 1.0) / f, (width - cx) / f
    top, bottom = (cy + 1.0) / f, (height - cy) / f
    return not (
        (x + left * z) < -radius * math.sqrt(1.0 + left * left)
        or (right * z - x) < -radius * math.sqrt(1.0 + right * right)
        or (y + top * z) < -radius * math.sqrt(1.0 + top * top)
        or (bottom * z - y) < -radius * math.sqrt(1.0 + bottom * bottom)
    )


@inlined
def _clip_near(q: Any, a: int, b: int, c: int, polygon: Any) -> int:
    """Write the corners (x, y) in pixels of triangle abc in front of the near plane; return how many there are."""
    n = 0
    corners = (a, b, c)
    for k in range(3):
        i, j = corners[k], corners[(k + 1) % 3]
        z_i, z_j = q[i, 2], q[j, 2]
        if z_i >= NEAR_M:
            polygon[n, 0] = q[i, 0] / z_i
            polygon[n, 1] = q[i, 1] / z_i
            n += 1
        if (z_i >= NEAR_M) != (z_j >= NEAR_M):
            # always from the visible end, so that both triangles at this edge get the same corner
            if z_i < NEAR_M:
                i, j = j, i
            w = (q[i, 2] - NEAR_M) / (q[i, 2] - q[j, 2])
            polygon[n, 0] = (q[i, 0] + w * (q[j, 0] - q[i, 0])) / NEAR_M
            polygon[n, 1] = (q[i, 1] + w * (q[j, 1] - q[i, 1])) / NEAR_M
            n += 1
    return n


@inlined
def _set_up(q: Any, a: int, b: int, c: int, attributes: Any, v0: int, two_sided: bool, records: Any, i: int) -> bool:
    """Fill record i with plane equations; False for a triangle seen from behind or edge-on."""
    ax, ay, az = q[a, 0], q[a, 1], q[a, 2]
    bx, by, bz = q[b, 0], q[b, 1], q[b, 2]
    cx, cy, cz = q[c, 0], q[c, 1], q[c, 2]
    # rows of the adjugate of [a b c]
    a0, a1, a2 = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    determinant = ax * a0 + ay * a1 + az * a2
    if determinant == 0.0 or (determinant > 0.0 and not two_sided):
        return False
    b0, b1, b2 = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    c0, c1, c2 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    scale = 1.0 / determinant
    records[i, 0] = (a0 + b0 + c0) * scale
    records[i, 1] = (a1 + b1 + c1) * scale
    records[i, 2] = (a2 + b2 + c2) * scale
    for k in range(3):
        p, r, s = attributes[v0 + a, k] * scale, attributes[v0 + b, k] * scale, attributes[v0 + c, k] * scale
        records[i, 3 + 3 * k] = p * a0 + r * b0 + s * c0
        records[i, 4 + 3 * k] = p * a1 + r * b1 + s * c1
        records[i, 5 + 3 * k] = p * a2 + r * b2 + s * c2
    return True


@inlined
def _scan(
    xa: float, ya: float, xb: float, yb: float, xc: float, yc: float, records: Any, i: int, samples: Any, buffer: Any,
    low: Any, high: Any, start: Any,
) -> None:  # fmt: skip
    """Scan-convert a triangle given in pixels, keeping what is nearest; low, high, start (samples,) are scratch."""
    height, width, _ = buffer.shape
    if ya > yb:
        xa, ya, xb, yb = xb, yb, xa, ya
    if yb > yc:
        xb, yb, xc, yc = xc, yc, xb, yb
    if ya > yb:
        xa, ya, xb, yb = xb, yb, xa, ya
    if yc < -0.5 or ya > height - 0.5 or max(xa, xb, xc) < -0.5 or min(xa, xb, xc) > width - 0.5 or ya == yc:
        return
    # edges always run downwards, whichever triangle they belong to
    slope_ac = (xc - xa) / (yc - ya)
    slope_ab = (xb - xa) / (yb - ya) if yb > ya else 0.0
    slope_bc = (xc - xb) / (yc - yb) if yc > yb else 0.0
    b_is_right = xa + (yb - ya) * slope_ac < xb
    for row in range(math.ceil(max(ya - REACH_PX, 0.0)), math.ceil(min(yc + REACH_PX, float(height)))):
        left, right = np.inf, -np.inf
        for s in range(COUNT):
            y = row + samples[s, 1]
            one = xa + (y - ya) * slope_ac - samples[s, 0]
            other = (xa + (y - ya) * slope_ab if y < yb else xb + (y - yb) * slope_bc) - samples[s, 0]
            within = (y >= ya) & (y < yc)
            low[s] = (one if b_is_right else other) if within else np.inf
            high[s] = (other if b_is_right else one) if within else -np.inf
            left, right = min(left, low[s]), max(right, high[s])
        x0, x1 = math.ceil(max(left, 0.0)), math.ceil(min(right, float(width)))
        if x0 < x1:
            _fill(x0, x1, row, records, i, samples, buffer, low, high, start)


@inlined
def _fill(
    x0: int, x1: int, row: int, records: Any, i: int, samples: Any, buffer: Any, low: Any, high: Any, start: Any
) -> None:
    """Put growing or shrinking 1/z into the pixels x0..x1 of a row, at samples between low and high, where nearest."""
    dx, dy, c = records[i, 0], records[i, 1], records[i, 2]
    for s in range(COUNT):
        start[s] = dx * (x0 + samples[s, 0]) + dy * (row + samples[s, 1]) + c
    step, index, line = np.float32(dx), np.uint64(i), np.uint64(row)
    for x in range(x0, x1):
        at, gone, column = float(x), np.float32(x - x0), np.uint64(x)
        for s in range(COUNT):
            key = np.uint64(np.float32(start[s] + step * gone).view(np.uint32)) << np.uint64(32) | index
            if (at >= low[s]) & (at < high[s]) & (key > buffer[line, column, s]):
                buffer[line, column, s] = key


@inlined
def _farthest_in(buffer: Any, top: int, left: int) -> Any:
    """Return the smallest 1/z in a tile, 0 if one of its samples is empty."""
    height, width, _ = buffer.shape
    smallest = buffer[top, left, 0]
    for row in range(top, min(top + TILE, height)):
        for column in range(left, min(left + TILE, width)):
            for s in range(COUNT):
                smallest = min(smallest, buffer[np.uint64(row), np.uint64(column), s])
        if smallest == np.uint64(0):
            return np.float32(0.0)
    return np.uint32(smallest >> np.uint64(32)).view(np.float32)


@inlined
def _refresh(buffer: Any, farthest: Any) -> None:
    """Look which tiles have filled up: what lies behind their farthest sample is hidden.

    Later drawing could only bring that sample nearer, and drawing nearest first, hardly ever does.
    """
    for i in range(farthest.shape[0]):
        for j in range(farthest.shape[1]):
            if farthest[i, j] == np.float32(0.0):
                farthest[i, j] = _farthest_in(buffer, i * TILE, j * TILE)


@inlined
def _is_hidden(polygon: Any, n: int, inverse_z: float, farthest: Any) -> bool:
    """Tell whether all tiles that a polygon touches are full of nearer things, or it is off the image."""
    x_low, x_high = polygon[0, 0], polygon[0, 0]
    y_low, y_high = polygon[0, 1], polygon[0, 1]
    for k in range(1, n):
        x_low, x_high = min(x_low, polygon[k, 0]), max(x_high, polygon[k, 0])
        y_low, y_high = min(y_low, polygon[k, 1]), max(y_high, polygon[k, 1])
    rows, columns = farthest.shape
    if not (x_high > -0.5 and y_high > -0.5 and x_low < columns * TILE and y_low < rows * TILE):
        return True
    # a pixel reaches half its width around its centre
    i0, i1 = int(max(y_low - 0.5, 0.0)) // TILE, int(min(y_high + 0.5, rows * TILE - 1.0)) // TILE
    j0, j1 = int(max(x_low - 0.5, 0.0)) // TILE, int(min(x_high + 0.5, columns * TILE - 1.0)) // TILE
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            if farthest[i, j] < inverse_z:
                return False
    return True


@allocating
def visible_parts(bounds: Any, R: Any, t: Any, eye: Any, intrinsics: Any, size: Any) -> Any:
    """Return the numbers of the parts in view and in drawing range, nearest first.

    bounds (P, 6) = sphere x, y, z, radius and the distances along x, y from `eye` (2,) between which a part
    is drawn; R, t take
    the parts' frame to the camera's; size = (width, height) in pixels.
    """
    f, cx, cy = intrinsics
    found = np.empty(len(bounds), np.int64)
    distances = np.empty(len(bounds))
    n = 0
    for part in range(len(bounds)):
        x, y, z, radius = bounds[part, 0], bounds[part, 1], bounds[part, 2], bounds[part, 3]
        beside = math.sqrt((x - eye[0]) ** 2 + (y - eye[1]) ** 2)
        if beside < bounds[part, 4] or beside >= bounds[part, 5]:
            continue
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if _sphere_is_seen(px, py, pz, radius, f, cx, cy, size[0], size[1]):
            found[n], distances[n] = part, pz - radius
            n += 1
    return found[:n][np.argsort(distances[:n], kind="mergesort")]


@inlined
def _transform(vertices: Any, first: int, last: int, R: Any, t: Any, intrinsics: Any, q: Any) -> None:
    """Write homogeneous pixels (x z, y z, z) of some vertices."""
    f, cx, cy = intrinsics
    for i in range(first, last):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        q[i - first, 0] = f * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) + cx * depth
        q[i - first, 1] = f * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) + cy * depth
        q[i - first, 2] = depth


@kernel
def rasterise(
    order: Any,
    vertices: Any,
    attributes: Any,
    triangles: Any,
    ranges: Any,
    flags: Any,
    first_part: int,
    R: Any,
    t: Any,
    intrinsics: Any,
    samples: Any,
    buffer: Any,
    farthest: Any,
    q: Any,
    polygon: Any,
    edges: Any,
    start: Any,
    records: Any,
    record_parts: Any,
    record_groups: Any,
    count: int,
) -> int:
    """Draw the parts of one batch in the given order; return how many set-up records are in use now.

    vertices (V, 3), attributes (V, 3) = (u, v in tiles, sun), triangles (T, 3) in the batch's frame; per part:
    ranges (P, 4) = first vertex, end, first triangle, end; flags (P, 2) = two-sided, loose. q (most vertices of a
    part, 3), polygon (4, 2), edges (2, samples) and start (samples,) float32 are scratch.
    """
    drawn = 0
    for n in range(len(order)):
        part = order[n]
        if drawn > REFRESH_TRIANGLES:
            _refresh(buffer, farthest)
            drawn = 0
        v0 = ranges[part, 0]
        _transform(vertices, v0, ranges[part, 1], R, t, intrinsics, q)
        for k in range(ranges[part, 2], ranges[part, 3]):
            a, b, c = triangles[k, 0] - v0, triangles[k, 1] - v0, triangles[k, 2] - v0
            corners = _clip_near(q, a, b, c, polygon)
            nearest = 1.0 / max(min(q[a, 2], q[b, 2], q[c, 2]), NEAR_M)
            if corners == 0 or _is_hidden(polygon, corners, nearest, farthest):
                continue
            if not _set_up(q, a, b, c, attributes, v0, flags[part, 0], records, count):
                continue
            record_parts[count] = first_part + part
            record_groups[count] = -2 - count if flags[part, 1] else first_part + part
            for corner in range(2, corners):
                _scan(
                    polygon[0, 0], polygon[0, 1], polygon[corner - 1, 0], polygon[corner - 1, 1],
                    polygon[corner, 0], polygon[corner, 1], records, count, samples, buffer, edges[0], edges[1], start,
                )  # fmt: skip
            count += 1
            drawn += 1
    return count
