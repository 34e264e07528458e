"""The twin's fault hooks: what each does to the vehicle and what a daemon can see of it."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from tests.support.autopilot_bench import NEUTRAL, AutopilotBench


@pytest.fixture
def bench() -> AutopilotBench:
    flying = AutopilotBench({"LOIT_SPEED": 500, "LOIT_BRK_DELAY": 0.2})
    flying.take_off()
    return flying


def heard_heartbeats(bench: AutopilotBench) -> int:
    return len(bench.station.heard["HEARTBEAT"])


def test_a_reboot_in_flight_silences_the_links_and_drops_the_vehicle(bench: AutopilotBench) -> None:
    bench.station.stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 10)
    bench.twin.reboot()
    before = heard_heartbeats(bench)
    bench.hold(1.9, *NEUTRAL)
    assert heard_heartbeats(bench) == before
    bench.hold(3.1, *NEUTRAL)
    assert heard_heartbeats(bench) - before == pytest.approx(3, abs=1), "back at 1 Hz, the rate is forgotten"
    assert bench.truth.height_m == 0.0
    assert not bench.twin.autopilot.armed


def test_ignored_overrides_are_seen_in_the_echo_alone(bench: AutopilotBench) -> None:
    said = len(bench.texts)
    bench.station.stream(mavlink.MAVLINK_MSG_ID_RC_CHANNELS, 10)
    bench.forward(1300, 2.0)
    assert bench.station.heard["RC_CHANNELS"][-1].chan2_raw == 1300
    bench.twin.ignore_overrides()
    bench.forward(1300, 3.0)
    assert bench.station.heard["RC_CHANNELS"][-1].chan2_raw == 1500
    assert bench.speed_m_s < 0.2
    assert len(bench.texts) == said
    bench.twin.ignore_overrides(ignore=False)
    bench.forward(1300, 1.0)
    assert bench.station.heard["RC_CHANNELS"][-1].chan2_raw == 1300


def test_an_unhealthy_ekf_lands_after_a_second_and_says_so(bench: AutopilotBench) -> None:
    bench.twin.ekf_unhealthy()
    start_ns = bench.clock.t_ns
    while bench.mode is not Mode.LAND:
        bench.hold(0.02, *NEUTRAL)
        assert bench.clock.t_ns - start_ns < 3e9
    assert (bench.clock.t_ns - start_ns) / 1e9 == pytest.approx(1.0, rel=0.1)
    bench.station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    assert bench.station.heard["EKF_STATUS_REPORT"][-1].velocity_variance > 0.8
    bench.twin.ekf_unhealthy(unhealthy=False)
    bench.hold(2.0, *NEUTRAL)
    assert "EKF Failsafe Cleared" in bench.texts
    assert bench.twin.autopilot.mode is Mode.LAND, "failsafe modes do not come back"


@pytest.mark.parametrize(("action", "mode"), [(0, Mode.LOITER), (1, Mode.LAND), (2, Mode.RTL)])
def test_a_low_battery_is_announced_and_acted_upon_as_set(action: int, mode: Mode) -> None:
    bench = AutopilotBench({"BATT_FS_LOW_ACT": action})
    bench.take_off()
    bench.twin.battery_low()
    bench.hold(9.0, *NEUTRAL)
    assert bench.mode is Mode.LOITER, "BATT_LOW_TIMER is 10 s"
    bench.hold(2.0, *NEUTRAL)
    assert bench.twin.autopilot.mode is mode
    assert any("Battery 1 is low" in text for text in bench.texts)
    bench.station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_BATTERY_STATUS)
    status = bench.station.heard["BATTERY_STATUS"][-1]
    assert status.battery_remaining <= 10
    assert status.charge_state == mavlink.MAV_BATTERY_CHARGE_STATE_LOW


def test_a_lost_radio_is_a_failsafe_and_coming_back_does_not_undo_it() -> None:
    bench = AutopilotBench({"FS_THR_ENABLE": 3, "RC_OVERRIDE_TIME": 0.5})
    bench.take_off()
    bench.wait(1.0)
    bench.twin.lose_radio()
    bench.wait(1.5)
    assert bench.mode is Mode.LAND
    bench.station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_SYS_STATUS)
    health = bench.station.heard["SYS_STATUS"][-1].onboard_control_sensors_health
    assert not health & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    bench.twin.lose_radio(lost=False)
    bench.wait(1.0)
    assert "Radio Failsafe Cleared" in bench.texts
    assert bench.twin.autopilot.mode is Mode.LAND


def test_a_pilots_mode_change_is_in_the_next_heartbeat(bench: AutopilotBench) -> None:
    bench.station.stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 10)
    bench.wait(0.5)
    bench.twin.set_mode(Mode.ALT_HOLD)
    bench.wait(0.11)
    assert bench.station.heard["HEARTBEAT"][-1].custom_mode == Mode.ALT_HOLD


def test_disarming_in_flight_ends_it(bench: AutopilotBench) -> None:
    bench.twin.disarm_in_flight()
    bench.wait(2.0)
    assert bench.truth.height_m == 0.0


def test_alt_hold_coasts_where_loiter_brakes(bench: AutopilotBench) -> None:
    bench.forward(1300, 6.0)
    bench.twin.set_mode(Mode.ALT_HOLD)
    bench.hold(2.0, *NEUTRAL)
    assert bench.speed_m_s > 0.8
    bench.twin.set_mode(Mode.LOITER)
    bench.hold(3.0, *NEUTRAL)
    assert bench.speed_m_s < 0.2
