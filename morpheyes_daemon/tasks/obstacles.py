"""Depth to OBSTACLE_DISTANCE: the autopilot's own second brake."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import Clock, Ticker
from morpheyes_daemon.messages.core import FloatMap
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.supervisor.supervisor import Pulse

RATE_HZ = 12.0
"""ArduPilot forgets a proximity message after 0.5 s; ten a second is the least it recommends."""
MAX_M = 25.0


class ObstacleOutput(Protocol):
    """Where the sectors go."""

    def send_obstacle_distance(self, sectors_m: FloatMap, h_fov_rad: float, max_m: float) -> None:
        """Send the nearest obstacle of 72 sectors."""


async def obstacles(output: ObstacleOutput, topics: Topics, gate: Gate, clock: Clock, pulse: Pulse) -> None:
    """Repeat the newest sectors, and fall silent as soon as the depth is stale."""
    ticker = Ticker(clock, RATE_HZ)
    while True:
        await ticker.wait()
        seen = topics.perception.get()
        if seen is not None and gate.is_fresh(Lease.DEPTH, clock.now_ns()):
            output.send_obstacle_distance(seen.sectors_m, seen.summary.h_fov_rad, MAX_M)
        pulse.beat()
