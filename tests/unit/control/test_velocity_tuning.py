"""The lean bounds of the velocity loop from the configuration."""

from __future__ import annotations

import math

import pytest

from morpheyes_daemon.config.vehicle import NoServoConfig, SafetyConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.control.limits import velocity_tuning
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.velocity import BRAKE_LEAN_RAD
from tests.support.copter_parameters import copter_parameters


def config(**safety: float) -> VehicleConfig:
    return VehicleConfig(camera=SimCameraConfig(), servo=NoServoConfig(backend="none"), safety=SafetyConfig(**safety))


def test_a_stop_is_neutral_without_active_braking() -> None:
    model = LoiterModel.from_parameters(copter_parameters())
    assert velocity_tuning(config(), model).stop_lean_rad == 0.0
    assert velocity_tuning(config(active_braking=True), model).stop_lean_rad == pytest.approx(BRAKE_LEAN_RAD)


def test_every_lean_is_within_what_config_and_autopilot_allow() -> None:
    steep = LoiterModel.from_parameters(copter_parameters())
    flat = LoiterModel.from_parameters(copter_parameters(LOIT_ANG_MAX=8))
    for settings, model, most_deg in [
        (config(max_lean_deg=10, active_braking=True), steep, 10.0),
        (config(max_lean_deg=40), flat, 8.0),
        (config(max_lean_deg=40), steep, 20.0),
    ]:
        tuning = velocity_tuning(settings, model)
        assert tuning.max_lean_rad == pytest.approx(math.radians(most_deg))
        assert max(tuning.brake_lean_rad, tuning.stop_lean_rad) <= tuning.max_lean_rad
