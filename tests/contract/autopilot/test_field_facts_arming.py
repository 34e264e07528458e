"""The autopilot twin against the measured rules of start, arming and messages (field facts, "Arming")."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.ekf import Ekf
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP
from tests.support.autopilot_bench import NEUTRAL, AutopilotBench, Station

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
ACCEPTED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED


def ready() -> AutopilotBench:
    bench = AutopilotBench()
    bench.wait(1.5)
    assert bench.twin.set_mode(Mode.LOITER)
    return bench


def ekf_flags(bench: AutopilotBench) -> int:
    bench.station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    return int(bench.station.heard["EKF_STATUS_REPORT"][-1].flags)


def set_origin(bench: AutopilotBench) -> None:
    bench.station.send(mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0))


# Arming


@pytest.mark.parametrize(("throttle_us", "result"), [(1000, ACCEPTED), (985, ACCEPTED), (984, FAILED), (1500, FAILED)])
def test_arming_needs_the_throttle_low_but_not_below_985(throttle_us: int, result: int) -> None:
    bench = ready()
    bench.radio.sticks(throttle_us=throttle_us)
    bench.wait(0.1)
    assert bench.station.command(ARM, 1) == result
    assert bench.twin.autopilot.armed is (result == ACCEPTED)


def test_a_refusal_to_arm_is_said_aloud() -> None:
    bench = ready()
    bench.radio.sticks(throttle_us=1500)
    bench.wait(0.1)
    bench.station.command(ARM, 1)
    assert bench.texts[-1] == "Arm: Throttle too high"


def test_the_throttle_may_be_low_for_ten_seconds_only() -> None:
    bench = ready()
    bench.station.command(ARM, 1)
    bench.wait(9.5)
    assert bench.twin.autopilot.armed
    bench.wait(1.0)
    assert not bench.twin.autopilot.armed


def test_a_centred_throttle_keeps_it_armed() -> None:
    bench = ready()
    bench.station.command(ARM, 1)
    bench.wait(5.0)
    bench.radio.sticks()
    bench.wait(15.0)
    assert bench.twin.autopilot.armed
    assert bench.truth.height_m == 0.0


def test_without_any_radio_input_arming_is_refused() -> None:
    bench = AutopilotBench(receiver=False)
    bench.wait(2.0)
    bench.twin.set_mode(Mode.LOITER)
    assert bench.station.command(ARM, 1) == FAILED
    assert bench.texts[-1] == "Arm: RC not found"


def test_in_the_air_only_force_disarms() -> None:
    bench = AutopilotBench()
    bench.take_off()
    assert bench.station.command(ARM, 0) == FAILED
    assert bench.station.command(ARM, 0, 21196) == ACCEPTED
    bench.wait(2.0)
    assert bench.truth.height_m == 0.0


def test_a_guided_take_off_reaches_its_height_and_land_disarms() -> None:
    bench = ready()
    bench.radio.sticks()
    bench.wait(0.1)
    assert bench.station.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3.0) == FAILED
    bench.twin.set_mode(Mode.GUIDED)
    assert bench.station.command(ARM, 1) == ACCEPTED
    assert bench.station.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3.0) == ACCEPTED
    bench.wait(8.0)
    assert bench.truth.height_m == pytest.approx(3.0, rel=0.1)
    bench.station.command(mavlink.MAV_CMD_NAV_LAND)
    bench.wait(12.0)
    assert bench.truth.height_m == 0.0
    assert not bench.twin.autopilot.armed


# Readiness


def test_with_gps_a_position_comes_42_seconds_after_boot() -> None:
    bench = AutopilotBench(ready_after_s=42.0)
    bench.wait(41.0)
    assert ekf_flags(bench) & Ekf.CONST_POS_MODE
    assert not bench.twin.set_mode(Mode.LOITER)
    bench.wait(2.0)
    assert ekf_flags(bench) & Ekf.POS_HORIZ_ABS
    assert bench.twin.set_mode(Mode.LOITER)


def test_with_flow_the_origin_must_be_set_once_per_boot() -> None:
    bench = AutopilotBench(dict(FLOW_SETUP))
    for _ in range(2):
        bench.wait(3.0)
        assert ekf_flags(bench) & Ekf.POS_HORIZ_REL
        assert not ekf_flags(bench) & Ekf.CONST_POS_MODE
        assert bench.twin.set_mode(Mode.LOITER)
        assert bench.station.command(ARM, 1) == FAILED
        assert bench.texts[-1] == "Arm: AHRS: waiting for home"
        set_origin(bench)
        bench.wait(1.0)
        assert bench.station.command(ARM, 1) == ACCEPTED
        assert bench.station.command(ARM, 0) == ACCEPTED
        assert bench.station.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED


def test_an_origin_that_comes_before_the_ekf_is_aiding_is_lost() -> None:
    bench = AutopilotBench(dict(FLOW_SETUP), ready_after_s=5.0)
    bench.wait(1.0)
    set_origin(bench)
    bench.wait(9.0)
    bench.twin.set_mode(Mode.LOITER)
    assert bench.station.command(ARM, 1) == FAILED


def test_flow_needs_a_rangefinder() -> None:
    bench = AutopilotBench({**FLOW_SETUP, "RNGFND1_TYPE": 0})
    bench.wait(10.0)
    assert ekf_flags(bench) & Ekf.CONST_POS_MODE


def test_flow_lost_in_flight_lands_after_1_9_seconds_and_drifts() -> None:
    bench = AutopilotBench({**FLOW_SETUP, "LOIT_SPEED": 500})
    bench.take_off(3.0)
    bench.forward(1400, 5.0)
    start_ns, place = bench.clock.t_ns, bench.truth.p_ned_m
    bench.twin.lose_flow()
    while bench.mode is not Mode.LAND:
        bench.forward(1400, 0.02)
        assert bench.clock.t_ns - start_ns < 5e9
    assert (bench.clock.t_ns - start_ns) / 1e9 == pytest.approx(1.9, rel=0.1)
    assert "EKF Failsafe: changed to LAND Mode" in bench.texts
    while bench.twin.autopilot.armed:
        bench.hold(0.1, *NEUTRAL)
    drift_m = math.hypot(bench.truth.p_ned_m[0] - place[0], bench.truth.p_ned_m[1] - place[1])
    assert drift_m == pytest.approx(4.0, rel=0.25), "about 4 m; the speed of the recording is not given"


def test_flow_lost_is_told_half_a_second_later_and_a_lost_fix_at_once() -> None:
    for setup, told, message_id, limit_s in (
        (FLOW_SETUP, lambda m: not m.onboard_control_sensors_health & 0x40, mavlink.MAVLINK_MSG_ID_SYS_STATUS, 0.5),
        ({}, lambda m: m.fix_type == 1, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 0.0),
    ):
        bench = AutopilotBench(dict(setup))
        bench.take_off(3.0)
        bench.station.stream(message_id, 50)
        bench.wait(0.5)
        name = mavlink.mavlink_map[message_id].msgname
        assert not told(bench.station.heard[name][-1])
        bench.twin.lose_flow()
        start_ns = bench.clock.t_ns
        while not told(bench.station.heard[name][-1]):
            bench.hold(0.02, *NEUTRAL)
            assert bench.clock.t_ns - start_ns < 2e9
        assert (bench.clock.t_ns - start_ns) / 1e9 == pytest.approx(limit_s, abs=0.06)


def test_gps_lost_in_flight_brakes_well_and_lands_after_8_6_seconds() -> None:
    bench = AutopilotBench({"LOIT_SPEED": 500, "LOIT_BRK_DELAY": 0.2})
    bench.take_off(3.0)
    bench.forward(1330, 5.0)
    bench.twin.lose_flow()
    start_ns = bench.clock.t_ns
    bench.hold(4.0, *NEUTRAL)
    assert bench.speed_m_s < 0.6, "0.2 m/s on ArduCopter 4.7"
    while bench.mode is not Mode.LAND:
        bench.hold(0.02, *NEUTRAL)
        assert bench.clock.t_ns - start_ns < 12e9
    assert (bench.clock.t_ns - start_ns) / 1e9 == pytest.approx(8.6, rel=0.1)


# Messages


def test_nothing_streams_unasked_but_heartbeat_statustext_and_timesync() -> None:
    bench = AutopilotBench()
    bench.wait(20.0)
    heard = {name for name, messages in bench.station.heard.items() if messages}
    assert heard <= {"HEARTBEAT", "STATUSTEXT", "TIMESYNC"}
    assert len(bench.station.heard["HEARTBEAT"]) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("rate_hz", [2.0, 12.5, 30.0, 50.0])
def test_a_message_interval_is_met_exactly(rate_hz: float) -> None:
    bench = AutopilotBench()
    assert bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, rate_hz) == ACCEPTED
    bench.wait(20.0)
    assert len(bench.station.heard["ATTITUDE"]) == pytest.approx(20.0 * rate_hz, abs=1)


def test_intervals_belong_to_one_link_and_die_with_a_reboot() -> None:
    bench = AutopilotBench()
    other = Station(bench, 254, 190)
    other.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10)
    bench.wait(1.0)
    assert not bench.station.heard["ATTITUDE"]
    assert len(other.heard["ATTITUDE"]) == pytest.approx(10, abs=1)
    bench.twin.reboot()
    before = len(other.heard["ATTITUDE"])
    bench.wait(2.0)
    assert len(other.heard["ATTITUDE"]) == before


def test_a_negative_interval_stops_the_stream() -> None:
    bench = AutopilotBench()
    bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10)
    bench.wait(1.0)
    bench.station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, -1)
    before = len(bench.station.heard["ATTITUDE"])
    bench.wait(1.0)
    assert len(bench.station.heard["ATTITUDE"]) == before


def test_a_reboot_starts_the_boot_time_again() -> None:
    bench = AutopilotBench()
    bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10)
    bench.wait(5.0)
    assert bench.station.heard["ATTITUDE"][-1].time_boot_ms == pytest.approx(5000, abs=100)
    bench.station.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)
    bench.wait(3.0)
    bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10)
    bench.wait(1.0)
    assert bench.station.heard["ATTITUDE"][-1].time_boot_ms == pytest.approx(4000, abs=100)
