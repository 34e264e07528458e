"""From a raw frame of a crooked rig to depth in metres, with limits, uncertainty and what it was made from."""

import math

import numpy as np
import pytest

from morpheyes_daemon.config.vehicle import StereoConfig
from morpheyes_daemon.errors import CalibrationError, InputError
from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.depth import (
    DepthEstimator,
    depth_from_disparity,
    depth_sigma,
    grey,
    near_limit_m,
)
from morpheyes_daemon.stereo.rectify import rays
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel
from tests.support.panels import Panel, crooked_rig, look, raw_pair

SIZE = (320, 240)


def frame_of(left, right, baseline_m, sigma_m=1e-4):
    return StereoFrame(7, 123, left, right, BaselineEstimate(123, baseline_m, baseline_m, sigma_m, False))


def true_depth(panels, depth):
    """Depth of every rectified pixel along the rectified axis, from the panels themselves."""
    pinhole = depth.pinhole
    v, u = np.mgrid[0 : pinhole.height, 0 : pinhole.width].astype(float)
    R_cam0_rect = depth.T_rig_rect[:3, :3]
    direction = rays(pinhole, np.stack([u, v], axis=-1)) @ R_cam0_rect.T
    return look(panels, np.eye(4), direction, pinhole.f_px)[1]


@pytest.fixture(scope="module")
def rig():
    return crooked_rig()


@pytest.mark.parametrize("baseline_m", [0.1, 0.1777, 0.3])
def test_depth_is_right_through_lenses_and_misalignment(rig, baseline_m):
    panels = [Panel(6.0, slope_x=0.3), Panel(2.5, x_m=(-0.4, 0.2), y_m=(-0.5, 0.4), seed=3)]
    left, right = raw_pair(panels, rig.rescaled(*SIZE), baseline_m, noise=1.5)
    depth = DepthEstimator(rig, size=SIZE).estimate(frame_of(left, right, baseline_m))
    truth = true_depth(panels, depth)
    known = np.isfinite(depth.depth_m)
    assert known.mean() > 0.8
    sigma = depth_sigma(truth, depth.baseline_m, depth.pinhole.f_px, depth.sigma_disparity_px)
    error = np.abs(depth.depth_m - truth)[known] / sigma[known]
    # the stated quarter of a pixel covers nearly everything but the panel's outline
    assert np.median(error) < 0.6
    assert np.mean(error > 3) < 0.04


def test_a_depth_map_says_what_it_was_made_from(rig):
    left, right = raw_pair([Panel(3.0)], rig.rescaled(*SIZE), 0.2)
    depth = DepthEstimator(rig, size=SIZE).estimate(frame_of(left, right, 0.2))
    assert (depth.seq, depth.t_ns) == (7, 123)
    assert depth.baseline_m == pytest.approx(rig.length_m(0.2))
    assert depth.calibration_hash == calibration_hash(rig)
    assert depth.near_limit_m == pytest.approx(depth.baseline_m * depth.pinhole.f_px / 80)
    assert depth.valid_fraction == pytest.approx(np.isfinite(depth.depth_m).mean())
    assert depth.ceiling_fraction == pytest.approx(depth.near.mean())
    assert depth.depth_m.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        depth.depth_m[0, 0] = 1.0


def test_uncertainties_of_servo_and_calibration_add_in_squares(rig):
    baselines = tuple(
        CalibratedBaseline(b.nominal_m, b.q_cam0_cam1, b.t_cam0_cam1_m, None, 3e-4, 2e-4) for b in rig.baselines
    )
    unsure = RigModel(rig.cam0, rig.cam1, baselines)
    left, right = raw_pair([Panel(3.0)], rig.rescaled(*SIZE), 0.2)
    depth = DepthEstimator(unsure, size=SIZE).estimate(frame_of(left, right, 0.2, sigma_m=4e-4))
    assert depth.baseline_sigma_m == pytest.approx(5e-4)
    assert depth.sigma_disparity_px == pytest.approx(math.hypot(0.25, depth.pinhole.f_px * 2e-4))


