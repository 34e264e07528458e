"""The calibrated rig, the craft and the strategy as one vehicle configuration gives them."""

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
    """Return the calibrated rig at the camera's size.

    Raises CalibrationError when it is another camera's, or lacks baselines that the vehicle may be asked for.
    """
    rig = read_calibration(calibration).rescaled(config.camera.width_px, config.camera.height_px)
    try:
        for baseline_m in config.baseline_range_m:
            rig.T_cam0_cam1(baseline_m)
    except CalibrationError as error:
        raise CalibrationError(f"{calibration}: {error}") from None
    return rig


def build_craft(config: VehicleConfig) -> Craft:
    """Return what strategies may know of the vehicle."""
    return Craft(
        footprint=config.footprint,
        T_frd_rig=T_frd_rig(config.camera.mount),
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
