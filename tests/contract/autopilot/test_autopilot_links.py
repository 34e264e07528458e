"""The twin's MAVLink face: parameters, commands, routing, telemetry against the truth, and garbage."""

import itertools
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.ekf import EstimatorNoise
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP
from morpheyes_daemon.simulation.autopilot.telemetry import STREAMS
from tests.support.autopilot_bench import AutopilotBench, Station

REQUEST = mavlink.MAV_CMD_REQUEST_MESSAGE
ACCEPTED, FAILED, UNSUPPORTED = 0, 4, 3


def test_the_whole_parameter_table_can_be_listed() -> None:
    bench = AutopilotBench()
    bench.station.send(mavlink.MAVLink_param_request_list_message(1, 1))
    bench.wait(1.0)
    values = bench.station.heard["PARAM_VALUE"]
    table = bench.twin.parameters
    assert [message.param_id for message in values] == list(table)
    assert all(message.param_count == len(table) for message in values)
    assert all(message.param_value == pytest.approx(table[message.param_id], rel=1e-6) for message in values)


@pytest.mark.parametrize("name", ["LOIT_SPEED", "FLTMODE_CH"])
def test_a_parameter_is_read_by_name_and_by_index(name: str) -> None:
    bench = AutopilotBench()
    bench.station.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    index = bench.twin.parameters.index_of(name)
    bench.station.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))
    by_name, by_index = bench.station.heard["PARAM_VALUE"]
    assert by_name.param_id == by_index.param_id == name
    assert by_name.param_value == by_index.param_value == bench.twin.parameters[name]


@pytest.mark.parametrize(("name", "index"), [(b"SYSID_MYGCS", -1), (b"", 30000), (b"", -2)])
def test_an_unknown_parameter_is_met_with_silence(name: bytes, index: int) -> None:
    bench = AutopilotBench()
    bench.station.send(mavlink.MAVLink_param_request_read_message(1, 1, name, index))
    bench.wait(0.5)
    assert not bench.station.heard["PARAM_VALUE"]


def test_setting_a_parameter_is_confirmed_on_every_link_and_obeyed_at_once() -> None:
    bench = AutopilotBench()
    other = Station(bench, 254)
    bench.take_off()
    bench.forward(1300, 6.0)
    slow = bench.speed_m_s
    bench.station.send(mavlink.MAVLink_param_set_message(1, 1, b"LOIT_SPEED", 300.0, 9))
    assert other.heard["PARAM_VALUE"][-1].param_value == 300.0
    bench.forward(1300, 6.0)
    assert slow > 2.0
    assert bench.speed_m_s == pytest.approx(1.08, rel=0.1)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_parameter_cannot_be_set_to_what_is_no_number(value: float) -> None:
    bench = AutopilotBench()
    bench.station.send(mavlink.MAVLink_param_set_message(1, 1, b"LOIT_SPEED", value, 9))
    assert bench.twin.parameters["LOIT_SPEED"] == 1250
    assert not bench.station.heard["PARAM_VALUE"]


def test_an_unknown_command_is_unsupported_and_acknowledged_to_its_sender() -> None:
    bench = AutopilotBench()
    assert bench.station.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1) == UNSUPPORTED
    acknowledgement = bench.station.heard["COMMAND_ACK"][-1]
    assert (acknowledgement.target_system, acknowledgement.target_component) == (255, 190)


@pytest.mark.parametrize(
    ("command", "params", "result"),
    [
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (11_111, 1e6), FAILED),
        (REQUEST, (11_111,), FAILED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, 3), FAILED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, Mode.ALT_HOLD), ACCEPTED),
        (mavlink.MAV_CMD_DO_AUX_FUNCTION, (40, 0), ACCEPTED),
        (mavlink.MAV_CMD_DO_AUX_FUNCTION, (40, 9), FAILED),
        (mavlink.MAV_CMD_DO_AUX_FUNCTION, (999, 0), FAILED),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0.5,), UNSUPPORTED),
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, 2.0), FAILED),
    ],
)
def test_commands_are_answered_as_by_arducopter(command: int, params: tuple[float, ...], result: int) -> None:
    bench = AutopilotBench()
    bench.wait(1.5)
    assert bench.station.command(command, *params) == result


def test_command_int_does_what_command_long_does() -> None:
    bench = AutopilotBench()
    bench.wait(1.5)
    message = mavlink.MAVLink_command_int_message
    bench.station.send(message(1, 1, 0, mavlink.MAV_CMD_DO_SET_MODE, 0, 0, 1, Mode.ALT_HOLD, 0, 0, 0, 0, 0))
    assert bench.mode is Mode.ALT_HOLD
    bench.station.send(mavlink.MAVLink_set_mode_message(1, 1, Mode.GUIDED))
    assert bench.twin.autopilot.mode is Mode.GUIDED


def test_a_command_for_another_component_is_not_obeyed() -> None:
    bench = AutopilotBench()
    message = mavlink.MAVLink_command_long_message
    bench.station.send(message(1, 100, mavlink.MAV_CMD_DO_SET_MODE, 0, 1, Mode.ALT_HOLD, 0, 0, 0, 0, 0))
    assert bench.mode is Mode.STABILIZE
    assert not bench.station.heard["COMMAND_ACK"]


