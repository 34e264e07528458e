"""Extrinsics monitor: estimates in flight how far the right camera has rotated, and corrects the rig.

Pitch and roll between the cameras appear in the rows of every textured frame, the time offset between the exposures
in row rates that follow the motion (both `stereo.epipolar`), the yaw only where one static scene is seen at two
baselines (`yaw_estimator`). Each is acted upon only when it is many sigmas from zero and confirmed over several
frames; frames without texture, with a moving servo, or of a moving scene do not count. The loaded rig is never
changed: `rig` is a corrected copy, and every correction is reported as a finding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from morpheyes_daemon.messages.core import KNOWN_SHARE, BaselineEstimate, DepthMap
from morpheyes_daemon.perception.camera_motion import CameraMotion, row_rates
from morpheyes_daemon.perception.yaw_estimator import MotionUncertainty, YawEstimator, YawObservation
from morpheyes_daemon.stereo.depth import RectifiedPair, disparity_of
from morpheyes_daemon.stereo.epipolar import (
    TIME_OFFSET_SIGMA_S,
    RowFit,
    RowOffsetEstimator,
    RowOffsets,
    without_rotation,
)
from morpheyes_daemon.stereo.rectify import rectifying_rotation
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel
from morpheyes_daemon.transforms import Array, R_from_rotvec, pose

_TIME_OFFSET_MODEL_ERROR = 0.05
"""Relative error of the measured time offset by the error of the reported velocity, one sigma; chosen: 0.1 m/s of
the simulated autopilot at 2 m/s."""
_MEMORY = 0.95
"""Weight of the evidence of the rows one frame later; chosen: 1 / (1 - 0.95) = 20 frames count, more react later."""
_UNCERTAINTY_SIGMAS = 2.0
"""Sigmas of the baseline within which its rows are predicted; chosen: 95 % of a Gaussian."""
_EDGE = 0.4
"""Normalised image coordinate at the edge of the view (47 degrees wide: tan 23.5 deg = 0.43), and disparity of near
objects over f; chosen: it turns a roll, or a slope of the baseline, into a row offset."""


@dataclass(frozen=True, slots=True)
class ExtrinsicsLimits:
    """Limits of drift and the evidence required; chosen: smaller ones correct sooner and more often wrongly."""

    rows_px: float = 0.4
    """Row offset that a rotation must cause before it is corrected."""
    yaw_px: float = 0.25
    """Disparity bias that a yaw must cause before it is corrected."""
    yaw_sigma_px: float = 0.15
    """One sigma of the disparity bias below which half of `strong_sigmas` suffices."""
    strong_sigmas: float = 6.0
    """Distance from zero in sigmas at which evidence is strong."""
    frames: int = 3
    """Consecutive frames that must agree."""
    unsharp_frames: int = 10
    """The same while the time offset is not measured: a manoeuvre then looks like a rotation."""
    points: int = 80
    """Least number of points of a frame that counts."""
    small_rad: float = math.radians(0.2)
    """Rotation up to which the row offsets are compensated before the image checks see them."""
    largest_rad: float = math.radians(0.25)
    """Total rotation beyond which the rig counts as broken or the calibration as that of another rig."""
    time_offset_s: float = 2e-3
    """Declared time offset between the exposures (camera.sync_error_ms of the configuration)."""
    time_offset_change_s: float = 1e-3
    """Largest difference of the measured from the declared time offset that is not reported."""
    time_offset_largest_s: float = 4e-3
    """Difference from the declared time offset beyond which depth must not be used; it is measured to 0.5 ms."""
    yaw_pairs: int = 2
    """Independent pairs of frames that must agree before a large yaw marks the rig as broken."""
    steady_s: float = 0.5
    """Longest time between successive frames for the yaw to be estimated."""
    watch_yaw: bool = True
    """Whether the yaw is estimated; False where much of the scene moves."""


class ExtrinsicsFault(StrEnum):
    """Subject of a finding."""

    ROWS = "rows"
    UNEXPLAINED = "unexplained"
    TURNED = "turned"
    YAW = "yaw"
    TIME_OFFSET = "time_offset"
    UNCONFIRMED = "unconfirmed"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class ExtrinsicsFinding:
    """One finding; `corrected` when the rig was corrected by it, `text` for the log."""

    what: ExtrinsicsFault
    corrected: bool
    text: str


@dataclass(frozen=True, slots=True)
class ExtrinsicsReport:
    """Estimates after one frame. Angles (rad) are those of the right camera relative to `rig`; sigmas inf when unknown.

    `rows_px` is the median row offset of this frame (NaN without points), `time_offset_s` the mid-exposure of the
    right camera minus that of the left one.
    """

    rows_px: float
    points: int
    pitch_rad: float
    pitch_sigma_rad: float
    roll_rad: float
    roll_sigma_rad: float
    yaw_rad: float
    yaw_sigma_rad: float
    time_offset_s: float
    time_offset_sigma_s: float
    findings: tuple[ExtrinsicsFinding, ...]

    @property
    def rig_changed(self) -> bool:
        """Whether the monitor's rig was corrected: the next frame must be rectified by it."""
        return any(finding.corrected for finding in self.findings)


