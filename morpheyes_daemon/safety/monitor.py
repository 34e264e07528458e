"""The monitor turns what is heard into triggers of the state machine and steps the gate.

Edges that hand the sticks back (switch off, mode change, disarm) act on reception, inside `on_vehicle`, before it
returns. Everything else is judged at each stick period in `step`. Pure: time comes in as an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.safety.engage_switch import EngageSwitch
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import LEASE_REASONS, Lease
from morpheyes_daemon.safety.states import HOLDING, Machine, Transition, Trigger
from morpheyes_daemon.safety.vehicle_health import vehicle_fault

LOITER = 5
"""ArduCopter's custom_mode of Loiter (ArduCopter mode.h)."""

AT_REST_M_S = 0.15
"""Below this the vehicle counts as stopped; the velocity's own noise is about 0.05 m/s."""

IDLE_S = 1.0
"""ENGAGED without a stick let through for this long means that whoever should fly does not."""

PAUSE_S = 0.5
"""Stick periods further apart than this: meanwhile nobody listened to the pilot."""

RESUMED = frozenset(
    {
        Reason.FRAME_STALE,
        Reason.DEPTH_STALE,
        Reason.MISSION_STALE,
        Reason.VEHICLE_STALE,
        Reason.SUPERVISOR_STALE,
    }
)
"""Braking for these, and only these, may end in flying on; while the pilot was not heard he may have taken over."""

PILOT_UNHEARD = frozenset({Reason.LINK_LOST, Reason.RC_LOST})
"""While these last the pilot cannot be heard taking the sticks back."""

REQUESTED_STOPS = (Reason.GOAL_REACHED, Reason.MISSION_REFUSED, Reason.STOP_REQUESTED, Reason.SHUTDOWN)
"""Stops that somebody asked for, as against braking for want of something."""


@dataclass(frozen=True, slots=True)
class SafetyMonitorLimits:
    """Ages in seconds; see SafetyConfig and AutopilotConfig.

    `battery_low` is a fraction of the charge; `gcs_timeout_s` None does not watch the ground station.
    """

    vehicle_timeout_s: float = 0.3
    switch_timeout_s: float = 0.5
    link_timeout_s: float = 0.5
    neutral_before_release_s: float = 2.0
    resume_within_s: float = 1.5
    engage_channel: int = 7
    engage_above_us: int = 1700
    battery_low: float = 0.2
    gcs_timeout_s: float | None = None

    @classmethod
    def of(cls, config: VehicleConfig) -> SafetyMonitorLimits:
        """Read the limits from the vehicle's configuration."""
        safety, autopilot = config.safety, config.autopilot
        return cls(
            vehicle_timeout_s=safety.vehicle_timeout_s,
            switch_timeout_s=safety.switch_timeout_s,
            link_timeout_s=autopilot.link_timeout_s,
            neutral_before_release_s=safety.neutral_before_release_s,
            engage_channel=autopilot.engage_channel,
            engage_above_us=autopilot.engage_above_us,
            battery_low=safety.battery_low_pct / 100.0,
            gcs_timeout_s=autopilot.gcs_timeout_s if autopilot.watch_gcs else None,
        )


