"""The autopilot's own proximity avoidance, switched off while a mission flies that must pass closer than it allows.

Only for missions that say `avoidance: false`; the others leave it as the pilot has it. Whatever ends the flight, it
is switched on again.
"""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.clock import Clock, Ticker
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.safety.states import HOLDING
from morpheyes_daemon.supervisor.supervisor import Pulse

RATE_HZ = 20.0
AVOID_PROXIMITY = 40
"""RCx_OPTION 40 of ArduCopter."""
OFF, ON = 0, 2
"""Positions of the switch: low and high."""


class AuxOutput(Protocol):
    """Where the switch is."""

    @property
    def up(self) -> bool:
        """True while the autopilot is heard."""

    async def set_aux_function(self, function: int, position: int) -> None:
        """Switch a function of the autopilot; raises DeviceError."""


async def avoidance(output: AuxOutput, monitor: SafetyMonitor, clock: Clock, pulse: Pulse) -> None:
    """Keep the avoidance off while we hold the sticks, and on otherwise; raises the output's DeviceError.

    What it was before nobody knows, so it is said once at the start, too: after a death in flight it may be off.
    """
    ticker = Ticker(clock, RATE_HZ)
    said: int | None = None
    while True:
        wanted = OFF if monitor.state in HOLDING else ON
        if output.up and wanted != said:
            await output.set_aux_function(AVOID_PROXIMITY, wanted)
            said = wanted
        pulse.beat()
        await ticker.wait()
