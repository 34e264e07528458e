"""Position and velocity of the object in ned, with covariance: a Kalman filter of constant velocity.

Measurements come from the stereo rig; their noise is what stereo leaves open at the present baseline along the line
of sight (eps_z = z^2 eps_d / (b f) and the baseline's own sigma), the autopilot's attitude across it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.stereo.depth import depth_sigma
from morpheyes_daemon.transforms import Array

ACCELERATION_M_S2 = 0.8
"""One sigma of how an object's velocity may change; people, balls rolling, cubes on strings."""

FIRST_SPEED_M_S = 1.0
"""One sigma of the velocity of an object just found."""

REGISTERED_PX = 0.12
"""One sigma of a disparity averaged over an object's patch (measured on rendered flights)."""

ATTITUDE_RAD = 0.0035
"""One sigma of the autopilot's attitude: it moves what is far sideways."""

SHAPE_SHARE = 0.1
"""The middle of the visible face wanders over a turning object by this share of its radius."""


@dataclass(frozen=True, slots=True)
class Eyes:
    """What the depth's uncertainty depends on."""

    baseline_m: float
    f_px: float
    baseline_sigma_m: float
    yaw_sigma_px: float = 0.0


def measurement_covariance(p_rect: Array, radius_m: float, eyes: Eyes) -> Array:
    """Return (3, 3) in rect axes, of a measured middle of the visible face at p_rect (3,)."""
    z_m = float(p_rect[2])
    sigma_px = math.hypot(REGISTERED_PX, eyes.yaw_sigma_px)
    along = depth_sigma(z_m, eyes.baseline_m, eyes.f_px, sigma_px, eyes.baseline_sigma_m)
    across = math.hypot(ATTITUDE_RAD * z_m, z_m / eyes.f_px)
    wander = SHAPE_SHARE * radius_m
    ray = p_rect / np.linalg.norm(p_rect)
    along_ray = math.hypot(along / ray[2], wander)
    return np.asarray((across**2 + wander**2) * (np.eye(3) - np.outer(ray, ray)) + along_ray**2 * np.outer(ray, ray))


class ObjectFilter:
    """State (position, velocity) in ned metres and metres per second."""

    def __init__(self, p_ned_m: Array, covariance: Array, v_ned_m_s: Array | None = None) -> None:
        v = np.zeros(3) if v_ned_m_s is None else v_ned_m_s
        self.x = np.concatenate([p_ned_m, v])
        self.P = np.zeros((6, 6))
        self.P[:3, :3] = covariance
        self.P[3:, 3:] = np.eye(3) * FIRST_SPEED_M_S**2

    @property
    def p_ned_m(self) -> Array:
        """Position (3,)."""
        return self.x[:3]

    @property
    def v_ned_m_s(self) -> Array:
        """Velocity (3,)."""
        return self.x[3:]

    def predict(self, dt_s: float) -> None:
        """Carry the state on, with an unknown constant acceleration over the step."""
        F = np.eye(6)
        F[:3, 3:] = dt_s * np.eye(3)
        G = np.concatenate([0.5 * dt_s**2 * np.eye(3), dt_s * np.eye(3)])
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + ACCELERATION_M_S2**2 * (G @ G.T)

    def surprise(self, p_ned_m: Array, covariance: Array) -> float:
        """Return the squared Mahalanobis length of a measurement's innovation."""
        innovation = p_ned_m - self.x[:3]
        return float(innovation @ np.linalg.solve(self.P[:3, :3] + covariance, innovation))

    def update(self, p_ned_m: Array, covariance: Array) -> None:
        """Take in a measured position (3,) with its covariance (3, 3); Joseph's form."""
        K = np.linalg.solve(self.P[:3, :3] + covariance, self.P[:3, :]).T
        self.x = self.x + K @ (p_ned_m - self.x[:3])
        kept = np.eye(6)
        kept[:, :3] -= K
        self.P = kept @ self.P @ kept.T + K @ covariance @ K.T
