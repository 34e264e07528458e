"""The calibrated rig, the craft and the strategy as one vehicle configuration gives them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.config.yaml_errors import validate
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.strategies.base import Craft, Strategy
from morpheyes_daemon.strategies.registry import find_strategy
from morpheyes_daemon.transforms import R_FRD_CAM, R_from_rpy, pose


def fitting_rig(calibration: Path, config: VehicleConfig) -> RigModel:
    """Return the rig of a calibration file.

    Raises CalibrationError when it is another camera's, or lacks baselines that the vehicle may be asked for.
    """
    rig = read_calibration(calibration)
    try:
        scaled = rig.rescaled(config.camera.width_px, config.camera.height_px)
        for baseline_m in config.baseline_range_m:
            scaled.T_cam0_cam1(baseline_m)
    except CalibrationError as error:
        raise CalibrationError(f"{calibration}: {error}") from None
    return rig


def build_craft(config: VehicleConfig) -> Craft:
    """Return what strategies may know of the vehicle."""
    mount = config.camera.mount
    tilt = R_from_rpy(0.0, math.radians(mount.tilt_up_deg), 0.0)
    position = np.array([mount.forward_mm, mount.right_mm, mount.down_mm]) / 1e3
    return Craft(
        footprint=config.footprint,
        T_frd_rig=pose(tilt @ R_FRD_CAM, position),
        baseline_range_m=config.baseline_range_m,
        frame_period_s=1.0 / config.camera.rate_hz,
        depth_sigmas=config.safety.depth_sigmas,
        max_relative_depth_error=config.safety.max_relative_depth_error,
    )


def build_strategy(mission: MissionFile, config: VehicleConfig) -> Strategy:
    """Return the mission's strategy with its checked parameters; raises ConfigError."""
    kind = find_strategy(mission.strategy)
    parameters = validate(mission.parameters, kind.Parameters, "parameters", None)
    return kind(parameters, build_craft(config))
