"""How wrong the twin's estimates are: noise, delay and drift as declared, the same for the same seed."""

import itertools
import math
import statistics
from typing import Any

import pytest

from morpheyes_daemon.simulation.airframe.dynamics import STEP_S, Airframe, Vehicle
from morpheyes_daemon.simulation.autopilot.ekf import Ekf, Estimate, Estimator, EstimatorNoise
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP, ParameterTable

TICK_S = 0.01


def flying(noise: EstimatorNoise, seed: int = 1, **changes: float) -> tuple[Vehicle, Estimator]:
    vehicle = Vehicle(Airframe(shiver_rad=0.0))
    vehicle.down_m, vehicle.on_ground, vehicle.controls.motors = -2.0, False, True
    estimator = Estimator(vehicle, ParameterTable(changes), noise, seed, 0.0)
    estimator.boot(0)
    return vehicle, estimator


def advance(vehicle: Vehicle, estimator: Estimator, seconds: float) -> list[Estimate]:
    estimates = []
    for _ in range(round(seconds / TICK_S)):
        for _ in range(round(TICK_S / STEP_S)):
            vehicle.step()
        estimator.advance(vehicle.t_ns, TICK_S)
        estimates.append(estimator.estimate())
    return estimates


def test_the_velocity_noise_has_its_sigma_and_is_not_white() -> None:
    estimates = advance(*flying(EstimatorNoise()), 120.0)
    errors = [e.v_ned_m_s[1] for e in estimates]
    assert statistics.pstdev(errors) == pytest.approx(0.05, rel=0.15), "120 s hold 400 time constants"
    steps = [b - a for a, b in itertools.pairwise(errors)]
    assert statistics.pstdev(steps) < 0.03


def test_the_position_drifts_as_a_random_walk() -> None:
    ends = []
    for seed in range(30):
        _vehicle, estimator = flying(EstimatorNoise(drift_m_sqrt_s=0.1), seed)
        for tick in range(400):
            estimator.advance(tick * 10_000_000, TICK_S)
        ends += estimator.drift_m[:2]
    assert statistics.pstdev(ends) == pytest.approx(0.1 * math.sqrt(4.0), rel=0.25), "60 samples: 9 % sigma"


def test_the_estimate_is_late_by_its_delay() -> None:
    quiet = EstimatorNoise(velocity_m_s=0.0, drift_m_sqrt_s=0.0, attitude_rad=0.0, height_m=0.0, delay_ns=100_000_000)
    vehicle, estimator = flying(quiet)
    vehicle.controls.lean_forward_rad = 0.2
    advance(vehicle, estimator, 1.0)
    truth = vehicle.truth_at(vehicle.t_ns - 100_000_000)
    estimate = estimator.estimate()
    assert estimate.v_ned_m_s == pytest.approx(truth.v_ned_m_s, abs=1e-9)
    assert estimate.pitch_rad == pytest.approx(truth.pitch_rad, abs=1e-9)


def test_body_rates_are_those_of_the_turning_body() -> None:
    quiet = EstimatorNoise(velocity_m_s=0.0, drift_m_sqrt_s=0.0, attitude_rad=0.0, height_m=0.0, delay_ns=0)
    vehicle, estimator = flying(quiet)
    vehicle.controls.yaw_rate_rad_s = 1.0
    vehicle.controls.lean_forward_rad = 0.3
    estimate = advance(vehicle, estimator, 2.0)[-1]
    p, q, r = estimate.rates_frd_rad_s
    assert p == pytest.approx(math.sin(0.3), abs=0.02), "nose down and turning right is a roll to the right"
    assert q == pytest.approx(0.0, abs=0.02)
    assert r == pytest.approx(math.cos(0.3), abs=0.02)


def test_the_range_is_slanted_by_the_lean_and_ends_at_its_limits() -> None:
    quiet = EstimatorNoise(height_m=0.0, attitude_rad=0.0)
    vehicle, estimator = flying(quiet, RNGFND1_MAX=6.0)
    vehicle.controls.lean_forward_rad = 0.3
    estimate = advance(vehicle, estimator, 1.0)[-1]
    assert estimate.range_m == pytest.approx(vehicle.height_m / math.cos(0.3), rel=0.01)
    vehicle.down_m = -20.0
    assert advance(vehicle, estimator, 0.1)[-1].range_m == 6.0


def test_the_same_seed_gives_the_same_errors() -> None:
    runs = [advance(*flying(EstimatorNoise(), seed), 1.0)[-1] for seed in (3, 3, 4)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


@pytest.mark.parametrize(
    ("setup", "told_s", "flags_s", "reported_s"),
    [pytest.param(FLOW_SETUP, 0.5, 0.9, 5.0, id="flow"), pytest.param({}, 0.0, 7.6, 16.8, id="gps")],
)
def test_lost_aiding_is_told_in_order(setup: dict[str, Any], told_s: float, flags_s: float, reported_s: float) -> None:
    vehicle, estimator = flying(EstimatorNoise(), **setup)
    advance(vehicle, estimator, 0.1)
    assert estimator.flags & Ekf.POS_HORIZ_REL
    estimator.lose_aiding()
    lost_s = 0.0
    for moment_s, signs in [
        (told_s - 0.05, (True, True, True)),
        (told_s + 0.05, (False, True, True)),
        (flags_s - 0.05, (False, True, True)),
        (flags_s + 0.05, (False, False, True)),
        (reported_s - 0.05, (False, False, True)),
        (reported_s + 0.05, (False, False, False)),
    ]:
        if moment_s < 0.0:
            continue
        advance(vehicle, estimator, moment_s - lost_s)
        lost_s = moment_s
        assert (estimator.aided, estimator.has_position, estimator.dead_reckons) == signs
        assert bool(estimator.flags & Ekf.CONST_POS_MODE) == (not signs[2])
    estimator.regain_aiding()
    assert estimator.has_position
    assert estimator.aided


def test_without_aiding_the_velocity_estimate_walks_away() -> None:
    vehicle, estimator = flying(EstimatorNoise(velocity_m_s=0.0))
    estimator.lose_aiding()
    estimate = advance(vehicle, estimator, 4.0)[-1]
    assert math.hypot(*estimate.v_ned_m_s[:2]) > 0.02
