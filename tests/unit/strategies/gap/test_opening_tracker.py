"""A standing opening is averaged, an oscillating one predicted, and the pointing error separated from its position."""

import math

import numpy as np
import pytest

from morpheyes_daemon.strategies.gap.opening_tracker import (
    POSITION_WALK_M_SQRT_S,
    PointMeasurement,
    PointTracker,
    fit_oscillation,
)

S = 1_000_000_000
SIGMA = np.full(3, 0.02)


def sway(t_s):
    return np.array([4.0, 0.5 * math.sin(t_s + 0.7), -1.4 + 0.15 * math.cos(t_s + 0.7)])


def measured(where, seconds, noise_m=0.02, moves=False, yaw_rad=0.0):
    track, rng = PointTracker(yaw_rad), np.random.default_rng(0)
    for k in range(round(5 * seconds)):
        track.update(k * S // 5, where(k / 5) + rng.normal(0.0, noise_m, 3), SIGMA)
        if moves:
            track.set_moving()
    return track, (round(5 * seconds) - 1) / 5


def approached(where, pointing_rad, moves=False):
    """Measured from 4 m for ten seconds, then while approaching at 3 m/s to 1 m, with a pointing error right and down."""
    track, rng = PointTracker(), np.random.default_rng(3)
    for k in range(56):
        t_s, range_m = k / 5, min(4.0, 4.0 - 3.0 * (k / 5 - 10.0))
        off = np.array([0.0, pointing_rad * range_m, -pointing_rad * range_m]) + rng.normal(0.0, 0.002 * range_m, 3)
        track.update(k * S // 5, where(t_s) + off, np.full(3, 0.003 * range_m), range_m)
        if moves:
            track.set_moving()
    return track, 11.0


def test_a_standing_point_is_averaged():
    track, t_s = measured(lambda t: np.array([4.0, 0.2, -1.5]), 6.0)
    # noise 20 mm, averaged over some frames
    assert track.at(round(t_s * S)).p_m == pytest.approx((4.0, 0.2, -1.5), abs=0.03)
    assert track.at(round(t_s * S)).v_m_s == pytest.approx((0, 0, 0), abs=1e-9)
    assert track.spread_m(3.0) < 0.1


def test_a_pointing_error_is_estimated_as_the_range_shrinks():
    place = np.array([4.0, 0.2, -1.5])
    track, t_s = approached(lambda _: place, 0.008)
    # the last measurement, from 1 m, is 8 mm off, the mean of all 31 mm
    assert track.at(round(t_s * S)).p_m[1:] == pytest.approx(place[1:], abs=0.004)


def test_an_oscillation_is_predicted_for_two_seconds():
    track, t_s = measured(sway, 9.0, moves=True)
    assert track.oscillation is not None
    ahead = track.at(round((t_s + 2.0) * S))
    # half a second of a 0.5 m/s wall would be 0.25 m
    assert ahead.p_m[1:] == pytest.approx(sway(t_s + 2.0)[1:], abs=0.04)
    assert ahead.v_m_s[1] == pytest.approx(0.5 * math.cos(t_s + 2.7), abs=0.06)


def test_an_oscillation_is_predicted_in_spite_of_a_pointing_error():
    track, t_s = approached(sway, 0.008, moves=True)
    # 0.4 s: from the last measurement to the wall
    assert track.at(round((t_s + 0.4) * S)).p_m[1:] == pytest.approx(sway(t_s + 0.4)[1:], abs=0.012)


def test_an_uncertain_measurement_does_not_change_the_oscillation():
    track, t_s = measured(sway, 12.0, moves=True)
    before = track.at(round((t_s + 0.5) * S)).p_m
    track.update(round((t_s + 0.2) * S), sway(t_s + 0.2) + (0.0, 0.6, 0.0), np.array([0.02, 0.6, 0.6]))
    assert track.oscillation is not None
    assert track.at(round((t_s + 0.5) * S)).p_m[1:] == pytest.approx(before[1:], abs=0.005)


def test_a_moving_point_without_an_oscillation_is_predicted_by_its_speed():
    track, t_s = measured(lambda t: np.array([4.0, 0.4 * t, -1.5]), 2.4, noise_m=0.005, moves=True)
    assert track.oscillation is None
    assert track.at(round((t_s + 0.5) * S)).p_m[1] == pytest.approx(0.4 * (t_s + 0.5), abs=0.06)


def test_a_moving_point_has_a_larger_spread():
    track, _ = measured(sway, 4.0)
    assert track.spread_m(3.0) > 0.2


def test_a_wall_does_not_move_along_its_normal():
    yaw = 0.6
    R = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1.0]])
    track, t_s = measured(lambda t: R @ sway(t), 9.0, moves=True, yaw_rad=yaw)
    v = R.T @ track.at(round(t_s * S)).v_m_s
    assert v[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(v[1]) > 0.1


def test_random_positions_are_no_oscillation():
    rng = np.random.default_rng(1)
    jumps = [PointMeasurement(k * S // 5, rng.normal(0.0, 0.4, 3), SIGMA, 4.0) for k in range(40)]
    assert fit_oscillation(jumps, POSITION_WALK_M_SQRT_S) is None
    assert (
        fit_oscillation(
            [PointMeasurement(k * S // 5, sway(k / 5), SIGMA, 4.0) for k in range(5)], POSITION_WALK_M_SQRT_S
        )
        is None
    )


def test_four_periods_give_a_better_period_than_two():
    rng, errors = np.random.default_rng(2), {}
    for seconds in (10, 25):
        errors[seconds] = []
        for _ in range(12):
            drift = np.cumsum(rng.normal(0.0, 0.02 * math.sqrt(0.2), 5 * seconds))
            seen = [
                PointMeasurement(k * S // 5, sway(k / 5) + np.array([0.0, drift[k], 0.0]), SIGMA, 4.0)
                for k in range(5 * seconds)
            ]
            wave = fit_oscillation(seen, POSITION_WALK_M_SQRT_S)
            assert wave is not None
            errors[seconds].append(wave.rate_rad_s - 1.0)
    # the error of a frequency goes with the record's length to the power of -1.5: by 4 here, of few trials by 2
    assert np.std(errors[25]) < np.std(errors[10]) / 2
