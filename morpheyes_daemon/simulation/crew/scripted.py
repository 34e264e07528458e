"""The people around a simulated flight: a pilot with a radio and a ground station.

`GroundCrew` gets the vehicle into the air in Loiter and hands it over by the engage switch, as a person would: it
hears telemetry over its own link, moves the radio's sticks, and sends a ground station's heartbeat and commands. It
never sends overrides, and runs in lockstep as well as in real time. `mavsdk_crew` does the same through mavsdk. The
daemon's flight service does none of this.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, Clock, S
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.telemetry_port import ByteLink

GROUND_STATION = (255, 190)
"""System and component id of a usual ground station."""

ORIGIN = (-353632620, 1491652370, 584000)
"""Latitude and longitude (1e-7 degrees) and altitude (mm) given to an EKF without GPS; any place will do."""

_CLIMB_US, _EASE_US, _SINK_US, _IDLE_US, _MIDDLE_US = 1750, 1640, 1360, 1000, 1500
_EASE_BELOW_M = 0.7
_PERIOD_NS = 50 * MS
_STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5,
}


class GroundCrew:
    """A pilot's hands on `radio` and a ground station on `link`; hand received bytes to `on_bytes`."""

    def __init__(
        self, radio: Radio, link: ByteLink, clock: Clock, *, without_gps: bool = False, vehicle_sysid: int = 1
    ) -> None:
        self._radio, self._link, self._clock = radio, link, clock
        self._without_gps = without_gps
        self._target = vehicle_sysid, 1
        self._mav = mavlink.MAVLink(None, *GROUND_STATION)
        self._mav.robust_parsing = True
        self.latest: dict[str, Any] = {}
        self.texts: list[str] = []

    def on_bytes(self, data: bytes) -> None:
        """Take bytes from the autopilot."""
        for message in self._mav.parse_buffer(data) or []:
            if (message.get_srcSystem(), message.get_srcComponent()) != self._target:
                continue
            self.latest[message.get_type()] = message
            if message.get_type() == "STATUSTEXT":
                self.texts.append(message.text)

    async def run(self) -> None:
        """Send the ground station's heartbeat until cancelled."""
        while True:
            station = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
            self._send(mavlink.MAVLink_heartbeat_message(*station, 0, 0, mavlink.MAV_STATE_ACTIVE, 3))
            await self._clock.sleep_until_ns(self._clock.now_ns() + S)

    async def take_off(self, height_m: float) -> None:
        """Arm in Loiter with the throttle low, climb to `height_m`, centre the sticks.

        Raises DeviceTimeoutError when the autopilot does not get ready, arm or climb, with its last words.
        """
        self._ask_for_streams()
        self._radio.sticks(throttle_us=_IDLE_US)
        await self._until(self._ready, 60.0, "get ready to arm", self._prepare)
        await self._until(self._armed, 10.0, "arm", self._request_arming)
        self._radio.sticks(throttle_us=_CLIMB_US)
        await self._until(lambda: self._height_m() > height_m - _EASE_BELOW_M, 60.0, "climb")
        self._radio.sticks(throttle_us=_EASE_US)
        await self._until(lambda: self._height_m() > height_m - 0.08, 30.0, "reach its height")
        self._radio.sticks(throttle_us=_MIDDLE_US)
        await self._until(self._still, 10.0, "come to rest")

    def engage(self) -> None:
        """Flip the switch that hands the sticks over."""
        self._radio.switch(on=True)

    def disengage(self) -> None:
        """Flip the switch back, sticks centred."""
        self._radio.sticks(throttle_us=_MIDDLE_US)
        self._radio.switch(on=False)

    async def land(self) -> None:
        """Take the sticks back and land; returns when the motors are off."""
        self.disengage()
        self._command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, Mode.LAND)
        await self._until(lambda: not self._armed(), 120.0, "land")

    def _ask_for_streams(self) -> None:
        for message_id, rate_hz in _STREAMS_HZ.items():
            self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, round(1e6 / rate_hz))

    def _prepare(self) -> None:
        """Ask for Loiter, and without GPS give the EKF its origin once it is aiding."""
        report = self.latest.get("EKF_STATUS_REPORT")
        if self._without_gps and report is not None and report.flags & mavlink.EKF_POS_HORIZ_REL:
            self._send(mavlink.MAVLink_set_gps_global_origin_message(self._target[0], *ORIGIN))
        if not self._in_loiter():
            self._command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, Mode.LOITER)

    def _request_arming(self) -> None:
        self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def _in_loiter(self) -> bool:
        heartbeat = self.latest.get("HEARTBEAT")
        return bool(heartbeat is not None and heartbeat.custom_mode == Mode.LOITER)

    def _ready(self) -> bool:
        status = self.latest.get("SYS_STATUS")
        if status is None or not self._in_loiter() or "LOCAL_POSITION_NED" not in self.latest:
            return False
        return bool(status.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK)

    def _armed(self) -> bool:
        heartbeat = self.latest.get("HEARTBEAT")
        return heartbeat is not None and bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def _height_m(self) -> float:
        return -float(self.latest["LOCAL_POSITION_NED"].z)

    def _still(self) -> bool:
        position = self.latest["LOCAL_POSITION_NED"]
        return bool(abs(position.vx) < 0.2 and abs(position.vy) < 0.2 and abs(position.vz) < 0.15)

    async def _until(
        self, done: Callable[[], bool], limit_s: float, what: str, ask: Callable[[], None] | None = None
    ) -> None:
        """Wait for `done`, repeating `ask` once a second."""
        end_ns = self._clock.now_ns() + round(limit_s * S)
        ask_ns = self._clock.now_ns()
        while not done():
            now_ns = self._clock.now_ns()
            if now_ns > end_ns:
                words = self.texts[-1] if self.texts else "it said nothing"
                raise DeviceTimeoutError(f"the vehicle did not {what} within {limit_s:.0f} s (autopilot: {words}).")
            if ask is not None and now_ns >= ask_ns:
                ask()
                ask_ns = now_ns + S
            await self._clock.sleep_until_ns(now_ns + _PERIOD_NS)

    def _command(self, command: int, *params: float) -> None:
        values = [float(value) for value in params] + [0.0] * (7 - len(params))
        self._send(mavlink.MAVLink_command_long_message(*self._target, command, 0, *values))

    def _send(self, message: Any) -> None:
        self._link.write(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
