"""From visibility to radiance: mip-mapped textures, sun, sky light and haze, and the exact depth of every pixel.

A pixel whose samples all see the same part is shaded once; otherwise every part in it is shaded where its samples
are and weighted by their number. Textures are sampled trilinearly, with several taps along the longer axis of the
pixel's footprint, because aliasing would make false stereo matches. Radiance is linear. No library function is
called whose last bit depends on the machine.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from morpheyes_daemon.simulation.rendering.jit import inlined, kernel
from morpheyes_daemon.simulation.rendering.raster import COUNT

MAX_TAPS = 3
"""Most texture taps along the longer axis of a pixel's footprint."""

REUSE_PX = 6
"""Neighbouring pixels of one triangle that share a footprint."""

SMALLEST_LEVEL = 2
"""log2 of the size of the last mip level."""

FAR_TILES = float(1 << 16)
RECORD = np.uint64(0xFFFFFFFF)
DONE = np.iinfo(np.int64).min


@inlined
def _log2(x: float) -> float:
    """Approximate the binary logarithm to 0.09 from the bits of a float32."""
    bits = np.float32(x).view(np.int32)
    return (bits >> 23) - 127 + (bits & 0x7FFFFF) * (1.0 / 0x800000)


@inlined
def _bilinear(texels: Any, start: int, log_size: int, u: float, v: float) -> Any:
    """Sample one mip level (wrapping) at (u, v) in tiles; four 16-bit lanes, 255 * 256 for 1."""
    size = 1 << log_size
    mask = size - 1
    # tiles repeat, so a whole number of them keeps the truncation on the positive side
    x, y = int((u + FAR_TILES) * (size * 256.0)) - 128, int((v + FAR_TILES) * (size * 256.0)) - 128
    fx, fy = x & 255, y & 255
    x0, y0, x1, y1 = (x >> 8) & mask, (y >> 8) & mask, ((x >> 8) + 1) & mask, ((y >> 8) + 1) & mask
    # texels lie in blocks of 4 x 4, see textures.pack
    row0 = start + ((y0 >> 2) << (log_size + 2)) + ((y0 & 3) << 2)
    row1 = start + ((y1 >> 2) << (log_size + 2)) + ((y1 & 3) << 2)
    column0, column1 = ((x0 >> 2) << 4) + (x0 & 3), ((x1 >> 2) << 4) + (x1 & 3)
    w11 = (fx * fy) >> 8
    return (
        np.uint64(256 - fx - fy + w11) * texels[np.uint64(row0 + column0)]
        + np.uint64(fx - w11) * texels[np.uint64(row0 + column1)]
        + np.uint64(fy - w11) * texels[np.uint64(row1 + column0)]
        + np.uint64(w11) * texels[np.uint64(row1 + column1)]
    )


@inlined
def _unpacked(lanes: Any) -> tuple[Any, Any, Any, Any]:
    """Return the four lanes as numbers."""
    low = np.uint64(0xFFFF)
    return (
        np.float32(np.int32(lanes & low)),
        np.float32(np.int32((lanes >> np.uint64(16)) & low)),
        np.float32(np.int32((lanes >> np.uint64(32)) & low)),
        np.float32(np.int32(lanes >> np.uint64(48))),
    )


@inlined
def _footprint(x: float, y: float, records: Any, i: Any, size: float) -> tuple[float, int, float, float]:
    """Return how a pixel of record i reads its texture: mip level, number of taps, and their spread in tiles."""
    z = 1.0 / (records[i, 0] * x + records[i, 1] * y + records[i, 2])
    u = (records[i, 3] * x + records[i, 4] * y + records[i, 5]) * z
    v = (records[i, 6] * x + records[i, 7] * y + records[i, 8]) * z
    ux, vx = (records[i, 3] - u * records[i, 0]) * z, (records[i, 6] - v * records[i, 0]) * z
    uy, vy = (records[i, 4] - u * records[i, 1]) * z, (records[i, 7] - v * records[i, 1]) * z
    across, along = ux * ux + vx * vx, uy * uy + vy * vy
    if across > along:
        across, along, uy, vy = along, across, ux, vx
    taps = 1
    while taps < MAX_TAPS and along > (taps + 0.3) * (taps + 0.3) * across:
        taps += 1
    lod = 0.5 * _log2(along * (size * size) / (taps * taps) + 1e-9)
    return lod, taps, uy / taps, vy / taps


