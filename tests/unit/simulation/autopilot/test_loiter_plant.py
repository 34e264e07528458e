"""The pure Loiter law against its own formulas, whatever airframe follows it."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.simulation.airframe.second_order import GRAVITY_M_S2, SecondOrder
from morpheyes_daemon.simulation.autopilot.position_controller import (
    LoiterLaw,
    LoiterReference,
    Tracking,
    VelocityReference,
    square_root_gain,
)

DT_S = 0.0025
LAW = LoiterLaw(5.0, math.radians(20.0), 2.5, 5.0, 0.2)
NORTH = (1.0, 0.0)


def fly(reference: LoiterReference, lean_rad: float, seconds: float, limit_m_s: float = 5.0) -> None:
    for _ in range(round(seconds / DT_S)):
        reference.step(LAW, limit_m_s, lean_rad, 0.0, NORTH, DT_S)


@pytest.mark.parametrize("n", [0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("limit_m_s", [1.5, 3.0, 5.0])
def test_it_settles_at_v_lim_tan_n_theta_over_tan_theta(n: float, limit_m_s: float) -> None:
    reference = LoiterReference()
    fly(reference, n * LAW.angle_rad, 12.0, limit_m_s)
    expected = limit_m_s * math.tan(n * LAW.angle_rad) / math.tan(LAW.angle_rad)
    assert reference.v_north_m_s == pytest.approx(expected, rel=0.01)


def test_it_settles_with_tau_v_lim_over_g_tan_theta() -> None:
    reference = LoiterReference()
    tau_s = 5.0 / (GRAVITY_M_S2 * math.tan(LAW.angle_rad))
    fly(reference, LAW.angle_rad / 2, tau_s + 2 * 0.075)
    settled = 5.0 * math.tan(LAW.angle_rad / 2) / math.tan(LAW.angle_rad)
    assert reference.v_north_m_s == pytest.approx(settled * (1.0 - math.exp(-1.0)), rel=0.03)


def test_the_brake_waits_and_is_slewed_at_its_jerk() -> None:
    reference = LoiterReference()
    fly(reference, LAW.angle_rad * 0.6, 10.0)
    fly(reference, 0.0, 0.19)
    assert reference.a_north_m_s2 == 0.0
    fly(reference, 0.0, 0.21)
    assert reference.a_north_m_s2 == pytest.approx(-5.0 * 0.2, rel=0.06), "0.2 s at 5 m/s^3"
    fly(reference, 0.0, 4.0)
    assert reference.v_north_m_s == pytest.approx(0.0, abs=0.02)


def test_the_speed_never_changes_sign_under_neutral_sticks() -> None:
    reference = LoiterReference()
    fly(reference, LAW.angle_rad, 5.0)
    for _ in range(4000):
        reference.step(LAW, 5.0, 0.0, 0.0, NORTH, DT_S)
        assert reference.v_north_m_s >= 0.0


@given(st.floats(-10, 10), st.floats(0.1, 5), st.floats(0.1, 20))
def test_the_square_root_gain_is_odd_growing_and_never_above_the_line(error: float, gain: float, limit: float) -> None:
    out = square_root_gain(error, gain, limit)
    assert square_root_gain(-error, gain, limit) == -out
    assert abs(out) <= abs(gain * error) * (1.0 + 1e-9)
    assert abs(square_root_gain(error * 1.1, gain, limit)) >= abs(out)


@given(st.floats(-4, 4), st.floats(-4, 4))
def test_a_velocity_reference_obeys_its_limits_and_arrives(north: float, east: float) -> None:
    reference = VelocityReference(2.5, 5.0)
    before = (0.0, 0.0)
    for _ in range(4000):
        reference.step(north, east, DT_S)
        now = reference.a_north_m_s2, reference.a_east_m_s2
        assert math.hypot(*now) <= 2.5 * 1.001
        assert math.dist(before, now) <= 5.0 * DT_S * 1.001
        before = now
    assert math.dist((reference.v_north_m_s, reference.v_east_m_s), (north, east)) < 0.02


def test_a_place_is_reached_without_running_past_it() -> None:
    reference = VelocityReference(2.5, 5.0)
    for _ in range(12_000):
        reference.step_to(20.0, 0.0, 5.0, DT_S)
        assert reference.north_m < 20.3
    assert reference.north_m == pytest.approx(20.0, abs=0.1)


def test_tracking_takes_away_a_steady_push() -> None:
    """Position and velocity return to the reference under 1 m/s^2 of wind."""
    tracking, position, speed = Tracking(), 0.0, 0.0
    for _ in range(16_000):
        speed += (tracking.step(-position, -speed, 0.0, DT_S) + 1.0) * DT_S
        position += speed * DT_S
    assert position == pytest.approx(0.0, abs=0.02)
    assert speed == pytest.approx(0.0, abs=0.01)


def test_the_second_order_lag_does_not_overshoot() -> None:
    lag = SecondOrder(0.075)
    values = [lag.step(1.0, DT_S) for _ in range(800)]
    assert max(values) <= 1.0 + 1e-6
    assert values[-1] == pytest.approx(1.0, abs=1e-3)
