"""The drift watch: a turned rig is what it says, strong evidence is needed, and nothing is done without texture."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry, infinity_px
from morpheyes_daemon.messages.core import BaselineEstimate, Pinhole, StereoFrame
from morpheyes_daemon.perception.camera_motion import CameraMotion, right_camera_rates, row_rates
from morpheyes_daemon.perception.extrinsics_monitor import (
    ExtrinsicsFault,
    ExtrinsicsMonitor,
    row_mismatch_rad,
    turned_rig,
)
from morpheyes_daemon.perception.yaw_estimator import leverage
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.depth import DepthEstimator, disparity_of
from morpheyes_daemon.stereo.epipolar import row_offsets
from morpheyes_daemon.stereo.rectify import rectifying_rotation
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import R_from_rotvec, inverse, pose
from tests.support.panels import Panel, crooked_rig, raw_pair
from tests.support.synthetic_rig import CAM0, CAM1, TEN_M, true_geometry, true_pose


def test_a_rig_turned_by_a_yaw_shows_that_much_disparity_at_infinity() -> None:
    rig = RigModel.from_poses(CAM0, CAM1, TEN_M.tolist(), [true_pose(b) for b in TEN_M])
    yaw = math.radians(0.15)
    turned = turned_rig(rig, np.array([0.0, yaw, 0.0]), 0.2)
    believed = StereoGeometry(CAM0, CAM1, rig.T_cam0_cam1(TEN_M[4]))
    true = StereoGeometry(CAM0, CAM1, turned.T_cam0_cam1(TEN_M[4]))
    # f yaw in the middle of the image, up to 18 % more at its sides
    assert np.median(infinity_px(believed, true)) == pytest.approx(believed.f_px * yaw, rel=0.1)
    assert turned.length_m(0.2) == pytest.approx(rig.length_m(0.2))
    assert calibration_hash(turned) != calibration_hash(rig)


def test_rows_are_no_farther_apart_than_a_wrong_baseline_can_make_them() -> None:
    """Directions of things three metres off, as the right camera sees them and as it should for the baseline believed."""
    rig = RigModel.from_poses(CAM0, CAM1, TEN_M.tolist(), [true_pose(b) for b in TEN_M])
    x, y = np.meshgrid([-0.4, 0.0, 0.4], [-0.3, 0.0, 0.3])
    points = 3.0 * np.stack([x.ravel(), y.ravel(), np.ones(9)], axis=1)
    for nominal_m, true_m in ((0.1, 0.3), (0.2, 0.16), (0.25, 0.24)):
        R_rect_cam0 = rectifying_rotation(rig.T_cam0_cam1(nominal_m)[:3, 3])
        seen, expected = (inverse(rig.T_cam0_cam1(b)) for b in (true_m, nominal_m))
        R_rect_cam1 = R_rect_cam0 @ rig.T_cam0_cam1(nominal_m)[:3, :3]
        rays = [(points @ T[:3, :3].T + T[:3, 3]) @ R_rect_cam1.T for T in (seen, expected)]
        rows = [ray[:, 1] / ray[:, 2] for ray in rays]
        apart = float(np.median(np.abs(rows[0] - rows[1])))
        bound = row_mismatch_rad(rig, nominal_m, true_m)
        assert apart <= bound <= 5.0 * apart + 2e-4
    assert row_mismatch_rad(rig, 0.2, 0.2) == pytest.approx(0.0, abs=1e-9)


def test_turning_back_gives_the_rig_again() -> None:
    rig = RigModel.from_poses(CAM0, CAM1, TEN_M.tolist(), [true_pose(b) for b in TEN_M])
    turn = np.radians([0.1, -0.2, 0.05])
    again = turned_rig(turned_rig(rig, turn, 0.2), -turn, 0.2)
    assert again.T_cam0_cam1(0.17) == pytest.approx(rig.T_cam0_cam1(0.17), abs=1e-9)


def test_rates_of_the_right_camera_are_those_of_moving_the_rig() -> None:
    pinhole, b = Pinhole(640, 480, 740.0, 319.5, 239.5), 0.25
    v, w, dt = np.array([0.4, -0.3, 2.0]), np.array([0.2, -0.3, 0.4]), 1e-6
    motion = CameraMotion(np.eye(4), v, w)
    points = np.array([[0.3, -0.2, 2.0], [-0.8, 0.5, 4.0], [1.0, 0.2, 8.0]])
    middle = np.array([pinhole.cx_px, pinhole.cy_px])
    uv = points[:, :2] / points[:, 2:] * pinhole.f_px + middle
    T_before_after = pose(R_from_rotvec(w * dt), v * dt)
    moved = points @ inverse(T_before_after)[:3, :3].T + inverse(T_before_after)[:3, 3]
    right = [(p - [b, 0, 0])[:, :2] / p[:, 2:] * pinhole.f_px + middle for p in (points, moved)]
    rates = right_camera_rates(uv, b * pinhole.f_px / points[:, 2], pinhole, b, motion)
    assert rates == pytest.approx((right[1] - right[0]) / dt, rel=1e-3, abs=1e-2), "first order over a microsecond"


def test_a_wider_change_of_baseline_tells_more() -> None:
    assert leverage(0.1, 0.3) > leverage(0.1, 0.2) > leverage(0.2, 0.3) > leverage(0.2, 0.2) == 0.0
    assert true_geometry(0.2).length_m == pytest.approx(0.2, abs=0.01)


WORLD = [Panel(5.0, slope_x=0.3), Panel(2.5, x_m=(-0.3, 0.6), y_m=(-0.5, 0.3), seed=3)]
SMALL = crooked_rig(320, 240)


def watched(
    pitch_deg: float, panels: list[Panel], frames: int, moving: bool = False
) -> tuple[ExtrinsicsMonitor, list[ExtrinsicsFault]]:
    """A monitor that has seen the same still pair for so many frames, the right camera having turned since."""
    monitor = ExtrinsicsMonitor(turned_rig(SMALL, -np.radians([pitch_deg, 0.0, 0.0]), 0.2))
    estimator = DepthEstimator(monitor.rig)
    at = BaselineEstimate(0, 0.2, 0.2, 1e-4, moving)
    frame = StereoFrame(0, 0, *raw_pair(panels, SMALL, 0.2, noise=1.5), at)
    pair = estimator.rectified(frame)
    depth = estimator.depth(frame, pair)
    offsets = row_offsets(pair.left, pair.right, disparity_of(depth))
    still = CameraMotion.still(np.eye(4))
    reports = [monitor.update(pair, depth, offsets, moving, still) for _ in range(frames)]
    return monitor, [finding.what for report in reports for finding in report.findings]


@pytest.mark.parametrize(("late_ms", "frames", "late"), [(2.0, 9, False), (5.0, 9, False), (7.0, 2, False),
                                                          (7.0, 3, True), (20.0, 3, True)])  # fmt: skip
def test_cameras_that_expose_far_from_when_they_should_end_trust_in_depth(
    late_ms: float, frames: int, late: bool
) -> None:
    """Declared are 2 ms; the rows are moved as flying ahead at 3 m/s moves them in that time."""
    monitor = ExtrinsicsMonitor(SMALL)
    estimator = DepthEstimator(SMALL)
    frame = StereoFrame(0, 0, *raw_pair(WORLD, SMALL, 0.2, noise=1.5), BaselineEstimate(0, 0.2, 0.2, 1e-4, False))
    pair = estimator.rectified(frame)
    depth = estimator.depth(frame, pair)
    ahead = CameraMotion(np.eye(4), np.array([0.0, 0.0, 3.0]), np.zeros(3))
    offsets = row_offsets(pair.left, pair.right, disparity_of(depth))
    by_travel, _ = row_rates(offsets.uv, offsets.d_px, depth.pinhole, depth.baseline_m, ahead)
    offsets = replace(offsets, dv_px=offsets.dv_px + late_ms / 1e3 * by_travel)
    for _ in range(frames):
        monitor.update(pair, depth, offsets, False, ahead)
    assert monitor.out_of_sync is late


def test_a_pitched_camera_is_told_at_once_and_corrected_ten_frames_later() -> None:
    monitor, told = watched(0.15, WORLD, frames=11)
    assert told == [ExtrinsicsFault.ROWS, ExtrinsicsFault.TURNED]
    turned_back = inverse(SMALL.T_cam0_cam1(0.2)) @ monitor.rig.T_cam0_cam1(0.2)
    left_over = np.degrees(Rotation.from_matrix(turned_back[:3, :3]).magnitude())
    assert left_over < 0.02, "a tenth of a pixel"


@pytest.mark.parametrize(
    ("pitch_deg", "panels", "moving"),
    [(0.0, WORLD, False), (0.15, [Panel(3.0, contrast=0.01)], False)],
    ids=["a good rig", "no texture"],
)
def test_nothing_is_done_without_evidence(pitch_deg: float, panels: list[Panel], moving: bool) -> None:
    monitor, told = watched(pitch_deg, panels, frames=15, moving=moving)
    assert told == []
    assert not monitor.broken


def test_nothing_is_corrected_while_the_servo_moves() -> None:
    _, told = watched(0.15, WORLD, frames=15, moving=True)
    assert ExtrinsicsFault.TURNED not in told


def test_a_camera_that_turned_far_is_broken_and_not_mended() -> None:
    monitor, told = watched(0.3, WORLD, frames=15)
    assert told == [ExtrinsicsFault.ROWS, ExtrinsicsFault.BROKEN]
    assert monitor.broken


def test_a_yaw_too_large_for_a_drift_must_be_seen_by_two_pairs_of_frames() -> None:
    rig = RigModel.from_poses(CAM0, CAM1, TEN_M.tolist(), [true_pose(b) for b in TEN_M])
    monitor, yaw_rad = ExtrinsicsMonitor(rig), math.radians(0.5)
    found = {}
    for pairs in (1, 2):
        monitor._yaw = SimpleNamespace(yaw_rad=yaw_rad, sigma_rad=0.02 * yaw_rad, pairs=pairs)  # type: ignore[assignment]
        found[pairs] = [finding.what for finding in monitor._check_yaw(740.0, 0.2)], monitor.broken
    assert found == {1: ([ExtrinsicsFault.UNCONFIRMED], False), 2: ([ExtrinsicsFault.BROKEN], True)}
    assert calibration_hash(monitor.rig) == calibration_hash(rig), "and nothing was corrected"
