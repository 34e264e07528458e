"""The daemon's tasks as a table: one row a task, with its loop, the reason its death is given, and when it is there.

A builder takes from the wiring what its task needs and nothing more; no task is handed the daemon.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from typing import Any

from morpheyes_daemon.bus import EventLog, StickPulse, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.config.vehicle import NoServoConfig, VehicleConfig
from morpheyes_daemon.control.baseline import BaselineModel, FixedBaseline
from morpheyes_daemon.control.baseline_planner import BaselinePlanner
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.devices.servo import Servo
from morpheyes_daemon.messages.core import Perception
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Health
from morpheyes_daemon.perception.pipeline import VisionJob
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.strategies.base import Strategy
from morpheyes_daemon.supervisor.alarms import Alarms
from morpheyes_daemon.supervisor.supervisor import Pulse, Supervisor, Task
from morpheyes_daemon.tasks.avoidance import avoidance
from morpheyes_daemon.tasks.baseline import BaselineTask
from morpheyes_daemon.tasks.capture import CaptureTask
from morpheyes_daemon.tasks.depth import DepthTask
from morpheyes_daemon.tasks.health import HealthTask
from morpheyes_daemon.tasks.mission import MissionTask
from morpheyes_daemon.tasks.obstacles import obstacles
from morpheyes_daemon.tasks.sticks import StickTask
from morpheyes_daemon.vision_worker.inline import VisionWorker

Run = Callable[[Pulse], Coroutine[Any, Any, None]]


@dataclass(frozen=True, slots=True)
class Wiring:
    """Everything that the composition has built, for the builders of this table alone.

    `baseline` is the servo's model, None for a rig that does not move; `where` gives the baseline at a moment.
    """

    config: VehicleConfig
    avoids: bool
    clock: Clock
    topics: Topics
    events: EventLog
    camera: Camera
    servo: Servo
    worker: VisionWorker[VisionJob, Perception]
    image_rate_hz: float
    connection: AutopilotConnection
    strategy: Strategy
    gate: Gate
    monitor: SafetyMonitor
    supervisor: Supervisor
    controller: StickController
    poses: PoseHistory
    baseline: BaselineModel | None
    where: BaselineModel | FixedBaseline
    alarms: Alarms
    on_health: Callable[[Health], None]
    sticks_sent: StickPulse


def _autopilot(w: Wiring) -> Run:
    async def run(pulse: Pulse) -> None:
        await w.connection.run()

    return run


def _sticks(w: Wiring) -> Run:
    rate_hz = w.config.autopilot.stick_rate_hz
    return StickTask(w.controller, w.poses, w.monitor, w.gate, w.topics, w.events, w.sticks_sent, w.clock, rate_hz).run


def _capture(w: Wiring) -> Run:
    return CaptureTask(w.camera, w.where, w.topics.frame, w.gate, _periods_ns(w, w.config.safety.frame_periods)).run


def _depth(w: Wiring) -> Run:
    lease_ns = _periods_ns(w, w.config.safety.depth_periods) + round(w.config.stereo.latency_ms * 1e6)
    return DepthTask(w.worker, w.poses, w.topics, w.events, w.gate, w.clock, lease_ns, w.image_rate_hz).run


def _mission(w: Wiring) -> Run:
    safety = w.config.safety
    return MissionTask(
        strategy=w.strategy,
        poses=w.poses,
        stopping=w.controller,
        monitor=w.monitor,
        gate=w.gate,
        topics=w.topics,
        sticks_sent=w.sticks_sent,
        clock=w.clock,
        reaction_s=safety.dead_daemon_s,
        longest_s=safety.mission_periods / w.config.camera.rate_hz,
    ).run


def _health(w: Wiring) -> Run:
    return HealthTask(w.supervisor, w.monitor, w.topics, w.clock, w.on_health).run


def _avoidance(w: Wiring) -> Run:
    return lambda pulse: avoidance(w.connection, w.monitor, w.clock, pulse)


def _obstacles(w: Wiring) -> Run:
    return lambda pulse: obstacles(w.connection, w.topics, w.gate, w.clock, pulse)


def _baseline(w: Wiring) -> Run:
    assert w.baseline is not None
    assert not isinstance(w.config.servo, NoServoConfig)
    planner, first_m = BaselinePlanner(w.config.servo.motion), w.config.baseline_range_m[0]
    return BaselineTask(w.servo, w.baseline, planner, first_m, w.topics, w.clock, w.alarms.on_baseline_known).run


def _periods_ns(w: Wiring, periods: float) -> int:
    return round(periods * round(S / w.config.camera.rate_hz))


def _always(w: Wiring) -> bool:
    return True


@dataclass(frozen=True, slots=True)
class Row:
    """One task: `essential` ones are needed for flight; `when` says in which configurations it is there at all."""

    name: str
    loop: Callable[[Wiring], Run]
    fault: Reason
    essential: bool = True
    when: Callable[[Wiring], bool] = _always


TASKS = (
    Row("autopilot", _autopilot, Reason.LINK_LOST),
    Row("sticks", _sticks, Reason.TASK_DIED),
    Row("capture", _capture, Reason.CAMERA_LOST),
    Row("depth", _depth, Reason.WORKER_LOST),
    Row("mission", _mission, Reason.TASK_DIED),
    Row("health", _health, Reason.TASK_DIED, essential=False),
    Row("avoidance", _avoidance, Reason.TASK_DIED, essential=False, when=lambda w: not w.avoids),
    Row("obstacles", _obstacles, Reason.TASK_DIED, essential=False, when=lambda w: w.config.autopilot.publish_obstacles),
    Row("baseline", _baseline, Reason.SERVO_LOST, when=lambda w: w.baseline is not None),
)


def build_tasks(wiring: Wiring) -> Iterator[Task]:
    """Yield the rows of the table that this configuration has, ready to run."""
    for row in TASKS:
        if row.when(wiring):
            yield Task(row.name, row.loop(wiring), row.fault, row.essential)
