"""The calibration file: readable YAML with frames and units in the keys and a hash of its content.

The hash covers every value but itself, so a truncated or edited file is detected; comments and layout are free.
Numbers have 12 significant digits, far below the uncertainty of any calibration.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field

from morpheyes_daemon.config.yaml_errors import validate
from morpheyes_daemon.config.yaml_reader import parse_yaml, read_text
from morpheyes_daemon.errors import CalibrationError, ConfigError
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import CalibratedBaseline, CameraMount, RigModel

FORMAT = "morpheyes-calibration-1"
"""Version of the file format, in its key `format`."""

_HEADER = """\
# Calibration of a stereo rig, as `morpheyes calibrate` writes and the daemon reads it.
# T_cam0_cam1 takes points from the right camera's frame to the left one's (x right, y down, z forward).
# Each pose belongs to a nominal baseline, the commanded one; the true baseline is the length of the translation.
# Distortion is in the paper's order: radial k1, k2, k5, tangential k3, k4.
# `mount` is the rotation vector of the left camera on the bar, as measured by `morpheyes calibrate mount`.
# sha256 covers every value here: do not edit, calibrate again instead.
"""
_REMEDY = "fetch it from a copy, or make it again with `morpheyes calibrate solve`"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Camera(_Part):
    size_px: tuple[int, int]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    alpha: float
    k1: float
    k2: float
    k3: float
    k4: float
    k5: float


class _Pose(_Part):
    rotation_quaternion_wxyz: tuple[float, float, float, float]
    translation_mm: tuple[float, float, float]


class _Baseline(_Part):
    nominal_mm: float
    T_cam0_cam1: _Pose
    rms_px: float | None = None
    sigma_length_mm: float | None = None
    sigma_yaw_deg: float | None = None


class _Mount(_Part):
    rotation_deg: tuple[float, float, float]
    sigma_deg: tuple[float, float, float]


class _Cameras(_Part):
    cam0: _Camera
    cam1: _Camera


class _File(_Part):
    format: Literal["morpheyes-calibration-1"]
    method: Literal["solved", "exact"]
    cameras: _Cameras
    baselines: list[_Baseline] = Field(min_length=1)
    mount: _Mount | None = None
    details: dict[str, Any]
    sha256: str


def read_calibration(path: Path) -> RigModel:
    """Return the rig of a calibration file; raises CalibrationError, naming file and remedy, when it is invalid."""
    try:
        data, root = parse_yaml(read_text(path), str(path))
    except ConfigError as error:
        raise CalibrationError(f"{error} If it was a calibration, {_REMEDY}.") from None
    _check_hash(data, path)
    try:
        return _rig(validate(data, _File, str(path), root))
    except ConfigError as error:
        raise CalibrationError(str(error)) from None
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def write_calibration(rig: RigModel, path: Path) -> None:
    """Write `rig` to `path` through a temporary file beside it, so that no reader gets an incomplete file.

    Raises CalibrationError when it cannot be written.
    """
    content = document(rig)
    text = _HEADER + yaml.safe_dump(
        {**content, "sha256": content_hash(content)}, sort_keys=False, default_flow_style=None, width=110
    )
    temporary = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        raise CalibrationError(f"{path}: the calibration cannot be written there ({error.strerror}).") from None


def document(rig: RigModel) -> dict[str, Any]:
    """Return the file's content as plain data, without its hash."""
    return {
        "format": FORMAT,
        "method": rig.method,
        "cameras": {"cam0": _camera_part(rig.cam0), "cam1": _camera_part(rig.cam1)},
        "baselines": [_baseline_part(baseline) for baseline in rig.baselines],
        **({} if rig.mount is None else {"mount": _mount_part(rig.mount)}),
        "details": _plain(rig.details),
    }


def calibration_hash(rig: RigModel) -> str:
    """Return the SHA-256 (hex) that the file of `rig` carries."""
    return content_hash(document(rig))


