"""Rectification: rows align at any baseline, maps are exact to 0.01 px, images follow the maps."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rectify import CACHED, Rectifier, pixels, rays, rectify, rectifying_rotation
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import R_from_rotvec, inverse, pose
from tests.support.panels import crooked_rig

BASELINES_M = (0.1, 0.1337, 0.2, 0.2851, 0.3)


def scene_points(seed=0):
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.6, 30.0, 400)
    return np.stack([rng.uniform(-0.35, 0.35, 400) * z, rng.uniform(-0.28, 0.28, 400) * z, z], axis=1)


def seen_by_both(rig, baseline_m):
    p_cam0 = scene_points()
    T_cam1_cam0 = inverse(rig.T_cam0_cam1(baseline_m))
    p_cam1 = p_cam0 @ T_cam1_cam0[:3, :3].T + T_cam1_cam0[:3, 3]
    return p_cam0, rig.cam0.project(p_cam0), rig.cam1.project(p_cam1)


@pytest.mark.parametrize("baseline_m", BASELINES_M)
def test_rows_of_noise_free_projections_align(baseline_m):
    rig = crooked_rig()
    rectification = rectify(rig, baseline_m)
    _, uv0, uv1 = seen_by_both(rig, baseline_m)
    left, right = rectification.cam0.points(uv0), rectification.cam1.points(uv1)
    # the issue allows 0.01 px; the formulas are exact
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1e-9


@pytest.mark.parametrize("baseline_m", BASELINES_M)
def test_disparity_is_baseline_times_focal_length_over_depth(baseline_m):
    rig = crooked_rig()
    rectification = rectify(rig, baseline_m)
    p_cam0, uv0, uv1 = seen_by_both(rig, baseline_m)
    d = rectification.cam0.points(uv0)[:, 0] - rectification.cam1.points(uv1)[:, 0]
    z_rect = (p_cam0 @ rectification.R_rect_cam0.T)[:, 2]
    assert_allclose(d, rectification.baseline_m * rectification.pinhole.f_px / z_rect, rtol=1e-9)
    assert rectification.baseline_m == pytest.approx(rig.length_m(baseline_m))


def test_the_quantised_baseline_of_the_cache_keeps_rows_aligned():
    rig = crooked_rig()
    baseline_m = 0.20012
    rectification = Rectifier(rig).at(baseline_m)
    _, uv0, uv1 = seen_by_both(rig, baseline_m)
    rows = rectification.cam0.points(uv0)[:, 1] - rectification.cam1.points(uv1)[:, 1]
    assert np.abs(rows).max() < 0.01


def test_r_rect_is_the_papers():
    t = np.array([0.2, 0.003, -0.004])
    R = rectifying_rotation(t)
    r_x = t / np.linalg.norm(t)
    z = np.array([0, 0, 1.0])
    r_z = (z - (z @ r_x) * r_x) / np.linalg.norm(z - (z @ r_x) * r_x)
    assert_allclose(R, np.stack([r_x, np.cross(r_z, r_x), r_z]))
    assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert_allclose(R @ t, [float(np.linalg.norm(t)), 0, 0], atol=1e-15)


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (642, 483)])
@pytest.mark.parametrize("k1", [-0.3, 0.15])
def test_maps_are_within_a_hundredth_of_a_pixel_of_the_formulas(size, k1):
    lens = CameraIntrinsics(640, 480, 741.0, 739.0, 322.5, 237.0, 4e-4, (k1, 0.08, 4e-4, -3e-4, 0.004))
    T = pose(R_from_rotvec(np.array([0.01, -0.006, 0.008])), np.array([0.2, 0.002, -0.001]))
    rectification = Rectifier(RigModel.from_poses(lens, lens, [0.2], [T]), size).at(0.2)
    v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(float)
    for side in (rectification.cam0, rectification.cam1):
        rays_cam = rays(rectification.pinhole, np.stack([u, v], axis=-1)) @ side.R_rect_cam
        exact = side.intrinsics.project(rays_cam)
        assert np.abs(side.map_px - exact).max() < 0.01


@pytest.mark.parametrize("channels", [1, 3])
def test_images_follow_the_maps(channels):
    rectification = Rectifier(crooked_rig(), (320, 240)).at(0.22)
    rng = np.random.default_rng(3)
    shape = (240, 320) if channels == 1 else (240, 320, 3)
    raw = rng.integers(0, 256, shape, dtype=np.uint8)
    for side in (rectification.cam0, rectification.cam1):
        fast = side.image(raw)
        assert fast.shape == shape
        for _ in range(200):
            row, column = rng.integers(0, 240), rng.integers(0, 320)
            # OpenCV places samples in steps of 1/32 px, of neighbours that differ by up to 255
            assert np.abs(slow_sample(raw, *side.map_px[row, column]) - fast[row, column]).max() <= 255 / 32 + 1


def slow_sample(image, u, v):
    """Bilinear interpolation, the edge repeated."""
    u0, v0 = int(np.floor(u)), int(np.floor(v))
    total = 0.0
    for dv in (0, 1):
        for du in (0, 1):
            weight = (1 - abs(u - u0 - du)) * (1 - abs(v - v0 - dv))
            row, column = np.clip(v0 + dv, 0, image.shape[0] - 1), np.clip(u0 + du, 0, image.shape[1] - 1)
            total = total + weight * image[row, column].astype(float)
    return total


def test_seen_is_where_the_raw_image_reaches():
    rectification = Rectifier(crooked_rig(), (640, 480)).at(0.2)
    for side in (rectification.cam0, rectification.cam1):
        u, v = side.map_px[..., 0], side.map_px[..., 1]
        inside = (u >= 0) & (u <= 639) & (v >= 0) & (v <= 479)
        assert side.covered is not None
        # linear interpolation of the distance to the edge moves it by less than the maps' own error
        assert np.mean(side.covered != inside) < 1e-3
        assert 0.9 < side.covered.mean() < 1.0


def test_a_view_that_fits_everywhere_has_no_mask():
    barrel = CameraIntrinsics(640, 480, 740.0, 740.0, 319.5, 239.5, 0.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
    rig = RigModel.from_poses(barrel, barrel, [0.2], [pose(np.eye(3), np.array([0.2, 0.0, 0.0]))])
    assert rectify(rig, 0.2).cam0.covered is None


def test_rays_and_pixels_are_each_others_inverse():
    pinhole = Pinhole(640, 480, 700.0, 310.0, 250.0)
    uv = np.random.default_rng(0).uniform(0, 480, (50, 2))
    assert_allclose(pixels(pinhole, 3.0 * rays(pinhole, uv)), uv)


def test_the_rig_frame_lies_midway_between_the_cameras():
    rig = crooked_rig()
    rectification = rectify(rig, 0.25)
    length = rig.length_m(0.25)
    T_rig_rect = rectification.T_rig_rect
    assert_allclose(T_rig_rect[:3, 3], [-length / 2, 0, 0], atol=1e-12)
    # the left camera keeps its own axes in the rig: rect differs from it by R_rect alone
    assert_allclose(T_rig_rect[:3, :3] @ rectification.R_rect_cam0, np.eye(3), atol=1e-12)


def test_rectifications_are_kept_and_shared_by_baselines_that_hardly_differ():
    rectifier = Rectifier(crooked_rig(), (320, 240))
    first = rectifier.at(0.2)
    assert rectifier.at(0.20005) is first
    assert rectifier.at(0.201) is not first
    for i in range(CACHED):
        rectifier.at(0.1 + 0.01 * i)
    assert rectifier.at(0.2) is not first


def test_the_ends_of_the_range_are_served_and_what_lies_outside_is_refused():
    rectifier = Rectifier(crooked_rig(), (320, 240))
    assert rectifier.at(0.3001).nominal_m == pytest.approx(0.3, abs=2e-4)
    with pytest.raises(CalibrationError, match="100 to 300 mm"):
        rectifier.at(0.33)


def test_arrays_are_read_only():
    rectification = rectify(crooked_rig(320, 240), 0.2)
    for array in (rectification.T_rig_rect, rectification.cam0.map_px, rectification.cam1.R_rect_cam):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_lens_folding_back_within_the_image_is_refused():
    lens = CameraIntrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, 0.0, (-3.0, 0.0, 0.0, 0.0, 0.0))
    rig = RigModel.from_poses(lens, lens, [0.2], [pose(np.eye(3), np.array([0.2, 0.0, 0.0]))])
    with pytest.raises(CalibrationError, match="folds back"):
        rectify(rig, 0.2)
