"""A simulated flight at the clock's pace: the daemon here, its vision in a second process, the simulator in a third.

The daemon has the devices it would have on a vehicle: MAVLink over TCP, the Teensy on a serial port, a camera on a
socket. The simulator hears its states, and it hears nothing of the simulator but the devices.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S, running_clock, stopwatch_s, wall_time_s
from morpheyes_daemon.config.vehicle import AutopilotConfig, DashboardConfig, SerialServoConfig, VehicleConfig
from morpheyes_daemon.daemon.composition import Daemon
from morpheyes_daemon.daemon.service import build_parts, real_time_runner
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.errors import DeviceLostError, DeviceTimeoutError
from morpheyes_daemon.flights.artifacts import FILES
from morpheyes_daemon.flights.lockstep import FlightCounter, FlightPlan, Progress, Summary, summarize_flight
from morpheyes_daemon.flights.referee import Verdict
from morpheyes_daemon.flights.simulator_process import End, PilotAct, Ready, SimulatorJob, simulate
from morpheyes_daemon.flights.stick_timing import StickIntervals, StickTiming
from morpheyes_daemon.messages.core import Perception
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import GateOutput
from morpheyes_daemon.observer.feed import Feed
from morpheyes_daemon.observer.process import ObserverJob
from morpheyes_daemon.observer.task import ObserverTask
from morpheyes_daemon.perception.pipeline import PipelineFactory, VisionJob
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.reader import read_flight
from morpheyes_daemon.recorder.report import draw_report
from morpheyes_daemon.stereo.calibration_file import calibration_hash, read_calibration
from morpheyes_daemon.supervisor.supervisor import Task
from morpheyes_daemon.vision_worker.process import ProcessWorker

READY_LIMIT_S = 600.0
"""World, textures and a first compilation of the renderer; a real GPS takes 42 s."""
CLOSE_LIMIT_S = 150.0
"""A SITL is landed before the simulator ends."""


@dataclass(frozen=True, slots=True)
class RealtimeSummary(Summary):
    """The row of a flight in real time; intervals are between stick messages while the sticks were ours."""

    p99_stick_interval_s: float = 0.0
    max_stick_interval_s: float = 0.0


class Simulator:
    """The parent's end of the simulator process."""

    def __init__(self, process: Any, pipe: Connection, progress: Callable[[Progress], None]) -> None:
        self._process, self._pipe, self._progress = process, pipe, progress
        loop = asyncio.get_running_loop()
        self.ready: asyncio.Future[Ready] = loop.create_future()
        self.verdict: asyncio.Future[Verdict] = loop.create_future()
        self._said: tuple[Any, Any] | None = None
        loop.add_reader(pipe.fileno(), self._read)

    async def get_ready(self) -> Ready:
        """Wait until everything is served; raises what kept it from that."""
        try:
            async with asyncio.timeout(READY_LIMIT_S):
                return await asyncio.shield(self.ready)
        except TimeoutError:
            raise DeviceTimeoutError(f"the simulator did not get ready within {READY_LIMIT_S:.0f} s.") from None

    def tell(self, out: GateOutput) -> None:
        """Pass on the daemon's state when it has changed."""
        if self._said != (out.state, out.reason):
            self._said = out.state, out.reason
            self._send(out)

    def ask_pilot(self, act: PilotAct) -> None:
        """Have the pilot do something."""
        self._send(act)

    async def close(self) -> None:
        """Let the simulator pack up; one that does not is killed."""
        self._send(End())
        await asyncio.to_thread(self._process.join, CLOSE_LIMIT_S)
        asyncio.get_running_loop().remove_reader(self._pipe.fileno())
        self.kill()
        for future in (self.ready, self.verdict):
            if future.done() and not future.cancelled():
                future.exception()
            future.cancel()

    def kill(self) -> None:
        """End it at once, if it still runs."""
        if self._process.is_alive():
            self._process.kill()

    def _send(self, message: GateOutput | PilotAct | End) -> None:
        try:
            self._pipe.send(message)
        except OSError:
            self._fail(DeviceLostError("the simulator has ended."))

    def _read(self) -> None:
        try:
            while self._pipe.poll():
                self._take(self._pipe.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(self._pipe.fileno())
            self._process.join(1.0)
            self._fail(DeviceLostError(f"the simulator process died (exit code {self._process.exitcode})."))

    def _take(self, message: object) -> None:
        if isinstance(message, Progress):
            self._progress(message)
        elif isinstance(message, Ready):
            self.ready.set_result(message)
        elif isinstance(message, Verdict):
            self.verdict.set_result(message)
        elif isinstance(message, Exception):
            self._fail(message)

    def _fail(self, error: Exception) -> None:
        for future in (self.ready, self.verdict):
            if not future.done():
                future.set_exception(error)
                future.exception()  # seen: whoever waits raises it, and nobody need wait


@asynccontextmanager
async def simulator_process(job: SimulatorJob, progress: Callable[[Progress], None]) -> AsyncIterator[Simulator]:
    """Run the simulator beside the body."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=simulate, args=(job, theirs), name="morpheyes-simulator", daemon=True)
    await asyncio.to_thread(process.start)
    theirs.close()
    simulator = Simulator(process, ours, progress)
    try:
        yield simulator
        await simulator.close()
    finally:
        simulator.kill()
        ours.close()


def fly_realtime(
    plan: FlightPlan, folder: Path, autopilot: str | None, progress: Callable[[Progress], None]
) -> RealtimeSummary:
    """Fly `plan` in real time, leave the results in `folder`, and return the summary.

    `autopilot` is the first port of a running ArduPilot SITL, None the autopilot twin. Raises DeviceError when the
    simulator or the daemon cannot go on.
    """
    with real_time_runner() as runner:
        summary = runner.run(_fly(plan, folder, autopilot, progress))
    draw_report(read_flight(folder / "flight.mcap"), folder)
    (folder / "summary.json").write_text(json.dumps(summary.as_json(), indent=2) + "\n", encoding="utf-8")
    return summary


async def _fly(
    plan: FlightPlan, folder: Path, autopilot: str | None, progress: Callable[[Progress], None]
) -> RealtimeSummary:
    started_s, clock = stopwatch_s(), running_clock()
    began_ns = clock.now_ns()
    async with realtime_daemon(plan, folder / "flight.mcap", autopilot, progress) as flight:
        verdict = await flight.verdict()
    seconds = (clock.now_ns() - began_ns) / S
    row = summarize_flight(plan, verdict, flight.tally, seconds, stopwatch_s() - started_s)
    return with_intervals(row, flight.beat.intervals())


def with_intervals(row: Summary, intervals: StickIntervals) -> RealtimeSummary:
    """Return the summary with the stick intervals."""
    values = {name: getattr(row, name) for name in Summary.__dataclass_fields__}
    return RealtimeSummary(**values, p99_stick_interval_s=intervals.p99_s, max_stick_interval_s=intervals.max_s)


@dataclass(slots=True)
class RealtimeFlight:
    """A daemon that runs against a simulator."""

    daemon: Daemon
    worker: ProcessWorker[VisionJob, Perception]
    simulator: Simulator
    running: asyncio.Task[None]
    tally: FlightCounter
    beat: StickTiming
    observer: ObserverTask

    async def verdict(self) -> Verdict:
        """Wait for the judge; raises what ended the simulator or the daemon before."""
        waited: set[asyncio.Future[Any]] = {self.simulator.verdict, self.running}
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
        if not self.simulator.verdict.done():
            self.running.result()
            raise DeviceLostError("the daemon ended before the flight did.")
        return self.simulator.verdict.result()


@asynccontextmanager
async def realtime_daemon(
    plan: FlightPlan,
    log: Path,
    autopilot: str | None,
    progress: Callable[[Progress], None],
    page: DashboardConfig | None = None,
) -> AsyncIterator[RealtimeFlight]:
    """Run simulator and daemon beside the body; at its end the daemon leaves in neutral, then release.

    `page` serves the dashboard, None none.
    """
    clock, topics, events = running_clock(), Topics.create(), EventLog()
    with tempfile.TemporaryDirectory(prefix="morpheyes-") as place:
        address = f"unix:{place}/frames"
        job = SimulatorJob(plan.scenario, plan.config, address, plan.limit_s, plan.threads, autopilot)
        async with simulator_process(job, progress) as simulator:
            ready = await simulator.get_ready()
            config = device_config(plan, ready, address)
            parts = build_parts(
                PipelineFactory(config, plan.mission, read_calibration(plan.calibration)),
                DeviceContext(clock, events, topics),
                film=True,
            )
            worker = parts.worker
            assert isinstance(worker, ProcessWorker)
            daemon = Daemon(config, plan.mission, parts, topics, events)
            observer = ObserverTask(
                _observer_job(plan, config, log, ready.scene_json, page),
                Feed(topics, events, clock),
                clock,
                lambda request: daemon.monitor.stop_requested(clock.now_ns()),
            )
            daemon.supervisor.add(Task("observer", observer.run, Reason.TASK_DIED, essential=False))
            watchers = FlightCounter(topics, events), StickTiming(topics.gate)
            topics.gate.tap(simulator.tell)
            await observer.start()
            stop = asyncio.Event()
            running = asyncio.create_task(daemon.run(stop))
            try:
                yield RealtimeFlight(daemon, worker, simulator, running, *watchers, observer)
            finally:
                stop.set()
                try:
                    await running
                finally:
                    await observer.close()


def device_config(plan: FlightPlan, ready: Ready, camera_address: str) -> VehicleConfig:
    """Return the plan's configuration with the devices that the simulator serves."""
    config = plan.config
    assert isinstance(config.servo, SerialServoConfig)
    autopilot = AutopilotConfig.model_validate({**config.autopilot.model_dump(), "url": ready.autopilot_url})
    return config.model_copy(
        update={
            "camera": config.camera.model_copy(update={"address": camera_address}),
            "servo": config.servo.model_copy(update={"url": ready.servo_url}),
            "autopilot": autopilot,
            "calibration": plan.calibration,
        }
    )


def _observer_job(
    plan: FlightPlan, config: VehicleConfig, log: Path, scene_json: str, page: DashboardConfig | None
) -> ObserverJob:
    log.parent.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        (log.parent / name).unlink(missing_ok=True)
    header = flight_header(
        mission=plan.mission_name,
        mission_file=plan.mission,
        config=config,
        calibration_hash=calibration_hash(read_calibration(plan.calibration)),
        wall_s=wall_time_s(),
        scene=scene_json,
    )
    return ObserverJob(
        log=log,
        header=header,
        image_rate_hz=plan.config.camera.rate_hz,
        page=page,
        identity={"mission": plan.mission_name, "seed": str(plan.scenario.seed), "calibration": str(plan.calibration)},
        journal=None,
        began_ns=running_clock().now_ns(),
    )
