"""From radiance to a digital picture: resampling through the lens, vignetting, exposure, noise, encoding.

One pass over the image. Resampling is bicubic (Catmull-Rom), which keeps fine texture alike at every sub-pixel
shift. Noise comes from a fixed table read at places hashed from the frame's key, so a frame is the same on every run.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.simulation.kernel import inlined, kernel

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
            for c in range(3):
                total = zero
                for j in range(4):
                    v = np.uint64(y0 - 1 + j)
                    total += wy[j] * (
                        wx[0] * radiance[v, np.uint64(x0 - 1), c]
                        + wx[1] * radiance[v, np.uint64(x0), c]
                        + wx[2] * radiance[v, np.uint64(x0 + 1), c]
                        + wx[3] * radiance[v, np.uint64(x0 + 2), c]
                    )
                signal = min(max(light * total, zero), one)
                value = signal + math.sqrt(shot * signal + read) * noise[(at + 3 * column + c) & mask]
                value = min(max(value, zero), one)
                image[row, column, c] = np.uint8(np.float32(255.0) * math.sqrt(value) + np.float32(0.5))
