"""How the rectified left eye moves, from what the autopilot says of the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.messages.core import Pinhole, VehicleState
from morpheyes_daemon.transforms import Array, R_from_rpy, pose


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Pose T_ned_rect (4, 4) of the rectified left eye; velocity (3,) m/s and turn rate (3,) rad/s in its axes."""

    T_ned_rect: Array
    v_rect_m_s: Array
    w_rect_rad_s: Array

    @classmethod
    def still(cls, T_ned_rect: Array) -> CameraMotion:
        """A vehicle that stands on the ground."""
        return cls(T_ned_rect, np.zeros(3), np.zeros(3))


def camera_motion(vehicle: VehicleState, T_frd_rig: Array, T_rig_rect: Array) -> CameraMotion:
    """Return the motion of the rectified left eye; the vehicle's state is taken as of the exposure."""
    R_ned_frd = R_from_rpy(vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)
    T_frd_rect = T_frd_rig @ T_rig_rect
    w_frd = np.array(vehicle.rates_frd_rad_s)
    v_frd = R_ned_frd.T @ np.array(vehicle.v_ned_m_s) + np.cross(w_frd, T_frd_rect[:3, 3])
    R_rect_frd = T_frd_rect[:3, :3].T
    T_ned_rect = pose(R_ned_frd, np.array(vehicle.p_ned_m)) @ T_frd_rect
    return CameraMotion(T_ned_rect, R_rect_frd @ v_frd, R_rect_frd @ w_frd)


def row_rates(uv: Array, d_px: Array, pinhole: Pinhole, baseline_m: float, motion: CameraMotion) -> tuple[Array, Array]:
    """Return how fast (n,) px/s the rows of static points move in the right eye: by its travel, and by its turning."""
    travel = CameraMotion(motion.T_ned_rect, motion.v_rect_m_s, np.zeros(3))
    by_travel = right_eye_rates(uv, d_px, pinhole, baseline_m, travel)[:, 1]
    return by_travel, right_eye_rates(uv, d_px, pinhole, baseline_m, motion)[:, 1] - by_travel


def right_eye_rates(uv: Array, d_px: Array, pinhole: Pinhole, baseline_m: float, motion: CameraMotion) -> Array:
    """Return how fast (n, 2) static points move in the right rectified image, px/s; uv (n, 2) are left pixels.

    dP/dt = -v - w x P for the right eye, which a turning bar carries along: v is taken there. This is what a time
    offset between the eyes multiplies.
    """
    x = (uv[:, 0] - d_px - pinhole.cx_px) / pinhole.f_px
    y = (uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    per_m = np.maximum(d_px, 0.0) / (baseline_m * pinhole.f_px)
    wx, wy, wz = motion.w_rect_rad_s
    vx, vy, vz = motion.v_rect_m_s + np.cross(motion.w_rect_rad_s, [baseline_m, 0.0, 0.0])
    columns = (x * vz - vx) * per_m - wy * (1.0 + x * x) + wx * x * y + wz * y
    rows = (y * vz - vy) * per_m + wx * (1.0 + y * y) - wy * x * y - wz * x
    return np.asarray(pinhole.f_px * np.stack([columns, rows], axis=-1))
