"""What the monitor makes of what it hears: getting ready, engaging, braking, resuming, holding, leaving."""

from __future__ import annotations

import math
from typing import Any

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.config.vehicle import AutopilotConfig, NoServoConfig, SafetyConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, State
from morpheyes_daemon.safety.gate import RELEASE_REPEATS
from morpheyes_daemon.safety.leases import LEASE_REASONS, Lease
from morpheyes_daemon.safety.monitor import (
    REQUESTED_STOPS,
    RESUMED,
    SafetyMonitor,
    SafetyMonitorLimits,
)
from morpheyes_daemon.safety.states import EFFECTS, HOLDING, Trigger
from tests.support.cockpit import LIMITS, OFF_US, ON_US, OTHER_LIMITS, Actor, Cockpit

AT_REST_M_S, IDLE_S, PAUSE_S = 0.15, 1.0, 0.5
OUTSIDE = [state for state in State if state not in HOLDING]
OWN = [lease for lease in Lease if LEASE_REASONS[lease] in RESUMED]
PILOTS = [Lease.LINK, Lease.SWITCH]


def actions(cockpit: Cockpit, seconds: float) -> set[Action]:
    return {out.action for out in cockpit.run(seconds)}


def is_in(cockpit: Actor, state: State, reason: Reason) -> None:
    assert (cockpit.state, cockpit.monitor.reason) == (state, reason)


# -- getting ready ----------------------------------------------------------------------------------------------


def test_a_new_monitor_waits_for_what_the_daemon_still_misses() -> None:
    actor = Actor()
    is_in(actor, State.BOOT, Reason.STARTED)
    assert actor.monitor.missing is Reason.STARTED
    assert not actor.monitor.let_go
    assert actor.step().action is Action.SILENT
    actor.monitor.boot_done(actor.now_ns)
    actor.step()
    is_in(actor, State.PREFLIGHT, Reason.STARTED)


def test_what_is_missing_is_named_one_by_one() -> None:
    cockpit = Cockpit().into(State.PREFLIGHT)
    cockpit.set_missing(Reason.DOCTOR_SAYS_NO)
    assert cockpit.monitor.missing is Reason.DOCTOR_SAYS_NO
    cockpit.step()
    is_in(cockpit, State.PREFLIGHT, Reason.DOCTOR_SAYS_NO)
    cockpit.set_missing(None)
    cockpit.step()
    is_in(cockpit, State.PREFLIGHT, Reason.PARAMETERS_UNKNOWN)
    cockpit.set_limits(LIMITS)
    cockpit.step()
    is_in(cockpit, State.PREFLIGHT, Reason.LINK_LOST)
    cockpit.period()
    is_in(cockpit, State.STANDBY, Reason.READY)


def test_what_one_source_no_longer_misses_hides_nothing_that_another_does() -> None:
    monitor = Actor().monitor
    monitor.set_missing(Reason.DOCTOR_SAYS_NO, "doctor")
    assert monitor.missing is Reason.STARTED
    monitor.set_missing(None)
    assert monitor.missing is Reason.DOCTOR_SAYS_NO
    monitor.set_missing(None, "another")
    assert monitor.missing is Reason.DOCTOR_SAYS_NO
    monitor.set_missing(None, "doctor")
    assert monitor.missing is None


def test_a_vehicle_without_stamps_is_not_heard_in_the_clocks_first_instants() -> None:
    actor = Actor(now_ns=100 * MS)
    actor.heartbeat()
    assert not actor.monitor.gate.is_fresh(Lease.VEHICLE, actor.now_ns)
    actor.motion()
    assert actor.monitor.gate.is_fresh(Lease.VEHICLE, actor.now_ns)


@pytest.mark.parametrize("lease", Lease)
def test_each_lease_is_needed_to_be_ready(lease: Lease) -> None:
    cockpit = Cockpit().into(State.STANDBY)
    cockpit.silent.add(lease)
    cockpit.run(0.6)
    is_in(cockpit, State.PREFLIGHT, LEASE_REASONS[lease])
    cockpit.silent.clear()
    cockpit.run(0.1)
    is_in(cockpit, State.STANDBY, Reason.READY)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"system_status": 5}, Reason.FAILSAFE),
        ({"ekf_flags": 0x80}, Reason.EKF_UNHEALTHY),
        ({"battery_fraction": 0.1}, Reason.BATTERY_LOW),
    ],
)
def test_the_autopilots_complaints_keep_from_being_ready(changes: dict[str, Any], reason: Reason) -> None:
    cockpit = Cockpit().into(State.STANDBY)
    cockpit.hear(**changes)
    cockpit.run(0.1)
    is_in(cockpit, State.PREFLIGHT, reason)
    cockpit.switch_us = ON_US
    assert actions(cockpit, 2.0) == {Action.SILENT}


