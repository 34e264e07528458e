"""The judge of a simulated flight: watches the truth, measures, and says how it ended. The daemon never hears it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.clock import S, Ticker
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import GateOutput, State
from morpheyes_daemon.safety.monitor import REQUESTED_STOPS

RATE_HZ = 50.0
GOAL_TOLERANCE_M = 4.0
"""Goal radius plus the autopilot's own drift over a flight."""
GIVEN_UP_S = 4.0
"""A flight that has been in HOLD for so long will not go on by itself."""


class Outcome(StrEnum):
    """How a flight ended."""

    REACHED = "reached"
    COLLIDED = "collided"
    REFUSED = "refused"
    TIMEOUT = "timeout"
    ABORTED = "aborted"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the judge saw from engaging to the end; distances and speeds are the truth's."""

    outcome: Outcome
    reason: str
    time_s: float
    path_m: float
    peak_speed_m_s: float
    min_clearance_m: float
    baseline_min_m: float
    baseline_max_m: float
    braking_events: int


class MonitorView(Protocol):
    """What the daemon says of itself: its monitor, or what was heard of it in another process."""

    @property
    def state(self) -> State:
        """Its state."""

    @property
    def reason(self) -> Reason:
        """Why it is in it."""

    @property
    def since_ns(self) -> int:
        """Since when."""


class Referee:
    """Watches one flight."""

    def __init__(self, stage: SimVehicle, monitor: MonitorView, gate: Latest[GateOutput], limit_s: float) -> None:
        self._stage = stage
        self._monitor = monitor
        self._limit_s = limit_s
        self._engaged = False
        self._engaged_ns = 0
        self._last: tuple[float, float, float] | None = None
        self._path_m = 0.0
        self._peak_m_s = 0.0
        self._clearance_m = math.inf
        self._baselines = (math.inf, -math.inf)
        self._height_m = math.inf
        self._braking = 0
        self._state: State | None = None
        gate.tap(self._count)

    async def watch(self) -> Verdict:
        """Return the verdict as soon as the flight is decided."""
        ticker = Ticker(self._stage.clock, RATE_HZ)
        while True:
            await ticker.wait()
            await self._stage.vehicle.catch_up()
            now_ns = self._stage.clock.now_ns()
            if self._engaged and not self._engaged_ns:
                self._engaged_ns = now_ns
            self._measure(now_ns)
            decided = self._decide(now_ns)
            if decided is not None:
                return self._verdict(*decided, now_ns)

    def _measure(self, now_ns: int) -> None:
        truth = self._stage.truth(now_ns)
        baseline_m = self._stage.baseline_m(now_ns)
        self._clearance_m = min(self._clearance_m, self._stage.clearance_m(now_ns))
        if not self._engaged_ns:
            return
        place = (float(truth.p_ned_m[0]), float(truth.p_ned_m[1]), float(truth.p_ned_m[2]))
        if self._last is not None:
            self._path_m += math.dist(place, self._last)
        self._last = place
        self._peak_m_s = max(self._peak_m_s, math.hypot(truth.v_ned_m_s[0], truth.v_ned_m_s[1]))
        self._height_m = min(self._height_m, truth.height_m)
        self._baselines = (min(self._baselines[0], baseline_m), max(self._baselines[1], baseline_m))

    def _decide(self, now_ns: int) -> tuple[Outcome, str] | None:
        state, reason = self._monitor.state, self._monitor.reason
        if self._clearance_m < 0.0:
            v = self._stage.truth(now_ns).v_ned_m_s
            depth, speed = -self._clearance_m * 1e3, math.hypot(*v)
            return Outcome.COLLIDED, f"hull or bar {depth:.0f} mm into an obstacle at {speed:.1f} m/s, {state}"
        if self._height_m <= self._stage.skids_m and state is State.ENGAGED:
            return Outcome.COLLIDED, "the ground touched in flight"
        if self._engaged_ns and now_ns - self._engaged_ns > self._limit_s * S:
            return Outcome.TIMEOUT, f"not there after {self._limit_s:.0f} s"
        if not self._engaged_ns or state is not State.HOLD:
            return None
        if reason is Reason.GOAL_REACHED:
            off_m = self._stage.world.to_goal_m(self._stage.truth(now_ns).p_ned_m)
            if off_m <= GOAL_TOLERANCE_M + self._stage.vehicle.drift * self._path_m:
                return Outcome.REACHED, reason
            return Outcome.ABORTED, f"believed to be at the goal, {off_m:.1f} m from it"
        if reason is Reason.MISSION_REFUSED:
            return Outcome.REFUSED, reason
        if reason not in REQUESTED_STOPS and now_ns - self._monitor.since_ns > GIVEN_UP_S * S:
            return Outcome.ABORTED, reason
        return None

    def _verdict(self, outcome: Outcome, reason: str, now_ns: int) -> Verdict:
        return Verdict(
            outcome,
            reason,
            (now_ns - self._engaged_ns) / S if self._engaged_ns else 0.0,
            self._path_m,
            self._peak_m_s,
            self._clearance_m,
            *self._baselines,
            self._braking,
        )

    def _count(self, out: GateOutput) -> None:
        # a mission that refuses at once is engaged for one stick period, which the ticker may miss
        self._engaged |= out.state is State.ENGAGED
        if out.state is State.BRAKING and self._state is not State.BRAKING and out.reason not in REQUESTED_STOPS:
            self._braking += 1
        self._state = out.state
