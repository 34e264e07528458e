"""A ground crew that works through mavsdk, for real time against the twin or a real ArduPilot SITL.

mavsdk opens a port of its own (SITL offers 5760, 5762, 5763; the daemon has the first) and does what a ground station
does; the pilot's sticks move through the `Radio`, which reaches a SITL as UDP packets by `RadioOverUdp`. Take-off is
GUIDED, then LOITER: mavsdk cannot tell Loiter from Brake, so modes are set by command and read from HEARTBEAT.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import struct
from collections.abc import Callable, Mapping
from functools import partial
from types import TracebackType
from typing import Any

from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.component_type import ComponentType
from mavsdk.logging import log_subscribe
from mavsdk.plugins.action import ActionError
from mavsdk.plugins.mavlink_direct import MavlinkMessage

from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.errors import ConfigError, DeviceNotFoundError, DeviceTimeoutError
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.rc_input import FRAME_NS, Radio
from morpheyes_daemon.simulation.crew.scripted import ORIGIN

logger = logging.getLogger(__name__)

SITL_RC_PORT = 5501
"""ArduPilot SITL takes 8 or 16 little-endian uint16 pulse widths here (plus 10 per instance)."""

_ARMED, _CUSTOM_MODE, _REAL32 = 128, 1, 9
_PREARM_CHECK, _POS_HORIZ_REL, _CONSTANT_POSITION = 0x10000000, 0x08, 0x80
_SET_MODE, _SET_INTERVAL = 176, 511
_HEARD = ("HEARTBEAT", "SYS_STATUS", "LOCAL_POSITION_NED", "EKF_STATUS_REPORT", "STATUSTEXT", "PARAM_VALUE")
_STREAMS_US = {1: 200_000, 32: 50_000, 193: 200_000}
"""SYS_STATUS, LOCAL_POSITION_NED, EKF_STATUS_REPORT."""


class RadioOverUdp:
    """Sends the radio's channels to a SITL's receiver port, 50 frames a second."""

    def __init__(self, radio: Radio, clock: Clock, host: str = "127.0.0.1", port: int = SITL_RC_PORT) -> None:
        self._radio, self._clock = radio, clock
        self._address = host, port

    async def run(self) -> None:
        """Send until cancelled; a radio that is not heard sends nothing."""
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(asyncio.DatagramProtocol, remote_addr=self._address)
        try:
            while True:
                if self._radio.present and self._radio.heard:
                    channels = self._radio.channels_us
                    transport.sendto(struct.pack(f"<{len(channels)}H", *channels))
                await self._clock.sleep_until_ns(self._clock.now_ns() + FRAME_NS)
        finally:
            transport.close()


class MavsdkCrew:
    """`async with MavsdkCrew(radio, "tcp:127.0.0.1:5762", clock) as crew: await crew.take_off(1.5)`."""

    def __init__(self, radio: Radio, url: str, clock: Clock, *, without_gps: bool = False) -> None:
        if not url.startswith("tcp:"):
            raise ConfigError(f"{url}: the ground crew connects by tcp:HOST:PORT.")
        self._radio, self._clock, self._url = radio, clock, url
        self.without_gps = without_gps
        self._native: Mavsdk | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self.latest: dict[str, dict[str, Any]] = {}
        self.parameters: dict[str, float] = {}

    async def __aenter__(self) -> MavsdkCrew:
        """Connect; raises DeviceNotFoundError when there is no autopilot."""
        log_subscribe(_log)
        self._native = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
        await self._native.add_any_connection(self._url.replace("tcp:", "tcpout://"))
        system = await self._native.first_autopilot(20.0)
        if system is None:
            await self._close()
            raise DeviceNotFoundError(f"no autopilot answers at {self._url}; is the simulator running?")
        self._action, self._direct = ActionAsync(system), MavlinkDirectAsync(system)
        for name in _HEARD:
            self._tasks.append(asyncio.create_task(self._listen(name)))
        for message_id, interval_us in _STREAMS_US.items():
            await self._command(_SET_INTERVAL, message_id, interval_us)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End mavsdk and its threads."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._close()

    async def _close(self) -> None:
        """Stop mavsdk off the loop: it waits for its threads."""
        if self._native is not None:
            await asyncio.get_running_loop().run_in_executor(None, self._native.destroy)
            self._native = None

    async def _listen(self, name: str) -> None:
        stream = self._direct.subscribe_message(name)
        try:
            async for message in stream:
                if message.system_id == 1 and message.component_id == 1:
                    fields = json.loads(message.fields_json)
                    self.latest[name] = fields
                    if name == "PARAM_VALUE":
                        self.parameters[fields["param_id"]] = float(fields["param_value"])
        finally:
            await stream.aclose()

    async def set_parameters(self, values: Mapping[str, float]) -> None:
        """Set parameters by name and wait until the autopilot confirms each; raises DeviceTimeoutError."""
        for name, value in values.items():
            fields = {"target_system": 1, "target_component": 1, "param_id": name, "param_value": value}
            message = {**fields, "param_type": _REAL32}
            confirmed = partial(self._has_parameter, name, value)
            await self._until(confirmed, 10.0, f"take {name}", partial(self._send, "PARAM_SET", message))

    async def read_parameter(self, name: str) -> float:
        """Return a parameter; raises DeviceTimeoutError when the autopilot does not know it."""
        fields = {"target_system": 1, "target_component": 1, "param_id": name, "param_index": -1}
        self.parameters.pop(name, None)
        ask = partial(self._send, "PARAM_REQUEST_READ", fields)
        await self._until(lambda: name in self.parameters, 10.0, f"tell {name}", ask)
        return self.parameters[name]

    def _has_parameter(self, name: str, value: float) -> bool:
        kept = self.parameters.get(name)
        return kept is not None and math.isclose(kept, value, rel_tol=1e-5, abs_tol=1e-6)

    async def take_off(self, height_m: float) -> None:
        """Arm, climb to `height_m` in GUIDED, hand the vehicle to the pilot in Loiter, sticks centred.

        Raises DeviceTimeoutError when the autopilot does not get ready, arm or climb, with its last words.
        """
        self._radio.sticks(throttle_us=1000)
        await self._until(self._ready, 90.0, "get ready to arm", self._prepare)
        await self._action.set_takeoff_altitude(height_m)
        await self._until(self._armed, 30.0, "arm", self._arm)
        self._radio.sticks()
        await self._action.takeoff()
        await self._until(lambda: self._height_m() > height_m - 0.15, 30.0, "reach its height")
        await self._until(lambda: self._in(Mode.LOITER), 10.0, "change to Loiter", self._ask_for(Mode.LOITER))
        await self._until(self._still, 10.0, "come to rest")

    def engage(self) -> None:
        """Flip the switch that hands the sticks over."""
        self._radio.switch(on=True)

    def disengage(self) -> None:
        """Flip the switch back, sticks centred."""
        self._radio.sticks()
        self._radio.switch(on=False)

    async def land(self) -> None:
        """Take the sticks back and land; returns when the motors are off."""
        self.disengage()
        await self._action.land()
        await self._until(lambda: not self._armed(), 120.0, "land")

    async def _prepare(self) -> None:
        flags = self.latest.get("EKF_STATUS_REPORT", {}).get("flags", 0)
        if self.without_gps and flags & _POS_HORIZ_REL and not flags & _CONSTANT_POSITION:
            keys = ("latitude", "longitude", "altitude")
            fields = {"target_system": 1, **dict(zip(keys, ORIGIN, strict=True))}
            await self._send("SET_GPS_GLOBAL_ORIGIN", fields)
        if not self._in(Mode.GUIDED):
            await self._command(_SET_MODE, _CUSTOM_MODE, Mode.GUIDED)

    async def _arm(self) -> None:
        try:
            await self._action.arm()
        except ActionError:
            return  # refused for now: the caller asks again, and reports the autopilot's words in the end

    def _ask_for(self, mode: Mode) -> Callable[[], Any]:
        return lambda: self._command(_SET_MODE, _CUSTOM_MODE, mode)

    def _ready(self) -> bool:
        health = int(self.latest.get("SYS_STATUS", {}).get("onboard_control_sensors_health", 0))
        return self._in(Mode.GUIDED) and "LOCAL_POSITION_NED" in self.latest and bool(health & _PREARM_CHECK)

    def _in(self, mode: Mode) -> bool:
        return bool(self.latest.get("HEARTBEAT", {}).get("custom_mode", -1) == mode)

    def _armed(self) -> bool:
        return bool(int(self.latest.get("HEARTBEAT", {}).get("base_mode", 0)) & _ARMED)

    def _height_m(self) -> float:
        return -float(self.latest["LOCAL_POSITION_NED"]["z"])

    def _still(self) -> bool:
        position = self.latest["LOCAL_POSITION_NED"]
        return all(abs(float(position[axis])) < 0.2 for axis in ("vx", "vy", "vz"))

    async def _until(
        self, done: Callable[[], bool], limit_s: float, what: str, ask: Callable[[], Any] | None = None
    ) -> None:
        """Wait for `done`, repeating `ask` once a second."""
        end_ns = self._clock.now_ns() + round(limit_s * S)
        ask_ns = self._clock.now_ns()
        while not done():
            now_ns = self._clock.now_ns()
            if now_ns > end_ns:
                words = self.latest.get("STATUSTEXT", {}).get("text", "it said nothing")
                raise DeviceTimeoutError(f"the vehicle did not {what} within {limit_s:.0f} s (autopilot: {words}).")
            if ask is not None and now_ns >= ask_ns:
                await ask()
                ask_ns = now_ns + S
            await self._clock.sleep_until_ns(now_ns + S // 20)

    async def _command(self, command: int, *params: float) -> None:
        values = {f"param{n}": float(value) for n, value in enumerate([*params, *[0.0] * (7 - len(params))], 1)}
        fields = {"target_system": 1, "target_component": 1, "command": command, "confirmation": 0, **values}
        await self._send("COMMAND_LONG", fields)

    async def _send(self, name: str, fields: dict[str, Any]) -> None:
        await self._direct.send_message(MavlinkMessage(name, 0, 0, 1, 1, json.dumps(fields)))


def _log(level: int, message: str, file: str | None, line: int) -> bool:
    """Take mavsdk's log off standard output, which may be somebody's JSON."""
    logger.debug("mavsdk (%d): %s", level, message)
    return True
