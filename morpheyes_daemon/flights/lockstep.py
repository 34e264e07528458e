"""One flight in the simulator, in lockstep: the real daemon on a virtual clock, its links in memory.

The same seed gives the same sticks bit for bit. Everything the daemon reads, its calibration file included, is what
a real one would read.
"""

from __future__ import annotations

import asyncio
import gc
import hashlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S, run_virtual, running_clock, stopwatch_s
from morpheyes_daemon.config.vehicle import (
    AutopilotConfig,
    MissionFile,
    SerialServoConfig,
    SimCameraConfig,
    VehicleConfig,
)
from morpheyes_daemon.daemon.composition import Daemon, Parts
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import Link, LinkOpener, MemoryLink, OnBytes, OnLost
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.errors import DeviceNotFoundError
from morpheyes_daemon.flights.referee import MonitorView, Outcome, Referee, Verdict
from morpheyes_daemon.flights.sim_vehicle import Scenario, SimVehicle, SimVehicleCamera
from morpheyes_daemon.messages.core import Event, StereoFrame
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import GateOutput, State
from morpheyes_daemon.perception.pipeline import PipelineFactory
from morpheyes_daemon.simulation.crew.scripted import GroundCrew
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.vision_worker.inline import InlineWorker

AUTOPILOT_URL = "memory:autopilot"
SERVO_URL = "memory:servo"
LINK_DELAY_S = 0.005
"""One way over a serial port at 921600 baud, a message of some 40 bytes and its handling."""
TAKE_OFF_HEIGHT_M = 1.5
READY_LIMIT_S = 30.0


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """Everything that decides a lockstep flight."""

    mission_name: str
    mission: MissionFile
    config: VehicleConfig
    calibration: Path
    scenario: Scenario
    limit_s: float = 180.0
    threads: int = 1


@dataclass(frozen=True, slots=True)
class Summary:
    """The row of one flight; `summary.json` holds exactly these keys. `text` tells more of the reason, if anyone did."""

    mission: str
    seed: int
    baseline_mode: str
    calibration: str
    outcome: str
    reason: str
    text: str
    time_s: float
    path_m: float
    mean_speed_m_s: float
    peak_speed_m_s: float
    min_clearance_m: float
    baseline_min_m: float
    baseline_max_m: float
    frames: int
    perception_rate_hz: float
    braking_events: int
    sticks_sha256: str
    wall_s: float
    simulated_s: float
    image_size: str
    camera_rate_hz: float
    world: str

    def as_json(self) -> dict[str, Any]:
        """Return plain values, lengths and times rounded to what they are good for."""
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(self).items()}


@dataclass(slots=True)
class Watchers:
    """What looks on while a flight goes: pictures, recorder, progress. Each may tap topics; none is asked."""

    attach: list[Callable[[Daemon, SimVehicle], None]] = field(default_factory=list)
    image_rate_hz: float = 0.0
    progress: Callable[[Progress], None] = lambda progress: None


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a flight is, for the progress line."""

    simulated_s: float
    phase: str
    distance_m: float
    speed_m_s: float
    baseline_m: float


def sim_config(config: VehicleConfig, rate_hz: float, size: tuple[int, int], baseline_m: float | None) -> VehicleConfig:
    """Return a vehicle configuration with the simulator's camera, servo and link in place of the real ones."""
    camera = SimCameraConfig(
        width_px=size[0],
        height_px=size[1],
        rate_hz=rate_hz,
        sync_error_ms=config.camera.sync_error_ms,
        mount=config.camera.mount,
    )
    motion = config.servo.motion if isinstance(config.servo, SerialServoConfig) else None
    servo = SerialServoConfig(backend="serial", url=SERVO_URL, **({"motion": motion} if motion else {}))
    autopilot = AutopilotConfig.model_validate({**config.autopilot.model_dump(), "url": AUTOPILOT_URL})
    hold_mm = None if baseline_m is None else 1e3 * baseline_m
    return config.model_copy(
        update={"camera": camera, "servo": servo, "autopilot": autopilot, "hold_baseline_mm": hold_mm}
    )


def fly(plan: FlightPlan, watchers: Watchers | None = None) -> Summary:
    """Fly `plan` to its end on a virtual clock and return the summary."""
    summary = run_virtual(_fly(plan, watchers or Watchers()))
    gc.collect()  # a flight is one knot of references, images and all, that a campaign would pile up
    return summary


