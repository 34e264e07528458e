"""The autopilot twin against the measured answers to the sticks (field facts, "Sticks in Loiter"), within 10 %."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP
from tests.support.autopilot_bench import AutopilotBench


def flying(changes: dict[str, float], height_m: float = 3.0) -> AutopilotBench:
    bench = AutopilotBench(changes)
    bench.take_off(height_m)
    return bench


@pytest.mark.parametrize(
    ("loit_speed", "pitch_us", "speed_m_s"),
    [
        (1250, 1450, 0.71),
        (1250, 1400, 1.92),
        (1250, 1356, 3.0),
        (1250, 1300, 4.37),
        (500, 1450, 0.28),
        (500, 1400, 0.77),
        (500, 1300, 1.77),
        (500, 1185, 2.95),
        (300, 1400, 0.49),
        (300, 1300, 1.08),
        (300, 1000, 2.97),
    ],
)
def test_a_held_pitch_stick_settles_at_the_measured_speed(loit_speed: float, pitch_us: int, speed_m_s: float) -> None:
    bench = flying({"LOIT_SPEED": loit_speed})
    bench.forward(pitch_us, 5.0 * loit_speed / 357.0 + 2.0)
    assert bench.truth.v_ned_m_s[0] == pytest.approx(speed_m_s, rel=0.1)
    assert abs(bench.truth.v_ned_m_s[1]) < 0.02


@pytest.mark.parametrize(("loit_speed", "tau_s"), [(1250, 3.5), (500, 1.4), (300, 0.84)])
def test_the_speed_settles_with_the_measured_time_constant(loit_speed: float, tau_s: float) -> None:
    """Time to 63 % of the speed; the lag of the lean is made up for by the controller's lead, as on the real one."""
    bench = flying({"LOIT_SPEED": loit_speed})
    theta = math.radians(20.0)
    settled = loit_speed / 100.0 * math.tan(0.375 * theta) / math.tan(theta)
    start_ns = bench.clock.t_ns
    bench.reach(settled * (1.0 - math.exp(-1.0)), 1300)
    assert (bench.clock.t_ns - start_ns) / 1e9 == pytest.approx(tau_s, rel=0.1)


def test_roll_and_reverse_pitch_mirror_forward_pitch() -> None:
    bench = flying({"LOIT_SPEED": 500})
    bench.hold(8.0, 1700, 1500, 1500, 1500)
    assert bench.truth.v_ned_m_s[1] == pytest.approx(1.77, rel=0.1)
    bench.hold(8.0, 1500, 1700, 1500, 1500)
    assert bench.truth.v_ned_m_s[0] == pytest.approx(-1.77, rel=0.1)


def test_a_reversed_pitch_channel_flies_the_other_way() -> None:
    bench = flying({"LOIT_SPEED": 500, "RC2_REVERSED": 1})
    bench.forward(1300, 6.0)
    assert bench.truth.v_ned_m_s[0] == pytest.approx(-1.77, rel=0.1)


@pytest.mark.parametrize("pitch_us", [1480, 1490, 1510, 1520])
def test_small_sticks_vanish_in_the_dead_zone(pitch_us: int) -> None:
    bench = flying({})
    bench.forward(pitch_us, 4.0)
    assert bench.speed_m_s < 0.01


@pytest.mark.parametrize(("height_m", "speed_m_s"), [(1.0, 0.50), (1.5, 0.81), (2.5, 1.31)])
def test_optical_flow_limits_the_speed_by_height(height_m: float, speed_m_s: float) -> None:
    bench = flying(dict(FLOW_SETUP), height_m)
    bench.forward(1300, 5.0)
    assert bench.speed_m_s == pytest.approx(speed_m_s, rel=0.1)


def test_optical_flow_has_a_ceiling_without_a_message() -> None:
    bench = flying({**FLOW_SETUP, "RNGFND1_MAX": 6.0}, 2.0)
    said = len(bench.texts)
    bench.hold(8.0, 1500, 1500, 1800, 1500)
    assert bench.truth.height_m == pytest.approx(0.7 * 6.0 - 1.0, abs=0.1)
    assert len(bench.texts) == said


@pytest.mark.parametrize(("yaw_us", "rate_deg_s"), [(1550, 12.5), (1600, 33.0), (1700, 77.5), (1900, 167.0)])
def test_the_yaw_stick_gives_the_measured_rate(yaw_us: int, rate_deg_s: float) -> None:
    bench = flying({})
    bench.hold(1.0, 1500, 1500, 1500, yaw_us)
    assert math.degrees(bench.vehicle.yaw_rate_rad_s) == pytest.approx(rate_deg_s, rel=0.1)


@pytest.mark.parametrize(
    ("throttle_us", "climb_m_s"), [(1640, 0.26), (1700, 0.64), (1360, -0.29), (1000, -2.5), (1410, 0.0), (1590, 0.0)]
)
def test_the_throttle_stick_gives_the_measured_climb(throttle_us: int, climb_m_s: float) -> None:
    bench = flying({}, 8.0)
    bench.hold(2.0, 1500, 1500, throttle_us, 1500)
    assert -bench.truth.v_ned_m_s[2] == pytest.approx(climb_m_s, rel=0.1, abs=0.01)


def test_neutral_throttle_is_the_middle_of_its_range_not_its_trim() -> None:
    bench = flying({"RC3_TRIM": 1000}, 5.0)
    bench.hold(2.0, 1500, 1500, 1500, 1500)
    assert bench.truth.height_m == pytest.approx(5.0, abs=0.1)
    bench.hold(1.0, 1500, 1500, 1000, 1500)
    assert bench.truth.v_ned_m_s[2] > 2.0


def test_the_lean_answers_with_the_measured_latency() -> None:
    """55-70 ms to the first motion (0.3 degrees), 0.20 s to 63 % of a step of 7.6 degrees."""
    bench = flying({})
    bench.station.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 100)
    start_ns, first = bench.clock.t_ns, len(bench.station.heard["ATTITUDE"])
    bench.forward(1298, 0.6)
    samples = zip(bench.station.heard_ns["ATTITUDE"][first:], bench.station.heard["ATTITUDE"][first:], strict=True)
    lean = [((t_ns - start_ns) / 1e9, -math.degrees(message.pitch)) for t_ns, message in samples]
    moved_s = next(t_s for t_s, deg in lean if deg > 0.3)
    most_s = next(t_s for t_s, deg in lean if deg > 0.63 * 7.6)
    assert 0.055 <= moved_s <= 0.070
    assert most_s == pytest.approx(0.20, rel=0.1)


def test_accelerating_to_three_metres_per_second_leans_by_the_sticks_twelve_degrees() -> None:
    bench = flying({"LOIT_SPEED": 500})
    most_rad = 0.0
    for _ in range(100):
        bench.forward(1182, 0.02)
        most_rad = max(most_rad, -bench.truth.pitch_rad)
    assert math.degrees(most_rad) == pytest.approx(12.0, rel=0.1)
