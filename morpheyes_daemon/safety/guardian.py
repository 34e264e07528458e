"""The guardian turns what is heard into triggers of the state machine and steps the gate.

Edges that hand the sticks back (switch off, mode change, disarm) act on reception, inside `on_vehicle`, before it
returns. Everything else is judged at each stick period in `step`. Pure: time comes in as an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages import VehicleState
from morpheyes_daemon.reasons import Reason
from morpheyes_daemon.safety.gate import LEASE_REASONS, Gate, GateOutput, Lease
from morpheyes_daemon.safety.states import Machine, State, Transition, Trigger

LOITER = 5
"""ArduCopter's custom_mode of Loiter (ArduCopter mode.h)."""

AT_REST_M_S = 0.15
"""Below this the vehicle counts as stopped; the velocity's own noise is about 0.05 m/s."""

HOLDING = (State.ENGAGED, State.BRAKING, State.HOLD)

NOT_RESUMED = (Reason.GOAL_REACHED, Reason.MISSION_REFUSED, Reason.SHUTDOWN)
"""Braking for these ends in HOLD even when every input is fresh."""


@dataclass(frozen=True, slots=True)
class GuardianLimits:
    """Ages in seconds; see SafetyConfig and AutopilotConfig."""

    vehicle_timeout_s: float = 0.3
    switch_timeout_s: float = 0.5
    link_timeout_s: float = 0.5
    neutral_before_release_s: float = 2.0
    resume_within_s: float = 1.5
    engage_channel: int = 7
    engage_above_us: int = 1700


