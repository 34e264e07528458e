"""The doctor on machine, calibration, servo and camera, each with its faults."""

from __future__ import annotations

import os
import shutil
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import (
    NoServoConfig,
    RecorderConfig,
    RecordingCameraConfig,
    SerialServoConfig,
    V4l2CameraConfig,
    VehicleConfig,
)
from morpheyes_daemon.devices.servo.none import NoServo
from morpheyes_daemon.doctor import machine
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.doctor.machine import examine_machine
from morpheyes_daemon.doctor.rig import examine_calibration, examine_camera, examine_servo
from morpheyes_daemon.errors import DeviceNotFoundError, DeviceTimeoutError
from morpheyes_daemon.messages.core import Image, RawPair
from morpheyes_daemon.stereo.calibration_file import write_calibration
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import CameraMount, RigModel

WIDTH, HEIGHT, F_PX, BASELINE_M, DISPARITY_PX = 320, 240, 300.0, 0.1, 12


def rig(method: str = "solved", verdict: str = "fit to fly: rows agree", longest_m: float = 0.3) -> RigModel:
    eye = CameraIntrinsics(WIDTH, HEIGHT, F_PX, F_PX, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
    poses = []
    for baseline_m in (BASELINE_M, longest_m):
        T = np.eye(4)
        T[0, 3] = baseline_m
        poses.append(T)
    return replace(
        RigModel.from_poses(eye, eye, (BASELINE_M, longest_m), poses, method, {"verdict": verdict}),
        mount=CameraMount((0.0, 0.01, 0.0), (1e-3, 1e-3, 1e-3)),
    )


def config(tmp_path: Path, **changes: Any) -> VehicleConfig:
    """A vehicle with a recording for a camera and no servo."""
    parts: dict[str, Any] = {
        "camera": RecordingCameraConfig(backend="recording", path=tmp_path, width_px=WIDTH, height_px=HEIGHT),
        "servo": NoServoConfig(backend="none", baseline_mm=BASELINE_M * 1e3),
        "recorder": RecorderConfig(folder=tmp_path / "flights"),
    }
    return VehicleConfig(**{**parts, **changes})


def ids(findings: list[Finding]) -> list[str]:
    return [finding.id for finding in findings]


def view(seq: int) -> tuple[Image, Image]:
    """A textured wall at DISPARITY_PX, with the noise that two exposures never share."""
    noise = np.random.default_rng(seq)
    wall = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH + 40), np.uint8), (0, 0), 1.2)
    wall = cv2.normalize(wall, np.empty_like(wall), 20, 230, cv2.NORM_MINMAX)
    left, right = wall[:, :WIDTH], wall[:, DISPARITY_PX : DISPARITY_PX + WIDTH]
    pair = (eye.astype(int) + noise.integers(-2, 3, eye.shape) for eye in (left, right))
    first, second = (np.clip(eye, 0, 255).astype(np.uint8) for eye in pair)
    return first, second


class Camera:
    """Pairs at a rate, made by `picture(seq)`."""

    def __init__(self, picture: Any = view, rate_hz: float = 5.0, fails: Exception | None = None) -> None:
        self._picture, self._rate_hz, self._fails = picture, rate_hz, fails
        self._seq = 0
        self.closed = 0

    async def open(self) -> None:
        if isinstance(self._fails, DeviceNotFoundError):
            raise self._fails

    async def read(self) -> RawPair:
        if self._fails is not None:
            raise self._fails
        self._seq += 1
        left, right = self._picture(self._seq)
        return RawPair(self._seq, round(self._seq / self._rate_hz * S), left, right)

    async def close(self) -> None:
        self.closed += 1


async def look(camera: Camera, settings: VehicleConfig, eyes: RigModel | None = None) -> list[Finding]:
    findings = await examine_camera(lambda: camera, settings, eyes or rig())
    assert camera.closed
    return findings


