"""Shapes of openings in a wall, and how large they must be for the vehicle to fit.

An outline is a closed polygon (n, 2) in a plane: first to the right, second downwards, in metres, around (0, 0).
What the vehicle needs is a rectangle: its silhouette in crossing attitude with the clearance on every side.
"""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.transforms import Array

Shape = Literal["rectangle", "infinity", "goku", "blob"]

FIT_PX = 1600
"""Pixels over a unit shape when looking for the place where a rectangle fits; 1 px is about a millimetre."""

# a bust with spiky hair, right and up
_GOKU = (
    (-0.62, -1.0), (0.62, -1.0), (0.72, -0.72), (0.55, -0.55), (0.28, -0.46), (0.24, -0.34), (0.38, -0.12),
    (0.46, 0.02), (0.42, 0.10), (0.78, 0.02), (0.62, 0.22), (1.0, 0.30), (0.70, 0.44), (0.95, 0.66), (0.60, 0.62),
    (0.66, 0.95), (0.36, 0.72), (0.22, 1.0), (0.08, 0.74), (-0.14, 0.98), (-0.22, 0.70), (-0.50, 0.90),
    (-0.46, 0.58), (-0.85, 0.62), (-0.62, 0.38), (-1.0, 0.22), (-0.62, 0.16), (-0.80, -0.08), (-0.44, 0.06),
    (-0.46, -0.02), (-0.38, -0.14), (-0.24, -0.34), (-0.28, -0.46), (-0.55, -0.55), (-0.72, -0.72),
)  # fmt: skip


def outline(shape: Shape, rng: np.random.Generator, width_m: float, height_m: float, slack: float = 1.0) -> Array:
    """Return the smallest opening of a shape that a rectangle fits in, times `slack`, the rectangle's place at (0, 0).

    A rectangular opening is the rectangle itself.
    """
    if shape == "rectangle":
        return np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (width_m, height_m) * 0.5 * slack
    return fitted(_unit_outline(shape, rng), width_m, height_m) * slack


def _unit_outline(shape: Shape, rng: np.random.Generator) -> Array:
    """Return a shape about two units wide; only a blob uses `rng`."""
    if shape == "goku":
        return np.array(_GOKU) * (1.0, -1.0)
    theta: Array = np.arange(72, dtype=np.float64) * (2 * math.pi / 72)
    radius = _cassini(theta) if shape == "infinity" else _wavy(theta, rng)
    return np.column_stack([radius * np.cos(theta), radius * np.sin(theta)])


def _cassini(theta: Array, waist: float = 1.08) -> Array:
    """Cassini's oval, an infinity sign with a narrow waist: r^2 = cos 2t + sqrt(waist^4 - sin^2 2t)."""
    c, s = np.cos(2 * theta), np.sin(2 * theta)
    return np.asarray(np.sqrt(c + np.sqrt(waist**4 - s * s)) / math.sqrt(1 + waist**2))


def _wavy(theta: Array, rng: np.random.Generator) -> Array:
    radius = np.ones_like(theta)
    for k in range(2, 7):
        radius += rng.uniform(0.05, 0.35) / k * np.cos(k * theta + rng.uniform(0, 2 * math.pi)) * 1.3
    return radius


def fitted(unit: Array, width_m: float, height_m: float) -> Array:
    """Scale a shape so that a rectangle just fits in somewhere, and put that place at (0, 0)."""
    low, high = 0.05, 20.0
    while high - low > 1e-3 * high:
        scale = math.sqrt(low * high)
        if _places(unit, width_m / scale, height_m / scale).any():
            high = scale
        else:
            low = scale
    places = _places(unit, width_m / high, height_m / high)
    v, u = np.nonzero(places)
    centre = np.array([u.mean(), v.mean()]) / _px_per_unit(unit) + unit.min(axis=0)
    return np.asarray((unit - centre) * high)


def _px_per_unit(unit: Array) -> float:
    return float(FIT_PX / np.ptp(unit, axis=0).max())


def _places(unit: Array, width: float, height: float) -> NDArray[np.bool_]:
    """Return where (pixels) the centre of a rectangle can be so that it lies inside the shape."""
    k = _px_per_unit(unit)
    inside = np.zeros((FIT_PX + 3, FIT_PX + 3), np.uint8)
    cv2.fillPoly(inside, [np.rint((unit - unit.min(axis=0)) * k * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
    size = (2 * round(width * k / 2) + 1, 2 * round(height * k / 2) + 1)
    if max(size) > FIT_PX:
        return np.zeros_like(inside, dtype=bool)
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, size)
    return np.asarray(cv2.erode(inside, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0.0), dtype=bool)
