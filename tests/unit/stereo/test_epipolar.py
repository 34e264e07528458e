"""Rows of both cameras: measured to a few hundredths of a pixel, and told apart by cause."""

import math

import numpy as np
import pytest

from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.perception.camera_motion import CameraMotion, row_rates
from morpheyes_daemon.stereo.epipolar import RowOffsetEstimator, RowOffsets, row_offsets
from morpheyes_daemon.stereo.matching import match
from morpheyes_daemon.transforms import R_from_rotvec, pose
from tests.support.panels import Panel, ideal_pair, turned_right

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
B = 0.2
PANELS = [Panel(5.0, slope_x=0.3), Panel(2.5, x_m=(-0.3, 0.6), y_m=(-0.5, 0.3), seed=3)]


def measured(T_right):
    left, right, _ = ideal_pair(PANELS, PINHOLE, B, 1.5, T_right)
    return row_offsets(left, right, match(left, right, 80).disparity_px)


def test_aligned_rows_have_no_offset():
    offsets = measured(np.eye(4))
    assert offsets.count > 200
    assert offsets.median_px < 0.05
    assert abs(offsets.dv_px.mean()) < 0.01


@pytest.mark.parametrize("pitch_deg", [-0.2, 0.05, 0.15, 0.3])
def test_a_pitched_camera_is_recovered(pitch_deg):
    offsets = measured(turned_right((math.radians(pitch_deg), 0.0, 0.0)))
    fit = RowOffsetEstimator().add(offsets, PINHOLE)
    # 0.3 degrees are 1.9 px; a fortieth of a pixel is 0.004 degrees
    assert math.degrees(fit.pitch_rad) == pytest.approx(pitch_deg, abs=0.004)
    assert abs(math.degrees(fit.roll_rad)) < 0.03
    assert math.isinf(fit.time_offset_sigma_s)
    assert fit.time_offset_s == 0.0


@pytest.mark.parametrize("roll_deg", [-0.3, 0.2])
def test_a_rolled_camera_is_recovered(roll_deg):
    offsets = measured(turned_right((0.0, 0.0, math.radians(roll_deg))))
    fit = RowOffsetEstimator().add(offsets, PINHOLE)
    assert math.degrees(fit.roll_rad) == pytest.approx(roll_deg, abs=0.008)
    assert abs(math.degrees(fit.pitch_rad)) < 0.015


def test_yaw_leaves_the_rows_alone():
    """0.15 degrees are 1 px of disparity here; rows hardly move (paper-notes 14)."""
    assert measured(turned_right((0.0, math.radians(0.15), 0.0))).median_px < 0.1


MOTION = (np.array([0.3, -0.2, 2.5]), np.array([0.25, 0.1, -0.15]))


def moved(time_offset_s):
    """How the right camera stands, seen from where it should, when it exposes late."""
    v, w = MOTION
    R = R_from_rotvec(w * time_offset_s)
    # the camera sits at b along x on a rig that turns about the left camera
    at_right = np.array([B, 0.0, 0.0])
    return pose(R, v * time_offset_s + R @ at_right - at_right)


@pytest.mark.parametrize("time_offset_s", [0.002, 0.005, 0.010])
def test_lateness_is_recovered_from_motion(time_offset_s):
    offsets = measured(moved(time_offset_s))
    rates = row_rates(offsets.uv, offsets.d_px, PINHOLE, B, CameraMotion(np.eye(4), *MOTION))
    fit = RowOffsetEstimator().add(offsets, PINHOLE, *rates)
    assert fit.time_offset_s == pytest.approx(time_offset_s, abs=max(5e-4, 3 * fit.time_offset_sigma_s))
    assert fit.time_offset_sigma_s < 1e-3
    assert abs(math.degrees(fit.pitch_rad)) < 0.03


def test_a_watch_grows_surer_with_frames_and_forgets_old_ones():
    watch = RowOffsetEstimator(memory=0.5)
    bent = measured(turned_right((math.radians(0.2), 0.0, 0.0)))
    first = watch.add(bent, PINHOLE)
    second = watch.add(bent, PINHOLE)
    assert second.pitch_sigma_rad < first.pitch_sigma_rad
    straight = measured(np.eye(4))
    for _ in range(8):
        last = watch.add(straight, PINHOLE)
    assert abs(math.degrees(last.pitch_rad)) < 0.01


def test_wrong_matches_do_not_bend_the_explanation():
    offsets = measured(turned_right((math.radians(0.1), 0.0, 0.0)))
    dv = offsets.dv_px.copy()
    dv[::6] = 2.5
    spoiled = RowOffsets(offsets.uv, offsets.d_px, dv)
    fit = RowOffsetEstimator().add(spoiled, PINHOLE)
    assert math.degrees(fit.pitch_rad) == pytest.approx(0.1, abs=0.004)


def test_nothing_to_see_gives_no_points_and_no_explanation():
    flat = np.full((240, 320), 90, np.uint8)
    unknown = np.full((240, 320), np.nan, np.float32)
    for offsets in (row_offsets(flat, flat, np.zeros_like(unknown)), row_offsets(flat, flat, unknown)):
        assert offsets.count == 0
        assert math.isnan(offsets.median_px)
        fit = RowOffsetEstimator().add(offsets, PINHOLE)
        assert math.isinf(fit.pitch_sigma_rad)
        assert fit.count == 0


def test_an_image_smaller_than_a_patch_has_no_points():
    tiny = np.zeros((16, 16), np.uint8)
    assert row_offsets(tiny, tiny, np.zeros((16, 16), np.float32)).count == 0
