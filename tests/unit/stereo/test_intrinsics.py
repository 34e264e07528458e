"""The lens model: the paper's formulas, OpenCV's where it has them, and back again."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics, distort, undistort

LENS = CameraIntrinsics(640, 480, 741.0, 738.0, 322.5, 237.0, 0.01, (-0.18, 0.06, 4e-4, -3e-4, 0.004))

small = st.floats(-1, 1)
coefficients = st.tuples(small, small, small, small, small).map(
    lambda k: (0.25 * k[0], 0.08 * k[1], 2e-3 * k[2], 2e-3 * k[3], 0.01 * k[4])
)
points = st.tuples(st.floats(-0.45, 0.45), st.floats(-0.35, 0.35))


def slow_pixel(lens, x, y):
    """The paper's section II, term by term."""
    k1, k2, k3, k4, k5 = lens.k
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k5 * r2**3
    x_r = radial * x + 2 * k3 * x * y + k4 * (r2 + 2 * x * x)
    y_r = radial * y + k3 * (r2 + 2 * y * y) + 2 * k4 * x * y
    return lens.fx * (x_r + lens.alpha * y_r) + lens.cx, lens.fy * y_r + lens.cy


@given(points, coefficients, st.floats(-0.02, 0.02))
def test_pixels_follow_the_papers_formulas(xy, k, alpha):
    lens = CameraIntrinsics(640, 480, 741.0, 738.0, 322.5, 237.0, alpha, k)
    assert lens.pixels_from_normalised(np.array(xy)) == pytest.approx(slow_pixel(lens, *xy), abs=1e-10)


@given(coefficients)
def test_without_skew_pixels_are_opencvs(k):
    lens = CameraIntrinsics(640, 480, 741.0, 738.0, 322.5, 237.0, 0.0, k)
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], axis=1) * rng.uniform(0.5, 20, (50, 1))
    k1, k2, k3, k4, k5 = k
    theirs, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), lens.K, np.array([k1, k2, k3, k4, k5]))
    assert np.allclose(lens.project(p), theirs[:, 0], atol=1e-9)


@given(coefficients, st.floats(-0.02, 0.02))
def test_undistortion_undoes_distortion(k, alpha):
    lens = CameraIntrinsics(640, 480, 741.0, 738.0, 322.5, 237.0, alpha, k)
    xy = np.random.default_rng(1).uniform(-0.43, 0.43, (200, 2))
    assert np.allclose(lens.normalised_from_pixels(lens.pixels_from_normalised(xy)), xy, atol=1e-11)


def test_a_lens_that_folds_back_gives_no_ray_instead_of_a_wrong_one():
    k = (-1.0, 0.0, 0.0, 0.0, 0.0)
    # r (1 - r^2) never exceeds 0.385
    assert np.isnan(undistort(np.array([[0.5, 0.0]]), k)).all()
    assert np.allclose(undistort(np.array([[0.3, 0.0]]), k), [[0.3389, 0.0]], atol=1e-4)


def test_the_largest_radius_is_where_distortion_turns_back():
    lens = CameraIntrinsics(640, 480, 740.0, 740.0, 320.0, 240.0, 0.0, (-1.0, 0.0, 0.0, 0.0, 0.0))
    r = lens.largest_radius
    assert r == pytest.approx(1 / math.sqrt(3))
    around = distort(np.array([[r - 1e-3, 0.0], [r, 0.0], [r + 1e-3, 0.0]]), lens.k)[:, 0]
    assert around[1] > around[0]
    assert around[1] > around[2]
    straight = CameraIntrinsics(640, 480, 740.0, 740.0, 320.0, 240.0)
    assert math.isinf(straight.largest_radius)


def test_a_smaller_image_of_the_same_lens_sees_the_same():
    half = LENS.rescaled(320, 240)
    xy = np.random.default_rng(2).uniform(-0.4, 0.4, (100, 2))
    full_px, half_px = LENS.pixels_from_normalised(xy), half.pixels_from_normalised(xy)
    # the outer edge of the image, half a pixel outside the first centre, stays the edge
    assert np.allclose((half_px + 0.5) * 2, full_px + 0.5, atol=1e-9)


def test_another_shape_of_image_is_refused():
    with pytest.raises(CalibrationError, match="640x480 px and cannot serve 640x360"):
        LENS.rescaled(640, 360)


@pytest.mark.parametrize("wrong", [{"fx": 0.0}, {"width": 0}, {"cx": math.nan}, {"k": (math.inf, 0, 0, 0, 0)}])
def test_impossible_numbers_are_refused(wrong):
    numbers = {"width": 640, "height": 480, "fx": 740.0, "fy": 740.0, "cx": 320.0, "cy": 240.0, **wrong}
    with pytest.raises(CalibrationError):
        CameraIntrinsics(**numbers)
