"""Rigid motions as unit dual quaternions, and screw linear interpolation (ScLERP) between them.

A dual quaternion is a float64 array (8,): real part (w, x, y, z), dual part (w, x, y, z), with
dual = t * real / 2. Interpolation uses the logarithm (Kavan et al., "Geometric skinning with approximate dual
quaternion blending", 2008), with series for small angles; it is stable up to a rotation of pi. The paper (section
III-B) uses it between calibrated baselines.
"""

from __future__ import annotations

import math

import numpy as np

from morpheyes_daemon.transforms import Array, R_from_q, pose

_SERIES_BELOW_RAD = 1e-2
"""Half angle, rad, below which series replace the closed forms; the omitted terms, are below 1e-17."""


def dual_quaternion(q: Array, t_m: Array) -> Array:
    """Return the unit dual quaternion (8,) of rotation q (4,), which is normalised here, and translation t (3,)."""
    real = np.asarray(q, dtype=np.float64) / np.linalg.norm(q)
    return np.concatenate([real, 0.5 * _multiply_q(np.concatenate([[0.0], t_m]), real)])


def pose_from_dual_quaternion(dq: Array) -> Array:
    """Return the pose (4, 4) of a unit dual quaternion (8,)."""
    real, dual = dq[:4], dq[4:]
    return pose(R_from_q(real), 2.0 * _multiply_q(dual, _conjugate_q(real))[1:])


def multiply(a: Array, b: Array) -> Array:
    """Return the product (8,) of two dual quaternions (8,): the motion b followed by a, as with matrices."""
    real = _multiply_q(a[:4], b[:4])
    return np.concatenate([real, _multiply_q(a[:4], b[4:]) + _multiply_q(a[4:], b[:4])])


def inverse(dq: Array) -> Array:
    """Return the inverse (8,) of a unit dual quaternion (8,)."""
    return np.concatenate([_conjugate_q(dq[:4]), _conjugate_q(dq[4:])])


def sclerp(a: Array, b: Array, t: float) -> Array:
    """Return a * (a^-1 * b)^t (8,): constant screw motion from a (t = 0) to b (t = 1), by the smaller rotation.

    At a rotation of pi both are equal; the one with w >= 0 in a^-1 * b is taken.
    """
    delta = multiply(inverse(a), b)
    if delta[0] < 0:
        delta = -delta
    return multiply(a, exponential(t * logarithm(delta)))


def logarithm(dq: Array) -> Array:
    """Return (6,) half the screw of a unit dual quaternion with w >= 0: half rotation vector, half moment."""
    w, v, w_dual, v_dual = dq[0], dq[1:4], dq[4], dq[5:8]
    sine = math.sqrt(float(v @ v))
    half = math.atan2(sine, float(w))
    if half < _SERIES_BELOW_RAD:
        h2 = half * half
        ratio = 1.0 + h2 / 6 + 7 * h2 * h2 / 360 + 31 * h2**3 / 15120
        slope = -1 / 3 - 2 * h2 / 15 - 2 * h2 * h2 / 63 - 4 * h2**3 / 675
    else:
        ratio = half / sine
        slope = (half * float(w) / sine - 1.0) / (sine * sine)
    return np.concatenate([ratio * v, ratio * v_dual + slope * w_dual * v])


def exponential(screw: Array) -> Array:
    """Return the unit dual quaternion (8,) of half a screw (6,); the inverse of `logarithm`."""
    a, b = screw[:3], screw[3:]
    h2 = float(a @ a)
    half = math.sqrt(h2)
    if half < _SERIES_BELOW_RAD:
        sinc = 1.0 - h2 / 6 + h2 * h2 / 120 - h2**3 / 5040
        slope = -1 / 3 + h2 / 30 - h2 * h2 / 840 + h2**3 / 45360
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / h2
    along = float(a @ b)
    return np.concatenate([[math.cos(half)], sinc * a, [-sinc * along], sinc * b + slope * along * a])


def _multiply_q(p: Array, q: Array) -> Array:
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return np.array(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def _conjugate_q(q: Array) -> Array:
    return np.array([q[0], -q[1], -q[2], -q[3]])
