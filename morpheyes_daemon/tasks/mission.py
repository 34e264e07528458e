"""Percepts to mission commands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from morpheyes_daemon.bus import StickPulse, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.messages.core import Intent, Perception
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.strategies.base import Strategy
from morpheyes_daemon.supervisor.supervisor import Pulse


class StoppingDistance(Protocol):
    """Knows how the vehicle brakes, once the autopilot's parameters have been read."""

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the distance to a stop; inf while the parameters are unknown."""


@dataclass(slots=True)
class MissionTask:
    """Lets the strategy decide on every percept; done or refused ends the flight in HOLD.

    A decision takes milliseconds, so it begins when a stick message has just gone out. `reaction_s` is how long the
    autopilot flies on without the daemon; no command counts for more than `longest_s`, whatever a strategy says.
    """

    strategy: Strategy
    poses: PoseHistory
    stopping: StoppingDistance
    monitor: SafetyMonitor
    gate: Gate
    topics: Topics
    sticks_sent: StickPulse
    clock: Clock
    reaction_s: float
    longest_s: float

    async def run(self, pulse: Pulse) -> None:
        """Decide until cancelled; raises what the strategy raises."""
        percepts = self.topics.perception.reader()
        while True:
            await percepts.next()
            await self.sticks_sent.next()
            self._decide(percepts.newest())
            pulse.beat()

    def _decide(self, seen: Perception) -> None:
        observation = self._observe(seen, self.clock.now_ns())
        self.topics.observation.publish(observation)
        followed = self.strategy.track(seen.percept)
        if followed is not None:
            self.topics.track.publish(followed)
        command = self.strategy.decide(observation)
        self.topics.command.publish(command)
        self.gate.renew(Lease.MISSION, min(command.expires_ns, observation.now_ns + round(self.longest_s * S)))
        if command.intent in (Intent.DONE, Intent.REFUSE):
            self.monitor.mission_over(command.reason or Reason.GOAL_REACHED, self.clock.now_ns())

    def _observe(self, seen: Perception, now_ns: int) -> Observation:
        present = self.poses.now(now_ns)
        speed = math.hypot(present.v_ned_m_s[0], present.v_ned_m_s[1])
        height_m = present.height_m if math.isfinite(present.height_m) else -present.p_ned_m[2]
        return Observation(
            now_ns=now_ns,
            percept=seen.percept,
            summary=seen.summary,
            vehicle=present,
            at_exposure=self.poses.at(seen.summary.t_ns),
            baseline_m=seen.summary.baseline_m,
            braking_m=self.stopping.stopping_distance_m(speed, height_m),
            reserve_m=self.stopping.stopping_distance_m(speed, height_m, self.reaction_s),
            engaged=self.monitor.state in (State.ENGAGED, State.BRAKING),
        )
