"""Parts of the moving-object mission, each against a known truth."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morpheyes_daemon.campaigns.imo_metrics import Sample, range_bins, visible_face
from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.strategies.imo.clusters import cluster_tracklets
from morpheyes_daemon.strategies.imo.kalman import ObjectFilter, StereoGeometry, measurement_covariance
from morpheyes_daemon.strategies.imo.object_segmentation import PredictedObject, detect_object
from morpheyes_daemon.strategies.imo.plane_sweep import plane_sweep_depth
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.strategies.imo.tracklets import MovingTracklets
from morpheyes_daemon.strategies.imo.visual_odometry import refine_motion
from morpheyes_daemon.transforms import R_FRD_CAM, R_from_rotvec, pose
from tests.support.moving_square import Square, view


def frame(square: Square | None = None, baseline_m: float = 0.2) -> RectifiedFrame:
    return RectifiedFrame.of(view(0, square, baseline_m=baseline_m))


@given(st.floats(0.3, 40.0), st.floats(-0.4, 0.4), st.floats(-0.3, 0.3))
@settings(max_examples=30, deadline=None)
def test_points_and_observations_are_inverse(z: float, x: float, y: float) -> None:
    f = frame_once()
    p = np.array([x * z, y * z, z])
    assert np.allclose(f.points(f.project(p)), p, rtol=1e-9)


_FRAME: list[RectifiedFrame] = []


def frame_once() -> RectifiedFrame:
    if not _FRAME:
        _FRAME.append(frame())
    return _FRAME[0]


def test_camera_motion_is_refined_though_most_corners_are_on_an_object() -> None:
    rng = np.random.default_rng(3)
    f = frame_once()
    depth = np.concatenate([rng.uniform(3.0, 15.0, 70), rng.uniform(0.8, 1.0, 150)])
    ray = np.stack([rng.uniform(-0.4, 0.4, 220), rng.uniform(-0.3, 0.3, 220), np.ones(220)], axis=1)
    p = ray * depth[:, None]
    true = pose(R_from_rotvec(np.array([0.002, -0.004, 0.001])), np.array([0.02, 0.0, -0.05]))
    prior = pose(R_from_rotvec(np.array([0.006, 0.001, 0.0])), np.array([0.035, 0.0, -0.06]))
    after = p @ true[:3, :3].T + true[:3, 3]
    after[70:] += (0.05, 0.0, 0.02)  # the object
    uvd = f.project(after) + rng.normal(0.0, 0.1, (220, 3))
    motion = refine_motion(prior, 0.2, p, uvd, f)
    # a tenth of a pixel on 70 points: some tenths of a milliradian and a millimetre
    assert np.allclose(motion.T_now_before[:3, 3], true[:3, 3], atol=0.006)
    assert np.allclose(motion.T_now_before[:3, :3], true[:3, :3], atol=0.001)
    assert motion.static[:70].mean() > 0.9
    assert motion.static[70:].mean() < 0.1


def test_with_too_few_static_points_the_autopilots_motion_is_kept() -> None:
    f = frame_once()
    prior = pose(np.eye(3), np.array([0.1, 0.0, 0.0]))
    p = np.array([[0.0, 0.0, 3.0], [0.3, 0.1, 4.0]])
    motion = refine_motion(prior, 0.2, p, f.project(p @ prior[:3, :3].T + prior[:3, 3]), f)
    assert np.array_equal(motion.T_now_before, prior)
    assert not motion.static.any()


def moving_tracklets(
    uv: Sequence[tuple[float, float]], d: list[float], drift: list[tuple[float, float]], sure: list[bool] | None = None
) -> MovingTracklets:
    uvd = np.column_stack([np.array(uv), np.array(d)])
    p = frame_once().points(uvd)
    v = np.tile([0.3, 0.0, 0.0], (len(d), 1))
    certain = np.array(sure if sure is not None else [True] * len(d))
    return MovingTracklets(uvd, p, v, np.array(drift), np.full(len(d), 0.2), certain)


def test_tracklets_cluster_by_motion_together_with_depth() -> None:
    uv = [(100, 100), (106, 102), (103, 108), (109, 107), (112, 104), (115, 109)]
    d = [30.0, 30.2, 29.8, 12.0, 12.1, 12.2]
    alike = cluster_tracklets(moving_tracklets(uv, d, [(40.0, 0.0)] * 6), frame_once())
    assert sorted(c.count for c in alike) == [3, 3]  # neighbours in the image, apart in depth
    apart = cluster_tracklets(moving_tracklets(uv, [30.0] * 6, [(40.0, 0.0)] * 3 + [(-40.0, 0.0)] * 3), frame_once())
    assert sorted(c.count for c in apart) == [3, 3]
    assert cluster_tracklets(moving_tracklets(uv[:2], d[:2], [(40.0, 0.0)] * 2), frame_once()) == []


def test_uncertain_tracklets_join_a_cluster_and_form_none() -> None:
    uv = [(100.0 + 6.0 * k, 100.0 + 5.0 * (k % 2)) for k in range(10)]
    sure = [k < 4 for k in range(10)]
    found = cluster_tracklets(moving_tracklets(uv, [30.0] * 10, [(40.0, 0.0)] * 10, sure), frame_once())
    assert [(c.count, int(c.members.sum())) for c in found] == [(4, 10)]
    assert cluster_tracklets(moving_tracklets(uv, [30.0] * 10, [(40.0, 0.0)] * 10, [False] * 10), frame_once()) == []


@pytest.mark.parametrize(("depth_m", "edge_m"), [(0.9, 0.3), (2.0, 0.3), (4.0, 0.3), (5.0, 0.17)])
def test_the_depth_of_an_object_errs_by_half_a_percent_at_most(depth_m: float, edge_m: float) -> None:
    f = frame(Square((depth_m, 0.03, 0.02), edge_m), baseline_m=max(0.1, min(0.3, 0.06 * depth_m)))
    found = detect_object(f, PredictedObject(np.array([0.0, 0.0, depth_m * 1.01]), 0.03, 0.05, edge_m / 2))
    assert found is not None
    assert found.depth_m == pytest.approx(depth_m, rel=0.005)
    assert np.allclose(found.p_rect[:2], (0.03, 0.02), atol=0.03)


@pytest.mark.parametrize("off_m", [-0.3, 0.0, 0.3])
def test_a_small_object_is_separated_from_a_wall_two_disparities_behind(off_m: float) -> None:
    f = frame(Square((5.4, 0.0, 0.0), 0.17), baseline_m=0.3)  # 12 px wide; 20.6 px of disparity, the wall 18.5
    found = detect_object(f, PredictedObject(np.array([0.0, 0.0, 5.4 + off_m]), 0.05, 0.15, 0.11))
    assert found is not None
    assert found.mask.sum() < 1.5 * 11.6**2
    assert abs(found.depth_m - 5.4) < 0.08 + 0.3 * abs(off_m)


def test_a_plane_sweep_gives_disparities_to_a_fraction_of_a_pixel() -> None:
    f = frame(Square((2.5, 0.0, 0.0), 0.3), baseline_m=0.2)  # 29.6 px
    box = slice(105, 135), slice(145, 175)
    off_px = f.bf_m_px / plane_sweep_depth(f, box, 1.5, 4.0) - 29.6
    assert abs(float(np.median(off_px))) < 0.15
    assert float(np.percentile(np.abs(off_px), 90)) < 0.35


def test_without_the_object_there_is_no_detection() -> None:
    assert detect_object(frame(None), PredictedObject(np.array([0.0, 0.0, 2.5]), 0.05, 0.1, 0.15)) is None
    assert detect_object(frame(None), PredictedObject(np.array([0.0, 0.0, -1.0]), 0.05, 0.1, 0.15)) is None


def test_measurement_noise_is_the_stereo_uncertainty_at_the_present_baseline() -> None:
    p = np.array([0.0, 0.0, 10.0])
    small, large = (measurement_covariance(p, 0.0, StereoGeometry(b, 740.0, 0.0)) for b in (0.1, 0.3))
    # eps_z falls with the baseline; across the line of sight nothing changes
    assert math.sqrt(small[2, 2] / large[2, 2]) == pytest.approx(3.0, rel=0.01)
    assert small[0, 0] == pytest.approx(large[0, 0])


def test_the_filter_estimates_velocity_with_a_consistent_covariance() -> None:
    lengths = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        R = np.diag([0.02, 0.02, 0.1]) ** 2
        v = np.array([0.4, -0.2, 0.1])
        fit = ObjectFilter(rng.normal(0.0, 0.05, 3), R)
        for k in range(1, 31):
            fit.predict(0.2)
            fit.update(v * 0.2 * k + rng.multivariate_normal(np.zeros(3), R), R)
        error = fit.x - np.concatenate([v * 6.0, v])
        lengths.append(error @ np.linalg.solve(fit.P, error))
        assert np.allclose(fit.v_ned_m_s[:2], v[:2], atol=0.25)
    # six degrees of freedom; less, since the filter allows for accelerations that do not happen here
    assert 0.5 < np.mean(lengths) < 7.0


def test_the_visible_face_of_a_cube_ahead_is_its_front_and_may_be_hidden() -> None:
    pinhole = Pinhole(640, 480, 740.0, 319.5, 239.5)
    T_ned_rect = pose(R_FRD_CAM, np.zeros(3))
    cube = pose(np.eye(3), np.array([5.0, 0.0, 0.0]))
    face = visible_face(T_ned_rect, pinhole, cube, 0.3, [])
    assert face is not None
    assert face.p_rect[2] == pytest.approx(4.85)
    assert face.in_view == pytest.approx(1.0)
    column = (pose(np.eye(3), np.array([3.0, 0.1, 0.0])), np.array([0.2, 0.2, 4.0]))
    half = visible_face(T_ned_rect, pinhole, cube, 0.3, [column])
    assert half is not None
    assert 0.2 < half.in_view < 0.8
    behind = pose(np.eye(3), np.array([-5.0, 0.0, 0.0]))
    assert visible_face(T_ned_rect, pinhole, behind, 0.3, []) is None


def test_range_bins_count_frames_and_errors_by_metre() -> None:
    samples = [Sample(0.0, 2.2, 2.222, 0.1), Sample(0.2, 2.9, None, 0.1), Sample(0.4, 5.0, 5.1, 0.2)]
    first, second = range_bins(samples)
    assert (first["from_m"], first["frames"], first["detected"]) == (2, 2, 1)
    assert first["median_rel_error"] == pytest.approx(0.01)
    assert (second["from_m"], second["to_m"], second["median_rel_error"]) == (5, 6, 0.02)
