"""The camera model of `stereo.intrinsics` with its derivatives, vectorized over points.

A camera is the vector (fx, fy, cx, cy, alpha, k1, k2, k3, k4, k5), the paper's K and distortion (section II).
"""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.transforms import Array

CAMERA_PARAMETERS = ("fx_px", "fy_px", "cx_px", "cy_px", "alpha", "k1", "k2", "k3", "k4", "k5")
"""Names of the components of a camera vector (10,)."""


def camera_vector(camera: CameraIntrinsics) -> Array:
    """Return the parameters (10,) of a camera."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.alpha, *camera.k])


def camera_from_vector(parameters: Array, size: tuple[int, int]) -> CameraIntrinsics:
    """Return the camera of parameters (10,) and its image size (w, h)."""
    fx, fy, cx, cy, alpha, k1, k2, k3, k4, k5 = (float(value) for value in parameters)
    return CameraIntrinsics(*size, fx, fy, cx, cy, alpha, (k1, k2, k3, k4, k5))


def project(p_cam: Array, camera: Array) -> tuple[Array, Array, Array]:
    """Return the pixels (..., 2) of points (..., 3) in camera axes, and their derivatives by camera (..., 2, 10) and by
    point (..., 2, 3).

    `camera` (10,) as in `camera_vector` (paper, section II).
    """
    fx, fy, cx, cy, alpha, k1, k2, k3, k4, k5 = camera
    inv_z = 1.0 / p_cam[..., 2]
    x, y = p_cam[..., 0] * inv_z, p_cam[..., 1] * inv_z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k5))
    two_xy, x_tail, y_tail = 2.0 * x * y, r2 + 2.0 * x * x, r2 + 2.0 * y * y
    x_d = radial * x + k3 * two_xy + k4 * x_tail
    y_d = radial * y + k3 * y_tail + k4 * two_xy
    uv = np.stack([fx * (x_d + alpha * y_d) + cx, fy * y_d + cy], axis=-1)

    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k5))
    xx = radial + slope * x * x + 2.0 * k3 * y + 6.0 * k4 * x
    xy = slope * x * y + 2.0 * k3 * x + 2.0 * k4 * y
    yy = radial + slope * y * y + 6.0 * k3 * y + 2.0 * k4 * x
    du = (fx * (xx + alpha * xy), fx * (xy + alpha * yy))
    dv = (fy * xy, fy * yy)
    d_point = np.empty((*uv.shape, 3))
    for row, (d_x, d_y) in enumerate((du, dv)):
        d_point[..., row, 0] = d_x * inv_z
        d_point[..., row, 1] = d_y * inv_z
        d_point[..., row, 2] = -(d_x * x + d_y * y) * inv_z

    d_camera = np.zeros((*uv.shape, 10))
    d_camera[..., 0, 0] = x_d + alpha * y_d
    d_camera[..., 1, 1] = y_d
    d_camera[..., 0, 2] = 1.0
    d_camera[..., 1, 3] = 1.0
    d_camera[..., 0, 4] = fx * y_d
    terms = ((r2 * x, r2 * y), (r2 * r2 * x, r2 * r2 * y), (two_xy, y_tail), (x_tail, two_xy), (r2**3 * x, r2**3 * y))
    for column, (along, down) in enumerate(terms, start=5):
        d_camera[..., 0, column] = fx * (along + alpha * down)
        d_camera[..., 1, column] = fy * down
    return uv, d_camera, d_point
