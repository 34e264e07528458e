"""One camera: pinhole with skew and the paper's radial-tangential distortion, projected and inverted.

OpenCV's camera matrix has no skew, so the formulas (paper, section II) are written here. Poses are not part of it;
they belong to the rig.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.transforms import Array

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-13
"""Most Newton steps and the normalised step that ends them; chosen: double precision of coordinates near 1."""
_LARGEST_STEP = 0.5
"""Largest Newton step, normalised; chosen: keeps an iteration from jumping over a fold of the polynomial."""
_SOLVED = 1e-9
"""Largest residual of a solution, normalised; chosen: a millionth of a pixel."""
_ASPECT_TOLERANCE = 0.01
"""Largest relative difference of the aspect ratios of two image sizes; chosen: rounding of small images."""
_BORDER_POINTS = 33
"""Points along each edge of the image; chosen: an edge bends smoothly between them."""


@dataclass(frozen=True)
class CameraIntrinsics:
    """Focal lengths, principal point, skew and distortion of one camera; pixel (0, 0) is a pixel's centre.

    `k` is (k1, k2, k3, k4, k5) in the paper's order: radial k1, k2, k5, tangential k3, k4; OpenCV's
    (k1, k2, p1, p2, k3) are the same five numbers. `alpha` is the skew: K = [[fx, alpha fx, cx], [0, fy, cy], ...].
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    alpha: float = 0.0
    k: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, self.alpha, *self.k)
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0 or len(self.k) != 5:
            raise CalibrationError("Camera intrinsics need a size, positive focal lengths and five coefficients.")
        if not all(math.isfinite(number) for number in numbers):
            raise CalibrationError("Camera intrinsics must be finite numbers.")

    @property
    def K(self) -> Array:
        """The camera matrix (3, 3) with skew."""
        return np.array([[self.fx, self.alpha * self.fx, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, p_cam: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3) in camera axes with z > 0 (paper, section II)."""
        return self.pixels_from_normalised(p_cam[..., :2] / p_cam[..., 2:3])

    def pixels_from_normalised(self, xy: Array) -> Array:
        """Return the pixels (..., 2) of undistorted normalised coordinates (..., 2) (paper, section II)."""
        distorted = distort(xy, self.k)
        x, y = distorted[..., 0], distorted[..., 1]
        return np.stack([self.fx * (x + self.alpha * y) + self.cx, self.fy * y + self.cy], axis=-1)

    def normalised_from_pixels(self, uv: Array) -> Array:
        """Return the undistorted normalised coordinates (..., 2), x = X/Z, y = Y/Z, of pixels (..., 2)."""
        y = (uv[..., 1] - self.cy) / self.fy
        x = (uv[..., 0] - self.cx) / self.fx - self.alpha * y
        return undistort(np.stack([x, y], axis=-1), self.k)

    def rescaled(self, width: int, height: int) -> CameraIntrinsics:
        """Return the intrinsics at another image size; raises CalibrationError when the aspect ratio differs."""
        sx, sy = width / self.width, height / self.height
        if abs(sx / sy - 1.0) > _ASPECT_TOLERANCE:
            raise CalibrationError(
                f"The calibration is for {self.width}x{self.height} px and cannot serve {width}x{height} px, "
                "which has another aspect ratio; calibrate at the size that is used."
            )
        return CameraIntrinsics(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.alpha,
            self.k,
        )

    @cached_property
    def largest_radius(self) -> float:
        """Undistorted normalised radius up to which the radial distortion is monotonic; inf for most lenses.

        Smallest positive root of d/dr (r + k1 r^3 + k2 r^5 + k5 r^7).
        """
        k1, k2, _, _, k5 = self.k
        roots = np.roots([7 * k5, 5 * k2, 3 * k1, 1.0])
        turning = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return math.sqrt(float(turning.min())) if turning.size else math.inf

    @cached_property
    def normalised_border(self) -> Array:
        """Undistorted normalised coordinates (n, 2) of points around the outer edge of the image."""
        xy = self.normalised_from_pixels(self._border_pixels())
        return xy[np.isfinite(xy).all(axis=-1)]

    def _border_pixels(self) -> Array:
        s = np.linspace(0.0, 1.0, _BORDER_POINTS)
        left, top, right, bottom = -0.5, -0.5, self.width - 0.5, self.height - 0.5
        u, v = left + s * (right - left), top + s * (bottom - top)
        sides = [(u, np.full_like(u, top)), (u, np.full_like(u, bottom))]
        sides += [(np.full_like(v, left), v), (np.full_like(v, right), v)]
        return np.concatenate([np.stack(side, axis=-1) for side in sides])


def distort(xy: Array, k: tuple[float, float, float, float, float]) -> Array:
    """Return the distorted normalised coordinates (..., 2) of `xy` (paper, section II, first equation)."""
    k1, k2, k3, k4, k5 = k
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k5))
    x_d = radial * x + 2.0 * k3 * x * y + k4 * (r2 + 2.0 * x * x)
    y_d = radial * y + k3 * (r2 + 2.0 * y * y) + 2.0 * k4 * x * y
    return np.stack([x_d, y_d], axis=-1)


def undistort(xy_d: Array, k: tuple[float, float, float, float, float]) -> Array:
    """Return the undistorted coordinates (..., 2) of `xy_d` by Newton's method on `distort`.

    NaN outside the range of the model, where its polynomial folds back before it reaches the point.
    """
    if not any(k):
        return np.array(xy_d, dtype=np.float64)
    target = np.asarray(xy_d, dtype=np.float64)
    xy = target.copy()
    step = np.zeros_like(xy)
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(xy, target, k)
        xy = xy - step
        if np.all(np.abs(step) <= _NEWTON_TOLERANCE):
            break
    solved = np.abs(distort(xy, k) - target).max(axis=-1, keepdims=True) < _SOLVED
    return np.where(solved & _invertible(xy, k)[..., None], xy, np.nan)


def _newton_step(xy: Array, target: Array, k: tuple[float, float, float, float, float]) -> Array:
    error = distort(xy, k) - target
    a, b, d = _jacobian(xy, k)
    det = a * d - b * b
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)
    step = np.stack(
        [(d * error[..., 0] - b * error[..., 1]) / det, (a * error[..., 1] - b * error[..., 0]) / det], axis=-1
    )
    return np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)


def _jacobian(xy: Array, k: tuple[float, float, float, float, float]) -> tuple[Array, Array, Array]:
    """Return dx_d/dx, dx_d/dy (= dy_d/dx: the model is a gradient field), dy_d/dy."""
    k1, k2, k3, k4, k5 = k
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k5))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k5))
    xx = radial + slope * x * x + 2.0 * k3 * y + 6.0 * k4 * x
    xy_ = slope * x * y + 2.0 * k3 * x + 2.0 * k4 * y
    yy = radial + slope * y * y + 6.0 * k3 * y + 2.0 * k4 * x
    return xx, xy_, yy


def _invertible(xy: Array, k: tuple[float, float, float, float, float]) -> NDArray[np.bool_]:
    """Return where (...,) the distortion is invertible: its Jacobian is positive definite."""
    xx, xy_, yy = _jacobian(xy, k)
    return np.asarray((xx * yy - xy_ * xy_ > 0) & (xx > 0))
