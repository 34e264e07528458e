"""Kalman filter of constant velocity: position and velocity of the object in ned, with covariance.

Measurements come from the stereo rig; their noise along the line of sight is the depth error at the present baseline
(eps_z = z^2 eps_d / (b f) and the baseline's own sigma), across it the error of the autopilot's attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.stereo.depth import depth_sigma
from morpheyes_daemon.transforms import Array

ACCELERATION_SIGMA_M_S2 = 0.8
"""One sigma of the acceleration of an object: people, rolling balls, cubes on strings.

Chosen: smaller lags behind turns, larger follows measurement noise."""

INITIAL_SPEED_SIGMA_M_S = 1.0
"""One sigma of the velocity of a new object.

Chosen: walking speed; smaller takes seconds to reach the velocity."""

DISPARITY_SIGMA_PX = 0.12
"""One sigma of a disparity averaged over an object's patch.

Chosen: as seen on rendered flights; smaller follows noise in depth, larger lags behind it."""

ATTITUDE_SIGMA_RAD = 0.0035
"""One sigma of the autopilot's attitude, which shifts distant objects sideways.

Chosen: a fifth of a degree, typical of an EKF; smaller takes attitude errors for motion."""

CENTRE_SHIFT_SHARE = 0.1
"""Shift of the visible face's centre on a turning object, as a share of its radius. Unit: none.

Chosen: a turned cube's face shifts by this; smaller takes turning for motion."""


@dataclass(frozen=True, slots=True)
class StereoGeometry:
    """Baseline, focal length and their uncertainties, from which the depth error follows."""

    baseline_m: float
    f_px: float
    baseline_sigma_m: float
    yaw_sigma_px: float = 0.0


def measurement_covariance(p_rect: Array, radius_m: float, stereo: StereoGeometry) -> Array:
    """Return the covariance (3, 3), m² in rect, of a measured centre of the visible face at p_rect (3,), metres."""
    z_m = float(p_rect[2])
    sigma_px = math.hypot(DISPARITY_SIGMA_PX, stereo.yaw_sigma_px)
    along = depth_sigma(z_m, stereo.baseline_m, stereo.f_px, sigma_px, stereo.baseline_sigma_m)
    across = math.hypot(ATTITUDE_SIGMA_RAD * z_m, z_m / stereo.f_px)
    shift = CENTRE_SHIFT_SHARE * radius_m
    ray = p_rect / np.linalg.norm(p_rect)
    along_ray = math.hypot(along / ray[2], shift)
    return np.asarray((across**2 + shift**2) * (np.eye(3) - np.outer(ray, ray)) + along_ray**2 * np.outer(ray, ray))


class ObjectFilter:
    """State `x` (6,): position and velocity in ned, m and m/s, with covariance `P` (6, 6)."""

    def __init__(self, p_ned_m: Array, covariance: Array, v_ned_m_s: Array | None = None) -> None:
        v = np.zeros(3) if v_ned_m_s is None else v_ned_m_s
        self.x = np.concatenate([p_ned_m, v])
        self.P = np.zeros((6, 6))
        self.P[:3, :3] = covariance
        self.P[3:, 3:] = np.eye(3) * INITIAL_SPEED_SIGMA_M_S**2

    @property
    def p_ned_m(self) -> Array:
        """Position (3,), ned metres."""
        return self.x[:3]

    @property
    def v_ned_m_s(self) -> Array:
        """Velocity (3,), ned m/s."""
        return self.x[3:]

    def predict(self, dt_s: float) -> None:
        """Predict the state, with an unknown constant acceleration over the step."""
        F = np.eye(6)
        F[:3, 3:] = dt_s * np.eye(3)
        G = np.concatenate([0.5 * dt_s**2 * np.eye(3), dt_s * np.eye(3)])
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + ACCELERATION_SIGMA_M_S2**2 * (G @ G.T)

    def mahalanobis2(self, p_ned_m: Array, covariance: Array) -> float:
        """Return the squared Mahalanobis distance (unitless) of a measurement (3,), ned metres, covariance (3, 3)."""
        innovation = p_ned_m - self.x[:3]
        return float(innovation @ np.linalg.solve(self.P[:3, :3] + covariance, innovation))

    def update(self, p_ned_m: Array, covariance: Array) -> None:
        """Update with a measured position (3,), ned metres, and its covariance (3, 3); Joseph form."""
        K = np.linalg.solve(self.P[:3, :3] + covariance, self.P[:3, :]).T
        self.x = self.x + K @ (p_ned_m - self.x[:3])
        rest = np.eye(6)
        rest[:, :3] -= K
        self.P = rest @ self.P @ rest.T + K @ covariance @ K.T
