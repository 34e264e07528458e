"""Camera backends: each delivers synchronized raw pairs."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.config.vehicle import CameraConfig
from morpheyes_daemon.devices.family import DeviceContext, Family
from morpheyes_daemon.messages.core import RawPair


class Camera(Protocol):
    """A stereo camera. `read` raises DeviceLostError when it went away, DeviceTimeoutError when it is silent."""

    async def open(self) -> None:
        """Open the device; raises DeviceNotFoundError."""

    async def read(self) -> RawPair:
        """Wait for the next pair and return the newest."""

    async def close(self) -> None:
        """Close; may be called twice, and the camera may be opened again."""


CAMERAS = Family(
    "camera",
    {
        "recording": "morpheyes_daemon.devices.camera.recording:RecordingCamera",
        "sim": "morpheyes_daemon.devices.camera.simulator:SimulatorCamera",
        "v4l2": "morpheyes_daemon.devices.camera.v4l2:V4l2Camera",
    },
)


def build_camera(config: CameraConfig, context: DeviceContext) -> Camera:
    """Return the configured backend, not yet open; ConfigError or InputError when it can never work."""
    camera: Camera = CAMERAS.build(config, context)
    return camera
