"""The simulator of a real-time flight, in a process of its own: vehicle, Teensy, cameras, crew and judge.

It offers what a vehicle would: a MAVLink port, a serial port, a camera. Over a pipe it says where they are, how the
flight goes and how it ended; back come the daemon's states, for judge and crew, and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.clock import MS, Clock, S, running_clock
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.errors import MorphEyesError
from morpheyes_daemon.flights.artifacts import scene_of
from morpheyes_daemon.flights.lockstep import Crew, Progress, conduct, make_crew
from morpheyes_daemon.flights.referee import Referee
from morpheyes_daemon.flights.sim_vehicle import Scenario, SimVehicle
from morpheyes_daemon.flights.sitl import open_sitl
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import GateOutput, State
from morpheyes_daemon.simulation.airframe.dynamics import Truth
from morpheyes_daemon.simulation.autopilot.core import TICK_NS
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.tcp_server import MavlinkServer
from morpheyes_daemon.simulation.camera.frame_server import FrameServer
from morpheyes_daemon.simulation.servo.pty import PseudoTerminal

EXPOSURE_LAG_NS = 10 * MS
"""A pose is asked for this long after its moment, so that it lies between two that are known."""

NICENESS = 10
"""A vehicle does not render its own pictures: they give way to the daemon, as its vision worker does."""

ALT_HOLD_POSITION = 4
"""FLTMODE4 of the recommended parameters."""


@dataclass(frozen=True, slots=True)
class SimulatorJob:
    """What the simulator must know: the scenario, the cameras and servo as configured, where to serve frames.

    `sitl` is the address of a running SITL that takes the autopilot twin's place.
    """

    scenario: Scenario
    config: VehicleConfig
    camera_address: str
    limit_s: float
    render_threads: int
    sitl: str | None = None


@dataclass(frozen=True, slots=True)
class Ready:
    """Everything is served: where the autopilot and the Teensy are, and the scene for the pictures."""

    autopilot_url: str
    servo_url: str
    scene_json: str


@dataclass(frozen=True, slots=True)
class End:
    """The daemon has let go; pack up."""


class PilotAct(StrEnum):
    """What the pilot may be asked to do in the middle of a flight."""

    SWITCH_OFF = "switch off"
    LEAVE_LOITER = "change to altitude hold"


class DaemonMirror:
    """What was last heard of the daemon; what the pilot is asked to do goes to `radio`."""

    def __init__(self, radio: Radio) -> None:
        self._radio = radio
        self.gate: Latest[GateOutput] = Latest("gate")
        self.booted, self.ended = asyncio.Event(), asyncio.Event()
        self.state, self.reason, self.since_ns = State.BOOT, Reason.STARTED, 0

    def take(self, message: GateOutput | PilotAct | End) -> None:
        """Take a message; a gate output is sent whenever state or reason change."""
        if isinstance(message, End):
            self.booted.set()
            self.ended.set()
        elif isinstance(message, PilotAct):
            self._act(message)
        else:
            self._note(message)

    def _act(self, act: PilotAct) -> None:
        self._radio.sticks()
        if act is PilotAct.SWITCH_OFF:
            self._radio.switch(on=False)
        else:
            self._radio.mode_switch(ALT_HOLD_POSITION)

    def _note(self, message: GateOutput) -> None:
        self.booted.set()
        if message.state is not self.state:
            self.since_ns = message.t_ns
        self.state, self.reason = message.state, message.reason or Reason.ENGAGED
        self.gate.publish(message)


def simulate(job: SimulatorJob, pipe: Connection) -> None:
    """The process's whole life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group; the parent decides
    with contextlib.suppress(OSError):  # where that is refused it renders at the daemon's priority
        os.nice(NICENESS)
    try:
        asyncio.run(_simulate(job, pipe))
    except MorphEyesError as error:
        pipe.send(error)


async def _simulate(job: SimulatorJob, pipe: Connection) -> None:
    clock = running_clock()
    if job.sitl is not None:
        async with open_sitl(job.sitl, clock) as (vehicle, crew):
            # in a thread, since the SITL goes on talking
            stage = await asyncio.to_thread(SimVehicle, job.scenario, job.config, clock, job.render_threads, vehicle)
            vehicle.stand_at(*stage.world.start_ned_m[:2])
            await _fly(job, pipe, stage, crew, job.sitl)
            await crew.land()
        return
    stage = TwinVehicle(job.scenario, job.config, clock, job.render_threads)
    station = make_crew(stage)
    async with MavlinkServer(stage.autopilot, port=0) as server, _background(stage.autopilot.run(), station.run()):
        await _fly(job, pipe, stage, station, server.url)