async def test_good_camera(tmp_path: Path) -> None:
    assert await look(Camera(), config(tmp_path)) == []


async def test_swapped_eyes_do_not_match(tmp_path: Path) -> None:
    def swapped(seq: int) -> tuple[Image, Image]:
        left, right = view(seq)
        return right, left

    [finding] = await look(Camera(swapped), config(tmp_path))
    assert (finding.id, finding.severity) == ("eyes-do-not-match", Severity.STOP)


async def test_rows_that_do_not_agree(tmp_path: Path) -> None:
    """Guards swapped intrinsics: exchanged principal points shift the rows, and coarse texture still matches."""

    def shifted(seq: int) -> tuple[Image, Image]:
        left, right = (cv2.GaussianBlur(eye, (0, 0), 5.0) for eye in view(seq))
        left, right = ((4.0 * (eye - eye.mean()) + 128).clip(20, 230).astype(np.uint8) for eye in (left, right))
        return left, np.roll(right, 2, axis=0)

    [finding] = await look(Camera(shifted), config(tmp_path))
    assert (finding.id, finding.severity) == ("eyes-do-not-match", Severity.STOP)
    assert "rows of matched points are " in finding.evidence


async def test_frozen_dark_and_burnt_images(tmp_path: Path) -> None:
    def dark_and_burnt(seq: int) -> tuple[Image, Image]:
        return np.full((HEIGHT, WIDTH), seq % 5, np.uint8), np.full((HEIGHT, WIDTH), 255, np.uint8)

    assert "image-frozen" in ids(await look(Camera(lambda seq: view(1)), config(tmp_path)))
    found = await look(Camera(dark_and_burnt), config(tmp_path))
    assert [finding.evidence.split("(")[0] for finding in found] == [
        "the left image is dark ",
        "the right image is burnt out ",
    ]


async def test_slow_missing_and_silent_cameras(tmp_path: Path) -> None:
    [slow] = await look(Camera(rate_hz=2.0), config(tmp_path))
    assert slow.id == "camera-slow"
    assert "2.0 pairs a second" in slow.evidence
    for error in (DeviceNotFoundError("no such camera"), DeviceTimeoutError("the camera is silent")):
        [missing] = await look(Camera(fails=error), config(tmp_path))
        assert missing.id == "camera-missing"
        assert str(error) in missing.evidence


async def test_images_of_another_size_are_a_finding(tmp_path: Path) -> None:
    def small(seq: int) -> tuple[Image, Image]:
        left, right = view(seq)
        return left[:200], right[:200]

    assert ids(await look(Camera(small), config(tmp_path))) == ["images-unusable"]


def saved(tmp_path: Path, model: RigModel) -> Path:
    path = tmp_path / "calibration.yaml"
    write_calibration(model, path)
    return path


def test_calibrations(tmp_path: Path) -> None:
    good = config(tmp_path, calibration=saved(tmp_path, rig()))
    findings, model = examine_calibration(good)
    assert findings == []
    assert model is not None
    poor = config(tmp_path, calibration=saved(tmp_path, rig(verdict="do not fly: 0.9 px")))
    [finding] = examine_calibration(poor)[0]
    assert (finding.id, finding.severity) == ("calibration-poor", Severity.STOP)
    careful = config(tmp_path, calibration=saved(tmp_path, rig(verdict="fly with care: few views")))
    assert examine_calibration(careful)[0][0].severity is Severity.CARE


def test_unusable_calibrations(tmp_path: Path) -> None:
    path = saved(tmp_path, rig(longest_m=0.2))
    servo = SerialServoConfig(backend="serial", url="serial:/dev/none")
    cases = [
        (config(tmp_path), "not set"),
        (config(tmp_path, calibration=tmp_path / "none.yaml"), "no such file"),
        (config(tmp_path, calibration=path, servo=servo), "100 to 200 mm"),
    ]
    for settings, words in cases:
        [finding], model = examine_calibration(settings)
        assert model is None
        assert finding.id == "calibration-unusable"
        assert words in finding.evidence
    path.write_text(path.read_text().replace("fx_px: 300", "fx_px: 301"))
    assert examine_calibration(config(tmp_path, calibration=path))[0][0].id == "calibration-unusable"


