"""Pose of the stereo bar on the body from the configured mount."""

from __future__ import annotations

import math

import numpy as np

from morpheyes_daemon.config.vehicle import Mount
from morpheyes_daemon.transforms import R_FRD_CAM, Array, R_from_rpy, pose


def T_frd_rig(mount: Mount) -> Array:
    """Return the pose (4, 4) of the stereo bar (camera axes, midway between the eyes) on the body."""
    tilt = R_from_rpy(0.0, math.radians(mount.tilt_up_deg), 0.0)
    return pose(tilt @ R_FRD_CAM, np.array([mount.forward_mm, mount.right_mm, mount.down_mm]) / 1e3)