@pytest.mark.parametrize("field", ["roll_rad", "pitch_rad", "yaw_rad"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_vehicle_state_that_is_not_finite_is_not_heard(field: str, value: float) -> None:
    cockpit = Cockpit().into(State.STANDBY)
    cockpit.said[field] = value
    cockpit.run(0.5)
    is_in(cockpit, State.PREFLIGHT, Reason.VEHICLE_STALE)


@pytest.mark.parametrize("group", ["p_ned_m", "v_ned_m_s"])
@pytest.mark.parametrize("axis", range(3))
def test_a_position_or_velocity_that_is_not_finite_is_not_heard(group: str, axis: int) -> None:
    cockpit = Cockpit().into(State.STANDBY)
    values = [0.0, 0.0, 0.0]
    values[axis] = math.nan
    cockpit.said[group] = tuple(values)
    cockpit.run(0.5)
    is_in(cockpit, State.PREFLIGHT, Reason.VEHICLE_STALE)


@pytest.mark.parametrize("group", ["attitude_t_ns", "position_t_ns"])
def test_attitude_and_position_are_both_needed(group: str) -> None:
    cockpit = Cockpit().into(State.STANDBY)
    cockpit.silent.add(Lease.VEHICLE)
    for _ in range(25):
        cockpit.hear(**{group: cockpit.now_ns})
        cockpit.period()
    is_in(cockpit, State.PREFLIGHT, Reason.VEHICLE_STALE)


def test_a_receiver_without_the_switchs_channel_is_not_heard() -> None:
    cockpit = Cockpit().into(State.STANDBY)
    cockpit.silent.add(Lease.SWITCH)
    for _ in range(30):
        cockpit.hear(rc_t_ns=cockpit.now_ns, rc_us=(1500,) * 6)
        cockpit.period()
    is_in(cockpit, State.PREFLIGHT, Reason.SWITCH_STALE)
    cockpit.hear(rc_t_ns=cockpit.now_ns, rc_us=(1500,) * 6 + (OFF_US,))
    cockpit.period()
    assert cockpit.state is State.STANDBY, "seven channels hold channel 7"


def test_radio_channels_without_a_stamp_were_never_heard() -> None:
    actor = Actor(now_ns=0)
    actor.hear(rc_t_ns=0, rc_us=(OFF_US,) * 8)
    assert not actor.monitor.gate.is_fresh(Lease.SWITCH, 0)


def test_the_switch_may_be_on_another_channel() -> None:
    cockpit = Cockpit(SafetyMonitorLimits(engage_channel=16, engage_above_us=1400)).into(State.PREFLIGHT)
    cockpit.set_missing(None)
    cockpit.set_limits(LIMITS)
    cockpit.silent.add(Lease.SWITCH)
    cockpit.heartbeat(armed=False)
    cockpit.run(0.1)
    is_in(cockpit, State.PREFLIGHT, Reason.SWITCH_STALE)
    cockpit.hear(rc_t_ns=cockpit.now_ns, rc_us=(1500,) * 15 + (OFF_US,))
    cockpit.period()
    is_in(cockpit, State.STANDBY, Reason.READY)


# -- engaging ---------------------------------------------------------------------------------------------------


def test_a_flip_engages_and_flying_begins_with_neutral() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.switch_us = ON_US
    outs = cockpit.run(0.4)
    sent = [out for out in outs if out.action is not Action.SILENT]
    assert [out.action for out in sent[:3]] == [Action.NEUTRAL, Action.STICKS, Action.STICKS]
    assert sent[0].reason is Reason.ENGAGED
    assert cockpit.transitions[-1].trigger is Trigger.ENGAGE
    assert len(sent) == 10, "0.2 s after the flip"


def test_a_switch_that_is_on_at_boot_engages_nothing() -> None:
    cockpit = Cockpit().into(State.PREFLIGHT)
    cockpit.switch_us = ON_US
    cockpit.set_missing(None)
    cockpit.set_limits(LIMITS)
    cockpit.heartbeat(armed=False, landed=True)
    cockpit.heartbeat(armed=True, landed=False)
    assert actions(cockpit, 3.0) == {Action.SILENT}
    is_in(cockpit, State.PREFLIGHT, Reason.SWITCH_NOT_SEEN_OFF)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"armed": False}, Reason.DISARMED),
        ({"landed": True}, Reason.LANDED),
        ({"custom_mode": 2}, Reason.MODE_NOT_LOITER),
        ({"armed": False, "landed": True, "custom_mode": 0}, Reason.DISARMED),
    ],
)
def test_a_flip_at_the_wrong_time_is_refused_and_needs_another(changes: dict[str, Any], reason: Reason) -> None:
    cockpit = Cockpit().stand_by()
    cockpit.heartbeat(**changes)
    cockpit.switch_us = ON_US
    cockpit.run(0.5)
    is_in(cockpit, State.STANDBY, Reason.READY)
    cockpit.run(1.0)
    is_in(cockpit, State.PREFLIGHT, reason)
    cockpit.heartbeat(armed=True, landed=False, custom_mode=5)
    assert actions(cockpit, 2.0) == {Action.SILENT}, "the flip is too old by now"
    cockpit.switch_us = OFF_US
    cockpit.run(0.3)
    is_in(cockpit, State.STANDBY, Reason.READY)
    cockpit.engage()


def test_a_flip_while_booting_is_not_used_up_before_it_can_engage() -> None:
    cockpit = Cockpit()
    cockpit.set_limits(LIMITS)
    cockpit.set_missing(None)
    cockpit.heartbeat(armed=False, landed=True)
    cockpit.heartbeat(armed=True, landed=False)
    cockpit.run(0.3)
    cockpit.switch_us = ON_US
    cockpit.run(0.4)
    is_in(cockpit, State.BOOT, Reason.STARTED)
    cockpit.monitor.boot_done(cockpit.now_ns)
    cockpit.run(0.1)
    assert cockpit.state is State.ENGAGED