def content_hash(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of plain data in canonical JSON, whatever the order of its keys."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _check_hash(data: Any, path: Path) -> None:
    if not isinstance(data, dict) or not str(data.get("format", "")).startswith("morpheyes-calibration"):
        raise CalibrationError(f"{path}: is not a MorphEyes calibration file; name one, or {_REMEDY}.")
    if data["format"] != FORMAT:
        raise CalibrationError(f"{path}: has the format {data['format']!r}, but {FORMAT!r} is read here; {_REMEDY}.")
    if "sha256" not in data:
        raise CalibrationError(f"{path}: has no sha256 at its end, so it is truncated; {_REMEDY}.")
    content = {key: value for key, value in data.items() if key != "sha256"}
    if content_hash(content) != data["sha256"]:
        raise CalibrationError(f"{path}: does not match its own hash, so it was edited or damaged; {_REMEDY}.")


def _rig(file: _File) -> RigModel:
    return RigModel(
        cam0=_intrinsics(file.cameras.cam0),
        cam1=_intrinsics(file.cameras.cam1),
        baselines=tuple(_baseline(part) for part in file.baselines),
        method=file.method,
        details=file.details,
        mount=None if file.mount is None else _camera_mount(file.mount),
    )


def _camera_mount(part: _Mount) -> CameraMount:
    return CameraMount(_radians(part.rotation_deg), _radians(part.sigma_deg))


def _intrinsics(part: _Camera) -> CameraIntrinsics:
    k = (part.k1, part.k2, part.k3, part.k4, part.k5)
    return CameraIntrinsics(*part.size_px, part.fx_px, part.fy_px, part.cx_px, part.cy_px, part.alpha, k)


def _baseline(part: _Baseline) -> CalibratedBaseline:
    x, y, z = part.T_cam0_cam1.translation_mm
    return CalibratedBaseline(
        nominal_m=part.nominal_mm / 1e3,
        q_cam0_cam1=part.T_cam0_cam1.rotation_quaternion_wxyz,
        t_cam0_cam1_m=(x / 1e3, y / 1e3, z / 1e3),
        rms_px=part.rms_px,
        sigma_length_m=None if part.sigma_length_mm is None else part.sigma_length_mm / 1e3,
        sigma_yaw_rad=None if part.sigma_yaw_deg is None else math.radians(part.sigma_yaw_deg),
    )


def _camera_part(camera: CameraIntrinsics) -> dict[str, Any]:
    names = ("k1", "k2", "k3", "k4", "k5")
    return {
        "size_px": [camera.width, camera.height],
        "fx_px": _digits(camera.fx),
        "fy_px": _digits(camera.fy),
        "cx_px": _digits(camera.cx),
        "cy_px": _digits(camera.cy),
        "alpha": _digits(camera.alpha),
        **{name: _digits(value) for name, value in zip(names, camera.k, strict=True)},
    }


def _baseline_part(baseline: CalibratedBaseline) -> dict[str, Any]:
    yaw, length = baseline.sigma_yaw_rad, baseline.sigma_length_m
    part: dict[str, Any] = {
        "nominal_mm": _digits(baseline.nominal_m * 1e3),
        "T_cam0_cam1": {
            "rotation_quaternion_wxyz": [_digits(c) for c in baseline.q_cam0_cam1],
            "translation_mm": [_digits(c * 1e3) for c in baseline.t_cam0_cam1_m],
        },
        "rms_px": None if baseline.rms_px is None else _digits(baseline.rms_px),
        "sigma_length_mm": None if length is None else _digits(length * 1e3),
        "sigma_yaw_deg": None if yaw is None else _digits(math.degrees(yaw)),
    }
    return {key: value for key, value in part.items() if value is not None}


def _mount_part(mount: CameraMount) -> dict[str, Any]:
    return {
        "rotation_deg": [_digits(math.degrees(angle)) for angle in mount.rotation_rad],
        "sigma_deg": [_digits(math.degrees(angle)) for angle in mount.sigma_rad],
    }


def _radians(degrees: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = (math.radians(angle) for angle in degrees)
    return x, y, z


def _digits(value: float) -> float:
    return float(f"{value:.12g}")


def _plain(value: Any) -> Any:
    """Return mappings, sequences and numpy numbers as types that YAML and JSON share."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)
