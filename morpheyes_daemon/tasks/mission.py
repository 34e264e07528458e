"""Percepts to mission commands."""

from __future__ import annotations

import math
from typing import Protocol

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.control.governor import Stopping
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.messages.core import Intent, Perception
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.strategies.base import Strategy
from morpheyes_daemon.supervisor.supervisor import Pulse


class StoppingSource(Protocol):
    """Knows the vehicle's braking once the autopilot's parameters have been read."""

    @property
    def stopping(self) -> Stopping | None:
        """The stopping model, None before the parameters are known."""


def observe(
    seen: Perception, track: PoseHistory, vehicle: StoppingSource, monitor: SafetyMonitor, now_ns: int, reaction_s: float
) -> Observation:
    """Put together what the strategy gets."""
    present = track.now(now_ns)
    speed = math.hypot(present.v_ned_m_s[0], present.v_ned_m_s[1])
    height_m = present.height_m if math.isfinite(present.height_m) else -present.p_ned_m[2]
    stopping = vehicle.stopping
    return Observation(
        now_ns=now_ns,
        percept=seen.percept,
        summary=seen.summary,
        vehicle=present,
        at_exposure=track.at(seen.summary.t_ns),
        baseline_m=seen.summary.baseline_m,
        braking_m=stopping.stopping_distance_m(speed, height_m) if stopping else math.inf,
        reserve_m=stopping.stopping_distance_m(speed, height_m, reaction_s) if stopping else math.inf,
        engaged=monitor.state in (State.ENGAGED, State.BRAKING),
    )


async def mission(
    strategy: Strategy,
    track: PoseHistory,
    vehicle: StoppingSource,
    monitor: SafetyMonitor,
    topics: Topics,
    clock: Clock,
    reaction_s: float,
    longest_s: float,
    pulse: Pulse,
) -> None:
    """Let the strategy decide on every percept; done or refused ends the flight in HOLD.

    It thinks for milliseconds, and begins when a stick message has just gone out: that long the next can wait. No
    command counts for more than `longest_s`, whatever a strategy says.
    """
    percepts = topics.perception.reader()
    while True:
        await percepts.next()
        await topics.gate.reader().next()
        seen = percepts.newest()
        observation = observe(seen, track, vehicle, monitor, clock.now_ns(), reaction_s)
        topics.observation.publish(observation)
        followed = strategy.track(seen.percept)
        if followed is not None:
            topics.track.publish(followed)
        command = strategy.decide(observation)
        topics.command.publish(command)
        monitor.gate.renew(Lease.MISSION, min(command.expires_ns, observation.now_ns + round(longest_s * S)))
        if command.intent in (Intent.DONE, Intent.REFUSE):
            monitor.mission_over(command.reason or Reason.GOAL_REACHED, clock.now_ns())
        pulse.beat()