def test_a_refusal_is_forgotten_with_the_switch_off() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.heartbeat(landed=True)
    cockpit.switch_us = ON_US
    cockpit.run(1.5)
    is_in(cockpit, State.PREFLIGHT, Reason.LANDED)
    cockpit.switch_us = OFF_US
    cockpit.run(0.06)
    cockpit.switch_us = ON_US
    cockpit.run(0.1)
    is_in(cockpit, State.PREFLIGHT, Reason.SWITCH_NOT_SEEN_OFF)


def test_a_mode_switched_just_before_the_flip_is_waited_for() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.heartbeat(custom_mode=2)
    cockpit.switch_us = ON_US
    cockpit.run(0.5)
    cockpit.heartbeat(custom_mode=5)
    cockpit.run(0.1)
    is_in(cockpit, State.ENGAGED, Reason.ENGAGED)


def test_taking_off_with_the_switch_on_engages_nothing() -> None:
    cockpit = Cockpit().into(State.STANDBY)
    cockpit.heartbeat(landed=True)
    cockpit.switch_us = ON_US
    cockpit.run(5.0)
    cockpit.hear(landed=False)
    assert actions(cockpit, 3.0) == {Action.SILENT}


# -- found flying -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.BOOT, State.PREFLIGHT])
def test_found_flying_it_only_looks_on(state: State) -> None:
    cockpit = Cockpit().into(state)
    cockpit.switch_us = ON_US
    cockpit.set_missing(None)
    cockpit.set_limits(LIMITS)
    assert actions(cockpit, 5.0) == {Action.SILENT}
    is_in(cockpit, State.PILOT, Reason.ALREADY_FLYING)
    cockpit.switch_us = OFF_US
    cockpit.run(0.3)
    is_in(cockpit, State.STANDBY, Reason.READY)
    cockpit.engage()


def test_found_flying_though_the_landing_state_came_late() -> None:
    cockpit = Cockpit().into(State.PREFLIGHT)
    cockpit.set_missing(None)
    cockpit.set_limits(LIMITS)
    cockpit.hear(landed=True)
    cockpit.run(0.3)
    is_in(cockpit, State.STANDBY, Reason.READY)
    cockpit.hear(landed=False)
    is_in(cockpit, State.PILOT, Reason.ALREADY_FLYING)
    cockpit.run(0.3)
    is_in(cockpit, State.STANDBY, Reason.READY)


def test_a_vehicle_seen_on_the_ground_was_not_found_flying() -> None:
    cockpit = Cockpit().into(State.PREFLIGHT)
    cockpit.heartbeat(armed=False)
    cockpit.heartbeat(armed=True, landed=False)
    assert cockpit.state is State.PREFLIGHT


def test_before_the_first_heartbeat_nothing_is_known_of_the_flight() -> None:
    cockpit = Cockpit().into(State.BOOT)
    cockpit.motion(armed=True, landed=False)
    assert cockpit.state is State.BOOT


# -- braking ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lease", Lease)
def test_each_stale_lease_brakes_within_a_period_of_its_expiry(lease: Lease) -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(lease)
    cockpit.run(0.66)
    braked = next(step for step in cockpit.transitions if step.after is State.BRAKING)
    assert braked.reason is LEASE_REASONS[lease]
    timeout_s = {Lease.LINK: 0.5, Lease.SWITCH: 0.5}.get(lease, 0.3)
    last_ns = cockpit.now_ns - 33 * cockpit.PERIOD_NS
    assert braked.t_ns == last_ns + round(timeout_s * S)
    neutral = [out for out in cockpit.sent if out.t_ns >= braked.t_ns]
    assert {out.action for out in neutral} == {Action.NEUTRAL}


@pytest.mark.parametrize("lease", OWN)
def test_an_input_of_our_own_that_returns_in_time_is_flown_on(lease: Lease) -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(lease)
    cockpit.run(1.0)
    is_in(cockpit, State.BRAKING, LEASE_REASONS[lease])
    cockpit.silent.clear()
    outs = cockpit.run(0.1)
    is_in(cockpit, State.ENGAGED, Reason.RECOVERED)
    assert [out.action for out in outs[:2]] == [Action.NEUTRAL, Action.STICKS]


@pytest.mark.parametrize("lease", PILOTS)
def test_what_the_pilot_is_heard_by_is_never_flown_on(lease: Lease) -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(lease)
    cockpit.run(0.6)
    is_in(cockpit, State.BRAKING, LEASE_REASONS[lease])
    cockpit.silent.clear()
    cockpit.said["v_ned_m_s"] = (0.0, 0.0, 0.0)
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, LEASE_REASONS[lease])


@pytest.mark.parametrize(("periods", "state"), [(74, State.ENGAGED), (75, State.BRAKING)])
def test_what_returns_too_late_is_not_flown_on(periods: int, state: State) -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.DEPTH)
    cockpit.run(0.3)
    is_in(cockpit, State.BRAKING, Reason.DEPTH_STALE)
    for _ in range(periods - 1):
        cockpit.period()
    cockpit.silent.clear()
    cockpit.period()
    assert cockpit.state is state
    if state is State.BRAKING:
        assert actions(cockpit, 5.0) == {Action.NEUTRAL}
        is_in(cockpit, State.HOLD, Reason.DEPTH_STALE)


def test_standing_still_gives_no_less_time_to_return() -> None:
    cockpit = Cockpit().engage()
    cockpit.said["v_ned_m_s"] = (0.0, 0.0, 0.0)
    cockpit.silent.add(Lease.DEPTH)
    cockpit.run(1.0)
    is_in(cockpit, State.BRAKING, Reason.DEPTH_STALE)
    cockpit.run(1.0)
    is_in(cockpit, State.HOLD, Reason.DEPTH_STALE)


