"""Camera to frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.supervisor.supervisor import Pulse


class BaselineHistory(Protocol):
    """The baseline at any moment of the last seconds."""

    def at(self, t_ns: int) -> BaselineEstimate:
        """Return the modelled baseline at `t_ns`."""


@dataclass(slots=True)
class CaptureTask:
    """Publishes each pair with the baseline at its mid-exposure; a frame counts for `lease_ns`."""

    camera: Camera
    baseline: BaselineHistory
    frames: Latest[StereoFrame]
    gate: Gate
    lease_ns: int

    async def run(self, pulse: Pulse) -> None:
        """Read until cancelled; raises the camera's DeviceError."""
        try:
            await self.camera.open()
            while True:
                pair = await self.camera.read()
                baseline = self.baseline.at(pair.t_ns)
                self.frames.publish(StereoFrame(pair.seq, pair.t_ns, pair.left, pair.right, baseline))
                self.gate.renew(Lease.FRAME, pair.t_ns + self.lease_ns)
                pulse.beat()
        finally:
            await self.camera.close()
