"""The autopilot twin against the measured rules of RC overrides (field facts: identity, time-outs, failsafes)."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from tests.support.autopilot_bench import KEEP, NEUTRAL, AutopilotBench

FORWARD = (1500, 1400, 1500, 1500)
QUICK = {"LOIT_SPEED": 500, "LOIT_BRK_DELAY": 0.2}


def flying(changes: dict[str, float] | None = None, *, receiver: bool = True) -> AutopilotBench:
    bench = AutopilotBench({**QUICK, **(changes or {})}, receiver=receiver)
    bench.take_off()
    return bench


def seconds_until(bench: AutopilotBench, mode: Mode, limit_s: float) -> float:
    """Let time pass without a stream until the mode changes; the time since the last override."""
    start_ns = bench.clock.t_ns
    while bench.mode is not mode:
        assert bench.clock.t_ns - start_ns < limit_s * 1e9, f"still in {bench.mode.name}; {bench.texts}"
        bench.wait(0.01)
    return (bench.clock.t_ns - start_ns) / 1e9 + 0.02


def rc_channels(bench: AutopilotBench) -> list[int]:
    bench.station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_RC_CHANNELS)
    message = bench.station.heard["RC_CHANNELS"][-1]
    return [int(getattr(message, f"chan{n}_raw")) for n in range(1, 17)]


# Identity and acceptance


@pytest.mark.parametrize(
    ("sysid", "compid", "accepted"),
    [(255, 190, True), (255, 191, True), (255, 1, True), (1, 191, False), (254, 190, False)],
)
def test_overrides_count_only_from_the_ground_station_system_id(sysid: int, compid: int, accepted: bool) -> None:
    bench = AutopilotBench()
    bench.wait(0.1)
    said = len(bench.texts)
    bench.station.override(1600, 1600, 1200, 1600, sysid=sysid, compid=compid)
    bench.wait(0.05)
    assert (rc_channels(bench)[:4] == [1600, 1600, 1200, 1600]) is accepted
    assert len(bench.texts) == said, "refused silently"
    assert not bench.station.heard["COMMAND_ACK"][:-1], "no acknowledgement ever"


def test_a_range_of_system_ids_can_be_accepted() -> None:
    bench = AutopilotBench({"MAV_GCS_SYSID": 250, "MAV_GCS_SYSID_HI": 253})
    for sysid, accepted in ((249, False), (250, True), (252, True), (254, False)):
        bench.station.override(1500, 1500, 1100 + sysid, 1500, sysid=sysid)
        bench.wait(0.05)
        assert (rc_channels(bench)[2] == 1100 + sysid) is accepted


def test_before_4_7_the_id_is_sysid_mygcs() -> None:
    bench = AutopilotBench({"SYSID_MYGCS": 7}, old_names=True)
    bench.station.override(1500, 1500, 1234, 1500, sysid=7)
    bench.wait(0.05)
    assert rc_channels(bench)[2] == 1234
    assert "MAV_GCS_SYSID" not in bench.twin.parameters


def test_while_overridden_the_pilots_sticks_cannot_be_seen() -> None:
    bench = AutopilotBench()
    bench.radio.sticks(1111, 1222, 1333, 1444)
    bench.hold(0.2, *NEUTRAL)
    assert rc_channels(bench)[:4] == list(NEUTRAL)
    bench.radio.switch(on=True)
    bench.hold(0.2, *NEUTRAL)
    assert rc_channels(bench)[6] == 1900, "a channel that is left alone shows the pilot"


def test_zero_releases_the_first_eight_channels_and_65534_the_others() -> None:
    bench = AutopilotBench()
    bench.wait(0.1)
    bench.station.override(*[1600] * 4, *[KEEP] * 4, 1700, 1700)
    bench.wait(0.05)
    assert rc_channels(bench)[:4] + rc_channels(bench)[8:10] == [1600] * 4 + [1700] * 2
    bench.station.override(*[0] * 4, *[KEEP] * 4, 0, 65534)
    bench.wait(0.05)
    assert rc_channels(bench)[:4] == bench.radio.channels_us[:4]
    assert rc_channels(bench)[8] == 1700, "0 means nothing on channel 9"
    assert rc_channels(bench)[9] == bench.radio.channels_us[9]


def test_the_option_to_ignore_overrides_ignores_them() -> None:
    bench = AutopilotBench({"RC_OPTIONS": 2})
    bench.hold(0.2, 1600, 1600, 1600, 1600)
    assert rc_channels(bench)[:4] == bench.radio.channels_us[:4]


def test_aux_function_46_switches_overrides_off_and_on() -> None:
    bench = AutopilotBench()
    bench.hold(0.1, 1600, 1600, 1600, 1600)
    assert bench.station.command(mavlink.MAV_CMD_DO_AUX_FUNCTION, 46, 0) == mavlink.MAV_RESULT_ACCEPTED
    bench.hold(0.1, 1600, 1600, 1600, 1600)
    assert rc_channels(bench)[0] == 1500
    bench.station.command(mavlink.MAV_CMD_DO_AUX_FUNCTION, 46, 2)
    bench.hold(0.1, 1600, 1600, 1600, 1600)
    assert rc_channels(bench)[0] == 1600


def test_a_switch_with_option_46_takes_the_sticks_back_at_once() -> None:
    bench = AutopilotBench({"RC8_OPTION": 46})
    bench.radio.set(8, 1900)
    bench.hold(0.5, 1600, 1600, 1600, 1600)
    assert rc_channels(bench)[0] == 1600
    bench.radio.set(8, 1100)
    bench.hold(0.3, 1600, 1600, 1600, 1600)
    assert rc_channels(bench)[0] == 1500


# The mode channel


def test_an_override_of_the_mode_channel_changes_the_mode_and_its_release_drops_into_stabilize() -> None:
    bench = AutopilotBench({**QUICK, "FLTMODE1": Mode.STABILIZE, "FLTMODE4": Mode.LOITER, "FLTMODE6": Mode.ALT_HOLD})
    bench.take_off()
    for _ in range(25):
        bench.station.override(*NEUTRAL, 1815)
        bench.wait(0.02)
    assert bench.mode is Mode.ALT_HOLD
    for _ in range(25):
        bench.station.override(*NEUTRAL, 0)
        bench.wait(0.02)
    assert bench.twin.autopilot.mode is Mode.STABILIZE
    assert not bench.truth.height_m < 1.0


def test_the_pilots_mode_switch_works_under_overrides() -> None:
    bench = flying({"FLTMODE4": Mode.ALT_HOLD})
    bench.radio.mode_switch(4)
    bench.hold(0.5, *NEUTRAL)
    assert bench.mode is Mode.ALT_HOLD


def test_a_neutral_throttle_override_in_stabilize_is_hover_thrust_against_the_pilot() -> None:
    bench = flying({"FLTMODE4": Mode.STABILIZE})
    bench.radio.sticks(throttle_us=1000)
    bench.radio.mode_switch(4)
    bench.hold(1.5, *NEUTRAL)
    assert bench.twin.autopilot.mode is Mode.STABILIZE
    assert abs(bench.truth.v_ned_m_s[2]) < 0.3, "the pilot's throttle was low"


# When the stream stops, receiver present


def test_with_a_receiver_the_last_sticks_are_held_for_rc_override_time() -> None:
    bench = flying()
    bench.hold(4.0, *FORWARD)
    speed = bench.speed_m_s
    bench.wait(2.9)
    assert bench.speed_m_s == pytest.approx(speed, rel=0.1)
    bench.wait(2.0)
    assert bench.speed_m_s < 0.3
    assert bench.mode is Mode.LOITER


@pytest.mark.parametrize("hold_s", [0.5, 1.0, 3.0])
def test_rc_override_time_is_met(hold_s: float) -> None:
    bench = flying({"RC_OVERRIDE_TIME": hold_s})
    bench.hold(1.0, *FORWARD)
    bench.wait(hold_s - 0.1)
    assert rc_channels(bench)[1] == 1400
    bench.wait(0.2)
    assert rc_channels(bench)[1] == 1500


def test_then_a_receiver_with_its_throttle_down_sinks_at_two_and_a_half_metres_per_second() -> None:
    bench = AutopilotBench(QUICK)
    bench.take_off(12.0)
    bench.radio.sticks(throttle_us=1000)
    bench.hold(1.0, *NEUTRAL)
    bench.wait(5.0)
    assert bench.truth.v_ned_m_s[2] == pytest.approx(2.5, rel=0.1)


# When the stream stops, no receiver


@pytest.mark.parametrize(("setting", "mode"), [(1, Mode.RTL), (3, Mode.LAND), (7, Mode.BRAKE)])
def test_without_a_receiver_the_failsafe_comes_after_one_second(setting: int, mode: Mode) -> None:
    bench = flying({"FS_THR_ENABLE": setting}, receiver=False)
    bench.hold(3.0, *FORWARD)
    speed = bench.speed_m_s
    assert seconds_until(bench, mode, 2.0) == pytest.approx(1.0, rel=0.1)
    assert bench.speed_m_s == pytest.approx(speed, rel=0.1), "the last sticks were held"
    assert "Radio Failsafe" in bench.texts


def test_rtl_climbs_to_fifteen_metres_indoors_too() -> None:
    bench = flying({"FS_THR_ENABLE": 1}, receiver=False)
    bench.wait(12.0)
    assert bench.mode is Mode.RTL
    assert bench.truth.height_m == pytest.approx(15.0, rel=0.1)


def test_land_stops_about_a_second_later() -> None:
    bench = flying({"FS_THR_ENABLE": 3}, receiver=False)
    bench.hold(3.0, *FORWARD)
    seconds_until(bench, Mode.LAND, 2.0)
    bench.wait(1.4)
    assert bench.speed_m_s < 0.1
    bench.wait(15.0)
    assert not bench.twin.autopilot.armed


def test_without_a_failsafe_it_flies_on_the_last_stick_for_ever() -> None:
    bench = flying({"FS_THR_ENABLE": 0, "RC_OVERRIDE_TIME": 1.0, "FS_GCS_ENABLE": 1}, receiver=False)
    bench.hold(6.0, *FORWARD)
    speed = bench.speed_m_s
    bench.wait(60.0)
    assert bench.speed_m_s == pytest.approx(speed, rel=0.1)
    assert bench.mode is Mode.LOITER, "FS_OPTIONS 16 lets pilot-controlled modes go on"


def test_without_a_receiver_a_release_keeps_the_last_value() -> None:
    bench = flying({"FS_THR_ENABLE": 0}, receiver=False)
    bench.hold(4.0, *FORWARD)
    speed = bench.speed_m_s
    for _ in range(100):
        bench.station.override(0, 0, 0, 0)
        bench.wait(0.02)
    assert rc_channels(bench)[1] == 1400
    assert bench.speed_m_s == pytest.approx(speed, rel=0.1)


def test_after_a_failsafe_the_mode_does_not_come_back_with_the_stream() -> None:
    bench = flying({"FS_THR_ENABLE": 7}, receiver=False)
    bench.wait(2.0)
    bench.hold(3.0, *FORWARD)
    assert "Radio Failsafe Cleared" in bench.texts
    assert bench.mode is Mode.BRAKE
    assert bench.speed_m_s < 0.1
    assert bench.twin.set_mode(Mode.LOITER)
    bench.hold(4.0, *FORWARD)
    assert bench.speed_m_s == pytest.approx(0.77, rel=0.1)


@pytest.mark.parametrize(("rate_hz", "mode"), [(1.2, Mode.LOITER), (0.8, Mode.LAND)])
def test_a_slow_stream_holds_loiter_at_1_2_hz_and_ends_in_land_at_0_8_hz(rate_hz: float, mode: Mode) -> None:
    bench = flying({"FS_THR_ENABLE": 3}, receiver=False)
    bench.hold(10.0, *NEUTRAL, rate_hz=rate_hz)
    assert bench.mode is mode
    assert (bench.texts.count("Radio Failsafe") > 1) is (mode is Mode.LAND), "it flaps"


# Loss of the ground station


def gcs_lost(changes: dict[str, float], *, overriding: bool) -> AutopilotBench:
    bench = flying({"FS_GCS_ENABLE": 5, "FS_OPTIONS": 0, **changes})
    station = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    for _ in range(3):
        bench.station.send(station)
        bench.hold(1.0, *NEUTRAL)
    for _ in range(6):
        if overriding:
            bench.hold(1.0, *NEUTRAL)
        else:
            bench.wait(1.0)
    return bench


def test_the_loss_of_the_ground_station_lands_after_five_seconds() -> None:
    bench = gcs_lost({}, overriding=False)
    assert bench.mode is Mode.LAND
    assert "GCS Failsafe" in bench.texts


def test_overrides_hide_the_loss_of_the_ground_station() -> None:
    assert gcs_lost({}, overriding=True).mode is Mode.LOITER


def test_the_transmitters_loss_is_hidden_by_overrides_too() -> None:
    bench = flying({"FS_THR_ENABLE": 3})
    bench.twin.lose_radio()
    bench.hold(5.0, *NEUTRAL)
    assert bench.mode is Mode.LOITER
    bench.wait(1.5)
    assert bench.twin.autopilot.mode is Mode.LAND
