"""Camera to frames."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.supervisor.supervisor import Pulse


class BaselineHistory(Protocol):
    """Where the eyes were."""

    def at(self, t_ns: int) -> BaselineEstimate:
        """Return the modelled baseline at `t_ns`."""


async def capture(
    camera: Camera, baseline: BaselineHistory, frames: Latest[StereoFrame], gate: Gate, lease_ns: int, pulse: Pulse
) -> None:
    """Publish each pair with the baseline of its own moment; raises the camera's DeviceError."""
    try:
        await camera.open()
        while True:
            pair = await camera.read()
            frames.publish(StereoFrame(pair.seq, pair.t_ns, pair.left, pair.right, baseline.at(pair.t_ns)))
            gate.renew(Lease.FRAME, pair.t_ns + lease_ns)
            pulse.beat()
    finally:
        await camera.close()
