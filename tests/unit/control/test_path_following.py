"""Path following: between two commands the vehicle is kept to its line, at the commanded velocity along it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.control.path_following import (
    CLIMB_GAIN_1_S,
    LEAN_LAG_S,
    LOOKAHEAD_S,
    MAX_CLIMB_M_S,
    MAX_INTEGRAL_M_S,
    PathFollower,
)
from morpheyes_daemon.messages.core import Intent, Line, MissionCommand, VehicleState

S = 1_000_000_000


def command(line, v=(3.0, 0.0, 0.0)):
    return MissionCommand(
        seq=1, t_ns=0, expires_ns=S, intent=Intent.FLY, reason=None, v_ned_m_s=v, yaw_rad=0.0, height_m=None,
        baseline_m=0.1, clear_m=5.0, p_measured_ned_m=(0.0, 0.0, 0.0), line=line,
    )  # fmt: skip


def wanted_velocity(order, vehicle, now_ns):
    return PathFollower().wanted_velocity(order, vehicle, now_ns)


def test_without_a_line_the_commands_velocity_is_returned():
    assert wanted_velocity(command(None), VehicleState(), 0) == (3.0, 0.0, 0.0)


def test_an_offset_is_corrected_across_the_line_only():
    vehicle = VehicleState(p_ned_m=(1.0, 0.2, -1.5))
    v = wanted_velocity(command(Line(0, (7.0, 0.0, -1.4), gain_1_s=2.0)), vehicle, 0)
    assert v == pytest.approx((3.0, -0.4, 0.2))


def test_a_point_is_held_at_zero_velocity():
    vehicle = VehicleState(p_ned_m=(1.0, 0.5, -1.5))
    v = wanted_velocity(command(Line(0, (2.0, 0.5, -1.5), gain_1_s=0.5), (0.0, 0.0, 0.0)), vehicle, 0)
    assert v == pytest.approx((0.5, 0.0, 0.0))


def test_a_moving_line_is_predicted_by_the_lag_of_the_lean():
    line = Line(0, (7.0, 0.0, -1.5), (0.0, 0.4, 0.0), (0.0, 0.2, 0.0), gain_1_s=1.0)
    moving = 0.4 + 0.2 * (1.0 + LEAN_LAG_S)
    vehicle = VehicleState(p_ned_m=(0.0, 0.4 + 0.1, -1.5), v_ned_m_s=(3.0, moving, 0.0))
    assert wanted_velocity(command(line), vehicle, S)[1] == pytest.approx(moving)


def test_the_error_is_taken_at_the_predicted_position():
    line, back = Line(0, (7.0, 0.0, -1.5), gain_1_s=2.0), (3.0, -0.3, 0.0)
    vehicle = VehicleState(p_ned_m=(1.0, 0.2, -1.5), v_ned_m_s=back)
    assert wanted_velocity(command(line), vehicle, 0)[1] == pytest.approx(-2.0 * (0.2 - 0.3 * LOOKAHEAD_S))


def test_the_vertical_gain_is_bounded():
    line, vehicle = Line(0, (7.0, 0.0, -1.5), gain_1_s=2 * CLIMB_GAIN_1_S), VehicleState(p_ned_m=(1.0, 0.0, -1.4))
    assert wanted_velocity(command(line), vehicle, 0)[2] == pytest.approx(-0.1 * CLIMB_GAIN_1_S)


def test_a_steady_error_is_integrated_up_to_a_bound():
    follower, vehicle = PathFollower(), VehicleState(p_ned_m=(1.0, 0.05, -1.5))
    order = command(Line(0, (7.0, 0.0, -1.5), gain_1_s=2.0, integral_1_s2=3.0))
    first, *_, last = (follower.wanted_velocity(order, vehicle, k * S // 50)[1] for k in range(1, 51))
    assert first == pytest.approx(-0.1)
    assert last == pytest.approx(-0.1 - 3.0 * 0.05 * 49 / 50)
    for k in range(51, 1000):
        last = follower.wanted_velocity(order, vehicle, k * S // 50)[1]
    assert last == pytest.approx(-0.1 - MAX_INTEGRAL_M_S)
    follower.reset()
    assert follower.wanted_velocity(order, vehicle, 1000 * S // 50)[1] == pytest.approx(-0.1)


@given(st.tuples(*[st.floats(-50, 50)] * 3), st.tuples(*[st.floats(-50, 50)] * 3), st.floats(0.1, 3.0))
def test_the_correction_is_bounded(place, here, most):
    line = Line(0, place, gain_1_s=2.0, max_m_s=most)
    vn, ve, vd = wanted_velocity(command(line), VehicleState(p_ned_m=here), 0)
    assert vn == pytest.approx(3.0)
    assert abs(ve) <= most + 1e-9
    assert abs(vd) <= MAX_CLIMB_M_S + 1e-9
