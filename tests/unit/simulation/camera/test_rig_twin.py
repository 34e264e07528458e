"""The rig twin: smooth along the rail, honest about its baseline, and its exact file says what it is."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from morpheyes_daemon.simulation.camera.true_rig import RANGE_M, RigErrors, RigTwin
from morpheyes_daemon.stereo.calibration_file import read_calibration, write_calibration
from morpheyes_daemon.transforms import inverse, q_from_R


@pytest.mark.parametrize("seed", range(5))
def test_the_distance_between_the_eyes_is_the_baseline(seed: int) -> None:
    rig = RigTwin(seed=seed)
    for baseline_m in np.linspace(*RANGE_M, 9):
        T = rig.T_cam0_cam1(float(baseline_m))
        assert np.linalg.norm(T[:3, 3]) == pytest.approx(baseline_m, abs=1e-12)
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_each_camera_moves_by_half() -> None:
    rig = RigTwin(seed=1)
    for eye, side in ((0, -0.5), (1, 0.5)):
        moved = rig.T_rig_eye(eye, 0.3)[:3, 3] - rig.T_rig_eye(eye, 0.1)[:3, 3]
        assert moved[0] == pytest.approx(side * 0.2, abs=1e-5)
        assert np.abs(moved[1:]).max() < 2e-3


def test_misalignment_is_there_and_changes_smoothly() -> None:
    rig = RigTwin(seed=2)
    baselines = np.linspace(*RANGE_M, 201)
    angles = np.array([2 * q_from_R(rig.T_cam0_cam1(float(b))[:3, :3])[1:] for b in baselines])
    assert np.degrees(np.abs(angles)).max() > 0.05
    # a second difference per millimetre far below what ten calibrated baselines can follow
    assert np.degrees(np.abs(np.diff(angles, 2, axis=0))).max() < 1e-4


def test_the_servo_is_not_quite_linear() -> None:
    errors = [RigTwin(seed=s).actual_m(float(b)) - b for s in range(10) for b in np.linspace(*RANGE_M, 41)]
    assert 2e-4 < np.abs(errors).max() < 1e-3
    assert RigTwin(errors=RigErrors.none()).actual_m(0.17) == 0.17


def test_a_perfect_rig_is_perfect() -> None:
    rig = RigTwin(320, 240, errors=RigErrors.none())
    assert np.allclose(rig.T_cam0_cam1(0.25)[:3, 3], [0.25, 0, 0])
    assert np.array_equal(rig.T_cam0_cam1(0.25)[:3, :3], np.eye(3))
    assert rig.cam0 == rig.cam1
    assert rig.cam0.fx == 370.0
    assert not any(rig.cam0.k)


def test_the_exact_file_is_exact(tmp_path: Path) -> None:
    rig = RigTwin(seed=3)
    path = tmp_path / "rig.yaml"
    write_calibration(rig.exact_rig(), path)
    model = read_calibration(path)
    assert model.method == "exact"
    # the file keeps nine digits
    assert np.allclose(astuple(model.cam0)[:7], astuple(rig.cam0)[:7], atol=1e-8)
    points = np.array([[x, y, z] for x in (-1.0, 0.0, 1.0) for y in (-0.6, 0.6) for z in (2.0, 8.0)])
    for nominal in np.linspace(0.1, 0.3, 17):
        truth, known = rig.T_cam0_cam1(rig.actual_m(float(nominal))), model.T_cam0_cam1(float(nominal))
        seen = [rig.cam1.project(points @ inverse(T)[:3, :3].T + inverse(T)[:3, 3]) for T in (truth, known)]
        assert np.abs(seen[0] - seen[1]).max() < 1e-3
