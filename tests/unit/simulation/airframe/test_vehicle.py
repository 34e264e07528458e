"""The airframe: free fall, ground, drag, lean, and the history of the truth."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.simulation.airframe.dynamics import STEP_NS, STEP_S, Airframe, Vehicle
from morpheyes_daemon.simulation.airframe.second_order import GRAVITY_M_S2
from morpheyes_daemon.simulation.airframe.wind import WindConditions

STILL = Airframe(shiver_rad=0.0)


def hovering(airframe: Airframe = STILL, wind_m_s: float = 0.0, height_m: float = 50.0) -> Vehicle:
    vehicle = Vehicle(airframe, WindConditions(wind_m_s, gust_fraction=0.0))
    vehicle.down_m = -height_m
    vehicle.on_ground = False
    vehicle.controls.motors = True
    return vehicle


def run(vehicle: Vehicle, seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        vehicle.step()


def test_it_rests_on_the_ground_until_the_motors_lift_it() -> None:
    vehicle = Vehicle(STILL)
    run(vehicle, 1.0)
    assert vehicle.height_m == 0.0
    vehicle.controls.motors = True
    vehicle.controls.accel_up_m_s2 = 1.0
    run(vehicle, 1.0)
    assert vehicle.height_m == pytest.approx(0.5, rel=0.2)


def test_without_motors_it_falls_and_stays_down() -> None:
    vehicle = hovering(height_m=5.0)
    vehicle.controls.motors = False
    run(vehicle, 0.5)
    assert vehicle.v_down_m_s == pytest.approx(GRAVITY_M_S2 * 0.45, rel=0.1)
    run(vehicle, 3.0)
    assert vehicle.height_m == 0.0
    assert vehicle.v_down_m_s == 0.0


def test_a_lean_settles_where_drag_balances_it() -> None:
    vehicle = hovering()
    vehicle.controls.lean_forward_rad = math.radians(6.0)
    run(vehicle, 25.0)
    v = vehicle.v_north_m_s
    assert (STILL.drag_1_s + STILL.drag_1_m * v) * v == pytest.approx(
        GRAVITY_M_S2 * math.tan(math.radians(6.0)), rel=0.01
    )
    assert v == pytest.approx(3.0, rel=0.1), "6 degrees hold 3 m/s"


def test_a_level_vehicle_drifts_with_the_wind() -> None:
    vehicle = hovering(wind_m_s=3.0, height_m=6.096)
    run(vehicle, 60.0)
    assert vehicle.v_north_m_s == pytest.approx(-3.0, rel=0.05)


def test_the_lean_follows_as_a_critically_damped_lag() -> None:
    vehicle = hovering()
    vehicle.controls.lean_right_rad = 0.1
    run(vehicle, 0.15)
    expected = 0.1 * (1.0 - (1.0 + 0.15 / 0.075) * math.exp(-0.15 / 0.075))
    assert vehicle.lean_rad[1] == pytest.approx(expected, rel=0.03)
    run(vehicle, 2.0)
    assert vehicle.attitude_rad()[0] == pytest.approx(0.1, rel=1e-3)


def test_the_attitude_shivers_by_its_sigma_and_by_its_seed() -> None:
    def rolls(seed: int) -> list[float]:
        vehicle = Vehicle(Airframe(shiver_rad=0.01), seed=seed)
        vehicle.down_m, vehicle.on_ground, vehicle.controls.motors = -50.0, False, True
        recorded = []
        for _ in range(8000):
            vehicle.step()
            recorded.append(vehicle.attitude_rad()[0])
        return recorded

    one = rolls(1)
    assert np.std(one) == pytest.approx(0.01, rel=0.1)
    assert rolls(1) == one
    assert rolls(2) != one


@given(st.floats(0.0, 1.0))
def test_the_truth_between_two_steps_is_interpolated(part: float) -> None:
    vehicle = hovering()
    vehicle.v_north_m_s = 2.0
    run(vehicle, 0.05)
    t_ns = vehicle.t_ns - STEP_NS
    a, b = vehicle.truth_at(t_ns), vehicle.truth_at(t_ns + STEP_NS)
    mixed = vehicle.truth_at(t_ns + round(part * STEP_NS))
    assert mixed.p_ned_m[0] == pytest.approx(a.p_ned_m[0] + part * (b.p_ned_m[0] - a.p_ned_m[0]), abs=1e-6)


def test_the_truth_turns_the_short_way_through_south() -> None:
    vehicle = hovering()
    vehicle.yaw_rad = math.pi - 1e-4
    vehicle.controls.yaw_rate_rad_s = 3.0
    vehicle.step()
    before_ns = vehicle.t_ns
    run(vehicle, 0.2)
    for t_ns in range(before_ns, vehicle.t_ns, STEP_NS // 5):
        assert abs(vehicle.truth_at(t_ns).yaw_rad) > math.pi - 0.7


def test_the_truth_is_kept_for_three_seconds_and_a_little_ahead() -> None:
    vehicle = hovering()
    run(vehicle, 10.0)
    vehicle.truth_at(vehicle.t_ns - 3_000_000_000)
    ahead = vehicle.truth_at(vehicle.t_ns + 10_000_000)
    assert ahead.t_ns == vehicle.t_ns + 10_000_000
    for t_ns in (vehicle.t_ns - 6_000_000_000, vehicle.t_ns + 200_000_000):
        with pytest.raises(InputError, match="not known"):
            vehicle.truth_at(t_ns)


def test_the_pose_takes_body_axes_to_ned() -> None:
    vehicle = hovering()
    vehicle.north_m, vehicle.yaw_rad = 7.0, math.pi / 2
    vehicle.step()
    T = vehicle.truth_at(vehicle.t_ns).T_ned_frd
    np.testing.assert_allclose(T @ [1.0, 0.0, 0.0, 1.0], [7.0, 1.0, vehicle.down_m, 1.0], atol=1e-3)