class SafetyMonitor:
    """Machine, gate and what was last heard of the pilot, kept together.

    `on_transition` is called for every step of the machine, after the gate has acted on it.
    """

    def __init__(
        self, gate: Gate, limits: SafetyMonitorLimits, on_transition: Callable[[Transition], None] = lambda step: None
    ) -> None:
        self.gate = gate
        self.machine = Machine()
        self._limits = limits
        self._on_transition = on_transition
        self._missing: dict[str, Reason] = {"": Reason.STARTED}
        self._faults: dict[tuple[Reason, str], None] = {}
        self._vehicle = VehicleState()
        self._switch = EngageSwitch(limits.engage_above_us, round(limits.switch_timeout_s * S))
        self._refused = Reason.SWITCH_NOT_SEEN_OFF
        self._seen_on_ground = False
        self._latched = False
        self._leaving = False
        self._stepped_ns: int | None = None
        self._flown_ns = 0
        self._deaf_since_ns: int | None = None

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
        """What keeps the daemon from being ready as far as `set_missing` said, None when nothing does."""
        return next(iter(self._missing.values()), None)

    @property
    def since_ns(self) -> int:
        """When the present state was entered."""
        return self.machine.since_ns

    # -- what is heard ------------------------------------------------------------------------------------------

    def on_vehicle(self, vehicle: VehicleState, now_ns: int) -> None:
        """Take a fresh vehicle state; the pilot's edges are acted on before this returns."""
        self._vehicle = vehicle
        self._update_switch(vehicle, now_ns)
        self._renew_vehicle(vehicle)
        if not vehicle.heartbeat_t_ns:
            return
        self.gate.renew(Lease.LINK, vehicle.heartbeat_t_ns + round(self._limits.link_timeout_s * S))
        if vehicle.custom_mode != LOITER:
            self._fire(Trigger.MODE_LEFT, Reason.MODE_NOT_LOITER, now_ns)
        if not vehicle.armed:
            self._seen_on_ground = True
            self._fire(Trigger.DISARMED, Reason.DISARMED, now_ns)
        elif not vehicle.landed and not self._seen_on_ground:
            self._seen_on_ground = True
            self._fire(Trigger.FOUND_FLYING, Reason.ALREADY_FLYING, now_ns)

    def boot_done(self, now_ns: int) -> None:
        """All tasks have been started."""
        self._fire(Trigger.BOOTED, Reason.STARTED, now_ns)

    def set_missing(self, reason: Reason | None, source: str = "") -> None:
        """Say what, as far as `source` knows, still keeps the daemon from being ready (None: nothing)."""
        if reason is None:
            self._missing.pop(source, None)
        else:
            self._missing[source] = reason

    def fault(self, reason: Reason, now_ns: int, source: str = "") -> None:
        """A part failed: neutral on the spot, and stay stopped until the pilot engages anew.

        `source` tells parts apart that fail for the same reason; `clear` must name the same.
        """
        self._faults[reason, source] = None
        self._brake(Trigger.FAULT, reason, now_ns)

    def clear(self, reason: Reason, now_ns: int, source: str = "") -> None:
        """A failed part works again; does not resume a flight."""
        self._faults.pop((reason, source), None)
        if not self._faults:
            self._fire(Trigger.CLEARED, Reason.RECOVERED, now_ns)

    def alarm(self, reason: Reason, now_ns: int) -> None:
        """Something happened in flight that forbids to fly on, though no part failed and nothing can be cleared."""
        if self.state in HOLDING:
            self._brake(Trigger.FAULT, reason, now_ns)

    def mission_over(self, reason: Reason, now_ns: int) -> None:
        """The mission is done or refuses; stop and wait for the pilot."""
        self._brake(Trigger.MISSION_OVER, reason, now_ns)

    def stop_requested(self, now_ns: int) -> None:
        """Somebody who watches asks for a stop; wait for the pilot then."""
        self._brake(Trigger.STOP_REQUESTED, Reason.STOP_REQUESTED, now_ns)

    def shutdown(self, now_ns: int) -> None:
        """Neutral for a while, then release; from outside flight, done at once."""
        self._leaving = True
        self._brake(Trigger.SHUTDOWN, Reason.SHUTDOWN, now_ns)

    @property
    def let_go(self) -> bool:
        """True once nothing of ours holds a stick after `shutdown`, and the release has been repeated."""
        return self._leaving and self.state not in HOLDING and self.gate.silent

    def release_now(self, reason: Reason, now_ns: int) -> GateOutput:
        """Last way out of a dying process: send a release whatever else holds, and no stick ever after."""
        self._leaving = True
        self._fire(Trigger.LET_GO if self.state in HOLDING else Trigger.SHUTDOWN, reason, now_ns)
        return self.gate.release(self.state, reason, now_ns)

    def step(self, now_ns: int) -> GateOutput:
        """Referee ages and readiness, then let the gate send; called at the stick rate."""
        self._watch_clock(now_ns)
        if self.state in HOLDING:
            self._check_flight(now_ns)
        else:
            self._check_ground(now_ns)
        out = self.gate.step(self.state, self.reason, now_ns)
        if out.action is Action.STICKS:
            self._flown_ns = now_ns
        return out

    # -- hearing ------------------------------------------------------------------------------------------------

    def _renew_vehicle(self, vehicle: VehicleState) -> None:
        oldest = min(vehicle.attitude_t_ns, vehicle.position_t_ns)
        angles = (vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)
        if oldest and math.isfinite(sum((*angles, *vehicle.p_ned_m, *vehicle.v_ned_m_s))):
            self.gate.renew(Lease.VEHICLE, oldest + round(self._limits.vehicle_timeout_s * S))

    def _update_switch(self, vehicle: VehicleState, now_ns: int) -> None:
        index = self._limits.engage_channel - 1
        if not vehicle.rc_t_ns or index >= len(vehicle.rc_us):
            return
        on = self._switch.hear(vehicle.rc_t_ns, vehicle.rc_us[index])
        if on is None:
            return
        self.gate.renew(Lease.SWITCH, vehicle.rc_t_ns + round(self._limits.switch_timeout_s * S))
        if not on:
            self._refused = Reason.SWITCH_NOT_SEEN_OFF
            if self.state in HOLDING or not self._leaving:
                self._fire(Trigger.SWITCH_OFF, Reason.SWITCH_OFF, now_ns)

    def _watch_clock(self, now_ns: int) -> None:
        """A clock that went back makes every stamp a lie; a long pause lost us the sticks already."""
        before_ns, self._stepped_ns = self._stepped_ns, now_ns
        if before_ns is None:
            return
        if now_ns < before_ns:
            self._distrust_stamps(now_ns)
            self._brake_for(Reason.CLOCK_STEPPED, now_ns)
        elif now_ns - before_ns > PAUSE_S * S:
            self._brake_for(Reason.LOOP_LATE, now_ns)

    def _distrust_stamps(self, now_ns: int) -> None:
        for lease in Lease:
            self.gate.revoke(lease)
        self._switch.forget()
        self._deaf_since_ns = None
        self.machine.since_ns = min(self.machine.since_ns, now_ns)

    # -- outside flight -----------------------------------------------------------------------------------------

    def _check_ground(self, now_ns: int) -> None:
        if self._leaving:
            return
        missing = self._missing_on_ground(now_ns)
        if self._faults:
            self._fire(Trigger.FAULT, next(iter(self._faults))[0], now_ns)
        elif missing is not None:
            self._fire(Trigger.NOT_READY, missing, now_ns)
        else:
            self._fire(Trigger.READY, Reason.READY, now_ns)
            self._try_engage(now_ns)

    def _missing_on_ground(self, now_ns: int) -> Reason | None:
        if self.missing is not None:
            return self.missing
        if not self.gate.has_limits:
            return Reason.PARAMETERS_UNKNOWN
        lease = self.gate.stale(now_ns)
        if lease is not None:
            return LEASE_REASONS[lease]
        worry = self._vehicle_fault(now_ns)
        if worry is not None:
            return worry
        if self._switch.on and not self._switch.flipped(now_ns):
            return self._refused
        return None

    def _try_engage(self, now_ns: int) -> None:
        if self.state is not State.STANDBY or not self._switch.asks(now_ns):
            return
        refusal = self._refusal()
        if refusal is None:
            self._switch.use()
            self._fire(Trigger.ENGAGE, Reason.ENGAGED, now_ns)
        else:
            self._refused = refusal

    def _refusal(self) -> Reason | None:
        vehicle = self._vehicle
        rows = (
            (Reason.DISARMED, not vehicle.armed),
            (Reason.LANDED, vehicle.landed),
            (Reason.MODE_NOT_LOITER, vehicle.custom_mode != LOITER),
        )
        return next((reason for reason, holds in rows if holds), None)

    # -- in flight ----------------------------------------------------------------------------------------------

    def _check_flight(self, now_ns: int) -> None:
        lease = self.gate.stale(now_ns)
        stale = LEASE_REASONS[lease] if lease is not None else None
        worry = self._vehicle_fault(now_ns) or self._idle_reason(now_ns)
        if worry is not None:
            self._brake_for(worry, now_ns)
        if stale is not None and not self._latched:
            self._check_lease(stale, now_ns)
        self._check_pilot_link(next((reason for reason in (stale, worry) if reason in PILOT_UNHEARD), None), now_ns)
        if self.state is State.BRAKING:
            self._check_braking(lease, now_ns)

    def _check_lease(self, reason: Reason, now_ns: int) -> None:
        """The first reason for braking stays, unless a later one forbids to fly on."""
        if self.state is State.ENGAGED or reason not in RESUMED:
            self._fire(Trigger.STALE, reason, now_ns)

    def _check_braking(self, lease: Lease | None, now_ns: int) -> None:
        held_s = (now_ns - self.machine.since_ns) / S
        neutral_s, resume_s = self._limits.neutral_before_release_s, self._limits.resume_within_s
        if self._leaving:
            if held_s >= neutral_s:
                self._fire(Trigger.LET_GO, Reason.SHUTDOWN, now_ns)
        elif not self._latched and held_s < resume_s:
            if lease is None:
                self._fire(Trigger.FRESH, Reason.RECOVERED, now_ns)
        elif self._at_rest(now_ns) or held_s >= 2.0 * neutral_s:
            self._fire(Trigger.STOPPED, self.reason, now_ns)

    def _check_pilot_link(self, deaf: Reason | None, now_ns: int) -> None:
        """Sticks are held only while the pilot can be heard taking them back."""
        if deaf is None:
            self._deaf_since_ns = None
            return
        if self._deaf_since_ns is None:
            self._deaf_since_ns = now_ns
        if now_ns - self._deaf_since_ns >= self._limits.neutral_before_release_s * S:
            self._fire(Trigger.LET_GO, deaf, now_ns)

    def _at_rest(self, now_ns: int) -> bool:
        known = self.gate.is_fresh(Lease.VEHICLE, now_ns)
        return known and math.hypot(*self._vehicle.v_ned_m_s) < AT_REST_M_S

    def _vehicle_fault(self, now_ns: int) -> Reason | None:
        return vehicle_fault(self._vehicle, now_ns, self._limits.battery_low, self._limits.gcs_timeout_s)

    def _idle_reason(self, now_ns: int) -> Reason | None:
        idle_ns = now_ns - max(self._flown_ns, self.machine.since_ns)
        idle = self.state is State.ENGAGED and idle_ns > IDLE_S * S
        return Reason.COMMAND_INVALID if idle else None

    # -- acting -------------------------------------------------------------------------------------------------

    def _brake_for(self, reason: Reason, now_ns: int) -> None:
        """Brake for what is no failed part of ours; said once, since it may last."""
        if self.state in HOLDING and not self._latched:
            self._fire(Trigger.FAULT, reason, now_ns)

    def _brake(self, trigger: Trigger, reason: Reason, now_ns: int) -> None:
        """Neutral must not wait for the next stick period: the task that beats it may be what failed."""
        self._fire(trigger, reason, now_ns)
        if self.state in HOLDING:
            self.gate.step(self.state, self.reason, now_ns)

    def _fire(self, trigger: Trigger, reason: Reason, now_ns: int) -> None:
        step = self.machine.handle(trigger, reason, now_ns)
        if step is None:
            return
        if step.after is State.BRAKING:
            self._latched = self._latched or reason not in RESUMED
        elif step.after is not State.HOLD:
            self._latched = False
        if step.before in HOLDING and step.after not in HOLDING:
            self.gate.release(step.after, reason, now_ns)
        self._on_transition(step)