async def _fly(plan: FlightPlan, watchers: Watchers) -> Summary:
    started_s = stopwatch_s()
    clock = running_clock()
    began_ns = clock.now_ns()
    topics, events = Topics.create(), EventLog()
    troubles: dict[str, str] = {}
    events.subscribe(lambda event: note_trouble(troubles, event))
    stage = SimVehicle(plan.scenario, plan.config, clock, plan.threads)
    crew = make_crew(stage)
    opener = memory_opener(stage)
    pipeline = PipelineFactory(plan.config, plan.mission, read_calibration(plan.calibration))()
    latency_ns = round(plan.config.stereo.latency_ms * S / 1e3)
    pool = ThreadPoolExecutor(1) if plan.threads > 1 else None
    parts = Parts(
        clock=clock,
        camera=SimVehicleCamera(stage, plan.config.camera.rate_hz),
        servo=build_servo(plan.config.servo, DeviceContext(clock, events, topics, opener)),
        opener=opener,
        worker=InlineWorker(pipeline.perceive, latency_ns, clock, pool),
        image_rate_hz=watchers.image_rate_hz,
    )
    daemon = Daemon(plan.config, plan.mission, parts, topics, events)
    tally = FlightCounter(topics, events)
    for attach in watchers.attach:
        attach(daemon, stage)
    judge = Referee(stage, daemon.monitor, topics.gate, plan.limit_s)
    stop = asyncio.Event()
    background = [
        asyncio.create_task(job)
        for job in (stage.autopilot.run(), stage.teensy.run(), crew.run(), _report(stage, daemon, watchers, began_ns))
    ]
    running = asyncio.create_task(daemon.run(stop))
    watching = asyncio.create_task(judge.watch())
    conducting = asyncio.create_task(conduct(crew, daemon.monitor, clock.sleep_until_ns, clock.now_ns, troubles))
    try:
        done, _ = await asyncio.wait({running, watching, conducting}, return_when=asyncio.FIRST_COMPLETED)
        if conducting in done:
            conducting.result()
            done, _ = await asyncio.wait({running, watching}, return_when=asyncio.FIRST_COMPLETED)
        if running in done:
            running.result()
            raise DeviceNotFoundError("The daemon ended before the flight did.")
        verdict = watching.result()
        crew.disengage()
        stop.set()
        await running
    finally:
        for task in (*background, running, watching, conducting):
            task.cancel()
        await asyncio.gather(*background, running, watching, conducting, return_exceptions=True)
        stage.close()
        if pool is not None:
            pool.shutdown()
    simulated_s = (clock.now_ns() - began_ns) / S
    return summarize_flight(plan, verdict, tally, simulated_s, stopwatch_s() - started_s)


class Crew(Protocol):
    """The people around a flight."""

    async def take_off(self, height_m: float) -> None:
        """Arm, climb, hover in Loiter."""

    def engage(self) -> None:
        """Hand the sticks over."""

    def disengage(self) -> None:
        """Take them back."""