def test_exact_calibration_is_not_a_real_rig(tmp_path: Path) -> None:
    camera = V4l2CameraConfig(backend="v4l2", width_px=WIDTH, height_px=HEIGHT)
    settings = config(tmp_path, calibration=saved(tmp_path, rig(method="exact", verdict="")), camera=camera)
    assert examine_calibration(settings)[0][0].severity is Severity.STOP


def test_a_mount_that_was_never_measured_is_noted(tmp_path: Path) -> None:
    unmounted = config(tmp_path, calibration=saved(tmp_path, replace(rig(), mount=None)))
    [finding] = examine_calibration(unmounted)[0]
    assert (finding.id, finding.severity) == ("mount-unmeasured", Severity.NOTE)
    assert "calibrate mount" in finding.remedy


def test_eyes_far_from_synchronous(tmp_path: Path) -> None:
    camera = config(tmp_path).camera.model_copy(update={"sync_error_ms": 30.0})
    settings = config(tmp_path, calibration=saved(tmp_path, rig()), camera=camera)
    assert ids(examine_calibration(settings)[0]) == ["eyes-not-synchronous"]


class SilentServo(NoServo):
    """A Teensy that does not answer."""

    async def move(self, baseline_m: float) -> None:
        raise DeviceTimeoutError("the servo does not answer.")


async def test_servo(tmp_path: Path) -> None:
    assert await examine_servo(NoServo(BASELINE_M), config(tmp_path)) == ([], True)
    [finding], placed = await examine_servo(SilentServo(BASELINE_M), config(tmp_path))
    assert (finding.id, placed) == ("servo-missing", False)


def test_sound_machine(tmp_path: Path) -> None:
    assert examine_machine(config(tmp_path), tmp_path / "no-sysfs") == []


@pytest.mark.parametrize(("millidegrees", "severity"), [(60_000, None), (78_000, "care"), (84_000, "stop")])
def test_temperature(tmp_path: Path, millidegrees: int, severity: str | None) -> None:
    zone = tmp_path / "class/thermal/thermal_zone0"
    zone.mkdir(parents=True)
    (zone / "temp").write_text(f"{millidegrees}\n")
    (tmp_path / "class/thermal/thermal_zone1").mkdir()
    found = examine_machine(config(tmp_path), tmp_path)
    assert [finding.severity for finding in found] == ([severity] if severity else [])


@pytest.mark.parametrize(("bits", "severity"), [("0", None), ("50000", "care"), ("50005", "stop"), ("??", None)])
def test_power_of_a_raspberry_pi(tmp_path: Path, bits: str, severity: str | None) -> None:
    path = tmp_path / "devices/platform/soc/soc:firmware/get_throttled"
    path.parent.mkdir(parents=True)
    path.write_text(bits)
    found = examine_machine(config(tmp_path), tmp_path)
    assert [finding.severity for finding in found] == ([severity] if severity else [])


def test_disk_clock_and_permissions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9, 5 * 10**7))
    monkeypatch.setattr(machine, "wall_time_s", lambda: 86_400.0)
    port = tmp_path / "port"
    port.write_text("")
    closed = {port, tmp_path}
    monkeypatch.setattr(os, "access", lambda path, mode: path not in closed)
    servo = SerialServoConfig(backend="serial", url=f"serial:{port}:115200")
    found = ids(examine_machine(config(tmp_path, servo=servo), tmp_path / "no-sysfs"))
    assert found == ["log-folder-closed", "clock-not-set", "no-permission"]
    closed.remove(tmp_path)
    assert ids(examine_machine(config(tmp_path), tmp_path / "no-sysfs"))[0] == "disk-full"
