"""A calibration of a fixed rig, for tests that need a file and no accuracy: two equal pinholes side by side."""

from pathlib import Path

import numpy as np

from morpheyes_daemon.stereo.calibration_file import write_calibration
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import pose


def fixed_rig(path: Path, width: int, height: int, f_px: float, baseline_m: float) -> Path:
    """Write the file and return its path."""
    eye = CameraIntrinsics(width, height, f_px, f_px, (width - 1) / 2, (height - 1) / 2)
    T_cam0_cam1 = pose(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    write_calibration(RigModel.from_poses(eye, eye, [baseline_m], [T_cam0_cam1]), path)
    return path