@pytest.mark.parametrize("graver", PILOTS)
def test_a_graver_reason_takes_the_place_of_a_lighter_one(graver: Lease) -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.FRAME)
    cockpit.run(0.4)
    is_in(cockpit, State.BRAKING, Reason.FRAME_STALE)
    cockpit.silent.add(graver)
    cockpit.run(0.6)
    is_in(cockpit, State.BRAKING, LEASE_REASONS[graver])
    cockpit.silent.clear()
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}


def test_the_first_of_several_lighter_reasons_stays() -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.DEPTH)
    cockpit.run(0.4)
    cockpit.silent.add(Lease.FRAME)
    cockpit.run(0.4)
    is_in(cockpit, State.BRAKING, Reason.DEPTH_STALE)
    assert [step.after for step in cockpit.transitions].count(State.BRAKING) == 1


CONCERNS = [
    ({"system_status": 5}, Reason.FAILSAFE),
    ({"ekf_flags": 0x80}, Reason.EKF_UNHEALTHY),
    ({"battery_fraction": 0.1}, Reason.BATTERY_LOW),
]


@pytest.mark.parametrize(("changes", "reason"), CONCERNS)
def test_the_autopilots_complaints_brake_for_good(changes: dict[str, Any], reason: Reason) -> None:
    cockpit = Cockpit().engage()
    before = {name: cockpit.said.get(name) for name in changes}
    cockpit.hear(**changes)
    assert cockpit.period().action is Action.NEUTRAL
    is_in(cockpit, State.BRAKING, reason)
    cockpit.hear(**{name: value for name, value in before.items() if value is not None} or {"battery_fraction": 0.9})
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, reason)
    assert [step.after for step in cockpit.transitions].count(State.BRAKING) == 1


def test_a_complaint_while_braking_for_less_ends_the_hope_of_flying_on() -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.DEPTH)
    cockpit.run(0.5)
    cockpit.hear(ekf_flags=0)
    cockpit.run(0.1)
    is_in(cockpit, State.BRAKING, Reason.EKF_UNHEALTHY)
    cockpit.hear(ekf_flags=8)
    cockpit.silent.clear()
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}


def test_the_ground_stations_loss_brakes_when_it_is_watched() -> None:
    cockpit = Cockpit(SafetyMonitorLimits(gcs_timeout_s=2.0)).engage()
    cockpit.hear(gcs_t_ns=cockpit.now_ns)
    assert actions(cockpit, 1.98) == {Action.STICKS}
    assert cockpit.period().action is Action.NEUTRAL
    is_in(cockpit, State.BRAKING, Reason.GCS_LOST)


def test_a_silent_ground_station_is_ignored_otherwise() -> None:
    cockpit = Cockpit().engage()
    assert actions(cockpit, 10.0) == {Action.STICKS}


# -- coming to rest ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed_m_s", "holds"), [(AT_REST_M_S - 1e-6, True), (AT_REST_M_S, False)])
def test_at_rest_braking_for_good_is_over(speed_m_s: float, holds: bool) -> None:
    cockpit = Cockpit().engage()
    cockpit.said["v_ned_m_s"] = (0.0, speed_m_s, 0.0)
    cockpit.mission_over(Reason.GOAL_REACHED)
    cockpit.period()
    assert (cockpit.state is State.HOLD) is holds
    assert cockpit.monitor.reason is Reason.GOAL_REACHED


@pytest.mark.parametrize("axis", range(3))
def test_moving_along_any_axis_is_not_at_rest(axis: int) -> None:
    cockpit = Cockpit().engage()
    v = [0.0, 0.0, 0.0]
    v[axis] = -1.0
    cockpit.said["v_ned_m_s"] = tuple(v)
    cockpit.mission_over(Reason.GOAL_REACHED)
    cockpit.run(1.0)
    assert cockpit.state is State.BRAKING


@pytest.mark.parametrize("stale", [False, True])
def test_braking_ends_in_time_though_the_vehicle_is_not_known_to_rest(stale: bool) -> None:
    cockpit = Cockpit().engage()
    if stale:
        cockpit.silent.add(Lease.VEHICLE)
        cockpit.said["v_ned_m_s"] = (0.0, 0.0, 0.0)
        cockpit.run(0.4)
    cockpit.mission_over(Reason.MISSION_REFUSED)
    since_ns = cockpit.monitor.machine.since_ns
    while cockpit.state is State.BRAKING:
        cockpit.period()
    assert 4.0 * S <= cockpit.now_ns - since_ns < 4.0 * S + 20 * MS
    is_in(cockpit, State.HOLD, Reason.MISSION_REFUSED)


def test_hold_never_ends_by_itself() -> None:
    cockpit = Cockpit().into(State.HOLD)
    cockpit.silent.clear()
    assert actions(cockpit, 60.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, Reason.DEPTH_STALE)


def test_out_of_hold_only_a_new_flip_engages() -> None:
    cockpit = Cockpit().into(State.HOLD)
    cockpit.silent.clear()
    cockpit.run(1.0)
    assert cockpit.state is State.HOLD
    cockpit.switch_us = OFF_US
    cockpit.run(0.3)
    cockpit.engage()
    assert cockpit.state is State.ENGAGED


