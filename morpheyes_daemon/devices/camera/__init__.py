"""Camera backends: each delivers synchronized raw pairs."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import CameraConfig, RecordingCameraConfig, V4l2CameraConfig
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.core import RawPair


class Camera(Protocol):
    """A stereo camera. `read` raises DeviceLostError when it went away, DeviceTimeoutError when it is silent."""

    async def open(self) -> None:
        """Open the device; raises DeviceNotFoundError."""

    async def read(self) -> RawPair:
        """Wait for the next pair and return the newest."""

    async def close(self) -> None:
        """Close; may be called twice, and the camera may be opened again."""


def build_camera(config: CameraConfig, clock: Clock) -> Camera:
    """Return the configured backend, not yet open; ConfigError or InputError when it can never work."""
    if isinstance(config, RecordingCameraConfig):
        from morpheyes_daemon.devices.camera.recording import RecordingCamera

        return RecordingCamera(config, clock)
    if isinstance(config, V4l2CameraConfig):
        from morpheyes_daemon.devices.camera.v4l2 import V4l2Camera

        return V4l2Camera(config, clock)
    if config.address is None:
        raise ConfigError(
            "camera.backend is sim without an address, which only `morpheyes sim` can fly; "
            "set camera.backend to v4l2 or recording, or camera.address to a simulator's socket."
        )
    from morpheyes_daemon.devices.camera.simulator import SimulatorCamera

    return SimulatorCamera(config.address, config)
