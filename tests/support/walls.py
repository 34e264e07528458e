"""Depth maps of a flat wall with holes, computed ray by ray: what the gap strategy is tried on without a renderer."""

import numpy as np

from morpheyes_daemon.messages.core import DepthMap, Pinhole
from morpheyes_daemon.transforms import R_FRD_CAM, R_from_rpy, pose

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
BASELINE_M = 0.15


def T_ned_rect(p_ned_m=(0.0, 0.0, -1.5), roll=0.0, pitch=0.0, yaw=0.0):
    """Pose of a camera that looks along the body's forward axis."""
    return pose(R_from_rpy(roll, pitch, yaw) @ R_FRD_CAM, np.array(p_ned_m))


def depth_of_wall(holes, T, distance_m=4.0, turn_rad=0.0, back_m=8.0, noise_px=0.15, seed=0):
    """Return the depth map of a wall `distance_m` north, turned about the vertical, before a back wall.

    `holes`: functions of (y, z) in the wall's plane (m, arrays) that say where it is open.
    """
    v, u = np.mgrid[0 : PINHOLE.height, 0 : PINHOLE.width].astype(float)
    rays = np.stack([(u - PINHOLE.cx_px) / PINHOLE.f_px, (v - PINHOLE.cy_px) / PINHOLE.f_px, np.ones_like(u)], axis=-1)
    R_wall = R_from_rpy(0.0, 0.0, turn_rad)
    directions = rays @ (R_wall.T @ T[:3, :3]).T
    origin = R_wall.T @ (T[:3, 3] - np.array([distance_m, 0.0, 0.0]))
    z = -origin[0] / directions[..., 0]
    y, down = (origin[k] + z * directions[..., k] for k in (1, 2))
    open_ = np.zeros(z.shape, bool)
    for hole in holes:
        open_ |= hole(y, down)
    z = np.where(open_, z + back_m, z)
    disparity = BASELINE_M * PINHOLE.f_px / z + np.random.default_rng(seed).normal(0.0, noise_px, z.shape)
    return depth_map(BASELINE_M * PINHOLE.f_px / disparity), open_


def depth_map(depth_m, near=None):
    """Wrap a depth image (H, W) as a map."""
    none = np.zeros(depth_m.shape, bool)
    return DepthMap(
        seq=1, t_ns=1_000_000_000, depth_m=depth_m.astype(np.float32), near=none if near is None else near,
        half_occluded=none, pinhole=PINHOLE, T_rig_rect=np.eye(4), baseline_m=BASELINE_M, baseline_sigma_m=1e-4,
        sigma_disparity_px=0.25, near_limit_m=0.7, valid_fraction=1.0, ceiling_fraction=0.0, calibration_hash="none",
    )  # fmt: skip


def rectangle(y_m, z_m, width_m, height_m):
    """Return a hole around (y, z)."""
    return lambda y, z: (np.abs(y - y_m) < width_m / 2) & (np.abs(z - z_m) < height_m / 2)