# -- the mission ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reason", [Reason.GOAL_REACHED, Reason.MISSION_REFUSED])
def test_the_end_of_the_mission_stops_at_once_and_for_good(reason: Reason) -> None:
    cockpit = Cockpit().engage()
    count = len(cockpit.sent)
    cockpit.mission_over(reason)
    assert [out.action for out in cockpit.sent[count:]] == [Action.NEUTRAL]
    assert actions(cockpit, 10.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, reason)
    assert reason in REQUESTED_STOPS


def test_a_refusal_while_braking_ends_the_hope_of_flying_on() -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.FRAME)
    cockpit.run(0.4)
    cockpit.mission_over(Reason.MISSION_REFUSED)
    is_in(cockpit, State.BRAKING, Reason.MISSION_REFUSED)
    cockpit.silent.clear()
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}


@pytest.mark.parametrize("state", OUTSIDE)
def test_the_end_of_a_mission_that_nobody_flies_changes_nothing(state: State) -> None:
    cockpit = Cockpit().into(state)
    count = len(cockpit.sent)
    cockpit.mission_over(Reason.GOAL_REACHED)
    assert cockpit.state is state
    assert cockpit.sent[count:] == []


def test_a_stop_that_somebody_asked_for_is_told_from_a_want() -> None:
    for stop in (Reason.GOAL_REACHED, Reason.MISSION_REFUSED):
        cockpit = Cockpit().engage()
        cockpit.mission_over(stop)
        assert cockpit.monitor.reason in REQUESTED_STOPS
    cockpit = Cockpit().engage()
    cockpit.shutdown()
    assert cockpit.monitor.reason in REQUESTED_STOPS
    assert Cockpit().into(State.BRAKING).monitor.reason not in REQUESTED_STOPS
    assert Cockpit().into(State.FAULT).monitor.reason not in REQUESTED_STOPS


def test_reasons_that_are_flown_on_are_no_stops() -> None:
    assert not RESUMED & set(REQUESTED_STOPS)
    assert {LEASE_REASONS[lease] for lease in OWN} == RESUMED
    assert not RESUMED & {LEASE_REASONS[lease] for lease in PILOTS}


# -- faults -----------------------------------------------------------------------------------------------------


def test_a_fault_in_flight_sends_neutral_on_the_spot_and_stops_for_good() -> None:
    cockpit = Cockpit().engage()
    count = len(cockpit.sent)
    cockpit.fault(Reason.TASK_DIED, "sticks")
    assert [(out.action, out.reason) for out in cockpit.sent[count:]] == [(Action.NEUTRAL, Reason.TASK_DIED)]
    cockpit.clear(Reason.TASK_DIED, "sticks")
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, Reason.TASK_DIED)


def test_a_fault_cleared_at_once_is_not_flown_on_though_all_is_fresh() -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.FRAME)
    cockpit.run(0.4)
    cockpit.fault(Reason.CAMERA_LOST)
    cockpit.clear(Reason.CAMERA_LOST)
    cockpit.silent.clear()
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}


@pytest.mark.parametrize("reason", sorted(RESUMED))
def test_a_lighter_reason_after_a_fault_revives_no_hope_of_flying_on(reason: Reason) -> None:
    cockpit = Cockpit().engage()
    cockpit.fault(Reason.TASK_DIED)
    cockpit.fault(reason)
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}


def test_of_two_complaints_in_one_braking_the_first_stays() -> None:
    cockpit = Cockpit().engage()
    cockpit.said["ekf_flags"] = 0
    cockpit.run(0.1)
    is_in(cockpit, State.BRAKING, Reason.EKF_UNHEALTHY)
    cockpit.said["system_status"] = 5
    cockpit.run(0.1)
    is_in(cockpit, State.BRAKING, Reason.EKF_UNHEALTHY)


def test_a_fault_that_lasts_is_shown_after_the_pilot_took_over() -> None:
    cockpit = Cockpit().engage()
    cockpit.fault(Reason.CAMERA_LOST)
    cockpit.switch_us = OFF_US
    cockpit.run(0.3)
    is_in(cockpit, State.FAULT, Reason.CAMERA_LOST)
    cockpit.clear(Reason.CAMERA_LOST)
    is_in(cockpit, State.PREFLIGHT, Reason.RECOVERED)
    cockpit.run(0.1)
    cockpit.engage()


def test_several_faults_are_all_waited_for() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.fault(Reason.TASK_DIED, "mission")
    cockpit.fault(Reason.TASK_DIED, "sticks")
    cockpit.fault(Reason.SERVO_LOST)
    cockpit.period()
    is_in(cockpit, State.FAULT, Reason.TASK_DIED)
    cockpit.clear(Reason.TASK_DIED, "sticks")
    assert cockpit.state is State.FAULT
    cockpit.period()
    is_in(cockpit, State.FAULT, Reason.TASK_DIED)
    cockpit.clear(Reason.TASK_DIED, "mission")
    cockpit.period()
    is_in(cockpit, State.FAULT, Reason.SERVO_LOST)
    cockpit.clear(Reason.SERVO_LOST, "another")
    cockpit.period()
    is_in(cockpit, State.FAULT, Reason.SERVO_LOST)
    cockpit.clear(Reason.SERVO_LOST)
    cockpit.period()
    is_in(cockpit, State.STANDBY, Reason.READY)


