"""Rotations and poses, named so that neighbours cancel: `T_frd_rect = T_frd_rig @ T_rig_cam0 @ T_cam0_rect`.

Frames are those of docs/conventions.md: ned, frd, rig, cam0, cam1, rect. Quaternions are (w, x, y, z),
Hamilton, w >= 0. Poses are (4, 4) homogeneous float64.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Vectors, matrices and point sets."""

R_FRD_CAM: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation (3, 3) from camera axes (x right, y down, z forward) to body axes (x forward, y right, z down)."""


def R_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return R_ned_frd (3, 3) of the aerospace Z-Y-X Euler angles."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_R(R_ned_frd: Array) -> tuple[float, float, float]:
    """Return (roll, pitch, yaw) in radians of R_ned_frd (3, 3): aerospace Z-Y-X Euler angles."""
    pitch = math.asin(max(-1.0, min(1.0, -float(R_ned_frd[2, 0]))))
    return (
        math.atan2(float(R_ned_frd[2, 1]), float(R_ned_frd[2, 2])),
        pitch,
        math.atan2(float(R_ned_frd[1, 0]), float(R_ned_frd[0, 0])),
    )


def R_from_rotvec(rotvec_rad: Array) -> Array:
    """Return the rotation (3, 3) of a rotation vector (3,) in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(rotvec_rad))
    if angle < 1e-12:
        return np.eye(3) + skew(rotvec_rad)
    k = skew(rotvec_rad / angle)
    return np.asarray(np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k))


def skew(v: Array) -> Array:
    """Return the cross-product matrix (3, 3) of v (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def q_from_R(R: Array) -> Array:
    """Return the unit quaternion (4,), (w, x, y, z) with w >= 0, of a rotation matrix (3, 3) (Shepperd 1978)."""
    trace = float(np.trace(R))
    choices = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    i = int(np.argmax(choices))
    if i == 0:
        q = np.array([1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        a, b, c = i - 1, i % 3, (i + 1) % 3
        q = np.empty(4)
        q[0] = R[c, b] - R[b, c]
        q[1 + a] = 1.0 + R[a, a] - R[b, b] - R[c, c]
        q[1 + b] = R[a, b] + R[b, a]
        q[1 + c] = R[a, c] + R[c, a]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def R_from_q(q: Array) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,), (w, x, y, z)."""
    w, x, y, z = (float(c) for c in q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotvec_from_R(R: Array) -> Array:
    """Return the rotation vector (3,) in radians, of norm at most pi, of a rotation matrix (3, 3)."""
    q = q_from_R(R)
    sine = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, q[0]) / sine))


def pose(R: Array, t: Array) -> Array:
    """Return T (4, 4) with rotation R (3, 3) and translation t (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T_a_b: Array) -> Array:
    """Return T_b_a (4, 4) of a rigid transform T_a_b (4, 4)."""
    R = T_a_b[:3, :3]
    return pose(R.T, -R.T @ T_a_b[:3, 3])


def wrap_rad(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2 * math.pi)
