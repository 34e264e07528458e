"""Motion of the rectified left camera, from the vehicle state that the autopilot reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.messages.core import Pinhole, VehicleState
from morpheyes_daemon.transforms import Array, R_from_rpy, pose


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Pose T_ned_rect (4, 4) of the rectified left camera; velocity (3,) m/s and turn rate (3,) rad/s in rect axes."""

    T_ned_rect: Array
    v_rect_m_s: Array
    w_rect_rad_s: Array

    @classmethod
    def still(cls, T_ned_rect: Array) -> CameraMotion:
        """Return the motion of a stationary camera at the pose T_ned_rect (4, 4)."""
        return cls(T_ned_rect, np.zeros(3), np.zeros(3))


def camera_motion(vehicle: VehicleState, T_frd_rig: Array, T_rig_rect: Array) -> CameraMotion:
    """Return the motion of the rectified left camera; `vehicle` is the state at mid-exposure.

    `T_frd_rig` (4, 4) is the pose of the stereo bar on the body, `T_rig_rect` (4, 4) that of the rectified left
    camera on the bar. Rigid-body kinematics: v_P = v_O + w x p.
    """
    R_ned_frd = R_from_rpy(vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)
    T_frd_rect = T_frd_rig @ T_rig_rect
    w_frd = np.array(vehicle.rates_frd_rad_s)
    v_frd = R_ned_frd.T @ np.array(vehicle.v_ned_m_s) + np.cross(w_frd, T_frd_rect[:3, 3])
    R_rect_frd = T_frd_rect[:3, :3].T
    T_ned_rect = pose(R_ned_frd, np.array(vehicle.p_ned_m)) @ T_frd_rect
    return CameraMotion(T_ned_rect, R_rect_frd @ v_frd, R_rect_frd @ w_frd)


def row_rates(uv: Array, d_px: Array, pinhole: Pinhole, baseline_m: float, motion: CameraMotion) -> tuple[Array, Array]:
    """Return the row rates (n,) px/s of static points in the right camera: by its translation, and by its rotation.

    `uv` (n, 2) are rectified left pixels, `d_px` (n,) their disparities; see `right_camera_rates`.
    """
    translation = CameraMotion(motion.T_ned_rect, motion.v_rect_m_s, np.zeros(3))
    by_translation = right_camera_rates(uv, d_px, pinhole, baseline_m, translation)[:, 1]
    return by_translation, right_camera_rates(uv, d_px, pinhole, baseline_m, motion)[:, 1] - by_translation


def right_camera_rates(uv: Array, d_px: Array, pinhole: Pinhole, baseline_m: float, motion: CameraMotion) -> Array:
    """Return the image velocities (n, 2) px/s of static points in the right rectified image.

    `uv` (n, 2) are rectified left pixels, `d_px` (n,) their disparities, `baseline_m` the true baseline. A point moves
    by dP/dt = -v - w x P in camera axes, v being the velocity of the right camera (w x b is added to that of the left
    one); projected, this is the motion field of Longuet-Higgins and Prazdny (1980). Multiplied by the time offset
    between the exposures it is the offset of the point in the right image.
    """
    x = (uv[:, 0] - d_px - pinhole.cx_px) / pinhole.f_px
    y = (uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    per_m = np.maximum(d_px, 0.0) / (baseline_m * pinhole.f_px)
    wx, wy, wz = motion.w_rect_rad_s
    vx, vy, vz = motion.v_rect_m_s + np.cross(motion.w_rect_rad_s, [baseline_m, 0.0, 0.0])
    columns = (x * vz - vx) * per_m - wy * (1.0 + x * x) + wx * x * y + wz * y
    rows = (y * vz - vy) * per_m + wx * (1.0 + y * y) - wy * x * y - wz * x
    return np.asarray(pinhole.f_px * np.stack([columns, rows], axis=-1))
