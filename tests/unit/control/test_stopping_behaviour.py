"""The braking distance against a slow scalar plant, and the table's look-ups between and beyond its rows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from morpheyes_daemon.control.stopping import Brake, StoppingTable, braking_distances_m

LEAN_RAD = math.radians(20.0)
BRAKES = [Brake(2.5, 5.0, 0.2), Brake(1.0, 2.0, 1.0), Brake(2.5, 5.0, 0.0, 0.5), Brake(4.0, 10.0, 0.3, 1.5)]


def slow_m(v: float, limit: float, brake: Brake, dt: float = 5e-4) -> float:
    """The identified plant step by step, written from its description: neutral sticks at time zero."""
    drag = 9.80665 * math.tan(LEAN_RAD) / limit
    wanted = lean = math.atan(min(1.0, v / limit) * math.tan(LEAN_RAD))
    rate = braking = way = t = 0.0
    corner = 1.0 / 0.075
    while v > 0.002 and t < 60.0:
        if t >= 0.02:
            wanted = 0.0
        knee = brake.jerk_m_s3 / brake.gain_1_s**2
        curve = math.sqrt(2 * brake.jerk_m_s3 * (v - knee / 2)) if v > knee else v * brake.gain_1_s
        target = min(brake.accel_m_s2, curve) if t >= 0.02 + brake.delay_s else 0.0
        step = brake.jerk_m_s3 * dt
        braking += max(-step, min(step, target - braking))
        rate += (corner * corner * (wanted - lean) - 2 * corner * rate) * dt
        lean += rate * dt
        v = max(0.0, v + (9.80665 * math.tan(lean) - drag * v - braking) * dt)
        way += v * dt
        t += dt
    return way


@pytest.mark.parametrize("brake", BRAKES, ids=str)
@pytest.mark.parametrize(("speed", "limit"), [(0.5, 3.0), (2.0, 3.0), (4.0, 5.0), (5.0, 3.0), (7.0, 12.5)])
def test_the_distance_is_that_of_the_slow_plant(brake: Brake, speed: float, limit: float) -> None:
    found = float(braking_distances_m(np.array([speed]), np.array([limit]), LEAN_RAD, brake)[0, 0])
    # steps of 5 ms, and the last 2 cm/s cut off
    assert found == pytest.approx(slow_m(speed, limit, brake), rel=0.02, abs=0.015)


def test_rows_are_limits_and_columns_speeds() -> None:
    found = braking_distances_m(np.array([1.0, 2.0, 3.0]), np.array([2.0, 8.0]), LEAN_RAD, BRAKES[0])
    assert found.shape == (2, 3)
    assert found[0, 2] == pytest.approx(slow_m(3.0, 2.0, BRAKES[0]), rel=0.02)
    assert found[1, 0] == pytest.approx(slow_m(1.0, 8.0, BRAKES[0]), rel=0.02)


@pytest.fixture(scope="module")
def table() -> StoppingTable:
    return StoppingTable([1.0, 2.0, 4.0], LEAN_RAD, BRAKES[0])


@pytest.mark.parametrize("speed", [0.0, 0.04, 0.1, 1.23, 2.57, 6.0, 9.95])
@pytest.mark.parametrize("limit", [1.0, 2.0, 4.0])
def test_between_its_speeds_the_table_is_near_the_plant(table: StoppingTable, speed: float, limit: float) -> None:
    exact = float(braking_distances_m(np.array([speed]), np.array([limit]), LEAN_RAD, BRAKES[0])[0, 0])
    # alone it is cut off at 2 cm/s, in the table with the fastest one
    assert table.distance_m(speed, limit, 0.0) == pytest.approx(exact, abs=0.015)


def test_between_two_limits_it_is_between_their_distances_in_proportion(table: StoppingTable) -> None:
    low, high = (table.distance_m(3.0, limit, 0.0) for limit in (2.0, 4.0))
    assert high > low
    for share in (0.25, 0.5, 0.75):
        assert table.distance_m(3.0, 2.0 + 2.0 * share, 0.0) == pytest.approx(low + share * (high - low))
    assert table.distance_m(3.0, 0.1, 0.0) == table.distance_m(3.0, 1.0, 0.0), "below the first row"
    assert table.distance_m(3.0, 40.0, 0.0) == high, "beyond the last"


def test_a_reaction_adds_the_way_flown_meanwhile_and_the_sign_of_a_speed_does_not_count(table: StoppingTable) -> None:
    still = table.distance_m(2.5, 2.0, 0.0)
    assert table.distance_m(2.5, 2.0, 0.8) == pytest.approx(still + 2.0)
    assert table.distance_m(-2.5, 2.0, 0.8) == pytest.approx(still + 2.0)


def test_beyond_the_tables_speed_the_last_slope_is_carried_on(table: StoppingTable) -> None:
    at = [table.distance_m(speed, 4.0, 0.0) for speed in (9.9, 10.0, 12.0)]
    assert at[2] == pytest.approx(at[1] + 20.0 * (at[1] - at[0]))


@pytest.mark.parametrize("reaction_s", [0.0, 1.0])
@pytest.mark.parametrize("limit", [1.0, 3.0, 4.0, 9.0])
@pytest.mark.parametrize("speed", [0.05, 0.7, 1.0, 3.33, 9.9])
def test_the_speed_that_fits_a_distance_is_the_one_that_needs_it(
    table: StoppingTable, speed: float, limit: float, reaction_s: float
) -> None:
    needed = table.distance_m(speed, limit, reaction_s)
    assert table.speed_m_s(needed, limit, reaction_s) == pytest.approx(speed, abs=1e-9)


def test_no_distance_is_no_speed_and_much_is_the_tables_last(table: StoppingTable) -> None:
    for nothing in (0.0, -1.0, math.nan):
        assert table.speed_m_s(nothing, 2.0, 0.5) == 0.0
    assert table.speed_m_s(1e-6, 2.0, 0.5) < 1e-4
    assert table.speed_m_s(1000.0, 2.0, 0.5) == 10.0


def test_a_faster_vehicle_never_stops_sooner_in_the_table() -> None:
    steep = StoppingTable([0.3], LEAN_RAD, Brake(2.5, 50.0, 0.0))
    distances = [steep.distance_m(0.1 * k, 0.3, 0.0) for k in range(101)]
    assert distances == sorted(distances)
