"""Check of a calibration on any static textured scene, without a board.

The row offsets of matched points are measured at every baseline and explained as pitch and roll of the right camera.
With the same scene seen at two baselines from a stationary vehicle, the yaw is checked too (paper-notes 14). The
scale is not checked: only a known length can show it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import BaselineEstimate, Image, StereoFrame
from morpheyes_daemon.perception.camera_motion import CameraMotion
from morpheyes_daemon.perception.yaw_estimator import STATIONARY, YawEstimator, YawObservation
from morpheyes_daemon.stereo.depth import DepthEstimator, disparity_of
from morpheyes_daemon.stereo.epipolar import RowFit, RowOffsetEstimator, row_offsets
from morpheyes_daemon.stereo.rig import RigModel

_FEWEST_POINTS = 60
"""Matched points that a pair needs to count; chosen: the median row offset of fewer is noisier than `rows_good_px`."""
_SERVO_SIGMA_M = 1e-4
"""One sigma of a resting servo's position, metres; chosen: the default of `ServoMotion.repeatability_sigma_mm`."""
_FRAME_PERIOD_NS = S // 100
"""Time given to successive pairs, nanoseconds; chosen: short against the yaw estimator's `MAX_AGE_S`."""


@dataclass(frozen=True)
class CheckLimits:
    """Up to `good` the rig is fit to fly, beyond `bad` it must not fly; in between it flies with care.

    All are chosen: StereoSGBM matches within one row, so `rows_bad_px` is where matches begin to be lost, and
    `bias_good_px` is about the matcher's own noise. Lower limits call healthy rigs back to the table.
    """

    rows_good_px: float = 0.5
    """Median row offset, pixels."""
    rows_bad_px: float = 1.0
    bias_good_px: float = 0.3
    """Bias of the disparity by a yaw of the right camera, pixels."""
    bias_bad_px: float = 1.0


@dataclass
class BaselineCheck:
    """Result at one nominal baseline: pairs taken, pairs without texture, and the median row offset of each pair.

    `fit` holds pitch and roll of the right camera relative to the calibration, None before the first textured pair.
    """

    nominal_m: float
    pairs: int = 0
    untextured: int = 0
    rows_px: list[float] = field(default_factory=list)
    estimator: RowOffsetEstimator = field(default_factory=lambda: RowOffsetEstimator(memory=1.0))
    fit: RowFit | None = None

    @property
    def median_px(self) -> float:
        """Median row offset over the pairs, pixels; NaN when none had texture."""
        return float(np.median(self.rows_px)) if self.rows_px else math.nan

    def figures(self) -> dict[str, Any]:
        """Return the entry of this baseline in the output of `calibrate check --json`."""
        known = self.fit is not None and math.isfinite(self.median_px)
        return {
            "nominal_mm": round(self.nominal_m * 1e3, 4),
            "pairs": self.pairs,
            "without_texture": self.untextured,
            "epipolar_median_px": round(self.median_px, 4) if known else None,
            "pitch_deg": round(math.degrees(self.fit.pitch_rad), 4) if self.fit is not None else None,
            "roll_deg": round(math.degrees(self.fit.roll_rad), 4) if self.fit is not None else None,
        }


@dataclass(frozen=True)
class CalibrationCheckResult:
    """All baselines, the disparity bias by yaw with its sigma (pixels; None without two baselines), the acceptance.

    `static` is False when the scene moved; `acceptance` begins with "fit to fly", "fly with care" or "do not fly".
    """

    baselines: tuple[BaselineCheck, ...]
    bias_px: float | None
    bias_sigma_px: float | None
    static: bool
    acceptance: str
    findings: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """False when the acceptance is "do not fly"."""
        return not self.acceptance.startswith("do not fly")

    def figures(self) -> dict[str, Any]:
        """Return the output of `calibrate check --json`."""
        bias, sigma = self.bias_px, self.bias_sigma_px
        return {
            "verdict": self.acceptance,
            "findings": list(self.findings),
            "baselines": [one.figures() for one in self.baselines],
            "disparity_bias_px": None if bias is None else round(bias, 4),
            "disparity_bias_sigma_px": None if sigma is None else round(sigma, 4),
            "scene_still": self.static,
        }


