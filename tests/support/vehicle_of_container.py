"""The vehicle that a daemon in a container is connected to: autopilot, Teensy, cameras, pilot. Runs in its network.

`python -m tests.support.vehicle_of_container ROOT` serves MAVLink and frames on loopback and the Teensy on a pty of
the container whose root is ROOT. One word a line comes in on stdin (take_off, engage, disengage, land); JSON goes out
on stdout, one object a line: what was done, and every override as the autopilot receives it.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import struct
import sys
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from morpheyes_daemon.clock import running_clock
from morpheyes_daemon.config.vehicle import SerialServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.flights.lockstep import TAKE_OFF_HEIGHT_M, make_crew
from morpheyes_daemon.flights.sim_vehicle import Scenario
from morpheyes_daemon.flights.simulator_process import Exposures, TwinVehicle
from morpheyes_daemon.simulation.autopilot.tcp_server import MavlinkServer
from morpheyes_daemon.simulation.camera.frame_server import FrameServer

WIDTH, HEIGHT, RATE_HZ = 320, 240, 5.0
AUTOPILOT_PORT, FRAMES = 5760, "tcp:127.0.0.1:5770"
DIALOUT = 20
"""Debian's group of serial ports."""
UNLOCK, NUMBER = 0x40045431, 0x80045430
"""TIOCSPTLCK and TIOCGPTN, <asm-generic/ioctls.h>; Python's termios has them from 3.13 on."""


def simulated_vehicle() -> VehicleConfig:
    """The configuration that the simulated vehicle is built by."""
    camera = SimCameraConfig(width_px=WIDTH, height_px=HEIGHT, rate_hz=RATE_HZ)
    return VehicleConfig(camera=camera, servo=SerialServoConfig(backend="serial"))


class PtyInside:
    """A serial port of the container, named /dev/morpheyes-teensy there, with the rights that udev would give it."""

    def __init__(self, root: Path, on_bytes: Callable[[bytes], None]) -> None:
        self._on_bytes = on_bytes
        self._master = os.open(root / "dev/pts/ptmx", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        fcntl.ioctl(self._master, UNLOCK, bytes(4))
        (number,) = struct.unpack("I", fcntl.ioctl(self._master, NUMBER, bytes(4)))
        slave = root / f"dev/pts/{number}"
        self._slave = os.open(slave, os.O_RDWR | os.O_NOCTTY)  # keeps the master readable while nobody is there
        tty.setraw(self._slave)
        os.chown(slave, 0, DIALOUT)
        os.chmod(slave, 0o660)
        name = root / "dev/morpheyes-teensy"
        name.unlink(missing_ok=True)
        name.symlink_to(f"pts/{number}")
        asyncio.get_running_loop().add_reader(self._master, self._read)

    def write(self, data: bytes) -> None:
        """Send; what nobody reads is dropped."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass

    def _read(self) -> None:
        self._on_bytes(os.read(self._master, 4096))


def tell(**words: Any) -> None:
    """Say something to the test."""
    print(json.dumps(words), flush=True)


def witness(stage: TwinVehicle) -> None:
    """Tell of every override at the moment the autopilot takes it."""
    rc = stage.autopilot.autopilot.rc
    take = rc.override

    def override(t_ns: int, values: Sequence[int]) -> None:
        take(t_ns, values)
        tell(override=list(values[:4]), t_ns=t_ns)

    rc.override = override  # type: ignore[method-assign, assignment]


async def main(root: Path) -> None:
    """Serve until stdin ends."""
    stage = TwinVehicle(Scenario("forest", 0, wind_m_s=0.0), simulated_vehicle(), running_clock(), 1)
    witness(stage)
    crew = make_crew(stage)
    port = PtyInside(root, stage.teensy.receive)
    stage.teensy.connect(port.write)
    exposures = Exposures(stage)
    await exposures.next()  # compiles what is not compiled yet
    frames = FrameServer(FRAMES, exposures.next, stage.clock, RATE_HZ)
    commands = {"engage": crew.engage, "disengage": crew.disengage}
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    async with MavlinkServer(stage.autopilot, port=AUTOPILOT_PORT), asyncio.TaskGroup() as group:
        background = [stage.autopilot.run(), crew.run(), stage.teensy.run(), frames.run()]
        tasks = [group.create_task(job) for job in background]
        await frames.listening.wait()
        tell(done="ready")
        while word := (await reader.readline()).decode().strip():
            if word == "take_off":
                await crew.take_off(TAKE_OFF_HEIGHT_M)
            elif word == "land":
                await crew.land()
            else:
                commands[word]()
            tell(done=word)
        for task in tasks:
            task.cancel()


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
