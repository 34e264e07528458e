"""From visibility to radiance: mip-mapped textures, sun, sky light and haze, and the exact depth of every pixel.

A pixel whose samples all see the same part is shaded once; otherwise every part in it is shaded where its samples
are and weighted by their number. Textures are sampled trilinearly, with several taps along the longer axis of the
pixel's footprint, because aliasing would make false stereo matches. Radiance is linear. No library function is
called whose last bit depends on the machine.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from morpheyes_daemon.simulation.kernel import kernel

MAX_TAPS = 6
"""Most texture taps along the longer axis of a pixel's footprint."""


@kernel
def _log2(x: float) -> float:
    """Approximate the binary logarithm to 0.09 from the bits of a float32."""
    bits = np.float32(x).view(np.int32)
    return (bits >> 23) - 127 + (bits & 0x7FFFFF) * (1.0 / 0x800000)


@kernel
def _bilinear(texels: Any, start: int, log_size: int, u: float, v: float) -> tuple[float, float, float, float]:
    """Sample one mip level (wrapping) at (u, v) in tiles; four channels in 0..255."""
    size = 1 << log_size
    mask = size - 1
    x, y = u * size - 0.5, v * size - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    row0, row1 = start + ((y0 & mask) << log_size), start + (((y0 + 1) & mask) << log_size)
    i, j = x0 & mask, (x0 + 1) & mask
    one = np.float32(1.0)
    w00, w01 = (one - fx) * (one - fy), fx * (one - fy)
    w10, w11 = (one - fx) * fy, fx * fy
    a, b, c, d = texels[row0 + i], texels[row0 + j], texels[row1 + i], texels[row1 + j]
    return (
        w00 * a[0] + w01 * b[0] + w10 * c[0] + w11 * d[0],
        w00 * a[1] + w01 * b[1] + w10 * c[1] + w11 * d[1],
        w00 * a[2] + w01 * b[2] + w10 * c[2] + w11 * d[2],
        w00 * a[3] + w01 * b[3] + w10 * c[3] + w11 * d[3],
    )


@kernel
def _trilinear(
    texels: Any, levels: Any, log_size: int, u: float, v: float, lod: float
) -> tuple[float, float, float, float]:
    """Sample between two mip levels; `levels` holds where each level starts."""
    lod = min(max(lod, 0.0), float(log_size))
    level = int(lod)
    w = np.float32(lod - level)
    a0, a1, a2, a3 = _bilinear(texels, levels[level], log_size - level, u, v)
    if w < np.float32(0.02):
        return a0, a1, a2, a3
    b0, b1, b2, b3 = _bilinear(texels, levels[level + 1], log_size - level - 1, u, v)
    return a0 + w * (b0 - a0), a1 + w * (b1 - a1), a2 + w * (b2 - a2), a3 + w * (b3 - a3)


