"""Calibration files edited and hashed anew: what no rig can be keeps the vehicle on the ground."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from morpheyes_daemon.config.vehicle import NoServoConfig, SerialServoConfig, V4l2CameraConfig, VehicleConfig
from morpheyes_daemon.doctor.calibration_plausibility import implausible
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.doctor.rig import examine_calibration
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.stereo.calibration_file import content_hash, document
from morpheyes_daemon.stereo.rig import CameraMount, RigModel
from tests.support.synthetic_rig import CAM0, CAM1, TEN_M, true_pose

H_FOV_DEG = 46.8
Document = dict[str, Any]


def rig() -> RigModel:
    """The simulator's rig with its errors, as solved, with a measured mount."""
    exact = RigTwin(seed=3).exact_rig(steps=9)
    mount = CameraMount((0.01, -0.005, 0.002), (1e-3, 1e-3, 1e-3))
    return RigModel(exact.cam0, exact.cam1, exact.baselines, "solved", {"verdict": "fit to fly"}, mount)


def vehicle(path: Path | None = None, **camera: Any) -> VehicleConfig:
    settings = {"h_fov_deg": H_FOV_DEG, "sync_error_ms": 0.0, **camera}
    return VehicleConfig(
        camera=V4l2CameraConfig(backend="v4l2", **settings),
        servo=SerialServoConfig(backend="serial"),
        calibration=path,
    )


def examined(tmp_path: Path, edit: Callable[[Document], None], **camera: Any) -> list[Finding]:
    content = copy.deepcopy(document(rig()))
    edit(content)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump({**content, "sha256": content_hash(content)}, sort_keys=False))
    return examine_calibration(vehicle(path, **camera))[0]


def focal(factor: float, *cameras: str, axes: tuple[str, ...] = ("fx_px", "fy_px")) -> Callable[[Document], None]:
    def edit(content: Document) -> None:
        for camera in cameras or ("cam0", "cam1"):
            for axis in axes:
                content["cameras"][camera][axis] *= factor

    return edit


def lengths(factor: float) -> Callable[[Document], None]:
    def edit(content: Document) -> None:
        for baseline in content["baselines"]:
            t = baseline["T_cam0_cam1"]
            t["translation_mm"] = [factor * c for c in t["translation_mm"]]

    return edit


def nominal(edited: Callable[[float], float]) -> Callable[[Document], None]:
    def edit(content: Document) -> None:
        for baseline in content["baselines"]:
            baseline["nominal_mm"] = edited(baseline["nominal_mm"])

    return edit


def poses_swapped(content: Document) -> None:
    """Left and right exchanged: cam1 in the middle, cam0 seen from it."""
    content["cameras"] = {"cam0": content["cameras"]["cam1"], "cam1": content["cameras"]["cam0"]}
    for baseline in content["baselines"]:
        t = baseline["T_cam0_cam1"]
        w, x, y, z = t["rotation_quaternion_wxyz"]
        t["rotation_quaternion_wxyz"] = [w, -x, -y, -z]
        t["translation_mm"] = [-c for c in t["translation_mm"]]


def upside_down(content: Document) -> None:
    """Exchanged by turning the whole bar: the right eye is right of the left one again, but stands on its head."""
    for baseline in content["baselines"]:
        baseline["T_cam0_cam1"]["rotation_quaternion_wxyz"] = [0.0, 0.0, 0.0, 1.0]


def orders_mixed(content: Document) -> None:
    poses = [baseline["T_cam0_cam1"] for baseline in content["baselines"]]
    for baseline, pose in zip(content["baselines"], reversed(poses), strict=True):
        baseline["T_cam0_cam1"] = pose


def put(value: Any, *keys: str | int) -> Callable[[Document], None]:
    def edit(content: Document) -> None:
        place: Any = content
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return edit


ABSURD: dict[str, Callable[[Document], None]] = {
    "cameras swapped with their poses": poses_swapped,
    "cameras upside down": upside_down,
    "lengths x 1.3": lengths(1.3),
    "lengths x 10": lengths(10.0),
    "lengths / 1.3": lengths(1 / 1.3),
    "focal lengths x 1.3": focal(1.3),
    "focal lengths / 1.3": focal(1 / 1.3),
    "focal length of one eye x 1.3": focal(1.3, "cam1"),
    "focal length across x 1.3": focal(1.3, axes=("fy_px",)),
    "focal lengths of 1e308": focal(1e305),
    "focal lengths of next to nothing": focal(1e-300),
    "negative nominals": nominal(lambda mm: mm - 400.0),
    "nominals shifted": nominal(lambda mm: mm + 30.0 * (mm < 299.0)),
    "baselines in the wrong order": orders_mixed,
    "mount turned by 180 degrees": put([0.0, 180.0, 0.0], "mount", "rotation_deg"),
    "mount turned by 30 degrees": put([0.0, 0.0, 30.0], "mount", "rotation_deg"),
    "mount with a negative sigma": put([-1.0, 0.1, 0.1], "mount", "sigma_deg"),
    "principal point in a corner": put(3.0, "cameras", "cam0", "cx_px"),
    "skewed pixels": put(0.3, "cameras", "cam0", "alpha"),
    "distortion that folds": put(-9.0, "cameras", "cam1", "k1"),
    "distortion of 1e300": put(1e300, "cameras", "cam1", "k5"),
    "negative sigma of a length": put(-1.0, "baselines", 0, "sigma_length_mm"),
    "an endless sigma of a yaw": put(1e300, "baselines", 0, "sigma_yaw_deg"),
    "one eye above the other": put([100.0, 60.0, 0.0], "baselines", 0, "T_cam0_cam1", "translation_mm"),
}


@pytest.mark.parametrize("name", ABSURD)
def test_what_no_rig_can_be_stops_the_flight(tmp_path: Path, name: str) -> None:
    """Guards the doctor, which passed each of these once the file's hash fitted; a STOP also bars standing by."""
    findings = examined(tmp_path, ABSURD[name])
    assert [finding.severity for finding in findings] == [Severity.STOP]
    assert findings[0].id in ("calibration-implausible", "calibration-unusable")
    assert len(findings[0].evidence) < 600


def test_an_unchanged_file_passes(tmp_path: Path) -> None:
    assert examined(tmp_path, lambda content: None) == []
    assert examined(tmp_path, lambda content: None, width_px=320, height_px=240) == []


def test_without_the_lenss_data_sheet_only_absurd_fields_of_view_are_found(tmp_path: Path) -> None:
    assert examined(tmp_path, focal(1.3), h_fov_deg=None) == []
    assert examined(tmp_path, focal(4.0), h_fov_deg=None)[0].id == "calibration-implausible"


def test_rigs_as_people_build_them_pass() -> None:
    """Twenty simulated rigs, the paper-like one with a bending rail, and a fixed one whose name is a ruler's reading."""
    for seed in range(20):
        assert implausible(RigTwin(seed=seed).exact_rig(steps=5), vehicle()) == []
    bending = RigModel.from_poses(CAM0, CAM1, TEN_M.tolist(), [true_pose(float(b)) for b in TEN_M])
    assert implausible(bending, vehicle()) == []
    fixed = VehicleConfig(camera=V4l2CameraConfig(backend="v4l2"), servo=NoServoConfig(backend="none"))
    T = np.eye(4)
    T[0, 3] = 0.066
    assert implausible(RigModel.from_poses(CAM0, CAM1, [0.060], [T]), fixed) == []
