"""Does the calibration still fit the rig, asked of any scene with texture, without a board.

Rows of matched points must agree at every baseline; what they do not agree in is told as pitch and roll. With the
scene seen at two baselines and the vehicle standing still, the yaw is checked too (paper-notes 14). The scale is not:
nothing but a known length can tell it.
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
from morpheyes_daemon.perception.yaw_estimator import STILL, Look, YawEstimator
from morpheyes_daemon.stereo.depth import DepthEstimator, disparity_of
from morpheyes_daemon.stereo.epipolar import RowFit, RowWatch, row_offsets
from morpheyes_daemon.stereo.rig import RigModel

_FEWEST_POINTS = 60
_SERVO_SIGMA_M = 1e-4
"""How well a servo at rest stands where it should."""


@dataclass(frozen=True)
class Limits:
    """Fit to fly up to `good`, not beyond `bad`; rows as the field's factories and matchers need them."""

    rows_good_px: float = 0.5
    rows_bad_px: float = 1.0
    bias_good_px: float = 0.3
    bias_bad_px: float = 1.0


@dataclass
class BaselineCheck:
    """What the pairs at one nominal baseline showed; angles are of the right eye, from the calibration."""

    nominal_m: float
    pairs: int = 0
    blind: int = 0
    rows_px: list[float] = field(default_factory=list)
    watch: RowWatch = field(default_factory=lambda: RowWatch(memory=1.0))
    fit: RowFit | None = None

    @property
    def median_px(self) -> float:
        """Median row difference over the pairs, NaN when none had texture."""
        return float(np.median(self.rows_px)) if self.rows_px else math.nan

    def figures(self) -> dict[str, Any]:
        """Return what `--json` prints of it."""
        known = self.fit is not None and math.isfinite(self.median_px)
        return {
            "nominal_mm": round(self.nominal_m * 1e3, 4),
            "pairs": self.pairs,
            "without_texture": self.blind,
            "epipolar_median_px": round(self.median_px, 4) if known else None,
            "pitch_deg": round(math.degrees(self.fit.pitch_rad), 4) if self.fit is not None else None,
            "roll_deg": round(math.degrees(self.fit.roll_rad), 4) if self.fit is not None else None,
        }


@dataclass(frozen=True)
class CheckResult:
    """All baselines, the yaw if two were seen (disparity bias and its sigma in pixels), and the verdict."""

    baselines: tuple[BaselineCheck, ...]
    bias_px: float | None
    bias_sigma_px: float | None
    static: bool
    verdict: str
    findings: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """False for "do not fly"."""
        return not self.verdict.startswith("do not fly")

    def figures(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        bias, sigma = self.bias_px, self.bias_sigma_px
        return {
            "verdict": self.verdict,
            "findings": list(self.findings),
            "baselines": [one.figures() for one in self.baselines],
            "disparity_bias_px": None if bias is None else round(bias, 4),
            "disparity_bias_sigma_px": None if sigma is None else round(sigma, 4),
            "scene_still": self.static,
        }


class RigCheck:
    """Takes raw pairs one by one, of a vehicle that stands still, and judges at the end."""

    def __init__(self, rig: RigModel, size: tuple[int, int], limits: Limits | None = None) -> None:
        self._estimator = DepthEstimator(rig, size=size)
        self._limits = limits or Limits()
        self._yaw = YawEstimator(STILL)
        self._checks: dict[float, BaselineCheck] = {}
        self._time_ns = 0

    def add(self, nominal_m: float, left: Image, right: Image) -> BaselineCheck:
        """Look at one raw pair; raises InputError or CalibrationError when it does not fit the calibration."""
        here = self._checks.setdefault(nominal_m, BaselineCheck(nominal_m))
        here.pairs += 1
        baseline = BaselineEstimate(0, nominal_m, nominal_m, _SERVO_SIGMA_M, False)
        frame = StereoFrame(0, self._time_ns, left, right, baseline)
        pair = self._estimator.rectified(frame)
        depth = self._estimator.depth(frame, pair)
        disparity = disparity_of(depth)
        offsets = row_offsets(pair.left, pair.right, disparity)
        if offsets.count < _FEWEST_POINTS:
            here.blind += 1
            return here
        here.rows_px.append(offsets.median_px)
        here.fit = here.watch.add(offsets, depth.pinhole)
        still = CameraMotion.still(depth.T_rig_rect)
        seen = (disparity, depth.baseline_m, depth.baseline_sigma_m, depth.pinhole, still)
        self._yaw.add(Look(self._time_ns, pair.left, pair.right, *seen))
        self._time_ns += S // 100
        return here

    def result(self) -> CheckResult:
        """Return the judgement on everything taken so far; raises InputError before any pair."""
        if not self._checks:
            raise InputError("There are no pictures to check the calibration with.")
        checks = tuple(self._checks[nominal] for nominal in sorted(self._checks))
        f_px = (self._estimator.rig.cam0.fx + self._estimator.rig.cam1.fx) / 2
        seen = self._yaw.pairs > 0
        bias, sigma = (self._yaw.yaw_rad * f_px, self._yaw.sigma_rad * f_px) if seen else (None, None)
        findings = [*self._rows(checks), *self._bias(bias, sigma, len(checks))]
        bad = [text for grave, text in findings if grave]
        texts = [text for _, text in findings]
        if bad:
            verdict = f"do not fly: {bad[0]}"
        elif texts:
            verdict = f"fly with care: {texts[0]}"
        else:
            worst = max(check.median_px for check in checks)
            verdict = f"fit to fly: rows agree within {worst:.2f} px (median)"
        return CheckResult(checks, bias, sigma, seen or not self._yaw.moving, verdict, tuple(texts))

    def _rows(self, checks: Iterable[BaselineCheck]) -> list[tuple[bool, str]]:
        found = []
        for check in checks:
            name = f"at {check.nominal_m * 1e3:g} mm"
            if not check.rows_px:
                found.append((False, f"{name} no pair shows enough texture to tell: look at something else"))
            elif check.median_px > self._limits.rows_good_px:
                turn = ""
                if check.fit is not None:
                    pitch, roll = math.degrees(check.fit.pitch_rad), math.degrees(check.fit.roll_rad)
                    turn = f" (the right eye has turned by {pitch:+.3f} deg in pitch, {roll:+.3f} deg in roll)"
                grave = check.median_px > self._limits.rows_bad_px
                found.append((grave, f"{name} rows differ by {check.median_px:.2f} px{turn}: calibrate again"))
        return found

    def _bias(self, bias: float | None, sigma: float | None, baselines: int) -> list[tuple[bool, str]]:
        if bias is None or sigma is None:
            if baselines < 2:
                return []
            why = "the scene moves" if self._yaw.moving else "too few points are seen at two baselines"
            return [(False, f"the yaw could not be checked: {why}")]
        if abs(bias) <= self._limits.bias_good_px or abs(bias) < 3 * sigma:
            return []
        grave = abs(bias) > self._limits.bias_bad_px
        return [(grave, f"disparities are off by {bias:+.2f} ± {sigma:.2f} px, a yaw of an eye: calibrate again")]
