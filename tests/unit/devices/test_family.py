"""Device families: built-in backends are loaded when named, other packages' come through entry points."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from types import ModuleType
from typing import Any

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from morpheyes_daemon.config import vehicle
from morpheyes_daemon.config.vehicle import CameraConfig, PluginCameraConfig, ServoConfig
from morpheyes_daemon.devices import family
from morpheyes_daemon.devices.autopilot import AUTOPILOTS
from morpheyes_daemon.devices.camera import CAMERAS, build_camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.servo import SERVOS
from morpheyes_daemon.errors import ConfigError
from tests.support.hand_clock import HandClock


class Webcam:
    """A camera of another package."""

    class Options(BaseModel):
        """Its own configuration."""

        serial: int

    def __init__(self, config: Any) -> None:
        self.config = config

    @classmethod
    def from_config(cls, config: Any, context: DeviceContext) -> Webcam:
        """Build it."""
        return cls(config)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package with the camera `webcam` is installed."""
    module = ModuleType("somebodys_cameras")
    module.Webcam = Webcam  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "somebodys_cameras", module)
    point = EntryPoint("webcam", "somebodys_cameras:Webcam", "morpheyes.cameras")

    def points(group: str) -> list[EntryPoint]:
        return [point] if group == point.group else []

    monkeypatch.setattr(family, "entry_points", points)
    monkeypatch.setattr(vehicle, "entry_points", points)


@pytest.mark.parametrize("devices", [CAMERAS, SERVOS, AUTOPILOTS], ids=lambda devices: devices.name)
def test_every_built_in_backend_can_be_loaded_and_built_from_its_configuration(devices: family.Family) -> None:
    for name in devices.built_in:
        assert callable(devices.load(name).from_config)


def test_the_configuration_lists_the_same_backends_as_the_tables() -> None:
    assert sorted(CAMERAS.built_in) == sorted(PluginCameraConfig.built_in)
    assert sorted(SERVOS.built_in) == sorted(vehicle.PluginServoConfig.built_in)


@pytest.mark.usefixtures("installed")
def test_a_camera_of_another_package_gets_its_checked_options() -> None:
    config: Any = TypeAdapter(CameraConfig).validate_python({"backend": "webcam", "options": {"serial": 7}})
    camera: Any = build_camera(config, DeviceContext.alone(HandClock()))
    assert isinstance(camera, Webcam)
    assert camera.config.options.serial == 7


@pytest.mark.usefixtures("installed")
def test_wrong_options_of_another_package_name_the_key() -> None:
    config: Any = TypeAdapter(CameraConfig).validate_python({"backend": "webcam", "options": {"serial": "x"}})
    with pytest.raises(ConfigError, match=r"camera\.options.*serial"):
        build_camera(config, DeviceContext.alone(HandClock()))


def test_a_backend_that_is_not_installed_is_refused_naming_those_that_are() -> None:
    with pytest.raises(ValidationError, match="no backend 'arm'; installed are: none, serial"):
        TypeAdapter(ServoConfig).validate_python({"backend": "arm"})
    with pytest.raises(ConfigError, match="installed are: mavlink"):
        AUTOPILOTS.load("px4")
