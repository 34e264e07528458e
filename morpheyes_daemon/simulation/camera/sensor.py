"""From radiance to a digital picture: resampling through the lens, vignetting, exposure, noise, encoding.

One pass over the image. Resampling is bicubic (Catmull-Rom), which keeps fine texture alike at every sub-pixel
shift. Noise comes from a fixed table read at places hashed from the frame's key, so a frame is the same on every run.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.simulation.rendering.jit import inlined, kernel

NOISE: NDArray[np.float32] = np.random.default_rng(4711).standard_normal(1 << 18, dtype=np.float32)
"""Unit normal numbers; a power of two of them."""


@inlined
def _hashed(key: Any, row: int) -> int:
    """Return a well mixed non-negative number (splitmix64)."""
    z = key * np.uint64(0x9E3779B97F4A7C15) + np.uint64(row) * np.uint64(0xD1B54A32D192ED03)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int((z ^ (z >> np.uint64(31))) >> np.uint64(33))


@inlined
def _cubic(t: Any) -> tuple[Any, Any, Any, Any]:
    """Catmull-Rom weights of the four neighbours at fraction t."""
    half = np.float32(0.5)
    one, two, three = np.float32(1.0), np.float32(2.0), np.float32(3.0)
    four, five = np.float32(4.0), np.float32(5.0)
    return (
        half * t * (t * (two - t) - one),
        half * (t * t * (three * t - five) + two),
        half * t * (t * (four - three * t) + one),
        half * t * t * (t - one),
    )


@inlined
def _along(radiance: Any, row: int, column: int, w: tuple[Any, Any, Any, Any]) -> tuple[Any, Any, Any]:
    """Return the weighted sum (blue, green, red) of four neighbours in a row."""
    y, x0, x1 = np.uint64(row), np.uint64(column - 1), np.uint64(column)
    x2, x3 = np.uint64(column + 1), np.uint64(column + 2)
    return (
        w[0] * radiance[y, x0, 0] + w[1] * radiance[y, x1, 0] + w[2] * radiance[y, x2, 0] + w[3] * radiance[y, x3, 0],
        w[0] * radiance[y, x0, 1] + w[1] * radiance[y, x1, 1] + w[2] * radiance[y, x2, 1] + w[3] * radiance[y, x3, 1],
        w[0] * radiance[y, x0, 2] + w[1] * radiance[y, x1, 2] + w[2] * radiance[y, x2, 2] + w[3] * radiance[y, x3, 2],
    )


@kernel
def develop(
    radiance: Any, lens_map: Any, vignette: Any, gain: Any, shot: Any, read: Any, noise: Any, key: Any, image: Any
) -> None:
    """Fill image (h, w, 3) uint8 from radiance (H, W, 3) at lens_map (h, w, 2) = x, y.

    Signal = gain * vignette * radiance, clipped to 0..1; its variance is shot * signal + read; the picture is 255
    times the square root.
    """
    height, width, _ = image.shape
    last_row, last_column = radiance.shape[0] - 3, radiance.shape[1] - 3
    mask = len(noise) - 1
    gain, shot, read = np.float32(gain), np.float32(shot), np.float32(read)
    zero, one = np.float32(0.0), np.float32(1.0)
    for row in range(height):
        at = _hashed(key, row)
        for column in range(width):
            x, y = lens_map[row, column, 0], lens_map[row, column, 1]
            x0 = min(max(int(x), 1), last_column)
            y0 = min(max(int(y), 1), last_row)
            wx = _cubic(x - np.float32(x0))
            wy = _cubic(y - np.float32(y0))
            light = gain * vignette[row, column]
            b0, g0, r0 = _along(radiance, y0 - 1, x0, wx)
            b1, g1, r1 = _along(radiance, y0, x0, wx)
            b2, g2, r2 = _along(radiance, y0 + 1, x0, wx)
            b3, g3, r3 = _along(radiance, y0 + 2, x0, wx)
            bgr = (
                wy[0] * b0 + wy[1] * b1 + wy[2] * b2 + wy[3] * b3,
                wy[0] * g0 + wy[1] * g1 + wy[2] * g2 + wy[3] * g3,
                wy[0] * r0 + wy[1] * r1 + wy[2] * r2 + wy[3] * r3,
            )
            for c in range(3):
                signal = min(max(light * bgr[c], zero), one)
                value = signal + math.sqrt(shot * signal + read) * noise[(at + 3 * column + c) & mask]
                value = min(max(value, zero), one)
                image[row, column, c] = np.uint8(np.float32(255.0) * math.sqrt(value) + np.float32(0.5))
