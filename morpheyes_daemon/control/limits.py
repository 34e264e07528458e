"""Bounds of governor and velocity loop from the vehicle configuration."""

from __future__ import annotations

import math

from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.control.governor import GovernorLimits
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.velocity import BRAKE_LEAN_RAD, VelocityTuning


def velocity_tuning(config: VehicleConfig, model: LoiterModel) -> VelocityTuning:
    """Return the velocity loop's lean bounds; without `active_braking` a stop is neutral sticks."""
    lean_rad = min(math.radians(config.safety.max_lean_deg), model.lean_max_rad)
    brake_rad = min(BRAKE_LEAN_RAD, lean_rad)
    stop_rad = brake_rad if config.safety.active_braking else 0.0
    return VelocityTuning(max_lean_rad=lean_rad, brake_lean_rad=brake_rad, stop_lean_rad=stop_rad)


def governor_limits(config: VehicleConfig) -> GovernorLimits:
    """Return the governor's bounds in SI units."""
    return GovernorLimits(
        dead_daemon_s=config.safety.dead_daemon_s,
        depth_sigmas=config.safety.depth_sigmas,
        max_relative_depth_error=config.safety.max_relative_depth_error,
        max_speed_m_s=config.safety.max_speed_m_s,
        sync_error_s=config.camera.sync_error_ms / 1e3,
        image_width_px=config.camera.width_px,
    )
