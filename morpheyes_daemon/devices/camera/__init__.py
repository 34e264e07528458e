"""Camera backends: each delivers synchronized raw pairs."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.messages import RawPair


class Camera(Protocol):
    """A stereo camera. `read` raises DeviceLostError when it went away, DeviceTimeoutError when it is silent."""

    async def open(self) -> None:
        """Open the device; raises DeviceNotFoundError."""

    async def read(self) -> RawPair:
        """Wait for the next pair and return the newest."""

    async def close(self) -> None:
        """Close; may be called twice."""