class Guardian:
    """Machine, gate and what was last heard of the pilot, kept together.

    `on_transition` is called for every step of the machine, after the gate has acted on it.
    """

    def __init__(
        self, gate: Gate, limits: GuardianLimits, on_transition: Callable[[Transition], None] = lambda step: None
    ) -> None:
        self.gate = gate
        self.machine = Machine()
        self._limits = limits
        self._on_transition = on_transition
        self._missing: Reason | None = Reason.STARTED
        self._faults: dict[Reason, None] = {}
        self._vehicle: VehicleState | None = None
        self._switch_seen_off = False
        self._switch_on = False
        self._heard_flight = False
        self._latched = False
        self._leaving = False

    @property
    def state(self) -> State:
        """The present state."""
        return self.machine.state

    @property
    def reason(self) -> Reason:
        """Why we are in it."""
        return self.machine.reason

    @property
    def missing(self) -> Reason | None:
        """What keeps the daemon from being ready, None when nothing does."""
        return self._missing

    def on_vehicle(self, vehicle: VehicleState, now_ns: int) -> None:
        """Take a fresh vehicle state; the pilot's edges are acted on before this returns."""
        before, self._vehicle = self._vehicle, vehicle
        self._renew(before, vehicle)
        if not self._heard_flight and vehicle.heartbeat_t_ns:
            self._heard_flight = True
            if vehicle.armed and not vehicle.landed:
                self._fire(Trigger.FOUND_FLYING, Reason.ALREADY_FLYING, now_ns)
        self._watch_switch(vehicle, now_ns)
        if vehicle.heartbeat_t_ns and vehicle.custom_mode != LOITER:
            self._fire(Trigger.MODE_LEFT, Reason.MODE_NOT_LOITER, now_ns)
        if vehicle.heartbeat_t_ns and not vehicle.armed:
            self._fire(Trigger.DISARMED, Reason.DISARMED, now_ns)

    def boot_done(self, now_ns: int) -> None:
        """All tasks have been started."""
        self._fire(Trigger.BOOTED, Reason.STARTED, now_ns)

    def set_missing(self, reason: Reason | None) -> None:
        """Say what still keeps the daemon from being ready (None: nothing)."""
        self._missing = reason

    def fault(self, reason: Reason, now_ns: int) -> None:
        """A part failed: brake in flight and stay stopped until the pilot engages anew."""
        self._faults[reason] = None
        self._latched = self._latched or self.state in HOLDING
        self._fire(Trigger.FAULT, reason, now_ns)

    def clear(self, reason: Reason, now_ns: int) -> None:
        """A failed part works again; does not resume a flight."""
        self._faults.pop(reason, None)
        if not self._faults:
            self._fire(Trigger.CLEARED, Reason.RECOVERED, now_ns)

    def mission_over(self, reason: Reason, now_ns: int) -> None:
        """The mission is done or refuses; stop and wait for the pilot."""
        if self.state is State.ENGAGED:
            self._latched = True
        self._fire(Trigger.MISSION_OVER, reason, now_ns)

    def shutdown(self, now_ns: int) -> None:
        """Neutral for a while, then release; from outside flight, release at once."""
        self._leaving = True
        self._latched = True
        self._fire(Trigger.SHUTDOWN, Reason.SHUTDOWN, now_ns)

    @property
    def let_go(self) -> bool:
        """True once nothing of ours holds a stick after `shutdown`."""
        return self._leaving and self.state not in HOLDING

    def step(self, now_ns: int) -> GateOutput:
        """Judge ages and readiness, then let the gate send; called at the stick rate."""
        if self.state in HOLDING:
            self._judge_flight(now_ns)
        else:
            self._judge_ground(now_ns)
        return self.gate.step(self.state, self.reason, now_ns)

    def release_now(self, reason: Reason, now_ns: int) -> GateOutput:
        """Last way out of a dying process: send a release whatever else holds."""
        return self.gate.release(State.RELEASED, reason, now_ns)

    def _renew(self, before: VehicleState | None, vehicle: VehicleState) -> None:
        limits = self._limits
        newest_needed = min(vehicle.attitude_t_ns, vehicle.position_t_ns)
        if newest_needed:
            self.gate.renew(Lease.VEHICLE, newest_needed + round(limits.vehicle_timeout_s * S))
        if vehicle.heartbeat_t_ns:
            self.gate.renew(Lease.LINK, vehicle.heartbeat_t_ns + round(limits.link_timeout_s * S))
        if vehicle.rc_t_ns:
            self.gate.renew(Lease.SWITCH, vehicle.rc_t_ns + round(limits.switch_timeout_s * S))

    def _watch_switch(self, vehicle: VehicleState, now_ns: int) -> None:
        index = self._limits.engage_channel - 1
        if not vehicle.rc_t_ns or index >= len(vehicle.rc_us):
            return
        self._switch_on = vehicle.rc_us[index] > self._limits.engage_above_us
        if not self._switch_on:
            self._switch_seen_off = True
            self._latched = self._leaving
            self._fire(Trigger.SWITCH_OFF, Reason.SWITCH_OFF, now_ns)

    def _judge_ground(self, now_ns: int) -> None:
        if self._leaving:
            return
        missing = self._missing or self._pilot_link_missing(now_ns)
        if self._faults:
            self._fire(Trigger.FAULT, next(iter(self._faults)), now_ns)
        elif missing is not None:
            self._fire(Trigger.NOT_READY, missing, now_ns)
            if self.state is State.PREFLIGHT:
                self.machine.reason = missing
        else:
            self._fire(Trigger.READY, Reason.READY, now_ns)
            self._try_engage(now_ns)

    def _try_engage(self, now_ns: int) -> None:
        vehicle = self._vehicle
        if self.state is not State.STANDBY or vehicle is None or not self._switch_on:
            return
        if not self._switch_seen_off or not vehicle.armed or vehicle.landed or vehicle.custom_mode != LOITER:
            return
        if self.gate.stale(now_ns) is None:
            self._fire(Trigger.ENGAGE, Reason.ENGAGED, now_ns)

    def _judge_flight(self, now_ns: int) -> None:
        lease = self.gate.stale(now_ns)
        if lease is not None:
            self._fire(Trigger.STALE, LEASE_REASONS[lease], now_ns)
        if self.state is not State.BRAKING:
            return
        held_s = (now_ns - self.machine.since_ns) / S
        if self._leaving:
            if held_s >= self._limits.neutral_before_release_s:
                self._fire(Trigger.LET_GO, Reason.SHUTDOWN, now_ns)
        elif lease is None and not self._latched and held_s < self._limits.resume_within_s:
            self._fire(Trigger.FRESH, Reason.RECOVERED, now_ns)
        elif self._at_rest(now_ns) or held_s >= 2 * self._limits.neutral_before_release_s:
            self._latched = True
            self._fire(Trigger.STOPPED, self.reason, now_ns)

    def _at_rest(self, now_ns: int) -> bool:
        vehicle = self._vehicle
        if vehicle is None or now_ns - vehicle.position_t_ns > self._limits.vehicle_timeout_s * S:
            return False
        return math.hypot(*vehicle.v_ned_m_s) < AT_REST_M_S

    def _pilot_link_missing(self, now_ns: int) -> Reason | None:
        if not self.gate.has_limits:
            return Reason.LINK_LOST
        lease = self.gate.stale(now_ns)
        needed_on_ground = (Lease.LINK, Lease.SWITCH, Lease.SUPERVISOR, Lease.FRAME, Lease.DEPTH, Lease.VEHICLE)
        return LEASE_REASONS[lease] if lease in needed_on_ground else None

    def _fire(self, trigger: Trigger, reason: Reason, now_ns: int) -> None:
        step = self.machine.handle(trigger, reason, now_ns)
        if step is None:
            return
        if step.after in (State.PILOT, State.RELEASED) and step.before is not step.after:
            self.gate.release(step.after, reason, now_ns)
        self._on_transition(step)
