"""The daemon on real devices, as systemd or a person starts it: parts, flight log, page, mavsdk, systemd and signals.

What is not connected is waited for in PREFLIGHT. Everything that decides about flight is in composition.py and below it.
"""

from __future__ import annotations

import asyncio
import gc
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from morpheyes_daemon import __version__
from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, running_clock, wall_time_s
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.daemon.composition import Daemon, Parts
from morpheyes_daemon.daemon.sd_notify import notify
from morpheyes_daemon.daemon.systemd import SystemdReport
from morpheyes_daemon.devices.autopilot.mavsdk_bridge import MavsdkBridge
from morpheyes_daemon.devices.camera import build_camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.doctor.rig import examine_rig
from morpheyes_daemon.errors import CalibrationError, mistake
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Health
from morpheyes_daemon.observer.feed import Feed
from morpheyes_daemon.observer.process import InheritedFile, ObserverJob
from morpheyes_daemon.observer.task import ObserverTask
from morpheyes_daemon.perception.craft import fitting_rig
from morpheyes_daemon.perception.pipeline import PipelineFactory
from morpheyes_daemon.recorder.flight_log import flight_header, flight_path
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.supervisor.supervisor import Pulse, Task
from morpheyes_daemon.vision_worker.process import ProcessWorker

JOB_TIMEOUT_S = 2.0
"""A frame that takes longer than this is lost, and the worker with it."""
DASHBOARD_IMAGE_HZ = 2.0

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""SIGHUP comes when the terminal or the ssh session that started us goes away."""


def load_rig(config: VehicleConfig) -> RigModel:
    """Read the configured calibration; raises CalibrationError when there is none or it does not fit the vehicle."""
    if config.calibration is None:
        raise CalibrationError(
            "calibration is not set: make a file with `morpheyes calibrate solve` and name it in config.yaml, "
            "or give --calibration FILE."
        )
    return fitting_rig(config.calibration, config)


def build_parts(
    pipeline: PipelineFactory,
    context: DeviceContext,
    tell: Callable[[Health], None] = lambda report: None,
    film: bool = False,
) -> Parts:
    """Return the real devices and the vision worker, nothing open yet; `film` keeps a picture of every frame.

    Raises ConfigError.
    """
    config, clock, events = pipeline.config, context.clock, context.events

    def on_worker_death(text: str) -> None:
        events.publish(Event(clock.now_ns(), "vision", Reason.WORKER_LOST, text))

    def on_worker_remark(text: str) -> None:
        events.publish(Event(clock.now_ns(), "vision", Reason.PRIORITY_KEPT, text))

    log_hz = config.recorder.image_rate_hz if config.recorder.images else 0.0
    log_hz = config.camera.rate_hz if film else log_hz
    page_hz = DASHBOARD_IMAGE_HZ if config.dashboard.enabled else 0.0
    return Parts(
        clock=clock,
        camera=build_camera(config.camera, context),
        servo=build_servo(config.servo, context),
        opener=context.opener,
        worker=ProcessWorker(
            pipeline, job_timeout_s=JOB_TIMEOUT_S, on_idle_death=on_worker_death, on_remark=on_worker_remark
        ),
        image_rate_hz=max(log_hz, page_hz),
        tell=tell,
    )


async def serve(pipeline: PipelineFactory, mission_name: str, journal: int | None) -> None:
    """Run until SIGINT, SIGTERM or SIGHUP; events go as lines to the file descriptor `journal`, None: nowhere."""
    config = pipeline.config
    clock, topics, events = running_clock(), Topics.create(), EventLog()
    observer_job = _observer_job(pipeline, mission_name, journal, clock.now_ns())
    feed = Feed(topics, events, clock)
    systemd = SystemdReport()
    parts = build_parts(pipeline, DeviceContext(clock, events, topics), systemd.tell)
    daemon = Daemon(config, pipeline.mission, parts, topics, events)
    observer = ObserverTask(observer_job, feed, clock, lambda request: daemon.monitor.stop_requested(clock.now_ns()))
    daemon.supervisor.add(Task("observer", observer.run, Reason.TASK_DIED, essential=False))
    if config.autopilot.mavsdk:
        daemon.supervisor.add(_mavsdk(daemon, clock))
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: _note(events, clock, context))
    stop = asyncio.Event()
    await observer.start()
    with ending_by_signal(stop):
        text = f"mission {mission_name}, calibration {config.calibration}, log {observer_job.log}"
        events.publish(Event(clock.now_ns(), "daemon", Reason.STARTED, text))
        daemon.stop_findings.take("calibration", examine_rig(pipeline.rig, config))
        try:
            await daemon.run(stop)
        finally:
            notify("STOPPING=1")
            await observer.close()


def real_time_runner() -> asyncio.Runner:
    """Return what runs the daemon: asyncio's own loop, since uvloop's timers know whole milliseconds only.

    What is imported by now stays: the garbage collector need not look at it again, which takes longer than a stick
    period.
    """
    gc.collect()
    gc.freeze()
    return asyncio.Runner()


@contextmanager
def ending_by_signal(stop: asyncio.Event) -> Iterator[None]:
    """The first of `ENDING` asks for neutral, then release; a second one for release at once."""
    loop, main = asyncio.get_running_loop(), asyncio.current_task()
    assert main is not None

    def end() -> None:
        if stop.is_set() and main.cancelling() == 0:
            main.cancel()
        stop.set()

    for number in ENDING:
        loop.add_signal_handler(number, end)
    try:
        yield
    finally:
        for number in ENDING:
            loop.remove_signal_handler(number)


def _observer_job(pipeline: PipelineFactory, mission_name: str, journal: int | None, began_ns: int) -> ObserverJob:
    config = pipeline.config
    return ObserverJob(
        log=flight_path(config.recorder.folder, mission_name, wall_time_s()),
        header=flight_header(
            mission=mission_name,
            mission_file=pipeline.mission,
            config=config,
            calibration_hash=calibration_hash(pipeline.rig),
            wall_s=wall_time_s(),
        ),
        image_rate_hz=config.recorder.image_rate_hz if config.recorder.images else None,
        page=config.dashboard if config.dashboard.enabled else None,
        identity={"mission": mission_name, "version": __version__, "calibration": str(config.calibration)},
        journal=InheritedFile(journal) if journal is not None else None,
        began_ns=began_ns,
    )


def _mavsdk(daemon: Daemon, clock: Clock) -> Task:
    """Mavsdk beside the connection; the daemon flies without it as well."""
    bridge = MavsdkBridge(daemon.connection, daemon.config.autopilot, clock)

    async def listen(pulse: Pulse) -> None:
        await bridge.run()

    return Task("mavsdk", listen, Reason.TASK_DIED, essential=False)


def _note(events: EventLog, clock: Clock, context: dict[str, Any]) -> None:
    """What asyncio would print about an error that nobody waits for."""
    error = context.get("exception")
    text = mistake(error) if isinstance(error, Exception) else str(context.get("message", ""))
    events.publish(Event(clock.now_ns(), "daemon", Reason.TASK_DIED, text))