def test_a_fault_and_its_end_without_a_source_are_the_same_fault() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.monitor.fault(Reason.SERVO_LOST, cockpit.now_ns)
    assert cockpit.state is State.FAULT
    cockpit.monitor.clear(Reason.SERVO_LOST, cockpit.now_ns, "")
    assert cockpit.state is State.PREFLIGHT
    cockpit.monitor.fault(Reason.SERVO_LOST, cockpit.now_ns, "")
    cockpit.monitor.clear(Reason.SERVO_LOST, cockpit.now_ns)
    assert cockpit.state is State.PREFLIGHT


def test_clearing_what_never_failed_changes_nothing() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.clear(Reason.CAMERA_LOST)
    is_in(cockpit, State.STANDBY, Reason.READY)


def test_sticks_that_never_pass_are_a_fault() -> None:
    cockpit = Cockpit().engage()
    flown_ns = cockpit.now_ns
    cockpit.wanted = (math.nan,) * 4
    while cockpit.state is State.ENGAGED:
        cockpit.period()
    is_in(cockpit, State.BRAKING, Reason.COMMAND_INVALID)
    assert cockpit.now_ns - flown_ns == round(IDLE_S * S) + 20 * MS
    cockpit.wanted = (1600, 1400, 1550, 1520)
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}


def test_engaging_without_any_offer_is_a_fault_too() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.run(2.0)
    cockpit.wanted = None
    cockpit.switch_us = ON_US
    cockpit.run(0.5)
    assert cockpit.state is State.ENGAGED
    engaged_ns = cockpit.transitions[-1].t_ns
    while cockpit.state is State.ENGAGED:
        cockpit.period()
    assert cockpit.now_ns - engaged_ns == round(IDLE_S * S) + 20 * MS


@pytest.mark.parametrize("reason", [Reason.OVERRIDE_IGNORED, Reason.AUTOPILOT_REBOOTED])
def test_an_alarm_in_flight_stops_for_good_and_outside_means_nothing(reason: Reason) -> None:
    cockpit = Cockpit().stand_by()
    cockpit.monitor.alarm(reason, cockpit.now_ns)
    is_in(cockpit, State.STANDBY, Reason.READY)
    cockpit.engage()
    count = len(cockpit.sent)
    cockpit.monitor.alarm(reason, cockpit.now_ns)
    assert [(out.action, out.reason) for out in cockpit.sent[count:]] == [(Action.NEUTRAL, reason)]
    assert actions(cockpit, 5.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, reason)
    cockpit.switch_us = OFF_US
    cockpit.run(0.3)
    cockpit.engage()


# -- deafness, clock and pauses ---------------------------------------------------------------------------------


def test_a_lost_link_is_let_go_after_neutral_for_a_while() -> None:
    cockpit = Cockpit().engage()
    heard_ns = cockpit.now_ns
    cockpit.silent.add(Lease.LINK)
    while cockpit.state in HOLDING:
        cockpit.period()
    assert cockpit.now_ns - heard_ns == round(2.5 * S)
    is_in(cockpit, State.RELEASED, Reason.LINK_LOST)
    assert actions(cockpit, 0.9) == {Action.RELEASE}
    cockpit.silent.clear()
    cockpit.run(0.2)
    assert actions(cockpit, 20.0) == {Action.SILENT}, "the link's return takes nothing from the pilot"
    is_in(cockpit, State.RELEASED, Reason.LINK_LOST)


def test_a_link_lost_in_the_very_period_after_engaging_is_let_go_too() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.switch_us = ON_US
    cockpit.run(0.16)
    cockpit.silent.add(Lease.LINK)
    while cockpit.state is not State.ENGAGED:
        cockpit.period()
    cockpit.wait(round(0.48 * S))
    cockpit.period()
    is_in(cockpit, State.BRAKING, Reason.LINK_LOST)
    assert cockpit.monitor.since_ns == cockpit.now_ns
    assert actions(cockpit, 1.98) == {Action.NEUTRAL}
    assert cockpit.period().action is Action.RELEASE


def test_a_link_that_comes_and_goes_is_counted_anew() -> None:
    cockpit = Cockpit().engage()
    for _ in range(3):
        cockpit.silent.add(Lease.LINK)
        cockpit.run(2.4)
        cockpit.silent.clear()
        cockpit.run(0.1)
    assert cockpit.state is State.HOLD
    cockpit.silent.add(Lease.LINK)
    cockpit.run(2.6)
    is_in(cockpit, State.RELEASED, Reason.LINK_LOST)


def test_a_lost_radio_is_let_go_so_that_the_autopilot_can_act() -> None:
    """While we stream, the autopilot takes our overrides for a radio and starts no failsafe."""
    cockpit = Cockpit().engage()
    cockpit.hear(rc_rssi=0)
    outs = cockpit.run(2.1)
    assert [out.action for out in outs].count(Action.NEUTRAL) == 100
    is_in(cockpit, State.RELEASED, Reason.RC_LOST)
    cockpit.hear(rc_rssi=200)
    cockpit.run(1.5)
    assert actions(cockpit, 5.0) == {Action.SILENT}


def test_a_lost_link_in_hold_is_let_go_too() -> None:
    cockpit = Cockpit().into(State.HOLD)
    cockpit.silent.add(Lease.LINK)
    cockpit.run(2.6)
    is_in(cockpit, State.RELEASED, Reason.LINK_LOST)


