"""MAV_CMD_* as the autopilot twin obeys them, from COMMAND_LONG and COMMAND_INT alike.

Each handler returns a MAV_RESULT. Streams and messages belong to the link that the command came by, so the handlers
for them take that link; everything else acts on the autopilot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.aux_switches import AuxFunction, Position
from morpheyes_daemon.simulation.autopilot.core import Autopilot
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode

ACCEPTED = int(mavlink.MAV_RESULT_ACCEPTED)
DENIED = int(mavlink.MAV_RESULT_DENIED)
UNSUPPORTED = int(mavlink.MAV_RESULT_UNSUPPORTED)
FAILED = int(mavlink.MAV_RESULT_FAILED)

_FORCE = 21196


class StreamTarget(Protocol):
    """The link that a command came by."""

    def set_interval(self, message_id: int, interval_us: float) -> bool:
        """Stream a message every `interval_us` (negative or 0: not at all); False when it is not known."""

    def send_once(self, message_id: int) -> bool:
        """Send a message now; False when it is not known or not available."""


class Commands:
    """Command number to action on one autopilot; `reboot` restarts the whole twin."""

    def __init__(self, autopilot: Autopilot, reboot: Callable[[], None]) -> None:
        self._autopilot = autopilot
        self._reboot = reboot
        self._actions: dict[int, Callable[[Sequence[float]], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_DO_SET_MODE: lambda p: self.set_mode(p[1]),
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_NAV_LAND: lambda _: self.set_mode(Mode.LAND),
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self.set_mode(Mode.RTL),
            mavlink.MAV_CMD_NAV_LOITER_UNLIM: lambda _: self.set_mode(Mode.LOITER),
            mavlink.MAV_CMD_DO_AUX_FUNCTION: self._aux_function,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._preflight_reboot,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: lambda _: ACCEPTED if not autopilot.armed else FAILED,
        }

    def execute(self, command: int, params: Sequence[float], source: StreamTarget) -> int:
        """Carry out `command` with its seven parameters; returns a MAV_RESULT."""
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return ACCEPTED if source.set_interval(int(params[0]), params[1]) else FAILED
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return ACCEPTED if source.send_once(int(params[0])) else FAILED
        if command == mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            return ACCEPTED if source.send_once(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) else FAILED
        action = self._actions.get(command)
        return UNSUPPORTED if action is None else action(params)

    def set_mode(self, number: float) -> int:
        """Change the flight mode by its number."""
        try:
            mode = Mode(int(number))
        except ValueError:
            return FAILED
        return ACCEPTED if self._autopilot.set_mode(mode) else FAILED

    def _arm_disarm(self, params: Sequence[float]) -> int:
        if params[0] == 1.0:
            return ACCEPTED if self._autopilot.arm() is None else FAILED
        if params[0] == 0.0:
            return ACCEPTED if self._autopilot.disarm(force=params[1] == _FORCE) else FAILED
        return UNSUPPORTED

    def _take_off(self, params: Sequence[float]) -> int:
        return ACCEPTED if self._autopilot.take_off(params[6]) else FAILED

    def _aux_function(self, params: Sequence[float]) -> int:
        try:
            function, position = AuxFunction(int(params[0])), Position(int(params[1]))
        except ValueError:
            return FAILED
        self._autopilot.switch(function, position)
        return ACCEPTED

    def _preflight_reboot(self, params: Sequence[float]) -> int:
        if params[0] != 1.0 or (self._autopilot.armed and params[5] != _FORCE):
            return FAILED
        self._reboot()
        return ACCEPTED