class ExtrinsicsMonitor:
    """Estimates rotations of the right camera from every frame; `rig` is the corrected calibration."""

    def __init__(
        self, rig: RigModel, limits: ExtrinsicsLimits | None = None, uncertainty: MotionUncertainty | None = None
    ) -> None:
        self.rig = rig
        self.limits = limits or ExtrinsicsLimits()
        self._motion_uncertainty = uncertainty
        self._turned: Array = np.eye(3)
        self._reported: set[ExtrinsicsFault] = set()
        self._fit: RowFit | None = None
        self._agreeing = self._out_of_sync_frames = 0
        self._last_ns = 0
        self.broken = False
        """The right camera has rotated farther than any drift: depth must not be used until a new calibration."""
        self._rows, self._yaw = RowOffsetEstimator(_MEMORY, self.limits.time_offset_s), YawEstimator(uncertainty)

    def update(
        self, pair: RectifiedPair, depth: DepthMap, offsets: RowOffsets, moving: bool, motion: CameraMotion
    ) -> ExtrinsicsReport:
        """Add one frame: the pair rectified by `rig`, its depth map and row offsets, and the motion of the left camera.

        Nothing is corrected while the servo moves (`moving`); a frame whose baseline is not known does not count.
        """
        if offsets.count < self.limits.points or not self.baseline_known(depth):
            self._agreeing = 0
            return self._report(offsets.median_px, offsets.count, self._fit, ())
        f_px, nominal_m = depth.pinhole.f_px, pair.rectification.nominal_m
        rates = row_rates(offsets.uv, offsets.d_px, depth.pinhole, depth.baseline_m, motion)
        self._fit = self._rows.add(offsets, depth.pinhole, *rates)
        self._out_of_sync_frames = self._out_of_sync_frames + 1 if self._time_offset_is_excessive(self._fit) else 0
        findings = [] if moving else self._check_rows(offsets.median_px, f_px, nominal_m)
        steady = depth.t_ns - self._last_ns <= self.limits.steady_s * 1e9
        self._last_ns = depth.t_ns
        if self.limits.watch_yaw and steady and not findings and offsets.median_px < 2 * self.limits.rows_px:
            seen = (disparity_of(depth), depth.baseline_m, depth.baseline_sigma_m, depth.pinhole, motion)
            self._yaw.add(YawObservation(depth.t_ns, pair.left, pair.right, *seen, *self._time_offset))
            findings += self._check_yaw(f_px, nominal_m)
        findings += self._check_time_offset()
        report = self._report(offsets.median_px, offsets.count, self._fit, tuple(findings))
        if report.rig_changed:
            self._reset()
        return report

    @property
    def out_of_sync(self) -> bool:
        """Whether the time offset is confirmed as so far from the declared one that depth must not be used."""
        return self._out_of_sync_frames >= self.limits.frames

    def baseline_known(self, depth: DepthMap) -> bool:
        """Return whether the sigma of the baseline is below KNOWN_SHARE of it, so that rows can be interpreted."""
        return depth.baseline_sigma_m < KNOWN_SHARE * depth.baseline_m

    def row_uncertainty_rad(self, baseline: BaselineEstimate) -> float:
        """Return the largest row offset, rad, that an error of the baseline of two sigmas causes."""
        off_m = _UNCERTAINTY_SIGMAS * baseline.sigma_m
        places = np.clip([baseline.baseline_m - off_m, baseline.baseline_m + off_m], *self.rig.range_m)
        return max(row_mismatch_rad(self.rig, baseline.baseline_m, float(place_m)) for place_m in places)

    def compensated(self, offsets: RowOffsets, depth: DepthMap) -> RowOffsets:
        """Return row offsets minus those of the estimated rotation, as long as it is small."""
        fit = self._fit
        if fit is None or max(abs(fit.pitch_rad), abs(fit.roll_rad)) > self.limits.small_rad:
            return offsets
        return without_rotation(offsets, depth.pinhole, fit)

    @property
    def _time_offset(self) -> tuple[float, float]:
        """Time offset and its sigma, s: the measured one when it is known well, else the declared one."""
        fit, limits = self._fit, self.limits
        if fit is None or fit.time_offset_sigma_s > 0.25 * limits.time_offset_change_s:
            return limits.time_offset_s, limits.time_offset_change_s
        return fit.time_offset_s, math.hypot(fit.time_offset_sigma_s, _TIME_OFFSET_MODEL_ERROR * fit.time_offset_s)

    def _reset(self) -> None:
        """Discard the evidence, which belongs to the previous rectification."""
        self._rows.reset_rotation()
        self._yaw = YawEstimator(self._motion_uncertainty)
        self._fit = None
        self._agreeing = 0

    def _check_rows(self, median_px: float, f_px: float, nominal_m: float) -> list[ExtrinsicsFinding]:
        fit, limits = self._fit, self.limits
        assert fit is not None
        rows_px = f_px * np.abs([fit.pitch_rad, _EDGE * fit.roll_rad])
        strong = np.abs([fit.pitch_rad, fit.roll_rad]) > limits.strong_sigmas * np.array(
            [fit.pitch_sigma_rad, fit.roll_sigma_rad]
        )
        if not np.any((rows_px > limits.rows_px) & strong):
            self._agreeing = 0
            return self._check_residual(fit, median_px)
        self._agreeing += 1
        if self._agreeing < (limits.frames if self._rows.time_offset_known else limits.unsharp_frames):
            return self._report_once(
                ExtrinsicsFault.ROWS, f"rows differ by {median_px:.2f} px: observing whether a camera has rotated"
            )
        turn = np.array([fit.pitch_rad if strong[0] else 0.0, 0.0, fit.roll_rad if strong[1] else 0.0])
        text = f"the right camera has rotated by {math.degrees(turn[0]):+.3f} deg in pitch and "
        return self._turn(ExtrinsicsFault.TURNED, turn, nominal_m, f"{text}{math.degrees(turn[2]):+.3f} deg in roll")

    def _check_residual(self, fit: RowFit, median_px: float) -> list[ExtrinsicsFinding]:
        """Report row offsets that neither a rotation nor a time offset explains."""
        if fit.residual_px < 2 * self.limits.rows_px or fit.count < 5 * self.limits.points:
            return []
        return self._report_once(
            ExtrinsicsFault.UNEXPLAINED, f"rows differ by {median_px:.2f} px, which no rotation of a camera explains"
        )

    def _check_yaw(self, f_px: float, nominal_m: float) -> list[ExtrinsicsFinding]:
        yaw, sigma, limits = self._yaw.yaw_rad, self._yaw.sigma_rad, self.limits
        sharp = sigma * f_px <= limits.yaw_sigma_px
        needed = limits.strong_sigmas * (0.5 if sharp else 1.0)
        if not abs(yaw) * f_px >= limits.yaw_px or abs(yaw) < needed * sigma:
            return []
        text = f"the right camera has rotated by {math.degrees(yaw):+.3f} deg in yaw ({yaw * f_px:+.2f} px of disparity)"
        return self._turn(ExtrinsicsFault.YAW, np.array([0.0, yaw, 0.0]), nominal_m, text)

    def _time_offset_error_s(self, fit: RowFit) -> float:
        return abs(abs(fit.time_offset_s) - self.limits.time_offset_s)

    def _time_offset_is_excessive(self, fit: RowFit) -> bool:
        least_s = max(self.limits.time_offset_largest_s, self.limits.strong_sigmas * fit.time_offset_sigma_s)
        return self._time_offset_error_s(fit) > least_s

    def _check_time_offset(self) -> list[ExtrinsicsFinding]:
        fit, limits = self._fit, self.limits
        if fit is None or fit.time_offset_sigma_s > TIME_OFFSET_SIGMA_S or self._agreeing:
            return []
        off_s = self._time_offset_error_s(fit)
        if off_s < limits.time_offset_change_s + 3.0 * fit.time_offset_sigma_s:
            return []
        text = (
            f"the right camera exposes {fit.time_offset_s * 1e3:.1f} ms after the left one, "
            f"not {limits.time_offset_s * 1e3:.1f} ms as declared"
        )
        return self._report_once(ExtrinsicsFault.TIME_OFFSET, text)

    def _turn(self, what: ExtrinsicsFault, turn_rect_rad: Array, nominal_m: float, text: str) -> list[ExtrinsicsFinding]:
        """Correct the rig by a rotation (3,), unless the total rotation exceeds any drift."""
        turned = turned_rig(self.rig, turn_rect_rad, nominal_m)
        total = rotation_in_cam0(self.rig, nominal_m, R_from_rotvec(turn_rect_rad)) @ self._turned
        angle = math.acos(max(-1.0, min(1.0, (float(np.trace(total)) - 1.0) / 2.0)))
        if angle > self.limits.largest_rad:
            if what is ExtrinsicsFault.YAW and self._yaw.pairs < self.limits.yaw_pairs:
                return self._report_once(ExtrinsicsFault.UNCONFIRMED, f"{text}: more than a drift, not yet confirmed")
            self._agreeing, self.broken = 0, True
            return self._report_once(ExtrinsicsFault.BROKEN, f"{text}: too far for a drift; land and calibrate again")
        self.rig, self._turned = turned, total
        return [ExtrinsicsFinding(what, True, f"{text}; corrected")]

    def _report_once(self, what: ExtrinsicsFault, text: str) -> list[ExtrinsicsFinding]:
        if what in self._reported:
            return []
        self._reported.add(what)
        return [ExtrinsicsFinding(what, False, text)]

    def _report(
        self, rows_px: float, points: int, fit: RowFit | None, findings: tuple[ExtrinsicsFinding, ...]
    ) -> ExtrinsicsReport:
        known = fit or RowFit(0.0, math.inf, 0.0, math.inf, 0.0, math.inf, math.nan, 0)
        return ExtrinsicsReport(
            rows_px=rows_px,
            points=points,
            pitch_rad=known.pitch_rad,
            pitch_sigma_rad=known.pitch_sigma_rad,
            roll_rad=known.roll_rad,
            roll_sigma_rad=known.roll_sigma_rad,
            yaw_rad=self._yaw.yaw_rad,
            yaw_sigma_rad=self._yaw.sigma_rad,
            time_offset_s=known.time_offset_s,
            time_offset_sigma_s=known.time_offset_sigma_s,
            findings=findings,
        )


