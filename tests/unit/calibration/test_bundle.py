"""The joint solve: exact on exact corners, its derivatives and its covariance right, and better than ten solves."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares

from morpheyes_daemon.calibration.solver import bundle_adjustment as bundle
from morpheyes_daemon.calibration.solver.cross_validation import geometry_at
from morpheyes_daemon.calibration.solver.initial_guess import first_guess
from morpheyes_daemon.calibration.solver.projection import camera_vector, project
from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry, infinity_px
from morpheyes_daemon.calibration.solver.solver import calibrate, camera_prior, solve_separately
from morpheyes_daemon.calibration.solver.uncertainty import baseline_uncertainty
from tests.support.synthetic_rig import CAM0, CAM1, TEN_M, observations, true_geometry, true_pose

THREE_M = np.array([0.1, 0.2, 0.3])


def test_the_derivatives_of_the_projection_are_those_of_finite_differences() -> None:
    point, camera = np.array([0.3, -0.2, 1.1]), camera_vector(CAM0)
    _, d_camera, d_point = project(point, camera)
    for row in (0, 1):
        by_camera = approx_fprime(camera, lambda c, row=row: project(point, c)[0][row], 1e-6)
        by_point = approx_fprime(point, lambda p, row=row: project(p, camera)[0][row], 1e-8)
        assert d_camera[row] == pytest.approx(by_camera, rel=1e-4, abs=1e-3), "forward differences, 1e-6 steps"
        assert d_point[row] == pytest.approx(by_point, rel=1e-4, abs=1e-3)


def test_exact_corners_give_the_exact_rig() -> None:
    seen = observations(THREE_M)
    calibration = calibrate(seen)
    state = calibration.solution.state
    # the weak prior of the lens pulls by its share of the corner noise's floor, 1e-6 px
    assert state.cameras[0][:4] == pytest.approx([CAM0.fx, CAM0.fy, CAM0.cx, CAM0.cy], abs=1e-3)
    assert state.cameras[1][:4] == pytest.approx([CAM1.fx, CAM1.fy, CAM1.cx, CAM1.cy], abs=1e-3)
    for index, nominal in enumerate(THREE_M):
        assert calibration.poses[index] == pytest.approx(true_pose(nominal), abs=1e-6)
    assert np.nanmax(np.abs(calibration.solution.residual_px)) < 1e-3


def test_the_solve_ends_where_scipy_ends() -> None:
    seen = observations(THREE_M, views=4, noise_px=0.1, seed=5)
    start, _ = first_guess(seen)
    prior = camera_prior(seen, start)
    ours = bundle.solve(seen, start, prior, sigma_px=1.0)  # wide: no corner is beyond the Huber limit
    root = np.sqrt(np.diag(prior.information))

    def errors(step: np.ndarray) -> np.ndarray:
        cut = len(root)
        moved = bundle._moved(ours.state, step[:cut], step[cut:].reshape(-1, 6))
        residual = bundle.residuals(seen, moved).ravel()
        return np.concatenate([residual, root * (moved.shared - prior.mean)])

    size = len(root) + 6 * seen.view_count
    scale = np.concatenate([np.sqrt(np.diag(ours.covariance)), np.full(6 * seen.view_count, 1e-3)])
    theirs = least_squares(errors, np.zeros(size), x_scale=scale, method="trf", xtol=1e-12, ftol=1e-14, gtol=1e-12)
    assert np.abs(theirs.x / scale).max() < 1e-2, "scipy finds nothing better than a hundredth of a sigma away"


def test_covariance_is_the_scatter_over_many_solves() -> None:
    biases, lengths, sigmas = [], [], []
    for seed in range(16):
        calibration = calibrate(observations(THREE_M, views=8, noise_px=0.1, seed=100 + seed))
        sigmas.append(baseline_uncertainty(calibration, 1))
        solved, true = geometry_at(calibration, 1), true_geometry(THREE_M[1])
        biases.append(float(np.mean(infinity_px(solved, true))))
        lengths.append(solved.length_m - true.length_m)
    # 16 draws tell a sigma to 18 %, poses differ from draw to draw: a factor of 1.7 either way is chance
    assert 1 / 1.7 < np.std(biases) / np.mean([sigma.disparity_px for sigma in sigmas]) < 1.7
    assert 1 / 1.7 < np.std(lengths) / np.mean([sigma.length_m for sigma in sigmas]) < 1.7


def test_ten_sets_help_each_other() -> None:
    joint, separate = [], []
    for seed in range(3):
        seen = observations(TEN_M, views=8, noise_px=0.1, seed=20 + seed)
        together = calibrate(seen)
        joint += [_bias_px(geometry_at(together, i), TEN_M[i]) for i in range(10)]
        separate += [_bias_px(geometry_at(one, 0), TEN_M[i]) for i, one in enumerate(solve_separately(seen))]
    assert np.sqrt(np.mean(np.square(joint))) < 0.75 * np.sqrt(np.mean(np.square(separate)))


def test_an_outlier_view_is_named_by_the_guilty_camera() -> None:
    seen = observations(THREE_M, noise_px=0.05, seed=3)
    rng = np.random.default_rng(0)
    seen.right[7] += rng.normal(0, 3.0, seen.right[7].shape)
    calibration = calibrate(seen)
    assert [outlier.name for outlier in calibration.outliers] == [seen.names[7][1]]
    assert calibration.solution.sigma_px == pytest.approx(0.05, rel=0.1)


def test_a_pair_that_was_moved_in_between_is_named_whole() -> None:
    seen = observations(THREE_M, noise_px=0.05, seed=3)
    seen.right[7] += [0.0, 4.0]
    names = {outlier.name for outlier in calibrate(seen).outliers}
    assert names == set(seen.names[7])


def test_single_stray_corners_are_set_aside_and_their_pictures_kept() -> None:
    seen = observations(THREE_M, noise_px=0.05, seed=3)
    seen.left[4, 10] += [3.0, -2.0]
    seen.right[9, 30] += [1.5, 2.0]
    calibration = calibrate(seen)
    assert calibration.stray_corners == 2
    assert not calibration.outliers


def _bias_px(solved: StereoGeometry, nominal_m: float) -> float:
    return float(np.mean(infinity_px(solved, true_geometry(nominal_m))))
