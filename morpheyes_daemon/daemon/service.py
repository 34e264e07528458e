"""The daemon on real devices, as systemd or a person starts it: parts, flight log, page, mavsdk, systemd and signals.

What is not connected is waited for in PREFLIGHT. Everything that decides about flight is in composition.py and below it.
"""

from __future__ import annotations

import asyncio
import gc
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

from morpheyes_daemon import __version__
from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, running_clock, wall_time_s
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.daemon.composition import Daemon, Parts
from morpheyes_daemon.daemon.sd_notify import notify
from morpheyes_daemon.daemon.systemd import SystemdReport
from morpheyes_daemon.dashboard.server import Dashboard
from morpheyes_daemon.devices.autopilot.mavsdk_bridge import MavsdkBridge
from morpheyes_daemon.devices.camera import build_camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.doctor.rig import examine_rig
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Health
from morpheyes_daemon.perception.craft import fitting_rig
from morpheyes_daemon.perception.pipeline import PipelineFactory
from morpheyes_daemon.recorder.flight_log import flight_header, flight_path
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.supervisor.supervisor import Pulse, Task
from morpheyes_daemon.vision_worker.process import ProcessWorker

JOB_TIMEOUT_S = 2.0
"""A frame that takes longer than this is lost, and the worker with it."""
DASHBOARD_IMAGE_HZ = 2.0

Say = Callable[[str], None]


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


async def serve(pipeline: PipelineFactory, mission_name: str, say: Say) -> None:
    """Run until SIGINT or SIGTERM; `say` gets one line for every change."""
    config, mission = pipeline.config, pipeline.mission
    clock, topics, events = running_clock(), Topics.create(), EventLog()
    began_ns = clock.now_ns()
    events.subscribe(lambda event: say(event_line(event, began_ns)))
    systemd = SystemdReport()
    parts = build_parts(pipeline, DeviceContext(clock, events, topics), systemd.tell)
    daemon = Daemon(config, mission, parts, topics, events)
    for task in _companions(daemon, mission_name, clock):
        daemon.supervisor.add(task)
    stop = asyncio.Event()
    with ending_by_signal(stop), closing(_recorder(daemon, mission_name, pipeline, clock)) as recorder:
        say(f"mission {mission_name}, calibration {config.calibration}, log {recorder.path}")
        daemon.stop_findings.take("calibration", examine_rig(pipeline.rig, config))
        await daemon.run(stop)
        notify("STOPPING=1")


def real_time_runner() -> asyncio.Runner:
    """Return what runs the daemon: asyncio's own loop, since uvloop's timers know whole milliseconds only.

    What is imported by now stays: the garbage collector need not look at it again, which takes longer than a stick
    period.
    """
    gc.collect()
    gc.freeze()
    return asyncio.Runner()


def event_line(event: Event, began_ns: int) -> str:
    """Return an event as a line for a person; what repeats the reason is left out."""
    seconds = (event.t_ns - began_ns) / 1e9
    text = event.text if event.reason.text in event.text else f"{event.reason.text}; {event.text}".rstrip("; ")
    return f"{seconds:9.2f} s  {event.source:<10} {text}"


@contextmanager
def ending_by_signal(stop: asyncio.Event) -> Iterator[None]:
    """The first SIGINT or SIGTERM asks for neutral, then release; a second one for release at once."""
    loop, main = asyncio.get_running_loop(), asyncio.current_task()
    assert main is not None

    def end() -> None:
        if stop.is_set():
            main.cancel()
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end)
    try:
        yield
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)


def _recorder(daemon: Daemon, mission_name: str, pipeline: PipelineFactory, clock: Clock) -> Recorder:
    config = daemon.config
    header = flight_header(
        mission=mission_name,
        mission_file=pipeline.mission,
        config=config,
        calibration_hash=calibration_hash(pipeline.rig),
        wall_s=wall_time_s(),
    )
    return Recorder(
        daemon.topics,
        daemon.events,
        clock,
        flight_path(config.recorder.folder, mission_name, wall_time_s()),
        header,
        image_rate_hz=config.recorder.image_rate_hz if config.recorder.images else None,
        threaded=True,
    )


def _companions(daemon: Daemon, mission_name: str, clock: Clock) -> list[Task]:
    """Tasks without which it flies as well: the page and mavsdk."""
    config, tasks = daemon.config, []
    if config.dashboard.enabled:
        identity = {"mission": mission_name, "version": __version__, "calibration": str(config.calibration)}
        page = Dashboard(daemon.topics, daemon.events, clock, identity)

        async def show(pulse: Pulse) -> None:
            await page.run(config.dashboard)

        tasks.append(Task("dashboard", show, Reason.TASK_DIED, essential=False))
    if config.autopilot.mavsdk:
        bridge = MavsdkBridge(daemon.connection, config.autopilot, clock)

        async def listen(pulse: Pulse) -> None:
            await bridge.run()

        tasks.append(Task("mavsdk", listen, Reason.TASK_DIED, essential=False))
    return tasks