def turned_rig(rig: RigModel, turn_rect_rad: Array, nominal_m: float) -> RigModel:
    """Return the rig with its right camera rotated by a rotation vector (3,), rad, in rect axes at a nominal baseline.

    Raises CalibrationError outside the calibrated range.
    """
    turn = rotation_in_cam0(rig, nominal_m, R_from_rotvec(turn_rect_rad))
    return replace(rig, baselines=tuple(_turned(baseline, rig, turn) for baseline in rig.baselines))


def row_mismatch_rad(rig: RigModel, nominal_m: float, true_m: float) -> float:
    """Return the largest row offset, rad, of a rig at the baseline `true_m` that is rectified as if at `nominal_m`.

    Sum of pitch, and of roll and the slope of the baseline at the edge of the view. Raises CalibrationError outside
    the calibrated range.
    """
    T, T_true = rig.T_cam0_cam1(nominal_m), rig.T_cam0_cam1(true_m)
    R_rect_cam0 = rectifying_rotation(T[:3, 3])
    turn = R_rect_cam0 @ T_true[:3, :3] @ T[:3, :3].T @ R_rect_cam0.T
    slope = float((R_rect_cam0 @ T_true[:3, 3])[1]) / float(np.linalg.norm(T_true[:3, 3]))
    pitch, roll = (turn[2, 1] - turn[1, 2]) / 2.0, (turn[1, 0] - turn[0, 1]) / 2.0
    return abs(float(pitch)) + _EDGE * abs(float(roll)) + _EDGE * abs(slope)


def rotation_in_cam0(rig: RigModel, nominal_m: float, R_turn_rect: Array) -> Array:
    """Return a rotation (3, 3) given in rect axes at a nominal baseline, in cam0 axes."""
    R_rect_cam0 = rectifying_rotation(rig.T_cam0_cam1(nominal_m)[:3, 3])
    return np.asarray(R_rect_cam0.T @ R_turn_rect @ R_rect_cam0)


def _turned(baseline: CalibratedBaseline, rig: RigModel, turn: Array) -> CalibratedBaseline:
    T = rig.T_cam0_cam1(baseline.nominal_m)
    made = CalibratedBaseline.from_pose(baseline.nominal_m, pose(turn @ T[:3, :3], T[:3, 3]))
    return replace(baseline, q_cam0_cam1=made.q_cam0_cam1)