def test_a_silent_switch_is_held_since_the_mode_is_still_heard() -> None:
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.SWITCH)
    cockpit.run(20.0)
    is_in(cockpit, State.HOLD, Reason.SWITCH_STALE)
    cockpit.heartbeat(custom_mode=2)
    is_in(cockpit, State.PILOT, Reason.MODE_NOT_LOITER)


@pytest.mark.parametrize(("pause_ns", "latched"), [(round(PAUSE_S * S), False), (round(PAUSE_S * S) + 1, True)])
def test_a_long_pause_is_not_flown_on(pause_ns: int, latched: bool) -> None:
    cockpit = Cockpit().engage()
    for lease in Lease:
        cockpit.renew(lease, 5 * S)
    cockpit.wait(pause_ns)
    out = cockpit.step()
    assert out.action is Action.NEUTRAL
    is_in(cockpit, *((State.BRAKING, Reason.LOOP_LATE) if latched else (State.ENGAGED, Reason.ENGAGED)))
    assert (Action.STICKS in actions(cockpit, 3.0)) is not latched


def test_a_late_period_starts_from_neutral_and_flies_on() -> None:
    cockpit = Cockpit().engage()
    cockpit.offer((1600, 1400, 1550, 1520), S)
    cockpit.wait(150 * MS)
    assert cockpit.step().action is Action.NEUTRAL
    assert cockpit.period().action is Action.STICKS


@pytest.mark.parametrize("back_ns", [1, 20 * MS, 100 * S])
def test_a_clock_that_goes_back_is_not_flown_on(back_ns: int) -> None:
    cockpit = Cockpit().engage()
    for lease in Lease:
        cockpit.renew(lease, 5 * S)
    cockpit.wait(-back_ns)
    assert cockpit.step().action is Action.NEUTRAL
    is_in(cockpit, State.BRAKING, Reason.CLOCK_STEPPED)
    assert not any(cockpit.monitor.gate.is_fresh(lease, cockpit.now_ns) for lease in Lease)
    assert actions(cockpit, 8.0) == {Action.NEUTRAL}
    is_in(cockpit, State.HOLD, Reason.CLOCK_STEPPED)
    cockpit.switch_us = OFF_US
    cockpit.run(0.3)
    cockpit.engage()


def test_the_same_instant_twice_is_no_step_back() -> None:
    cockpit = Cockpit().engage()
    cockpit.step()
    assert cockpit.state is State.ENGAGED


def test_a_clock_that_goes_back_does_not_delay_what_is_timed() -> None:
    cockpit = Cockpit().engage()
    cockpit.shutdown()
    cockpit.wait(-100 * S)
    cockpit.step()
    cockpit.run(1.9)
    assert cockpit.state is State.BRAKING
    cockpit.run(0.2)
    is_in(cockpit, State.RELEASED, Reason.SHUTDOWN)


def test_a_clock_that_goes_back_forgets_the_flip_and_the_deafness() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.switch_us = ON_US
    cockpit.run(0.1)
    cockpit.wait(-MS)
    cockpit.step()
    assert actions(cockpit, 2.0) == {Action.SILENT}
    cockpit = Cockpit().engage()
    cockpit.silent.add(Lease.LINK)
    cockpit.run(2.4)
    cockpit.wait(-S)
    cockpit.step()
    cockpit.run(1.9)
    assert cockpit.state in HOLDING
    cockpit.run(0.2)
    assert cockpit.state is State.RELEASED


@pytest.mark.parametrize("state", OUTSIDE)
def test_clock_and_pauses_are_no_fault_outside_flight(state: State) -> None:
    cockpit = Cockpit().into(state)
    cockpit.wait(-5 * S)
    cockpit.step()
    cockpit.wait(50 * S)
    cockpit.step()
    assert cockpit.state is state or cockpit.state is State.PREFLIGHT


# -- leaving ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", State)
def test_shutdown_ends_in_released_from_every_state(state: State) -> None:
    cockpit = Cockpit().into(state)
    held = state in HOLDING
    cockpit.monitor.gate.step(state, Reason.READY, cockpit.now_ns)
    began_ns, count = cockpit.now_ns, len(cockpit.sent)
    cockpit.shutdown()
    assert [out.action for out in cockpit.sent[count:]] == [Action.NEUTRAL] * held
    assert cockpit.monitor.let_go is (state in OUTSIDE and cockpit.monitor.gate.silent)
    while not cockpit.monitor.let_go:
        cockpit.period()
    if state not in (State.RELEASED, State.PILOT):
        assert [out.action for out in cockpit.sent[count:]].count(Action.RELEASE) >= RELEASE_REPEATS * held
    is_in(cockpit, State.RELEASED, cockpit.monitor.reason if state is State.RELEASED else Reason.SHUTDOWN)
    if held:
        assert 2.8 * S <= cockpit.now_ns - began_ns <= 3.1 * S
    cockpit.switch_us = OFF_US
    cockpit.run(0.5)
    cockpit.switch_us = ON_US
    assert actions(cockpit, 5.0) == {Action.SILENT}
    assert cockpit.state is State.RELEASED, "and there it stays"


def test_shutdown_in_flight_is_neutral_for_two_seconds() -> None:
    cockpit = Cockpit().engage()
    cockpit.said["v_ned_m_s"] = (0.0, 0.0, 0.0)
    cockpit.shutdown()
    is_in(cockpit, State.BRAKING, Reason.SHUTDOWN)
    outs = cockpit.run(1.98)
    assert {out.action for out in outs} == {Action.NEUTRAL}
    assert cockpit.period().action is Action.RELEASE


