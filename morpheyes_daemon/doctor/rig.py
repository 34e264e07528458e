"""The stereo rig: is there a calibration that covers it, do the servo and the camera answer, do the eyes match?

The servo is moved to its smallest baseline, where a pair is matched; nothing is judged that only flight shows.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.devices.servo import Servo
from morpheyes_daemon.doctor.calibration_plausibility import implausible
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.errors import CalibrationError, ConfigError, DeviceError, InputError, MorphEyesError
from morpheyes_daemon.messages.core import BaselineEstimate, RawPair, StereoFrame
from morpheyes_daemon.perception.craft import fitting_rig
from morpheyes_daemon.stereo.depth import DepthEstimator, disparity_of
from morpheyes_daemon.stereo.epipolar import row_offsets
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.theory.sync import sync_speed_bound_m_s

PAIRS = 6
FIRST_PAIR_S = 10.0
SLOW_SHARE = 0.8
DARK, BURNT = 12.0, 243.0
"""Median grey levels beyond which matching has nothing to work on."""
FEWEST_MATCHES = 0.25
MOST_SAID = 3
ROWS_APART_PX, FEWEST_ROWS = 1.0, 60
"""Median row offset of matched points beyond which `calibrate check` says "do not fly" as well."""
SYNC_NEAR_M = 1.0
SYNC_SPEED_M_S = 0.3
"""The governor flies as slowly past obstacles at SYNC_NEAR_M as the time between the eyes asks for."""


def examine_calibration(config: VehicleConfig) -> tuple[list[Finding], RigModel | None]:
    """Return the findings on the calibration file, and the rig at the camera's size when it can be used."""
    if config.calibration is None:
        return [_unusable("calibration is not set in config.yaml")], None
    try:
        rig = fitting_rig(config.calibration, config)
    except (CalibrationError, ConfigError) as error:
        return [_unusable(str(error))], None
    findings = examine_rig(rig, config)
    usable = all(finding.id != "calibration-implausible" for finding in findings)
    return findings, rig.rescaled(config.camera.width_px, config.camera.height_px) if usable else None


def examine_rig(rig: RigModel, config: VehicleConfig) -> list[Finding]:
    """Return the findings on a calibrated rig that fits the vehicle."""
    scaled = rig.rescaled(config.camera.width_px, config.camera.height_px)
    unlikely = implausible(scaled, config)
    if unlikely:
        return [_implausible(config, unlikely)]
    return [*_calibration_verdict(scaled, config), *_mount(scaled, config), *_sync(scaled, config)]


def _unusable(evidence: str) -> Finding:
    return Finding(
        "calibration-unusable",
        Severity.STOP,
        evidence,
        "no depth can be computed",
        "calibrate the rig with `morpheyes calibrate` and name the file in config.yaml",
    )


def _implausible(config: VehicleConfig, unlikely: list[str]) -> Finding:
    more = f" and {len(unlikely) - MOST_SAID} more" if len(unlikely) > MOST_SAID else ""
    return Finding(
        "calibration-implausible",
        Severity.STOP,
        f"{config.calibration}: {'; '.join(unlikely[:MOST_SAID])}{more}",
        "depth and direction would be wrong without anything to show it",
        "fetch the file that `morpheyes calibrate solve` wrote for this rig, or calibrate again",
    )


def _calibration_verdict(rig: RigModel, config: VehicleConfig) -> list[Finding]:
    words = str(rig.details.get("verdict", ""))
    severity = Severity.STOP if words.startswith("do not fly") else Severity.CARE
    if rig.method == "exact" and config.camera.backend == "v4l2":
        words, severity = "it was not made from images of this rig (method: exact)", Severity.STOP
    elif not words.startswith(("do not fly", "fly with care")):
        return []
    return [
        Finding(
            "calibration-poor",
            severity,
            f"{config.calibration}: {words}",
            "depth is wrong by more than the daemon reckons with",
            "take new images as `morpheyes calibrate report` advises and solve again",
        )
    ]


def _mount(rig: RigModel, config: VehicleConfig) -> list[Finding]:
    if rig.mount is not None:
        return []
    return [
        Finding(
            "mount-unmeasured",
            Severity.NOTE,
            f"{config.calibration}: says nothing of where the eyes point on the vehicle",
            "half a degree is 35 mm aside at 4 m, as much as the vehicle has to spare in a gap",
            "measure it with `morpheyes calibrate capture --mount` and `morpheyes calibrate mount`",
        )
    ]


def _sync(rig: RigModel, config: VehicleConfig) -> list[Finding]:
    dt_s = config.camera.sync_error_ms / 1e3
    if dt_s <= 0.0:
        return []
    bound = sync_speed_bound_m_s(
        dt_s=dt_s,
        baseline_m=config.baseline_range_m[0],
        z_m=SYNC_NEAR_M,
        f_px=rig.cam0.fx,
        k_px=1.0,
        half_width_px=config.camera.width_px / 2,
    )
    if bound >= SYNC_SPEED_M_S:
        return []
    return [
        Finding(
            "eyes-not-synchronous",
            Severity.CARE,
            f"camera.sync_error_ms is {config.camera.sync_error_ms:g}: {bound:.2f} m/s at {SYNC_NEAR_M:g} m at most",
            "the eyes see different moments, and near obstacles get a wrong depth",
            "synchronize the cameras in hardware, measure the rest with `morpheyes calibrate check`",
        )
    ]