async def conduct(
    crew: Crew,
    monitor: MonitorView,
    sleep_until_ns: Callable[[int], Any],
    now_ns: Callable[[], int],
    troubles: Mapping[str, str] | None = None,
) -> None:
    """Take off, wait until the daemon stands by, hand over; raises DeviceNotFoundError when it never gets ready.

    `troubles` (`note_trouble`) tell more than the daemon's own reason.
    """
    await crew.take_off(TAKE_OFF_HEIGHT_M)
    limit_ns = now_ns() + round(READY_LIMIT_S * S)
    while monitor.state is not State.STANDBY:
        if now_ns() > limit_ns:
            why = next(iter((troubles or {}).values()), monitor.reason.text).rstrip(".")
            raise DeviceNotFoundError(f"The daemon did not get ready within {READY_LIMIT_S:.0f} s: {why}.")
        await sleep_until_ns(now_ns() + S // 20)
    crew.engage()


def note_trouble(troubles: dict[str, str], event: Event) -> None:
    """Keep what tasks died of, by task, until they work again."""
    if event.reason is Reason.RECOVERED:
        troubles.pop(event.source, None)
    elif event.text.startswith(f"{event.source}: "):
        troubles.setdefault(event.source, event.text)


class FlightCounter:
    """Counts frames, hashes every stick that went out, and keeps what was last said of each reason."""

    def __init__(self, topics: Topics, events: EventLog) -> None:
        self.frames = 0
        self._said: dict[str, str] = {}
        self.first_ns = self.last_ns = 0
        self._hash = hashlib.sha256()
        topics.frame.tap(self._frame)
        topics.gate.tap(self._gate)
        events.subscribe(self._event)

    @property
    def sticks_sha256(self) -> str:
        """Hash of time, action and the four widths of every stick period."""
        return self._hash.hexdigest()

    @property
    def rate_hz(self) -> float:
        """Mean frame rate."""
        return (self.frames - 1) * S / (self.last_ns - self.first_ns) if self.frames > 1 else 0.0

    def said(self, reason: str) -> str:
        """Return what a device, a task or the mission said of a reason, such as the size of a gap; else nothing."""
        return self._said.get(reason, "")

    def _event(self, event: Event) -> None:
        if event.source != "monitor":  # whose text is the reason's own
            self._said[event.reason] = event.text

    def _frame(self, frame: StereoFrame) -> None:
        self.frames += 1
        self.first_ns = self.first_ns or frame.t_ns
        self.last_ns = frame.t_ns

    def _gate(self, out: GateOutput) -> None:
        self._hash.update(f"{out.t_ns} {out.action} {out.widths_us}\n".encode())


def summarize_flight(
    plan: FlightPlan, verdict: Verdict, tally: FlightCounter, simulated_s: float, wall_s: float
) -> Summary:
    """Put the referee's verdict and the counts into the row of one flight."""
    hold_mm = plan.config.hold_baseline_mm
    camera = plan.config.camera
    return Summary(
        mission=plan.mission_name,
        seed=plan.scenario.seed,
        baseline_mode="variable" if hold_mm is None else f"{hold_mm / 1e3:g}",
        calibration=read_calibration(plan.calibration).origin,
        outcome=verdict.outcome,
        reason=verdict.reason,
        text=tally.said(verdict.reason),
        time_s=verdict.time_s,
        path_m=verdict.path_m,
        mean_speed_m_s=verdict.path_m / verdict.time_s if verdict.time_s else 0.0,
        peak_speed_m_s=verdict.peak_speed_m_s,
        min_clearance_m=verdict.min_clearance_m,
        baseline_min_m=verdict.baseline_min_m,
        baseline_max_m=verdict.baseline_max_m,
        frames=tally.frames,
        perception_rate_hz=tally.rate_hz,
        braking_events=verdict.braking_events,
        sticks_sha256=tally.sticks_sha256,
        wall_s=wall_s,
        simulated_s=simulated_s,
        image_size=f"{camera.width_px}x{camera.height_px}",
        camera_rate_hz=camera.rate_hz,
        world=plan.scenario.world,
    )


def make_crew(stage: SimVehicle) -> GroundCrew:
    """Return a ground crew with an in-memory link of its own."""
    ours, theirs = MemoryLink.pair(LINK_DELAY_S)
    crew = GroundCrew(stage.radio, ours, stage.clock, without_gps=stage.autopilot.parameters.flow_only)
    ours.on_bytes = crew.on_bytes
    theirs.on_bytes = stage.autopilot.attach(theirs)
    return crew


def memory_opener(stage: SimVehicle) -> LinkOpener:
    """Return what opens the daemon's links to the autopilot and the Teensy of `stage`."""

    async def open_memory(url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
        ours, theirs = MemoryLink.pair(LINK_DELAY_S)
        ours.on_bytes, ours.on_lost = on_bytes, on_lost
        if url == AUTOPILOT_URL:
            theirs.on_bytes = stage.autopilot.attach(theirs)
        elif url == SERVO_URL:
            stage.teensy.connect(theirs.write)
            theirs.on_bytes = stage.teensy.receive
        else:
            raise DeviceNotFoundError(f"There is no in-memory link {url}.")
        return ours

    return open_memory


async def _report(stage: SimVehicle, daemon: Daemon, watchers: Watchers, began_ns: int) -> None:
    clock = stage.clock
    while True:
        now_ns = clock.now_ns()
        truth = stage.truth(now_ns)
        distance = stage.world.to_goal_m(truth.p_ned_m)
        speed = (truth.v_ned_m_s[0] ** 2 + truth.v_ned_m_s[1] ** 2) ** 0.5
        phase = str(daemon.monitor.state)
        watchers.progress(Progress((now_ns - began_ns) / S, phase, distance, speed, stage.baseline_m(now_ns)))
        await clock.sleep_until_ns(now_ns + S // 2)


__all__ = ["FlightPlan", "Outcome", "Progress", "Summary", "Watchers", "fly", "replace", "sim_config"]