def test_the_pilot_takes_over_while_the_daemon_leaves() -> None:
    cockpit = Cockpit().engage()
    cockpit.shutdown()
    cockpit.run(0.5)
    cockpit.rc(OFF_US)
    is_in(cockpit, State.RELEASED, Reason.SWITCH_OFF)
    cockpit.run(3.0)
    assert cockpit.monitor.let_go


def test_a_fault_while_leaving_changes_nothing_outside_flight() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.shutdown()
    cockpit.fault(Reason.TASK_DIED)
    cockpit.run(1.0)
    is_in(cockpit, State.RELEASED, Reason.SHUTDOWN)


@pytest.mark.parametrize("state", State)
def test_the_last_way_out_releases_from_every_state_and_sends_no_stick_after(state: State) -> None:
    cockpit = Cockpit().into(state)
    cockpit.release_now(Reason.TASK_DIED)
    assert cockpit.state is State.RELEASED
    assert cockpit.sent[-1].reason is Reason.TASK_DIED
    cockpit.silent.clear()
    assert Action.RELEASE in actions(cockpit, 0.1)
    cockpit.switch_us = OFF_US
    cockpit.run(2.0)
    cockpit.switch_us = ON_US
    assert actions(cockpit, 2.0) == {Action.SILENT}
    assert cockpit.monitor.let_go


# -- the rest ---------------------------------------------------------------------------------------------------


def test_transitions_are_told_after_the_gate_has_acted() -> None:
    seen: list[tuple[State, int]] = []
    cockpit = Cockpit().engage()
    count = len(cockpit.sent)
    cockpit.monitor._on_transition = lambda step: seen.append((step.after, len(cockpit.sent)))
    cockpit.rc(OFF_US)
    assert seen == [(State.RELEASED, count + 1)]


def test_nobody_need_listen_to_transitions() -> None:
    monitor = SafetyMonitor(Actor().monitor.gate, SafetyMonitorLimits())
    monitor.boot_done(1)
    assert monitor.state is State.PREFLIGHT


def test_what_a_step_returns_is_what_was_sent() -> None:
    cockpit = Cockpit().engage()
    for out in cockpit.run(1.0):
        assert out in cockpit.sent
        assert out.state is State.ENGAGED
    assert EFFECTS[State.ENGAGED] is Action.STICKS


def test_limits_changed_in_flight_count_at_once() -> None:
    cockpit = Cockpit().engage()
    cockpit.wanted = (2000, 1000, 2000, 1000)
    cockpit.run(0.5)
    cockpit.set_limits(OTHER_LIMITS)
    assert cockpit.period().widths_us == (1900, 1100, 1900, 1100)


def test_offers_from_before_engaging_are_not_flown() -> None:
    cockpit = Cockpit().stand_by()
    cockpit.wanted = None
    cockpit.switch_us = ON_US
    for _ in range(20):
        cockpit.offer((1900, 1100, 1900, 1100), 5 * S)
        was = cockpit.state
        out = cockpit.period()
        if cockpit.state is State.ENGAGED and was is State.STANDBY:
            assert out.action is Action.NEUTRAL
            break
    assert cockpit.period().action is Action.NEUTRAL


def test_the_limits_come_from_the_configuration() -> None:
    config = VehicleConfig(
        camera=SimCameraConfig(),
        servo=NoServoConfig(backend="none"),
        safety=SafetyConfig(
            vehicle_timeout_s=0.31, switch_timeout_s=0.52, neutral_before_release_s=2.3, battery_low_pct=25.0
        ),
        autopilot=AutopilotConfig(
            link_timeout_s=0.54, engage_channel=9, engage_above_us=1650, watch_gcs=True, gcs_timeout_s=7.0
        ),
    )
    assert SafetyMonitorLimits.of(config) == SafetyMonitorLimits(
        vehicle_timeout_s=0.31,
        switch_timeout_s=0.52,
        link_timeout_s=0.54,
        neutral_before_release_s=2.3,
        engage_channel=9,
        engage_above_us=1650,
        battery_low=0.25,
        gcs_timeout_s=7.0,
    )
    unwatched = config.model_copy(update={"autopilot": AutopilotConfig()})
    assert SafetyMonitorLimits.of(unwatched).gcs_timeout_s is None


def test_the_ages_are_those_of_the_configurations_defaults() -> None:
    config = VehicleConfig(camera=SimCameraConfig(), servo=NoServoConfig(backend="none"))
    assert SafetyMonitorLimits.of(config) == SafetyMonitorLimits()


@pytest.mark.parametrize("lease", [Lease.VEHICLE, Lease.LINK, Lease.SWITCH])
def test_leases_last_from_when_the_message_was_measured(lease: Lease) -> None:
    """Not from when it was heard: an old measurement is old."""
    cockpit = Cockpit()
    stamp_ns = cockpit.now_ns - 100 * MS
    cockpit.hear(attitude_t_ns=stamp_ns, position_t_ns=stamp_ns + 5, heartbeat_t_ns=stamp_ns)
    cockpit.rc(OFF_US, stamp_ns)
    lasts_ns = {Lease.VEHICLE: 300 * MS}.get(lease, 500 * MS)
    assert cockpit.monitor.gate.is_fresh(lease, stamp_ns + lasts_ns - 1)
    assert not cockpit.monitor.gate.is_fresh(lease, stamp_ns + lasts_ns)
