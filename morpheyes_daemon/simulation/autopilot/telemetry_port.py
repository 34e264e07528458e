"""One telemetry port of the autopilot twin: parsing, numbering, stream rates, parameter download of one link."""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import S
from morpheyes_daemon.simulation.autopilot.core import Autopilot
from morpheyes_daemon.simulation.autopilot.telemetry import STREAMS

_AUTOPILOT_COMPONENT = 1
_PARAMETERS_PER_TICK = 5
_TIMESYNC_NS = 10 * S


class ByteLink(Protocol):
    """What the twin needs of a link; `devices.link.Link` is one."""

    def write(self, data: bytes) -> None:
        """Send without blocking."""


class AutopilotPort:
    """State of one link; rates set on it die with it, and with a reboot."""

    def __init__(self, link: ByteLink, autopilot: Autopilot, sysid: int) -> None:
        self._link = link
        self._autopilot = autopilot
        self._mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=_AUTOPILOT_COMPONENT)
        self._mav.robust_parsing = True
        self._intervals_ns: dict[int, int] = {}
        self._due_ns: dict[int, int] = {}
        self._parameters: deque[str] = deque()
        self.forget()

    def forget(self) -> None:
        """Go back to what a port does after boot."""
        t_ns = self._autopilot.t_ns
        self._intervals_ns = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: S}
        self._due_ns = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: t_ns}
        self._timesync_ns = t_ns
        self._parameters.clear()

    def parse(self, data: bytes) -> list[Any]:
        """Return the whole messages in the stream so far; what is damaged is skipped."""
        messages = self._mav.parse_buffer(data) or []
        return [message for message in messages if message.get_type() != "BAD_DATA"]

    def send(self, message: Any) -> None:
        """Number and send a message."""
        self._link.write(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

    def forward(self, frame: bytes) -> None:
        """Pass on somebody else's frame unchanged."""
        self._link.write(frame)

    def set_interval(self, message_id: int, interval_us: float) -> bool:
        """See `StreamTarget`."""
        if message_id not in STREAMS:
            return False
        if interval_us > 0:
            self._intervals_ns[message_id] = round(interval_us * 1000)
            self._due_ns[message_id] = self._autopilot.t_ns
        else:
            self._intervals_ns.pop(message_id, None)
        return True

    def send_once(self, message_id: int) -> bool:
        """See `StreamTarget`."""
        builder = STREAMS.get(message_id)
        message = builder(self._autopilot) if builder is not None else None
        if message is None:
            return False
        self.send(message)
        return True

    def stream(self, t_ns: int) -> None:
        """Send everything that is due by `t_ns`."""
        for message_id, interval_ns in self._intervals_ns.items():
            if t_ns >= self._due_ns[message_id]:
                late_ns = t_ns - self._due_ns[message_id]
                self._due_ns[message_id] += interval_ns * (1 + late_ns // interval_ns)
                self.send_once(message_id)
        if t_ns >= self._timesync_ns:
            self._timesync_ns = t_ns + _TIMESYNC_NS
            self.send(mavlink.MAVLink_timesync_message(0, t_ns - self._autopilot.boot_ns))
        for _ in range(min(_PARAMETERS_PER_TICK, len(self._parameters))):
            self.send_parameter(self._parameters.popleft())

    def list_parameters(self) -> None:
        """Start sending the whole table."""
        self._parameters = deque(self._autopilot.table)

    def send_parameter(self, name: str) -> None:
        """Send one PARAM_VALUE."""
        table = self._autopilot.table
        self.send(
            mavlink.MAVLink_param_value_message(
                name.encode(), table[name], table.type_of(name), len(table), table.index_of(name)
            )
        )
