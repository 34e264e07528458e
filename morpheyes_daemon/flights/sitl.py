"""A running ArduPilot SITL in place of the autopilot twin: its ports, its parameters, and the crew around it.

The daemon has the first port; the crew (mavsdk) and the truth take the next two, which SITL offers for that. What
SITL is set up for (GPS or optical flow) is read from it, and the settings that `doctor` asks for are set.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.devices.link import Link, OnBytes, open_link
from morpheyes_daemon.errors import ConfigError, DeviceNotFoundError
from morpheyes_daemon.simulation.autopilot.parameters import RECOMMENDED
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.crew.mavsdk import SITL_RC_PORT, MavsdkCrew, RadioOverUdp
from morpheyes_daemon.simulation.crew.sitl_vehicle import SitlVehicle

FIRST_PORT, CREW_PORT, TRUTH_PORT = 5760, 2, 3
"""SITL's serial0 is tcp 5760 (plus 10 per instance); serial1 and serial2 are two and three above."""
BOOT_LIMIT_NS = 20 * S

FLOW_DRIFT = 0.06
"""Of the way, by optical flow alone; measured 4 m over 80 m with SITL's own sensors."""

RECOMMENDED_HERE = {name: value for name, value in RECOMMENDED.items() if name != "RNGFND1_TYPE"}
RECOMMENDED_HERE[f"RC{Radio.SWITCH_CHANNEL}_OPTION"] = 0.0
"""The rangefinder is SITL's own; the engage switch must do nothing else."""


@contextlib.asynccontextmanager
async def open_sitl(url: str, clock: Clock) -> AsyncIterator[tuple[SitlVehicle, MavsdkCrew]]:
    """Connect truth, radio and crew to the SITL whose first port is `url`, and set its parameters."""
    host, port = _address(url)
    radio = Radio()
    buffer: list[SitlVehicle] = []
    link = await _booted(host, port, lambda data: buffer[0].on_bytes(data), clock)
    vehicle = SitlVehicle(link, radio, clock)
    buffer.append(vehicle)
    waves = RadioOverUdp(radio, clock, host, SITL_RC_PORT + port - FIRST_PORT)
    sending = asyncio.create_task(waves.run())
    try:
        async with MavsdkCrew(radio, f"tcp:{host}:{port + CREW_PORT}", clock) as crew:
            await vehicle.listen()
            await crew.set_parameters(RECOMMENDED_HERE)
            crew.without_gps = await crew.read_parameter("GPS1_TYPE") == 0.0
            vehicle.drift = FLOW_DRIFT if crew.without_gps else 0.0
            yield vehicle, crew
    finally:
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)
        link.close()


async def _booted(host: str, port: int, on_bytes: OnBytes, clock: Clock) -> Link:
    """Open the truth's port. SITL boots, and opens its other ports, only once somebody is on the first one."""
    knock = await open_link(f"tcp:{host}:{port}", lambda data: None, lambda why: None)
    end_ns = clock.now_ns() + BOOT_LIMIT_NS
    try:
        while True:
            try:
                return await open_link(f"tcp:{host}:{port + TRUTH_PORT}", on_bytes, lambda why: None)
            except DeviceNotFoundError:
                if clock.now_ns() > end_ns:
                    raise
                await clock.sleep_until_ns(clock.now_ns() + S // 2)
    finally:
        knock.close()


def _address(url: str) -> tuple[str, int]:
    scheme, _, rest = url.partition(":")
    host, _, port = rest.rpartition(":")
    if scheme != "tcp" or not host or not port.isdigit():
        raise ConfigError(f"--autopilot {url}: write tcp:HOST:PORT, the first port of the SITL, mostly 5760.")
    return host, int(port)
