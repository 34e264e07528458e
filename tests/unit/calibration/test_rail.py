"""The rail: straight where the servo is straight, wavy where it waves, and a help to the solve."""

import numpy as np
import pytest

from morpheyes_daemon.benchmarks.calibration_error import true_projections
from morpheyes_daemon.calibration.solver.cross_validation import geometry_at, held_out, leave_one_out
from morpheyes_daemon.calibration.solver.rail_model import fit_rail
from morpheyes_daemon.calibration.solver.rectification_residuals import row_error_px
from morpheyes_daemon.calibration.solver.solver import calibrate
from tests.support.synthetic_rig import TEN_M, observations, true_geometry


def test_a_straight_rail_is_found_straight() -> None:
    rng = np.random.default_rng(1)
    sigma = np.array([1e-5] * 3 + [1e-5] * 3)
    poses = np.zeros((10, 6))
    poses[:, 3] = TEN_M
    poses[:, 0] = 1e-3 * (TEN_M - 0.2) / 0.1
    rail = fit_rail(TEN_M, poses + sigma * rng.standard_normal((10, 6)), np.diag(np.tile(sigma**2, 10)))
    assert rail is not None
    orders = {component.name: component.order for component in rail.components}
    assert orders["x"] == 1
    assert orders["rotation_x"] == 1
    # 2e-5 is what ten measurements of 1e-5 can hide
    assert all(component.scatter < 2e-5 for component in rail.components)


def test_a_rail_with_play_keeps_its_scatter() -> None:
    rng = np.random.default_rng(2)
    poses = np.zeros((10, 6))
    poses[:, 3] = TEN_M + 3e-4 * rng.standard_normal(10)
    rail = fit_rail(TEN_M, poses, np.diag(np.full(60, 1e-12)))
    assert rail is not None
    # the scatter of ten draws is known to a quarter
    assert rail.components[3].scatter == pytest.approx(3e-4, rel=0.6)


def test_three_baselines_are_no_rail() -> None:
    assert fit_rail(TEN_M[:3], np.zeros((3, 6)), np.eye(18)) is None


def test_between_the_calibrated_baselines_the_knots_follow_the_bend() -> None:
    calibration = calibrate(observations(TEN_M, noise_px=0.02, seed=4))
    nominal_m, poses = calibration.knots()
    assert set(TEN_M) <= set(nominal_m)
    assert np.diff(nominal_m).max() <= 0.012 + 1e-9
    for nominal, T_cam0_cam1 in zip(nominal_m, poses, strict=True):
        true = true_geometry(nominal)
        # corners of 0.02 px over ten sets leave a twentieth of that in length and direction
        assert np.linalg.norm(T_cam0_cam1[:3, 3]) == pytest.approx(true.length_m, abs=1e-4)
        assert T_cam0_cam1[:3, :3] == pytest.approx(true.T_cam0_cam1[:3, :3], abs=2e-4)


def test_an_inner_baseline_is_predicted_by_the_others() -> None:
    calibration = calibrate(observations(TEN_M, noise_px=0.1, seed=6))
    unseen = held_out(calibration)
    left_out = leave_one_out(calibration, unseen)
    assert [round(one.baseline_mm, 1) for one in left_out] == [round(b * 1e3, 1) for b in TEN_M[1:-1]]
    for one in left_out:
        assert one.epipolar_median_px <= 1.3 * one.full_epipolar_median_px
        assert one.baseline_error_mm < 0.3
        assert one.disparity_bias_px < 0.15, "corner noise of 0.1 px and ten views"


def test_held_out_rows_are_corner_noise_and_little_else() -> None:
    unseen = held_out(calibrate(observations(TEN_M, noise_px=0.1, seed=6)))
    # two cameras with 0.1 px each: median of |N(0, 0.141)| is 0.095, 95 % is 0.277; poses add some percent
    assert unseen.median_px == pytest.approx(0.095, rel=0.12)
    assert unseen.p95_px == pytest.approx(0.277, rel=0.12)


def test_rows_of_true_projections_agree_at_every_calibrated_baseline() -> None:
    calibration = calibrate(observations(TEN_M, noise_px=0.05, seed=8))
    for index, nominal in enumerate(TEN_M):
        left, right = true_projections(true_geometry(nominal))
        assert np.median(np.abs(row_error_px(geometry_at(calibration, index), left, right))) < 0.05
