"""The composition root, the one file that knows everybody: config to devices to topics to tasks to supervisor.

Real, simulated and replayed daemons differ in the `Parts` they are given and in nothing else. What the tasks do is in
`task_table`, `tasks/` and below; here they are only put together.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from morpheyes_daemon.bus import EventLog, StickPulse, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.control.baseline import BaselineModel, baseline_model
from morpheyes_daemon.control.governor import Governor
from morpheyes_daemon.control.limits import governor_limits, velocity_tuning
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.daemon.task_table import Wiring, build_tasks
from morpheyes_daemon.devices.autopilot import build_connection
from morpheyes_daemon.devices.autopilot.stick_output import ChannelMap, StickOutput
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.devices.servo import Servo
from morpheyes_daemon.doctor.standing_by import StopFindings
from morpheyes_daemon.errors import DeviceError, mistake
from morpheyes_daemon.messages.core import Event, Perception, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, Health
from morpheyes_daemon.perception.craft import build_strategy
from morpheyes_daemon.perception.pipeline import VisionJob
from morpheyes_daemon.safety.gate import Gate, StickLimits
from morpheyes_daemon.safety.monitor import SafetyMonitor, SafetyMonitorLimits
from morpheyes_daemon.safety.states import Transition
from morpheyes_daemon.supervisor.alarms import Alarms
from morpheyes_daemon.supervisor.supervisor import Supervisor
from morpheyes_daemon.tasks.status import StatusTelemetry
from morpheyes_daemon.vision_worker.inline import VisionWorker

DRAIN_S = 0.2
"""How long a link that is being closed may take to send what was written; chosen: the release is 30 bytes."""


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
        self._parts = parts
        self._clock = parts.clock
        self.connection = build_connection(config.autopilot, DeviceContext(parts.clock, events, topics, parts.opener))
        self._output = StickOutput(self.connection.claim_stick_output())
        self.gate = Gate(self._output)
        self.monitor = SafetyMonitor(self.gate, SafetyMonitorLimits.of(config), self._on_transition)
        self.supervisor = Supervisor(self.monitor, self.gate, events, parts.clock, config.safety.supervisor_timeout_s)
        self.stop_findings = StopFindings(config, self.monitor, events, parts.clock)
        self._status = StatusTelemetry(self.connection, topics, events)
        self._controller = StickController(
            Governor(governor_limits(config)), lambda model: velocity_tuning(config, model)
        )
        self._poses = PoseHistory()
        where = baseline_model(config)
        model = where if isinstance(where, BaselineModel) else None
        alarms = Alarms(self.monitor, model)
        self.supervisor.add(
            *build_tasks(
                Wiring(
                    config=config,
                    avoids=mission_file.avoidance,
                    clock=parts.clock,
                    topics=topics,
                    events=events,
                    camera=parts.camera,
                    servo=parts.servo,
                    worker=parts.worker,
                    image_rate_hz=parts.image_rate_hz,
                    connection=self.connection,
                    strategy=build_strategy(mission_file, config),
                    gate=self.gate,
                    monitor=self.monitor,
                    supervisor=self.supervisor,
                    controller=self._controller,
                    poses=self._poses,
                    baseline=model,
                    where=where,
                    alarms=alarms,
                    on_health=self._on_health,
                    sticks_sent=StickPulse(),
                )
            )
        )
        self.connection.on_vehicle(self._on_vehicle)
        self.connection.parameters.on_change(self._on_parameters)
        topics.track.tap(self._status.on_track)
        topics.command.tap(self._status.on_command)
        events.subscribe(alarms.on_event)
        self._subscriber_failed = False
        self.connection.on_error = events.on_error = self._on_subscriber_error
        topics.on_error(self._on_subscriber_error)

    async def run(self, stop: asyncio.Event) -> None:
        """Live until `stop` is set, then neutral, release and end. Every way out sends a release on an open link.

        Raises what ended the supervisor, after the release.
        """
        await self._parts.worker.start()
        self.monitor.set_missing(None)
        running = asyncio.create_task(self.supervisor.run(), name="supervisor")
        stopping = asyncio.create_task(stop.wait(), name="stop")
        try:
            self.monitor.boot_done(self._clock.now_ns())
            await asyncio.wait({running, stopping}, return_when=asyncio.FIRST_COMPLETED)
            await self._leave(running)
        finally:
            self.release()
            for task in (running, stopping):
                task.cancel()
            results = await asyncio.gather(running, stopping, return_exceptions=True)
            await self._close_link()
            await self._parts.worker.close()
        failure = results[0]
        if isinstance(failure, Exception):
            raise failure

    def release(self) -> None:
        """Let go of the sticks for good, at once; whatever is broken, a release goes to the link."""
        try:
            self.monitor.release_now(Reason.SHUTDOWN, self._clock.now_ns())
        finally:
            self._output.release()

    async def _leave(self, running: asyncio.Task[None]) -> None:
        """Neutral for a while if we hold the sticks, then the release, repeated by the gate.

        When the supervisor has died no task steps the monitor any more, and it is done here.
        """
        if running.done():
            self.monitor.fault(Reason.TASK_DIED, self._clock.now_ns(), "supervisor")
        self.monitor.shutdown(self._clock.now_ns())
        held = self.topics.gate.get()
        while not self.monitor.let_go:
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 50)
            if running.done():
                self.monitor.step(self._clock.now_ns())
        if held is not None and held.action is not Action.SILENT:
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 5)

    async def _close_link(self) -> None:
        """Close the link and give what has been written a moment to go out."""
        if self.connection.transmitter.link is not None:
            self.connection.close()
            await self._clock.sleep_until_ns(self._clock.now_ns() + round(DRAIN_S * S))

    def _on_subscriber_error(self, error: Exception) -> None:
        """A subscriber of ours raised: whatever it was for is not done, so the flight is not flown on."""
        now_ns = self._clock.now_ns()
        self.monitor.fault(Reason.TASK_DIED, now_ns, "subscriber")
        if not self._subscriber_failed:
            self._subscriber_failed = True
            self.events.publish(Event(now_ns, "daemon", Reason.TASK_DIED, f"a subscriber failed: {mistake(error)}"))

    def _on_vehicle(self, vehicle: VehicleState) -> None:
        self.monitor.on_vehicle(vehicle, self._clock.now_ns())
        self._poses.add(vehicle)

    def _on_parameters(self, values: Mapping[str, float]) -> None:
        """The autopilot's own numbers, new: whether it may be flown, how it flies, where its sticks end."""
        self.stop_findings.on_parameters(values)
        try:
            model = LoiterModel.from_parameters(values)
            limits = StickLimits(model.minimum, model.maximum, model.neutral)
            channel_map = ChannelMap.from_parameters(values)
        except DeviceError:
            return  # the doctor has just said so
        if self._controller.model == model:
            return  # the autopilot counts flight time in a parameter; the gate keeps its limits
        self._output.set_channel_map(channel_map)
        self._controller.configure(model)
        self.gate.set_limits(limits)

    def _on_transition(self, step: Transition) -> None:
        self._status.on_transition(step)

    def _on_health(self, report: Health) -> None:
        self._status.on_health(report)
        with contextlib.suppress(OSError):
            self._parts.tell(report)
