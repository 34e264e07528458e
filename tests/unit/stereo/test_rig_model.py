"""The rig at any baseline: between the calibrated ones, at them, outside them; a fixed rig; other image sizes."""

import numpy as np
import pytest

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import RANGE_TOLERANCE_M, CalibratedBaseline, RigModel
from morpheyes_daemon.transforms import R_from_rotvec, pose
from tests.support.panels import crooked_rig

LENS = CameraIntrinsics(640, 480, 740.0, 740.0, 320.0, 240.0)


def straight_pose(length_m):
    return pose(np.eye(3), np.array([length_m, 0.0, 0.0]))


def test_calibrated_baselines_are_met_exactly():
    rig = crooked_rig()
    for baseline in rig.baselines:
        assert np.allclose(rig.dual_quaternion(baseline.nominal_m), baseline.dual_quaternion, atol=1e-12)


def test_between_neighbours_the_pose_follows_the_smooth_truth():
    coarse, fine = crooked_rig(steps=10), crooked_rig(steps=400)
    for b in np.linspace(0.1, 0.3, 57):
        # the truth is linear in rotation vector and translation; a screw between neighbours leaves it by microns
        assert np.abs(coarse.T_cam0_cam1(b) - fine.T_cam0_cam1(b)).max() < 2e-6


def test_the_nominal_baseline_is_the_parameter_and_the_length_comes_from_the_pose():
    lengths = [0.101, 0.152, 0.204]
    rig = RigModel.from_poses(LENS, LENS, [0.1, 0.15, 0.2], [straight_pose(length) for length in lengths])
    assert rig.length_m(0.15) == pytest.approx(0.152)
    assert rig.length_m(0.125) == pytest.approx(0.1265)
    assert rig.baselines_m == (0.1, 0.15, 0.2)
    assert rig.range_m == (0.1, 0.2)


@pytest.mark.parametrize("outside", [0.09, 0.31, -1.0, 5.0])
def test_outside_the_range_is_refused_with_the_range(outside):
    with pytest.raises(CalibrationError, match=r"covers a baseline of 100 to 300 mm, not"):
        crooked_rig().T_cam0_cam1(outside)


def test_the_servos_play_at_the_stops_is_served():
    rig = crooked_rig()
    below = rig.length_m(0.1 - RANGE_TOLERANCE_M)
    assert below == pytest.approx(rig.length_m(0.1) - 1.004 * RANGE_TOLERANCE_M, abs=1e-6)
    with pytest.raises(CalibrationError):
        rig.T_cam0_cam1(0.1 - 1.1 * RANGE_TOLERANCE_M)


def test_a_fixed_rig_has_one_baseline_and_keeps_to_it():
    rig = RigModel.from_poses(LENS, LENS, [0.0577], [straight_pose(0.0577)], "solved")
    assert rig.length_m(0.058) == pytest.approx(0.0577)
    with pytest.raises(CalibrationError, match=r"covers a baseline of 57\.7 mm, not 100 mm"):
        rig.T_cam0_cam1(0.1)


def test_sigmas_are_interpolated_and_zero_where_none_is_stated():
    q, t = (1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.0)
    baselines = (
        CalibratedBaseline(0.1, q, t, sigma_length_m=1e-4),
        CalibratedBaseline(0.2, q, (0.2, 0.0, 0.0), sigma_length_m=3e-4),
    )
    rig = RigModel(LENS, LENS, baselines)
    assert rig.sigma_length_m(0.15) == pytest.approx(2e-4)
    assert rig.sigma_yaw_rad(0.15) == 0.0


def test_a_smaller_image_has_the_same_poses():
    rig = crooked_rig()
    small = rig.rescaled(320, 240)
    assert small.size == (320, 240)
    assert np.array_equal(small.T_cam0_cam1(0.17), rig.T_cam0_cam1(0.17))
    assert rig.rescaled(640, 480) is rig


@pytest.mark.parametrize(
    ("nominal", "poses", "words"),
    [
        ([], [], "at least one"),
        ([0.2, 0.1], [straight_pose(0.2), straight_pose(0.1)], "must grow"),
        ([0.1, 0.1], [straight_pose(0.1), straight_pose(0.1)], "none twice"),
        ([0.1], [straight_pose(-0.1)], "exchange the left and right images"),
        ([0.1], [straight_pose(np.nan)], "not finite"),
    ],
)
def test_rigs_that_cannot_be_are_refused(nominal, poses, words):
    with pytest.raises(CalibrationError, match=words):
        RigModel.from_poses(LENS, LENS, nominal, poses)


def test_cameras_of_different_size_are_refused():
    with pytest.raises(CalibrationError, match="same image size"):
        RigModel.from_poses(LENS, LENS.rescaled(320, 240), [0.1], [straight_pose(0.1)])


def test_a_rotation_survives_the_way_into_the_rig():
    T = pose(R_from_rotvec(np.array([0.01, -0.02, 0.03])), np.array([0.2, 0.001, -0.002]))
    rig = RigModel.from_poses(LENS, LENS, [0.2], [T])
    assert np.allclose(rig.T_cam0_cam1(0.2), T, atol=1e-15)
