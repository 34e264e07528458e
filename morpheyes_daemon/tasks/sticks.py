"""The stick period: governor, velocity loop, gate; the only task with a hard beat."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import MS, Clock, Ticker
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.supervisor.supervisor import Pulse

LATE_NS = 100 * MS
"""A stick period held up for longer than this was not flown on purpose: neutral first, then go on."""


class ControlSource(Protocol):
    """Has the flight control once the autopilot's parameters are known."""

    @property
    def control(self) -> StickController | None:
        """The flight control, None before the parameters are known."""


async def sticks(
    source: ControlSource,
    track: PoseHistory,
    monitor: SafetyMonitor,
    topics: Topics,
    events: EventLog,
    clock: Clock,
    rate_hz: float,
    pulse: Pulse,
) -> None:
    """Offer sticks to the gate and let it send, `rate_hz` times a second."""
    ticker = Ticker(clock, rate_hz)
    while True:
        late_ns = await ticker.wait()
        now_ns = clock.now_ns()
        if late_ns > LATE_NS:
            monitor.gate.revoke(Lease.SUPERVISOR)
            events.publish(Event(now_ns, "sticks", Reason.LOOP_LATE, f"held up for {late_ns / MS:.0f} ms"))
        else:
            _offer(source.control, track, monitor, topics, now_ns)
        topics.gate.publish(monitor.step(now_ns))
        pulse.beat()


def _offer(
    control: StickController | None, track: PoseHistory, monitor: SafetyMonitor, topics: Topics, now_ns: int
) -> None:
    command, seen = topics.command.get(), topics.perception.get()
    if control is None or command is None or seen is None:
        return
    if monitor.state is not State.ENGAGED:
        control.reset()
        return
    wanted, governed = control.step(command, seen.summary, track.now(now_ns), now_ns)
    topics.governed.publish(governed)
    topics.sticks.publish(wanted)
    monitor.gate.offer(wanted)