def test_what_is_not_for_the_vehicle_is_passed_on_to_the_other_links() -> None:
    bench = AutopilotBench()
    companion = Station(bench, 1, 191)
    bench.station.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    heard = companion.heard["HEARTBEAT"][-1]
    assert (heard.get_srcSystem(), heard.get_srcComponent()) == (255, 190)
    before = sum(len(messages) for messages in companion.heard.values())
    bench.station.override(1500, 1500, 1000, 1500)
    bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 1)
    assert sum(len(messages) for messages in companion.heard.values()) == before
    companion.send(mavlink.MAVLink_statustext_message(6, b"hello"))
    assert bench.texts[-1] == "hello"


def test_sequence_numbers_run_per_link() -> None:
    bench = AutopilotBench()
    bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 50)
    bench.wait(8.0)
    sequence = [message.get_seq() for message in bench.station.heard["ATTITUDE"]]
    gaps = {(b - a) % 256 for a, b in itertools.pairwise(sequence)}
    assert gaps <= {1, 2, 3}
    assert len(sequence) > 300


def test_a_timesync_request_is_answered_with_its_own_stamp_and_the_time_since_boot() -> None:
    bench = AutopilotBench()
    bench.wait(0.1)
    bench.station.send(mavlink.MAVLink_timesync_message(0, 123_456_789))
    answer = bench.station.heard["TIMESYNC"][-1]
    assert answer.ts1 == 123_456_789
    assert answer.tc1 == 100_000_000


@pytest.mark.parametrize("changes", [{"RNGFND1_TYPE": 10}, FLOW_SETUP], ids=["gps", "flow"])
def test_every_message_that_can_be_streamed_can_be_built_in_flight(changes: dict[str, float]) -> None:
    bench = AutopilotBench(dict(changes))
    bench.take_off()
    for message_id in STREAMS:
        assert bench.station.command(REQUEST, message_id) == ACCEPTED, message_id
        name = mavlink.mavlink_map[message_id].msgname
        assert bench.station.heard[name], name


def test_position_and_attitude_messages_agree_with_the_truth() -> None:
    bench = AutopilotBench({"RNGFND1_TYPE": 10})
    bench.take_off()
    bench.hold(3.0, 1600, 1400, 1500, 1600)
    ids = ("ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "VFR_HUD", "DISTANCE_SENSOR", "SIM_STATE")
    for name in ids:
        bench.station.command(REQUEST, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
    heard, truth = {name: bench.station.heard[name][-1] for name in ids}, bench.truth
    local, attitude = heard["LOCAL_POSITION_NED"], heard["ATTITUDE"]
    assert (local.x, local.y, local.z) == pytest.approx(truth.p_ned_m, abs=0.01)
    assert (local.vx, local.vy, local.vz) == pytest.approx(truth.v_ned_m_s, abs=0.01)
    assert (attitude.roll, attitude.pitch, attitude.yaw) == pytest.approx(
        (truth.roll_rad, truth.pitch_rad, truth.yaw_rad), abs=1e-3
    )
    north_m = (heard["GLOBAL_POSITION_INT"].lat / 1e7 - -35.363262) * 111_319.49
    assert north_m == pytest.approx(truth.p_ned_m[0], abs=0.05)
    assert heard["GLOBAL_POSITION_INT"].relative_alt / 1e3 == pytest.approx(truth.height_m, abs=0.01)
    assert heard["VFR_HUD"].groundspeed == pytest.approx(math.hypot(*truth.v_ned_m_s[:2]), abs=0.02)
    assert heard["DISTANCE_SENSOR"].current_distance / 100 == pytest.approx(truth.height_m, rel=0.05)
    assert heard["SIM_STATE"].vn == pytest.approx(truth.v_ned_m_s[0], abs=1e-3)


def test_the_reported_velocity_has_the_declared_noise() -> None:
    bench = AutopilotBench(noise=EstimatorNoise())
    bench.take_off()
    bench.station.stream(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50)
    bench.wait(30.0)
    errors = [message.vy for message in bench.station.heard["LOCAL_POSITION_NED"][50:]]
    assert math.sqrt(sum(v * v for v in errors) / len(errors)) == pytest.approx(0.05, rel=0.25)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400))
def test_garbage_between_frames_costs_no_frame_and_raises_nothing(garbage: bytes) -> None:
    bench = AutopilotBench()
    link = bench.station
    link._receive(garbage)
    link._receive(b"\x00" * 300)
    for _ in range(3):
        link.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10)
    assert link.heard["COMMAND_ACK"]


def test_a_million_random_bytes_move_no_stick() -> None:
    bench = AutopilotBench()
    bench.take_off()
    bench.wait(4.0)
    rng = random.Random(5)
    place = bench.truth.p_ned_m
    for _ in range(250):
        frame = mavlink.MAVLink_rc_channels_override_message(1, 1, *[1900] * 4, *[65535] * 4, *[0] * 10)
        damaged = bytearray(frame.pack(bench.station._mav))
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        if damaged[5] in bench.twin.parameters.gcs_sysids() and damaged[0] == 0xFD and damaged[2] == 0:
            bench.station._receive(bytes(damaged[:-2]))
        bench.station._receive(rng.randbytes(4000))
        bench.wait(0.02)
    assert math.dist(place, bench.truth.p_ned_m) < 0.2