class CalibrationCheck:
    """Collects raw pairs of a static scene, taken by a stationary vehicle; `result` judges the calibration by them.

    `size` (width, height) of the images in pixels.
    """

    def __init__(self, rig: RigModel, size: tuple[int, int], limits: CheckLimits | None = None) -> None:
        self._estimator = DepthEstimator(rig, size=size)
        self._limits = limits or CheckLimits()
        self._yaw = YawEstimator(STATIONARY)
        self._checks: dict[float, BaselineCheck] = {}
        self._time_ns = 0

    def add(self, nominal_m: float, left: Image, right: Image) -> BaselineCheck:
        """Evaluate one raw pair (H, W) or (H, W, 3) at a nominal baseline and return that baseline's result so far.

        Raises InputError on a wrong image size, CalibrationError outside the calibrated range.
        """
        here = self._checks.setdefault(nominal_m, BaselineCheck(nominal_m))
        here.pairs += 1
        baseline = BaselineEstimate(0, nominal_m, nominal_m, _SERVO_SIGMA_M, False)
        frame = StereoFrame(0, self._time_ns, left, right, baseline)
        pair = self._estimator.rectified(frame)
        depth = self._estimator.depth(frame, pair)
        disparity = disparity_of(depth)
        offsets = row_offsets(pair.left, pair.right, disparity)
        if offsets.count < _FEWEST_POINTS:
            here.untextured += 1
            return here
        here.rows_px.append(offsets.median_px)
        here.fit = here.estimator.add(offsets, depth.pinhole)
        still = CameraMotion.still(depth.T_rig_rect)
        seen = (disparity, depth.baseline_m, depth.baseline_sigma_m, depth.pinhole, still)
        self._yaw.add(YawObservation(self._time_ns, pair.left, pair.right, *seen))
        self._time_ns += _FRAME_PERIOD_NS
        return here

    def result(self) -> CalibrationCheckResult:
        """Return the acceptance from all pairs so far; raises InputError when there are none."""
        if not self._checks:
            raise InputError("There are no pictures to check the calibration with.")
        checks = tuple(self._checks[nominal] for nominal in sorted(self._checks))
        f_px = (self._estimator.rig.cam0.fx + self._estimator.rig.cam1.fx) / 2
        seen = self._yaw.pairs > 0
        bias, sigma = (self._yaw.yaw_rad * f_px, self._yaw.sigma_rad * f_px) if seen else (None, None)
        findings = [*self._rows(checks), *self._bias(bias, sigma, len(checks))]
        bad = [text for fatal, text in findings if fatal]
        texts = [text for _, text in findings]
        if bad:
            acceptance = f"do not fly: {bad[0]}"
        elif texts:
            acceptance = f"fly with care: {texts[0]}"
        else:
            worst = max(check.median_px for check in checks)
            acceptance = f"fit to fly: rows agree within {worst:.2f} px (median)"
        return CalibrationCheckResult(checks, bias, sigma, seen or not self._yaw.moving, acceptance, tuple(texts))

    def _rows(self, checks: Iterable[BaselineCheck]) -> list[tuple[bool, str]]:
        found = []
        for check in checks:
            name = f"at {check.nominal_m * 1e3:g} mm"
            if not check.rows_px:
                found.append((False, f"{name} no pair has enough texture: point the cameras at another scene"))
            elif check.median_px > self._limits.rows_good_px:
                turn = ""
                if check.fit is not None:
                    pitch, roll = math.degrees(check.fit.pitch_rad), math.degrees(check.fit.roll_rad)
                    turn = f" (the right camera has rotated by {pitch:+.3f} deg in pitch, {roll:+.3f} deg in roll)"
                fatal = check.median_px > self._limits.rows_bad_px
                found.append((fatal, f"{name} rows differ by {check.median_px:.2f} px{turn}: calibrate again"))
        return found

    def _bias(self, bias: float | None, sigma: float | None, baselines: int) -> list[tuple[bool, str]]:
        if bias is None or sigma is None:
            if baselines < 2:
                return []
            why = "the scene moves" if self._yaw.moving else "too few points are seen at two baselines"
            return [(False, f"the yaw could not be checked: {why}")]
        if abs(bias) <= self._limits.bias_good_px or abs(bias) < 3 * sigma:
            return []
        fatal = abs(bias) > self._limits.bias_bad_px
        return [
            (
                fatal,
                f"disparities are biased by {bias:+.2f} ± {sigma:.2f} px by a yaw of the right camera: calibrate again",
            )
        ]
