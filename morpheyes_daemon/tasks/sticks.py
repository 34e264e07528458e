"""The stick period: governor, velocity loop, gate; the only task with a hard rate."""

from __future__ import annotations

from dataclasses import dataclass

from morpheyes_daemon.bus import EventLog, StickPulse, Topics
from morpheyes_daemon.clock import MS, Clock, Ticker
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.gate import LATE_NS, Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.supervisor.supervisor import Pulse


@dataclass(slots=True)
class StickTask:
    """Offers sticks to the gate and lets it send, `rate_hz` times a second."""

    controller: StickController
    poses: PoseHistory
    monitor: SafetyMonitor
    gate: Gate
    topics: Topics
    events: EventLog
    sent: StickPulse
    clock: Clock
    rate_hz: float

    async def run(self, pulse: Pulse) -> None:
        """Step until cancelled."""
        ticker = Ticker(self.clock, self.rate_hz)
        while True:
            late_ns = await ticker.wait()
            now_ns = self.clock.now_ns()
            if late_ns > LATE_NS:
                self.gate.revoke(Lease.SUPERVISOR)
                text = f"held up for {late_ns / MS:.0f} ms"
                self.events.publish(Event(now_ns, "sticks", Reason.LOOP_LATE, text))
            else:
                self._offer(now_ns)
            self.topics.gate.publish(self.monitor.step(now_ns))
            self.sent.strike()
            pulse.beat()

    def _offer(self, now_ns: int) -> None:
        command, seen = self.topics.command.get(), self.topics.perception.get()
        if command is None or seen is None:
            return
        if self.monitor.state is not State.ENGAGED:
            self.controller.reset()
            return
        stepped = self.controller.step(command, seen.summary, self.poses.now(now_ns), now_ns)
        if stepped is None:
            return
        wanted, governed = stepped
        self.topics.governed.publish(governed)
        self.topics.sticks.publish(wanted)
        self.gate.offer(wanted)