@inlined
def _detail(
    texels: Any, levels: Any, texture: int, log_size: int, u: float, v: float,
    lod: float, taps: int, du: float, dv: float,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Sample a texture's colour (0..1) trilinearly, averaging `taps` taps."""
    lod = min(max(lod, 0.0), float(log_size - SMALLEST_LEVEL))
    level = int(lod)
    # only the middle of the way between two levels is blended
    w1 = np.float32(min(max(1.6 * (lod - level) - 0.3, 0.0), 1.0))
    w0 = np.float32(1.0) - w1
    b, g, r = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    p, q = u - 0.5 * (taps - 1) * du, v - 0.5 * (taps - 1) * dv
    for _ in range(taps):
        if w0 > np.float32(0.0):
            s0, s1, s2, _s = _unpacked(_bilinear(texels, levels[texture, level], log_size - level, p, q))
            b, g, r = b + w0 * s0, g + w0 * s1, r + w0 * s2
        if w1 > np.float32(0.0):
            s0, s1, s2, _s = _unpacked(_bilinear(texels, levels[texture, level + 1], log_size - level - 1, p, q))
            b, g, r = b + w1 * s0, g + w1 * s1, r + w1 * s2
        p, q = p + du, q + dv
    share = np.float32(1.0 / (255.0 * 256.0)) / np.float32(taps)
    return b * share, g * share, r * share


@inlined
def _shade(
    x: float, y: float, records: Any, i: Any, part: int, footprint: tuple[float, int, float, float],
    looks: Any, materials: Any, m: int, ratios: Any, texels: Any, levels: Any, light: Any,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Return the linear radiance (blue, green, red) of the surface of record i at pixel (x, y)."""
    lod, taps, du, dv = footprint
    z = 1.0 / (records[i, 0] * x + records[i, 1] * y + records[i, 2])
    u = (records[i, 3] * x + records[i, 4] * y + records[i, 5]) * z
    v = (records[i, 6] * x + records[i, 7] * y + records[i, 8]) * z
    b, g, r = _detail(texels, levels, materials[m, 0], materials[m, 1], u, v, lod, taps, du, dv)
    b, g, r = b * b * looks[part, 0], g * g * looks[part, 1], r * r * looks[part, 2]
    if materials[m, 4] > 0:
        return b, g, r
    sun = np.float32((records[i, 9] * x + records[i, 10] * y + records[i, 11]) * z)
    sun = min(max(sun, np.float32(0.0)), np.float32(1.0))
    texture, log_size = materials[m, 2], materials[m, 3]
    if texture >= 0:
        level = int(min(max(lod + ratios[m, 2] + 0.5 * taps, 0.0), float(log_size - SMALLEST_LEVEL)))
        lanes = _bilinear(texels, levels[texture, level], log_size - level, u * ratios[m, 0], v * ratios[m, 1])
        mb, mg, mr, ms = _unpacked(lanes)
        double = np.float32(2.0 / (255.0 * 256.0))
        b, g, r, sun = b * mb * double, g * mg * double, r * mr * double, sun * ms * np.float32(0.5) * double
    haze = np.float32(z) * light[3, 0]
    haze = haze * haze
    haze = haze / (np.float32(1.0) + haze)
    ambient = looks[part, 3]
    b = b * (sun * light[0, 0] + ambient * light[1, 0])
    g = g * (sun * light[0, 1] + ambient * light[1, 1])
    r = r * (sun * light[0, 2] + ambient * light[1, 2])
    return b + haze * (light[2, 0] - b), g + haze * (light[2, 1] - g), r + haze * (light[2, 2] - r)


@inlined
def _gather(groups: Any, first: int, samples: Any) -> tuple[int, float, float]:
    """Count the samples of one group, sum up their offsets, and mark them done."""
    group, n, x, y = groups[first], 0, 0.0, 0.0
    for s in range(first, COUNT):
        if groups[s] == group:
            groups[s] = DONE
            n += 1
            x += samples[s, 0]
            y += samples[s, 1]
    return n, x, y


@inlined
def _is_uniform(buffer: Any, row: int, column: int, record_groups: Any, groups: Any) -> bool:
    """Tell whether all samples of a pixel see the same; if not, note the group of each."""
    y, x = np.uint64(row), np.uint64(column)
    difference = np.uint64(0)
    for s in range(1, COUNT):
        difference |= buffer[y, x, s] ^ buffer[y, x, 0]
    if difference & RECORD == np.uint64(0):
        groups[0] = 0
        return True
    uniform = True
    for s in range(COUNT):
        groups[s] = record_groups[buffer[y, x, s] & RECORD]
        uniform = uniform and groups[s] == groups[0]
    return uniform


@kernel
def shade_image(
    buffer: Any,
    samples: Any,
    groups: Any,
    records: Any,
    record_parts: Any,
    record_groups: Any,
    looks: Any,
    part_materials: Any,
    part_objects: Any,
    materials: Any,
    ratios: Any,
    texels: Any,
    levels: Any,
    light: Any,
    radiance: Any,
    depth: Any,
    objects: Any,
) -> None:
    """Fill radiance (H, W, 3) float32 BGR linear, depth (H, W) float32 (inf: sky), objects (H, W) int32 (-1: none).

    looks (P, 4) = tint b, g, r and share of sky light per part; materials (M, 5) = texture, log2 of its size,
    modulating texture (-1: none), log2 of its size, kind (1 emissive, 2 sky); ratios (M, 3) = tiles of the modulating
    texture per tile in u and v, mip levels between the two; light (4, 3) = sun, sky, haze, 1/haze range; groups
    (samples,) int64 is scratch.
    """
    height, width, _ = buffer.shape
    share = np.float32(1.0 / COUNT)
    for row in range(height):
        known, fresh_until, footprint = np.int64(-1), 0, (0.0, 1, 0.0, 0.0)
        for column in range(width):
            uniform = _is_uniform(buffer, row, column, record_groups, groups)
            depth[row, column], objects[row, column] = np.inf, -1
            blue, green, red = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for s in range(COUNT):
                if groups[s] == DONE:
                    continue
                n, x, y = COUNT, float(column), float(row)
                if not uniform:
                    n, dx, dy = _gather(groups, s, samples)
                    x, y = column + dx / n, row + dy / n
                i = np.int64(buffer[np.uint64(row), np.uint64(column), s] & RECORD)
                b, g, r = light[2, 0], light[2, 1], light[2, 2]
                if i > 0:
                    part = record_parts[i]
                    m = part_materials[part]
                    if s == 0 and materials[m, 4] < 2:
                        depth[row, column] = 1.0 / (records[i, 0] * column + records[i, 1] * row + records[i, 2])
                        objects[row, column] = part_objects[part]
                    if i != known or column >= fresh_until:
                        footprint = _footprint(x, y, records, i, float(1 << materials[m, 1]))
                        known, fresh_until = i, column + REUSE_PX
                    b, g, r = _shade(
                        x, y, records, i, part, footprint, looks, materials, m, ratios, texels, levels, light
                    )
                weight = share * np.float32(n)
                blue, green, red = blue + weight * b, green + weight * g, red + weight * r
                if uniform:
                    break
            radiance[row, column, 0], radiance[row, column, 1], radiance[row, column, 2] = blue, green, red
