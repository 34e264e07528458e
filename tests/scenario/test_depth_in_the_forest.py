"""The depth of the simulator's forest, through crooked lenses, noise and late eyes, against the simulator's truth."""

import math
from functools import cache

import cv2
import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer needs the extra `sim`")

from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame
from morpheyes_daemon.perception.image_checks import exposure_faults, matching_faults
from morpheyes_daemon.simulation.camera.stereo_camera import CameraTwin, Sensor
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.simulation.rendering.renderer import Renderer
from morpheyes_daemon.simulation.worlds.loader import build_world, load_world
from morpheyes_daemon.stereo.depth import DepthEstimator, depth_sigma
from morpheyes_daemon.stereo.rectify import rays
from morpheyes_daemon.transforms import R_from_rpy, pose

SIZE = (320, 240)
SPEED_M_S = np.array([2.5, 0.2, 0.0])
PLACES = range(4)


@cache
def stage():
    world = build_world(load_world("forest"), 0)
    twin = RigTwin(*SIZE, seed=2)
    camera = CameraTwin(Renderer(world.scene), twin, sensor=Sensor(), seed=1)
    return twin, camera, DepthEstimator(twin.exact_rig(40), size=SIZE)


@cache
def seen(k, baseline_m):
    """One frame from the k-th place along the course: rectified pair, depth map, true depth (inf sky, NaN unseen)."""
    twin, camera, estimator = stage()
    turn = R_from_rpy(0.05 * math.sin(k), -0.12 + 0.06 * math.sin(2 * k), 0.2 * math.sin(1.3 * k))
    place = np.array([4.0 + 7.0 * k, 1.5 * math.sin(k), -1.6])

    def pose_at(t_ns):
        return pose(turn, place + SPEED_M_S * (t_ns / 1e9 - k))

    t_ns, length_m = k * 1_000_000_000, twin.actual_m(baseline_m)
    raw = camera.render_pair(t_ns, k, pose_at, length_m)
    estimate = BaselineEstimate(t_ns, baseline_m, baseline_m, 1e-4, False)
    frame = StereoFrame(k, t_ns, raw.left, raw.right, estimate)
    pair = estimator.rectified(frame)
    return pair, estimator.depth(frame, pair), rectified_truth(camera.true_depth(t_ns, pose_at, length_m), pair)


def rectified_truth(raw_depth, pair):
    eye, pinhole = pair.rectification.cam0, pair.rectification.pinhole
    column, row = np.rint(eye.map_px).astype(int).transpose(2, 0, 1)
    inside = (column >= 0) & (column < SIZE[0]) & (row >= 0) & (row < SIZE[1])
    z_cam0 = np.where(inside, raw_depth[row.clip(0, SIZE[1] - 1), column.clip(0, SIZE[0] - 1)], np.nan)
    v, u = np.mgrid[0 : pinhole.height, 0 : pinhole.width].astype(float)
    return z_cam0 / (rays(pinhole, np.stack([u, v], axis=-1)) @ pair.rectification.R_rect_cam0)[..., 2]


def smooth(truth):
    """Where depth does not jump within two pixels: a pixel of the truth is nearest neighbour, too."""
    inverse = np.where(np.isfinite(truth), 1 / np.where(truth == 0, np.nan, truth), 0).astype(np.float32)
    kernel = np.ones((5, 5), np.uint8)
    return cv2.dilate(inverse, kernel) - cv2.erode(inverse, kernel) < 0.02


@pytest.mark.parametrize("baseline_m", [0.1, 0.2, 0.3])
def test_depth_holds_what_its_uncertainty_says(baseline_m):
    known_share, errors = [], []
    for k in PLACES:
        _, depth, truth = seen(k, baseline_m)
        disparity = depth.baseline_m * depth.pinhole.f_px / truth
        visible = np.isfinite(truth) & (np.arange(SIZE[0]) >= disparity) & (truth > depth.near_limit_m)
        known = visible & np.isfinite(depth.depth_m)
        known_share.append(known.sum() / visible.sum())
        inner = known & smooth(truth)
        sigma = depth_sigma(truth[inner], depth.baseline_m, depth.pinhole.f_px, depth.sigma_disparity_px)
        errors.append(np.abs(depth.depth_m - truth)[inner] / sigma)
    error = np.concatenate(errors)
    # occlusion grows with the baseline; measured 0.95, 0.92, 0.87
    assert np.mean(known_share) > 0.80
    assert np.median(error) < 0.7
    assert np.mean(error > 3) < 0.06


@pytest.mark.parametrize("baseline_m", [0.1, 0.2, 0.3])
def test_hardly_anything_far_is_taken_for_near_or_near_for_far(baseline_m):
    spurious, missed = [], []
    for k in PLACES:
        _, depth, truth = seen(k, baseline_m)
        inverse = np.where(np.isfinite(truth), 1 / truth, 0.0).astype(np.float32)
        nearest = 1 / np.maximum(cv2.dilate(inverse, np.ones((5, 5), np.uint8)), 1e-6)
        spurious.append(np.mean((depth.depth_m < 8.0) & (depth.depth_m < 0.6 * nearest)))
        missed.append(np.mean((truth < 8.0) & (depth.depth_m > 1.67 * truth)))
        assert np.mean(depth.near & (nearest > 2 * depth.near_limit_m)) < 0.002
    assert np.mean(spurious) < 0.004
    assert np.mean(missed) < 0.002


def test_what_only_the_left_eye_sees_is_told():
    _, depth, truth = seen(1, 0.3)
    partner = np.arange(SIZE[0]) - np.where(np.isfinite(truth), depth.baseline_m * depth.pinhole.f_px / truth, 0.0)
    right_of = np.minimum.accumulate(partner[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(truth.shape, bool)
    hidden[:, :-1] = right_of[:, 1:] < partner[:, :-1] - 0.5
    hidden |= partner < 0
    near_hidden = cv2.dilate(hidden.astype(np.uint8), np.ones((3, 5), np.uint8)).astype(bool)
    assert near_hidden[depth.half_occluded].mean() > 0.85
    assert depth.half_occluded[hidden].mean() > 0.4


@pytest.mark.parametrize("baseline_m", [0.1, 0.3])
def test_good_images_have_no_fault(baseline_m):
    for k in PLACES:
        pair, depth, _ = seen(k, baseline_m)
        assert exposure_faults(pair.left, pair.right) == set()
        assert matching_faults(pair.left, pair.right, 0.0) == set()
        assert matching_faults(pair.left, pair.right, depth.valid_fraction) == set()