@kernel
def _anisotropic(
    texels: Any, levels: Any, log_size: int, u: float, v: float, gradients: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Sample along the longer axis of the footprint; gradients du/dx, dv/dx, du/dy, dv/dy in tiles per pixel."""
    ux, vx, uy, vy = gradients
    size = 1 << log_size
    across, along = ux * ux + vx * vx, uy * uy + vy * vy
    if across > along:
        across, along, uy, vy = along, across, ux, vx
    ratio = math.sqrt(along / max(across, 1e-12))
    taps = min(max(math.ceil(ratio - 0.3), 1), MAX_TAPS)
    lod = 0.5 * _log2(max(along * size * size / (taps * taps), 1e-12))
    r, g, b, a = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(taps):
        w = (k + 0.5) / taps - 0.5
        s0, s1, s2, s3 = _trilinear(texels, levels, log_size, u + w * uy, v + w * vy, lod)
        r, g, b, a = r + s0, g + s1, b + s2, a + s3
    share = np.float32(1.0 / (255.0 * taps))
    return r * share, g * share, b * share, a * share


@kernel
def _shade(
    x: float, y: float, record: Any, part: int, look: Any, material: Any, atlas: Any, light: Any
) -> tuple[float, float, float]:
    """Return the linear radiance (blue, green, red) of one surface point."""
    texels, levels, log_sizes = atlas
    iz = record[0] * x + record[1] * y + record[2]
    z = 1.0 / iz
    u = (record[3] * x + record[4] * y + record[5]) * z
    v = (record[6] * x + record[7] * y + record[8]) * z
    sun = min(max((record[9] * x + record[10] * y + record[11]) * z, 0.0), 1.0)
    gradients = (
        (record[3] - u * record[0]) * z,
        (record[6] - v * record[0]) * z,
        (record[4] - u * record[1]) * z,
        (record[7] - v * record[1]) * z,
    )
    texture, su, sv = int(material[0]), material[1], material[2]
    b, g, r, _ = _anisotropic(
        texels, levels[texture], log_sizes[texture], u * su, v * sv,
        (gradients[0] * su, gradients[1] * sv, gradients[2] * su, gradients[3] * sv),
    )
    b, g, r = b * b * look[0], g * g * look[1], r * r * look[2]
    if material[6] > 0.0:
        return b, g, r
    if material[3] >= 0.0:
        texture, su, sv = int(material[3]), material[4], material[5]
        mb, mg, mr, ms = _anisotropic(
            texels, levels[texture], log_sizes[texture], u * su, v * sv,
            (gradients[0] * su, gradients[1] * sv, gradients[2] * su, gradients[3] * sv),
        )
        b, g, r, sun = b * mb * 2.0, g * mg * 2.0, r * mr * 2.0, sun * ms
    haze = z * light[3, 0]
    haze = haze * haze / (1.0 + haze * haze)
    ambient = look[3]
    b = b * (sun * light[0, 0] + ambient * light[1, 0])
    g = g * (sun * light[0, 1] + ambient * light[1, 1])
    r = r * (sun * light[0, 2] + ambient * light[1, 2])
    return b + haze * (light[2, 0] - b), g + haze * (light[2, 1] - g), r + haze * (light[2, 2] - r)


@kernel
def shade_image(
    indices: Any,
    samples: Any,
    records: Any,
    record_parts: Any,
    record_groups: Any,
    looks: Any,
    part_materials: Any,
    part_objects: Any,
    materials: Any,
    atlas: Any,
    light: Any,
    radiance: Any,
    depth: Any,
    objects: Any,
) -> None:
    """Fill radiance (H, W, 3) float32 BGR linear, depth (H, W) float32 (inf: sky), objects (H, W) int32 (-1: none).

    looks (P, 4) = tint b, g, r and share of sky light per part; materials (M, 7) = texture, its tiles per metre in u
    and v, modulating texture (-1: none), its tiles per metre, emissive; light (4, 3) = sun, sky, haze, 1/haze range.
    """
    planes, height, width = indices.shape
    for row in range(height):
        for column in range(width):
            first = indices[0, row, column]
            part, group = -1, -1
            depth[row, column] = np.inf
            objects[row, column] = -1
            if first >= 0:
                part, group = record_parts[first], record_groups[first]
                if materials[part_materials[part], 6] < 2.0:
                    iz = records[first, 0] * column + records[first, 1] * row + records[first, 2]
                    depth[row, column] = 1.0 / iz
                    objects[row, column] = part_objects[part]
            uniform = True
            for s in range(1, planes):
                other = indices[s, row, column]
                if (record_groups[other] if other >= 0 else -1) != group:
                    uniform = False
            if uniform:
                if part >= 0:
                    b, g, r = _shade(
                        float(column), float(row), records[first], part, looks[part],
                        materials[part_materials[part]], atlas, light,
                    )
                else:
                    b, g, r = light[2, 0], light[2, 1], light[2, 2]
                radiance[row, column, 0] = b
                radiance[row, column, 1] = g
                radiance[row, column, 2] = r
                continue
            total_b, total_g, total_r = 0.0, 0.0, 0.0
            done = 0
            for s in range(planes):
                if done >> s & 1:
                    continue
                index = indices[s, row, column]
                part = record_parts[index] if index >= 0 else -1
                group = record_groups[index] if index >= 0 else -1
                n, x, y = 0, 0.0, 0.0
                for other_s in range(s, planes):
                    other = indices[other_s, row, column]
                    if (record_groups[other] if other >= 0 else -1) == group:
                        done |= 1 << other_s
                        n += 1
                        x += samples[other_s, 0]
                        y += samples[other_s, 1]
                b, g, r = light[2, 0], light[2, 1], light[2, 2]
                if part >= 0:
                    b, g, r = _shade(
                        column + x / n, row + y / n, records[index], part, looks[part],
                        materials[part_materials[part]], atlas, light,
                    )
                total_b += n * b
                total_g += n * g
                total_r += n * r
            radiance[row, column, 0] = total_b / planes
            radiance[row, column, 1] = total_g / planes
            radiance[row, column, 2] = total_r / planes