def test_the_search_goes_as_far_as_asked_and_no_further_than_configured(rig):
    left, right = raw_pair([Panel(3.0)], rig.rescaled(*SIZE), 0.3)
    estimator = DepthEstimator(rig, StereoConfig(disparities_fraction=0.25), SIZE)
    frame = frame_of(left, right, 0.3)
    f_px = estimator.estimate(frame).pinhole.f_px
    bf = rig.length_m(0.3) * f_px
    assert estimator.estimate(frame, near_m=3.5).near_limit_m == pytest.approx(bf / 48)
    assert estimator.estimate(frame, near_m=0.2).near_limit_m == pytest.approx(bf / 80)
    shorter = DepthEstimator(rig, StereoConfig(disparities_fraction=0.1), SIZE).estimate(frame)
    assert shorter.near_limit_m == pytest.approx(bf / 32)


def test_colour_and_grey_frames_give_the_same_depth(rig):
    left, right = raw_pair([Panel(3.0)], rig.rescaled(*SIZE), 0.2)
    estimator = DepthEstimator(rig, size=SIZE)
    plain = estimator.estimate(frame_of(left, right, 0.2))
    coloured = estimator.estimate(frame_of(np.dstack([left] * 3), np.dstack([right] * 3), 0.2))
    assert np.array_equal(plain.depth_m, coloured.depth_m, equal_nan=True)
    assert np.array_equal(grey(np.dstack([left] * 3)), left)


def test_frames_of_another_size_are_refused(rig):
    wrong = np.zeros((240, 324), np.uint8)
    with pytest.raises(InputError, match="324x240 px, but 320x240 px"):
        DepthEstimator(rig, size=SIZE).estimate(frame_of(wrong, wrong, 0.2))


def test_a_baseline_the_calibration_lacks_is_refused(rig):
    image = np.zeros((240, 320), np.uint8)
    with pytest.raises(CalibrationError, match="100 to 300 mm"):
        DepthEstimator(rig, size=SIZE).estimate(frame_of(image, image, 0.05))


def test_depth_from_disparity_is_b_f_over_d():
    d = np.array([[np.nan, 0.0, -3.0, 10.0]], np.float32)
    z = depth_from_disparity(d, 0.2, 500.0)
    assert z[0, 3] == pytest.approx(10.0)
    assert np.isnan(z[0, :3]).all()
    with_offset = depth_from_disparity(d, 0.2, 500.0, doffs_px=10.0)
    assert with_offset[0, 1:].tolist() == pytest.approx([10.0, 100 / 7, 5.0])
    assert near_limit_m(0.2, 500.0, 80, 20.0) == pytest.approx(1.0)


def test_sigma_is_what_noise_on_every_input_makes_of_the_depth():
    rng = np.random.default_rng(0)
    z, b, f = 4.0, 0.2, 740.0
    sigma_d, sigma_b, sigma_yaw = 0.25, 1e-3, 2e-4
    n = 200_000
    d = b * f / z + sigma_d * rng.standard_normal(n) + f * sigma_yaw * rng.standard_normal(n)
    measured = (b + sigma_b * rng.standard_normal(n)) * f / d
    # 200 000 draws know a standard deviation to 0.2 %, and the law is the first order of the true one
    assert np.std(measured) == pytest.approx(depth_sigma(z, b, f, sigma_d, sigma_b, sigma_yaw), rel=0.01)


def test_sigma_of_a_map_keeps_its_shape_and_unknowns():
    z = np.array([[1.0, np.nan], [2.0, 4.0]], np.float32)
    sigma = depth_sigma(z, 0.1, 400.0, 0.25)
    assert sigma.dtype == np.float32
    assert np.isnan(sigma[0, 1])
    assert sigma[1, 1] == pytest.approx(16 * 0.25 / 40)
    assert sigma[1, 0] / sigma[0, 0] == pytest.approx(4.0)
