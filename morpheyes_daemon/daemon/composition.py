"""The composition root, the one file that knows everybody: config to devices to topics to tasks to supervisor.

Real, simulated and replayed daemons differ in the `Parts` they are given and in nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.config.vehicle import MissionFile, NoServoConfig, VehicleConfig
from morpheyes_daemon.control.baseline import BaselineModel, baseline_model
from morpheyes_daemon.control.baseline_planner import BaselinePlanner
from morpheyes_daemon.control.governor import Governor
from morpheyes_daemon.control.limits import governor_limits, velocity_tuning
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.devices.servo import Servo
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.doctor.parameter_rules import examine_parameters
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import Event, MissionCommand, Perception, Track, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, Health, State
from morpheyes_daemon.perception.craft import build_strategy
from morpheyes_daemon.perception.pipeline import VisionJob
from morpheyes_daemon.safety.gate import Gate, StickLimits
from morpheyes_daemon.safety.monitor import SafetyMonitor, SafetyMonitorLimits
from morpheyes_daemon.safety.states import Transition
from morpheyes_daemon.supervisor.supervisor import Supervisor, Task
from morpheyes_daemon.tasks.avoidance import avoidance
from morpheyes_daemon.tasks.baseline import baseline
from morpheyes_daemon.tasks.capture import capture
from morpheyes_daemon.tasks.depth import depth
from morpheyes_daemon.tasks.health import health
from morpheyes_daemon.tasks.mission import mission
from morpheyes_daemon.tasks.obstacles import obstacles
from morpheyes_daemon.tasks.sticks import sticks
from morpheyes_daemon.vision_worker.inline import VisionWorker
from morpheyes_daemon.wire.mavlink import RELEASE, ChannelOverride

ALARMS = frozenset(
    {
        Reason.OVERRIDE_IGNORED,
        Reason.AUTOPILOT_REBOOTED,
        Reason.BASELINE_STALE,
        Reason.SERVO_LOST,
        Reason.WORKER_LOST,
        Reason.EYES_APART,
        Reason.DEPTH_SCALE,
    }
)
"""What devices and images tell that ends a flight in HOLD, though all may be well again a moment later."""

STATE_NUMBERS: dict[State, int] = {state: number for number, state in enumerate(State)}
"""What NAMED_VALUE_INT carries for a state."""


@dataclass(slots=True)
class Parts:
    """What differs between the real, the simulated and the replayed daemon."""

    clock: Clock
    camera: Camera
    servo: Servo
    opener: LinkOpener
    worker: VisionWorker[VisionJob, Perception]
    image_rate_hz: float = 0.0
    tell: Callable[[Health], None] = lambda report: None


class Daemon:
    """One mission on one vehicle. `run` is the daemon's life; topics and events are for recorder and dashboard."""

    def __init__(
        self, config: VehicleConfig, mission_file: MissionFile, parts: Parts, topics: Topics, events: EventLog
    ) -> None:
        self.config = config
        self.topics = topics
        self.events = events
        self.track = PoseHistory()
        self._parts = parts
        self._clock = parts.clock
        self._strategy = build_strategy(mission_file, config)
        self._avoids = mission_file.avoidance
        self.connection = AutopilotConnection(config.autopilot, parts.clock, topics, events, parts.opener)
        self._send = self.connection.claim_stick_output()
        self.gate = Gate(self._output)
        self.monitor = SafetyMonitor(self.gate, SafetyMonitorLimits.of(config), self._on_transition)
        self.control: StickController | None = None
        self._governor = Governor(governor_limits(config))
        self._where = baseline_model(config)
        self._model = self._where if isinstance(self._where, BaselineModel) else None
        self.connection.on_vehicle(self._on_vehicle)
        topics.track.tap(self._tell_track)
        events.subscribe(self._on_event)
        topics.command.tap(self._on_command)
        self.connection.parameters.on_change(self._on_parameters)
        self._stops: tuple[str, ...] = ()
        self._said = ""
        self.supervisor = Supervisor(
            self._tasks(), self.monitor, events, parts.clock, config.safety.supervisor_timeout_s
        )

    @property
    def stopping(self) -> LoiterModel | None:
        """How the vehicle brakes, None before its parameters are known."""
        return self.control.model if self.control else None

    async def run(self, stop: asyncio.Event) -> None:
        """Live until `stop` is set, then neutral, release and end. Every way out sends a release."""
        await self._parts.worker.start()
        self.monitor.set_missing(None)
        running = asyncio.create_task(self.supervisor.run(), name="supervisor")
        stopping = asyncio.create_task(stop.wait(), name="stop")
        try:
            self.monitor.boot_done(self._clock.now_ns())
            await asyncio.wait({running, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if not running.done():
                await self._leave(running)
        finally:
            self.monitor.release_now(Reason.SHUTDOWN, self._clock.now_ns())
            for task in (running, stopping):
                task.cancel()
            results = await asyncio.gather(running, stopping, return_exceptions=True)
            await self._parts.worker.close()
        failure = results[0]
        if isinstance(failure, Exception):
            raise failure

    async def _leave(self, running: asyncio.Task[None]) -> None:
        """Neutral for a while if we hold the sticks, then the release, repeated by the gate."""
        self.monitor.shutdown(self._clock.now_ns())
        held = self.topics.gate.get()
        while not (self.monitor.let_go or running.done()):
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 50)
        if held is not None and held.action is not Action.SILENT:
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 5)

    def _tasks(self) -> list[Task]:
        """The task table: name, loop, the reason its death is given, and whether flight needs it."""
        config, parts, clock, topics = self.config, self._parts, self._clock, self.topics
        gate, monitor, safety = self.gate, self.monitor, config.safety
        period_ns = round(S / config.camera.rate_hz)
        reaction_s = safety.dead_daemon_s
        longest_s = safety.mission_periods / self.config.camera.rate_hz
        frame_ns = round(safety.frame_periods * period_ns)
        depth_ns = round(safety.depth_periods * period_ns)
        table = [
            Task("autopilot", lambda pulse: self.connection.run(), Reason.LINK_LOST),
            Task(
                "sticks",
                lambda pulse: sticks(
                    self, self.track, monitor, topics, self.events, clock, config.autopilot.stick_rate_hz, pulse
                ),
                Reason.TASK_DIED,
            ),
            Task(
                "capture",
                lambda pulse: capture(parts.camera, self._where, topics.frame, gate, frame_ns, pulse),
                Reason.CAMERA_LOST,
            ),
            Task(
                "depth",
                lambda pulse: depth(
                    parts.worker,
                    self.track,
                    topics,
                    self.events,
                    gate,
                    clock,
                    depth_ns + round(config.stereo.latency_ms * 1e6),
                    parts.image_rate_hz,
                    pulse,
                ),
                Reason.WORKER_LOST,
            ),
            Task(
                "mission",
                lambda pulse: mission(
                    self._strategy, self.track, self, monitor, topics, clock, reaction_s, longest_s, pulse
                ),
                Reason.TASK_DIED,
            ),
            Task(
                "health",
                lambda pulse: health(self.supervisor, monitor, topics, clock, self._tell, pulse),
                Reason.TASK_DIED,
                essential=False,
            ),
        ]
        if not self._avoids:
            table.append(
                Task(
                    "avoidance",
                    lambda pulse: avoidance(self.connection, monitor, clock, pulse),
                    Reason.TASK_DIED,
                    essential=False,
                )
            )
        if config.autopilot.publish_obstacles:
            table.append(
                Task(
                    "obstacles",
                    lambda pulse: obstacles(self.connection, topics, gate, clock, pulse),
                    Reason.TASK_DIED,
                    essential=False,
                )
            )
        if self._model is not None and not isinstance(config.servo, NoServoConfig):
            model, planner = self._model, BaselinePlanner(config.servo.motion)
            first_m = config.baseline_range_m[0]
            table.append(
                Task(
                    "baseline",
                    lambda pulse: baseline(
                        parts.servo, model, planner, first_m, topics, clock, self.on_baseline_known, pulse
                    ),
                    Reason.SERVO_LOST,
                )
            )
        return table

    def _on_vehicle(self, vehicle: VehicleState) -> None:
        self.monitor.on_vehicle(vehicle, self._clock.now_ns())
        self.track.add(vehicle)

    def _on_event(self, event: Event) -> None:
        if event.source != "monitor" and event.reason in ALARMS:
            self.monitor.alarm(event.reason, event.t_ns)
        if event.source == "servo":
            self.on_servo_event(event)

    def on_servo_event(self, event: Event) -> None:
        """Until the Teensy answers again the eyes may be anywhere on their way, and nobody engages."""
        lost = event.reason in ALARMS
        self.monitor.set_missing(event.reason if lost else None, "servo")
        if lost and self._model is not None:
            self._model.on_unconfirmed(self._model.at(event.t_ns).target_m, event.t_ns)

    def on_baseline_known(self, known: bool) -> None:
        """Until the eyes are known to be somewhere, neither depth nor the checks of their pictures mean anything."""
        self.monitor.set_missing(None if known else Reason.BASELINE_UNKNOWN, "baseline")

    def _on_command(self, command: MissionCommand) -> None:
        """What a mission says beside its reason, such as the size of the gap it refuses, once."""
        if command.text and command.reason and command.text != self._said:
            self.events.publish(Event(command.t_ns, "mission", command.reason, command.text))
        self._said = command.text

    def _on_parameters(self, values: Mapping[str, float]) -> None:
        """The autopilot's own numbers, new: how it flies, where its sticks end, and whether it may be flown."""
        self.on_doctor_findings(examine_parameters(values, self.config))
        try:
            model = LoiterModel.from_parameters(values)
            limits = StickLimits(model.minimum, model.maximum, model.neutral)
        except DeviceError:
            return  # the doctor has just said so
        if self.control is not None and self.control.model == model:
            return  # the autopilot counts flight time in a parameter; the loop keeps what it has learned
        self.control = StickController(model, self._governor, velocity_tuning(self.config, model))
        self.gate.set_limits(limits)

    def on_doctor_findings(self, findings: list[Finding]) -> None:
        """A finding that says do not fly keeps us from engaging; a flight that is under way is not ended by it."""
        stops = tuple(finding.id for finding in findings if finding.severity is Severity.STOP)
        self.monitor.set_missing(Reason.DOCTOR_SAYS_NO if stops else None, "doctor")
        for finding in findings:
            if finding.id in stops and finding.id not in self._stops:
                text = f"{finding.id}: {finding.evidence}; {finding.risk}; {finding.remedy}"
                self.events.publish(Event(self._clock.now_ns(), "doctor", Reason.DOCTOR_SAYS_NO, text))
        self._stops = stops

    def _output(self, out: GateOutput) -> None:
        """The gate's output, in the order of the radio's channels."""
        if out.action is Action.RELEASE or self.control is None:
            self._send(RELEASE)
        else:
            self._send(ChannelOverride(self.control.model.channels(out.widths_us)))

    def _on_transition(self, step: Transition) -> None:
        text = f"{step.before} to {step.after}: {step.reason.text}"
        self.events.publish(Event(step.t_ns, "monitor", step.reason, text))
        severity = 4 if step.after in (State.BRAKING, State.HOLD, State.FAULT) else 6
        self.connection.send_statustext(severity, f"MorphEyes {step.after}: {step.reason}")

    def _tell_track(self, track: Track) -> None:
        """A moving object: for ground stations where it is and how it moves (ned), for the log its depth and sigma.

        Messages that the autopilot would act on (LANDING_TARGET, FOLLOW_TARGET) are left alone on purpose.
        """
        self.connection.send_debug_vector("me_obj_p", *track.p_ned_m)
        self.connection.send_debug_vector("me_obj_v", *track.v_ned_m_s)
        self.connection.send_named_float("me_obj_z", track.p_rect_m[2] if track.seen else math.nan)
        self.connection.send_named_float("me_obj_sd", math.sqrt(float(track.covariance[:3, :3].trace())))

    def _tell(self, report: Health) -> None:
        """Into the autopilot's own log: state, reason, baseline, nearest depth, frame age."""
        self.connection.send_named_int("me_state", STATE_NUMBERS[report.state])
        self.connection.send_named_int("me_reason", report.reason.number)
        estimate, seen = self.topics.baseline.get(), self.topics.perception.get()
        if estimate is not None:
            self.connection.send_named_float("me_base", estimate.baseline_m)
        if seen is not None:
            self.connection.send_named_float("me_near", seen.summary.nearest_m)
        self.connection.send_named_float("me_age", report.ages_s["frame"])
        with contextlib.suppress(OSError):
            self._parts.tell(report)
