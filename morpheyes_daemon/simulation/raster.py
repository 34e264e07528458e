"""Which triangle every sample sees: culling, near clipping and scan conversion into a visibility buffer.

Per sample the buffer keeps 1/z and the index of a set-up record, from which `shading` computes everything else.
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

from morpheyes_daemon.simulation.kernel import kernel

NEAR_M = 0.05

SAMPLES: NDArray[np.float64] = np.array(
    [[0.0, 0.0], [-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]]
)
"""Offsets (x, y) in pixels of the samples of a pixel: its centre, then a rotated grid."""

PLANES = 12
"""Columns of a set-up record: the planes (x, y, 1) of 1/z, u/z, v/z and sun/z over the image."""


@kernel
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


@kernel
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


@kernel
def _set_up(q: Any, a: int, b: int, c: int, attributes: Any, two_sided: bool, record: Any) -> bool:
    """Fill one record with plane equations; False for a triangle seen from behind or edge-on."""
    ax, ay, az = q[a, 0], q[a, 1], q[a, 2]
    bx, by, bz = q[b, 0], q[b, 1], q[b, 2]
    cx, cy, cz = q[c, 0], q[c, 1], q[c, 2]
    # rows of the adjugate of [a b c]
    a0, a1, a2 = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    b0, b1, b2 = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    c0, c1, c2 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    determinant = ax * a0 + ay * a1 + az * a2
    if determinant == 0.0 or (determinant > 0.0 and not two_sided):
        return False
    scale = 1.0 / determinant
    record[0] = (a0 + b0 + c0) * scale
    record[1] = (a1 + b1 + c1) * scale
    record[2] = (a2 + b2 + c2) * scale
    for k in range(3):
        p, r, s = attributes[a, k] * scale, attributes[b, k] * scale, attributes[c, k] * scale
        record[3 + 3 * k] = p * a0 + r * b0 + s * c0
        record[4 + 3 * k] = p * a1 + r * b1 + s * c1
        record[5 + 3 * k] = p * a2 + r * b2 + s * c2
    return True


@kernel
def _scan(
    polygon: Any, n: int, record: Any, index: int, samples: Any, spans: Any, inverse_z: Any, indices: Any
) -> None:
    """Scan-convert a convex polygon into every sample plane, keeping what is nearest."""
    planes, height, width = inverse_z.shape
    y_low, y_high = polygon[0, 1], polygon[0, 1]
    x_low, x_high = polygon[0, 0], polygon[0, 0]
    for k in range(1, n):
        y_low, y_high = min(y_low, polygon[k, 1]), max(y_high, polygon[k, 1])
        x_low, x_high = min(x_low, polygon[k, 0]), max(x_high, polygon[k, 0])
    if x_high < -0.5 or x_low > width - 0.5 or y_high < -0.5 or y_low > height - 0.5:
        return
    first = math.ceil(max(y_low - 0.5, 0.0))
    last = math.ceil(min(y_high + 0.5, float(height)))
    for s in range(planes):
        for row in range(first, last):
            spans[s, row, 0] = width
            spans[s, row, 1] = 0
    for k in range(n):
        xa, ya = polygon[k, 0], polygon[k, 1]
        xb, yb = polygon[(k + 1) % n, 0], polygon[(k + 1) % n, 1]
        if ya == yb:
            continue
        if ya > yb:
            xa, ya, xb, yb = xb, yb, xa, ya
        slope = (xb - xa) / (yb - ya)
        for s in range(planes):
            ox, oy = samples[s, 0], samples[s, 1]
            top = math.ceil(max(ya - oy, 0.0))
            bottom = math.ceil(min(yb - oy, float(height)))
            for row in range(top, bottom):
                x = xa + (row + oy - ya) * slope - ox
                column = math.ceil(min(max(x, 0.0), float(width)))
                spans[s, row, 0] = min(spans[s, row, 0], column)
                spans[s, row, 1] = max(spans[s, row, 1], column)
    for s in range(planes):
        for row in range(first, last):
            x0, x1 = spans[s, row, 0], spans[s, row, 1]
            if x0 < x1:
                at_x0 = record[0] * (x0 + samples[s, 0]) + record[1] * (row + samples[s, 1]) + record[2]
                _fill(np.float32(at_x0), np.float32(record[0]), index, inverse_z[s, row, x0:x1], indices[s, row, x0:x1])


@kernel
def _fill(start: Any, step: Any, index: int, inverse_z: Any, indices: Any) -> None:
    for x in range(inverse_z.shape[0]):
        value = start + step * np.float32(x)
        if value > inverse_z[x]:
            inverse_z[x] = value
            indices[x] = index


@kernel
def rasterise(
    vertices: Any,
    attributes: Any,
    triangles: Any,
    bounds: Any,
    ranges: Any,
    flags: Any,
    first_part: int,
    R: Any,
    t: Any,
    eye: Any,
    intrinsics: Any,
    samples: Any,
    inverse_z: Any,
    indices: Any,
    records: Any,
    record_parts: Any,
    record_groups: Any,
    count: int,
) -> int:
    """Draw one batch of parts; return how many set-up records are in use now.

    vertices (V, 3), attributes (V, 3) = (u, v, sun), triangles (T, 3) in the batch's frame; per part: bounds (P, 6)
    = sphere x, y, z, radius and the distances from `eye` between which it is drawn, ranges (P, 4) = first vertex,
    end, first triangle, end, flags (P, 2) = two-sided, loose. R, t take the batch's frame to the camera's; eye (3,) in the batch's frame.
    """
    f, cx, cy = intrinsics
    _, height, width = inverse_z.shape
    q = np.empty((np.max(ranges[:, 1] - ranges[:, 0]), 3))
    polygon = np.empty((4, 2))
    spans = np.empty((inverse_z.shape[0], height, 2), np.int32)
    for part in range(ranges.shape[0]):
        x, y, z, radius = bounds[part, 0], bounds[part, 1], bounds[part, 2], bounds[part, 3]
        distance = math.sqrt((x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2)
        if distance < bounds[part, 4] or distance >= bounds[part, 5]:
            continue
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if not _sphere_is_seen(px, py, pz, radius, f, cx, cy, width, height):
            continue
        v0 = ranges[part, 0]
        for i in range(v0, ranges[part, 1]):
            x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
            pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            q[i - v0, 0] = f * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) + cx * pz
            q[i - v0, 1] = f * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) + cy * pz
            q[i - v0, 2] = pz
        values = attributes[v0 : ranges[part, 1]]
        for k in range(ranges[part, 2], ranges[part, 3]):
            a, b, c = triangles[k, 0] - v0, triangles[k, 1] - v0, triangles[k, 2] - v0
            if q[a, 2] < NEAR_M and q[b, 2] < NEAR_M and q[c, 2] < NEAR_M:
                continue
            if not _set_up(q, a, b, c, values, flags[part, 0], records[count]):
                continue
            record_parts[count] = first_part + part
            record_groups[count] = -2 - count if flags[part, 1] else first_part + part
            corners = _clip_near(q, a, b, c, polygon)
            _scan(polygon, corners, records[count], count, samples, spans, inverse_z, indices)
            count += 1
    return count