async def examine_servo(servo: Servo, config: VehicleConfig) -> tuple[list[Finding], bool]:
    """Open the servo and command its smallest baseline; return findings and whether it is there now."""
    try:
        await servo.open()
        await servo.move(config.baseline_range_m[0])
    except DeviceError as error:
        finding = Finding(
            "servo-missing",
            Severity.STOP,
            str(error),
            "the baseline cannot be changed and is not known",
            "check cable, power and servo.url; `servo.backend: none` flies a fixed rig",
        )
        return [finding], False
    finally:
        await servo.close()
    return [], True


async def examine_camera(build: Callable[[], Camera], config: VehicleConfig, rig: RigModel | None) -> list[Finding]:
    """Read some pairs and judge rate and content; with `rig` (eyes at the smallest baseline) match one."""
    try:
        pairs = await _read(build())
    except (DeviceError, ConfigError, InputError) as error:
        return [_camera_finding("camera-missing", Severity.STOP, str(error), "there is nothing to see with")]
    findings = [*_rate(pairs, config), *_content(pairs)]
    if not findings and rig is not None:
        findings += await asyncio.to_thread(_match, pairs[-1], config, rig)
    return findings


async def _read(camera: Camera) -> list[RawPair]:
    try:
        await camera.open()
        async with asyncio.timeout(FIRST_PAIR_S):
            return [await camera.read() for _ in range(PAIRS)]
    except TimeoutError:
        raise DeviceError(f"fewer than {PAIRS} pairs came in {FIRST_PAIR_S:g} s.") from None
    finally:
        await camera.close()


def _rate(pairs: Sequence[RawPair], config: VehicleConfig) -> list[Finding]:
    span_s = (pairs[-1].t_ns - pairs[0].t_ns) / S
    rate_hz = (pairs[-1].seq - pairs[0].seq) / span_s if span_s > 0 else 0.0
    if rate_hz >= SLOW_SHARE * config.camera.rate_hz:
        return []
    evidence = f"{rate_hz:.1f} pairs a second came instead of {config.camera.rate_hz:g}"
    return [_camera_finding("camera-slow", Severity.CARE, evidence, "frames go stale, and the vehicle brakes for it")]


def _content(pairs: Sequence[RawPair]) -> list[Finding]:
    findings = []
    if all(np.array_equal(pairs[0].left, pair.left) for pair in pairs[1:]):
        evidence = f"{len(pairs)} left images in a row are identical"
        findings.append(_camera_finding("image-frozen", Severity.STOP, evidence, "old images pass for new ones"))
    for eye in ("left", "right"):
        level = float(np.median(getattr(pairs[-1], eye)))
        if not DARK <= level <= BURNT:
            word = "dark" if level < DARK else "burnt out"
            evidence = f"the {eye} image is {word} (median grey level {level:.0f} of 255)"
            findings.append(_camera_finding("image-blind", Severity.STOP, evidence, "there is nothing to match"))
    return findings


def _match(pair: RawPair, config: VehicleConfig, rig: RigModel) -> list[Finding]:
    size = (config.camera.width_px, config.camera.height_px)
    baseline_m = config.baseline_range_m[0]
    at = BaselineEstimate(pair.t_ns, baseline_m, baseline_m, 0.0, False)
    frame = StereoFrame(pair.seq, pair.t_ns, pair.left, pair.right, at)
    try:
        estimator = DepthEstimator(rig, config.stereo, size)
        rectified = estimator.rectified(frame)
        depth = estimator.depth(frame, rectified)
    except MorphEyesError as error:
        return [_camera_finding("images-unusable", Severity.STOP, str(error), "no depth can be computed")]
    offsets = row_offsets(rectified.left, rectified.right, disparity_of(depth))
    evidence = ""
    if depth.valid_fraction < FEWEST_MATCHES:
        evidence = f"only {depth.valid_fraction:.0%} of the pixels find their partner"
    elif offsets.count >= FEWEST_ROWS and offsets.median_px > ROWS_APART_PX:
        evidence = f"rows of matched points are {offsets.median_px:.1f} px apart"
    risk = "swapped eyes, a knock, or another rig's calibration look like this"
    return [_camera_finding("eyes-do-not-match", Severity.STOP, evidence, risk)] if evidence else []


def _camera_finding(name: str, severity: Severity, evidence: str, risk: str) -> Finding:
    remedy = "check cable, exposure, lens caps and the camera section of config.yaml"
    if name == "eyes-do-not-match":
        remedy = "point it at something with texture; if it stays, check camera.swap_eyes and calibrate again"
    return Finding(name, severity, evidence, risk, remedy)
