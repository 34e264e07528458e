"""A vehicle flown by somebody else's ArduPilot simulator (SITL): its own truth, heard over a link of the simulator's.

SIM_STATE carries no stamp, so a pose counts from its reception; between poses it is interpolated. Positions are local
ned from where the vehicle stood when it was first heard, moved to the world's start. The daemon never hears of this.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import replace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, Clock, S
from morpheyes_daemon.errors import DeviceTimeoutError, InputError
from morpheyes_daemon.simulation.airframe.dynamics import Truth
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.telemetry_port import ByteLink
from morpheyes_daemon.transforms import wrap_rad

RATE_HZ = 100.0
KEPT = 400
AHEAD_NS = S // 2
"""A simulator that is this far behind is extrapolated; beyond it nothing is known."""
LATE_NS, PATIENCE_NS = 50 * MS, 3 * S
"""One that is so late is waited for, so long."""
IDENTITY = (254, 190)
"""System and component id of this listener: no ground station that anybody waits for."""
METRES_PER_DEGREE = 6_378_137.0 * math.pi / 180.0
"""Of the equator, WGS84; ArduPilot's own LOCATION_SCALING_FACTOR is 1e7 times less per 1e-7 degree."""


class SitlVehicle:
    """`on_bytes` takes what arrives on `link`; `listen` asks for the truth and returns once it comes."""

    def __init__(self, link: ByteLink, radio: Radio, clock: Clock) -> None:
        self.radio = radio
        self.drift = 0.0
        self._link, self._clock = link, clock
        self._start = 0.0, 0.0
        self._mav = mavlink.MAVLink(None, *IDENTITY)
        self._mav.robust_parsing = True
        self._origin: tuple[float, float, float] | None = None
        self._rows: deque[Truth] = deque(maxlen=KEPT)

    def on_bytes(self, data: bytes) -> None:
        """Take bytes from the SITL."""
        for message in self._mav.parse_buffer(data) or []:
            if message.get_type() == "SIM_STATE":
                self._take(message)

    def stand_at(self, north_m: float, east_m: float) -> None:
        """Say where in the world the vehicle stood when it was first heard."""
        self._start = north_m, east_m

    async def listen(self, limit_s: float = 30.0) -> None:
        """Ask for SIM_STATE until it streams; raises DeviceTimeoutError when it does not come."""
        end_ns = self._clock.now_ns() + round(limit_s * S)
        while not self._rows:
            if self._clock.now_ns() > end_ns:
                raise DeviceTimeoutError("the SITL does not send SIM_STATE; is it an ArduPilot simulator?")
            self._ask()
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 2)

    async def catch_up(self) -> None:
        """Wait until the truth is as good as the present; DeviceTimeoutError when the SITL says nothing any more."""
        began_ns = self._clock.now_ns()
        while (now_ns := self._clock.now_ns()) - self._rows[-1].t_ns > LATE_NS:
            if now_ns - began_ns > PATIENCE_NS:
                raise DeviceTimeoutError("the SITL has stopped sending SIM_STATE; is it still running?")
            await self._clock.sleep_until_ns(now_ns + MS)

    def truth_at(self, t_ns: int) -> Truth:
        """Return the truth at `t_ns`; InputError for a time that is no longer, or not yet, known."""
        rows = tuple(self._rows)
        index = bisect_right(rows, t_ns, key=lambda row: row.t_ns)
        if index == 0 or t_ns > rows[-1].t_ns + AHEAD_NS:
            raise InputError(f"the SITL's pose at {t_ns} ns is not known.")
        truth = _moved(rows[-1], t_ns) if index == len(rows) else _between(rows[index - 1], rows[index], t_ns)
        north, east, down = truth.p_ned_m
        return replace(truth, p_ned_m=(north + self._start[0], east + self._start[1], down))

    def _ask(self) -> None:
        interval_us = 1e6 / RATE_HZ
        message = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
            mavlink.MAVLINK_MSG_ID_SIM_STATE, interval_us, 0, 0, 0, 0, 0,
        )  # fmt: skip
        self._link.write(message.pack(self._mav))

    def _take(self, message: Any) -> None:
        lat, lon = (message.lat_int / 1e7, message.lon_int / 1e7) if message.lat_int else (message.lat, message.lon)
        if self._origin is None:
            self._origin = lat, lon, message.alt
        lat0, lon0, alt0 = self._origin
        north = (lat - lat0) * METRES_PER_DEGREE
        east = (lon - lon0) * METRES_PER_DEGREE * math.cos(math.radians(lat0))
        attitude = message.roll, message.pitch, wrap_rad(message.yaw)
        velocity = message.vn, message.ve, message.vd
        self._rows.append(Truth(self._clock.now_ns(), (north, east, alt0 - message.alt), velocity, *attitude))


def _moved(last: Truth, t_ns: int) -> Truth:
    dt_s = (t_ns - last.t_ns) / S
    x, y, z = (p + v * dt_s for p, v in zip(last.p_ned_m, last.v_ned_m_s, strict=True))
    return Truth(t_ns, (x, y, z), last.v_ned_m_s, last.roll_rad, last.pitch_rad, last.yaw_rad)


def _between(a: Truth, b: Truth, t_ns: int) -> Truth:
    part = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    x, y, z = (p + (q - p) * part for p, q in zip(a.p_ned_m, b.p_ned_m, strict=True))
    u, v, w = (p + (q - p) * part for p, q in zip(a.v_ned_m_s, b.v_ned_m_s, strict=True))
    roll = a.roll_rad + (b.roll_rad - a.roll_rad) * part
    pitch = a.pitch_rad + (b.pitch_rad - a.pitch_rad) * part
    yaw = wrap_rad(a.yaw_rad + wrap_rad(b.yaw_rad - a.yaw_rad) * part)
    return Truth(t_ns, (x, y, z), (u, v, w), roll, pitch, yaw)