class TwinVehicle(SimVehicle):
    """A stage whose twin is brought up to the moment it is asked about, should the loop have been held up."""

    def truth(self, t_ns: int) -> Truth:
        """Return where the vehicle really was; in the event loop only."""
        while t_ns - self.autopilot.autopilot.t_ns >= TICK_NS:
            self.autopilot.advance(t_ns)
        return super().truth(t_ns)


async def _fly(job: SimulatorJob, pipe: Connection, stage: SimVehicle, crew: Crew, url: str) -> None:
    clock, heard = stage.clock, DaemonMirror(stage.radio)
    port = PseudoTerminal(stage.teensy.receive)
    stage.teensy.connect(port.write)
    exposures = Exposures(stage)
    frames = FrameServer(job.camera_address, exposures.next, clock, job.config.camera.rate_hz)
    began_ns = clock.now_ns()
    try:
        with _hearing(pipe, heard):
            await exposures.next()  # compiles what is not compiled yet
            async with _background(stage.teensy.run(), frames.run(), _report(stage, heard, pipe, began_ns)):
                await frames.listening.wait()
                pipe.send(Ready(url, f"serial:{port.path}:115200", scene_of(stage.world).as_json()))
                await heard.booted.wait()  # or it would find the vehicle flying, and only observe
                await _judge(job, pipe, stage, crew, heard)
                await heard.ended.wait()
                crew.disengage()
    finally:
        port.close()
        stage.close()


async def _judge(job: SimulatorJob, pipe: Connection, stage: SimVehicle, crew: Crew, heard: DaemonMirror) -> None:
    """Hand over, and send the verdict when there is one; over when the daemon ends before."""
    judge = Referee(stage, heard, heard.gate, job.limit_s)
    watching = asyncio.create_task(judge.watch())
    conducting = asyncio.create_task(conduct(crew, heard, stage.clock.sleep_until_ns, stage.clock.now_ns))
    ended = asyncio.create_task(heard.ended.wait())
    tasks = {watching, conducting, ended}
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if conducting in done:
            conducting.result()
            done, _ = await asyncio.wait(tasks - {conducting}, return_when=asyncio.FIRST_COMPLETED)
        if watching in done:
            pipe.send(watching.result())
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class Exposures:
    """Renders pairs in a thread, so that the vehicle goes on flying meanwhile."""

    def __init__(self, stage: SimVehicle) -> None:
        self._stage = stage
        self._seq = 0

    async def next(self) -> RawPair:
        """Expose now and return the pair."""
        stage = self._stage
        self._seq += 1
        await stage.vehicle.catch_up()
        now_ns = stage.clock.now_ns()
        stage.truth(now_ns)
        t_ns = now_ns - stage.delivery_ns - EXPOSURE_LAG_NS
        return await asyncio.to_thread(stage.exposure(self._seq, t_ns))


async def _report(stage: SimVehicle, heard: DaemonMirror, pipe: Connection, began_ns: int) -> None:
    clock: Clock = stage.clock
    while True:
        await stage.vehicle.catch_up()
        now_ns = clock.now_ns()
        truth = stage.truth(now_ns)
        distance_m = stage.world.to_goal_m(truth.p_ned_m)
        speed_m_s = (truth.v_ned_m_s[0] ** 2 + truth.v_ned_m_s[1] ** 2) ** 0.5
        seconds, state = (now_ns - began_ns) / S, str(heard.state)
        pipe.send(Progress(seconds, state, distance_m, speed_m_s, stage.baseline_m(now_ns)))
        await clock.sleep_until_ns(now_ns + S // 2)


@contextlib.contextmanager
def _hearing(pipe: Connection, heard: DaemonMirror) -> Any:
    """Hand on what comes through the pipe; a parent that is gone counts as the end."""
    loop = asyncio.get_running_loop()

    def read() -> None:
        try:
            while pipe.poll():
                heard.take(pipe.recv())
        except (EOFError, OSError):
            loop.remove_reader(pipe.fileno())
            heard.take(End())

    loop.add_reader(pipe.fileno(), read)
    try:
        yield
    finally:
        loop.remove_reader(pipe.fileno())


@contextlib.asynccontextmanager
async def _background(*jobs: Any) -> AsyncIterator[None]:
    """Run `jobs` beside the body; when one of them fails, the body is cancelled and the failure raised."""
    body = asyncio.current_task()
    assert body is not None
    failures: list[BaseException] = []

    def note(body: asyncio.Task[Any], task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and task.exception() is not None:
            failures.append(task.exception())  # type: ignore[arg-type]
            body.cancel()

    tasks = [asyncio.create_task(job) for job in jobs]
    for task in tasks:
        task.add_done_callback(partial(note, body))
    try:
        yield
    except asyncio.CancelledError:
        if failures:
            body.uncancel()
            raise failures[0] from None
        raise
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
