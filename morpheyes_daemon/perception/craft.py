"""Builds the calibrated rig, the craft and the strategy of one vehicle configuration."""

from __future__ import annotations

from pathlib import Path

from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.config.yaml_errors import validate
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.strategies.base import Craft, Strategy
from morpheyes_daemon.strategies.registry import find_strategy


def fitting_rig(calibration: Path, config: VehicleConfig) -> RigModel:
    """Return the rig of a calibration file.

    Raises CalibrationError when the file cannot be read, its images have another aspect ratio, or its calibrated
    range does not cover the configured baselines.
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
    """Return the properties of the vehicle that strategies use."""
    return Craft(
        footprint=config.footprint,
        T_frd_rig=T_frd_rig(config.camera.mount),
        baseline_range_m=config.baseline_range_m,
        frame_period_s=1.0 / config.camera.rate_hz,
        depth_sigmas=config.safety.depth_sigmas,
        max_relative_depth_error=config.safety.max_relative_depth_error,
    )


def build_strategy(mission: MissionFile, config: VehicleConfig) -> Strategy:
    """Return the mission's strategy; raises ConfigError when it does not exist or its parameters are invalid."""
    kind = find_strategy(mission.strategy)
    parameters = validate(mission.parameters, kind.Parameters, "parameters", None)
    return kind(parameters, build_craft(config))
