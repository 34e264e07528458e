"""Watching the calibration in flight: has an eye turned, and by how much; corrected when the evidence is strong.

Pitch and roll between the eyes show in the rows of every textured frame (stereo.epipolar), the time between the eyes
in how rows follow the motion, the yaw only where the same static scene is seen at two baselines (`yaw_watch`). Each
is acted upon only when it is many sigmas clear of zero and confirmed over several frames; scenes without texture,
frames with the servo moving and scenes that move themselves count for nothing. The rig that was loaded is never
changed: `rig` is a turned copy, and every correction is told as a finding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from morpheyes_daemon.messages.core import KNOWN_SHARE, BaselineEstimate, DepthMap
from morpheyes_daemon.perception.camera_motion import CameraMotion, row_rates
from morpheyes_daemon.perception.yaw_estimator import Look, Uncertain, YawEstimator
from morpheyes_daemon.stereo.depth import RectifiedPair, disparity_of
from morpheyes_daemon.stereo.epipolar import SHARP_S, RowFit, RowOffsets, RowWatch, levelled
from morpheyes_daemon.stereo.rectify import rectifying_rotation
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel
from morpheyes_daemon.transforms import Array, R_from_rotvec, pose

_LATE_MODEL = 0.05
"""Share by which the measured time offset may be wrong for want of an exact motion."""
_MEMORY = 0.95
"""How much of the rows' evidence is left one frame later: twenty frames count."""


@dataclass(frozen=True, slots=True)
class ExtrinsicsLimits:
    """What counts as drift, and what evidence it takes."""

    rows_px: float = 0.4
    """Row error that a turn must cause before it is corrected."""
    yaw_px: float = 0.25
    """Disparity bias that a yaw must cause before it is corrected."""
    yaw_sigma_px: float = 0.15
    """One sigma of the disparity bias from which half of `strong_sigmas` will do."""
    strong_sigmas: float = 6.0
    frames: int = 3
    """Frames in a row that must agree ..."""
    unsharp_frames: int = 10
    """... and so many before a correction while the lateness is not measured: a manoeuvre then looks like a turn."""
    points: int = 80
    """Points that a frame must have to count at all."""
    small_rad: float = math.radians(0.2)
    """A turn up to this is watched and corrected before it is held against the frame."""
    largest_rad: float = math.radians(0.25)
    """A turn beyond this, all in all, is no drift: something broke, or it is the calibration of another rig."""
    late_s: float = 2e-3
    """Time offset between the eyes that was declared."""
    late_change_s: float = 1e-3
    """How far the measured offset may be from it."""
    late_largest_s: float = 4e-3
    """An offset farther than this from the declared one makes depth worth nothing; it is measured to half a
    millisecond."""
    yaw_pairs: int = 2
    """Pairs of frames, each of other seconds, that must agree before a yaw is called too large to be a drift."""
    steady_s: float = 0.5
    """Frames farther apart say nothing of the yaw: too much happens in between."""
    watch_yaw: bool = True
    """A yaw is told from how disparities change with the baseline and on the way: not where much of the scene moves."""


class ExtrinsicsFault(StrEnum):
    """What a finding is about."""

    ROWS = "rows"
    UNEXPLAINED = "unexplained"
    TURNED = "turned"
    YAW = "yaw"
    LATE = "late"
    DOUBTED = "doubted"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class ExtrinsicsFinding:
    """One thing noticed; `corrected` when the rig was turned for it."""

    what: ExtrinsicsFault
    corrected: bool
    text: str


@dataclass(frozen=True, slots=True)
class ExtrinsicsReport:
    """What one frame added. Angles are of the right eye, from where `rig` has it; sigmas inf when unknown.

    `rows_px` is the median row difference of this frame (NaN without points), `late_s` by how much the right eye
    exposes after the left one.
    """

    rows_px: float
    points: int
    pitch_rad: float
    pitch_sigma_rad: float
    roll_rad: float
    roll_sigma_rad: float
    yaw_rad: float
    yaw_sigma_rad: float
    late_s: float
    late_sigma_s: float
    findings: tuple[ExtrinsicsFinding, ...]

    @property
    def rig_changed(self) -> bool:
        """The monitor's rig was turned: rectify by it from now on."""
        return any(finding.corrected for finding in self.findings)


class ExtrinsicsMonitor:
    """Fed with every depth map; `rig` is the calibration as corrected so far, to rectify the next frame by."""

    def __init__(
        self, rig: RigModel, limits: ExtrinsicsLimits | None = None, uncertain: Uncertain | None = None
    ) -> None:
        self.rig = rig
        self.limits = limits or ExtrinsicsLimits()
        self._uncertain = uncertain
        self._turned: Array = np.eye(3)
        self._told: set[ExtrinsicsFault] = set()
        self._fit: RowFit | None = None
        self._agreeing = self._late_frames = 0
        self._last_ns = 0
        self.broken = False
        """An eye has turned farther than any drift: depth is worth nothing until a new calibration."""
        self._rows, self._yaw = RowWatch(_MEMORY, self.limits.late_s), YawEstimator(uncertain)

    def update(
        self, pair: RectifiedPair, depth: DepthMap, offsets: RowOffsets, moving: bool, motion: CameraMotion
    ) -> ExtrinsicsReport:
        """Look at one pair rectified by `rig`, its depth map and row offsets, and the eye's motion.

        Nothing is corrected while the servo moves, and a frame whose baseline is hardly known does not count.
        """
        if offsets.count < self.limits.points or not self.knows(depth):
            self._agreeing = 0
            return self._report(offsets.median_px, offsets.count, self._fit, ())
        f_px, nominal_m = depth.pinhole.f_px, pair.rectification.nominal_m
        rates = row_rates(offsets.uv, offsets.d_px, depth.pinhole, depth.baseline_m, motion)
        self._fit = self._rows.add(offsets, depth.pinhole, *rates)
        self._late_frames = self._late_frames + 1 if self._is_late(self._fit) else 0
        findings = [] if moving else self._judge_rows(offsets.median_px, f_px, nominal_m)
        steady = depth.t_ns - self._last_ns <= self.limits.steady_s * 1e9
        self._last_ns = depth.t_ns
        if self.limits.watch_yaw and steady and not findings and offsets.median_px < 2 * self.limits.rows_px:
            seen = (disparity_of(depth), depth.baseline_m, depth.baseline_sigma_m, depth.pinhole, motion)
            self._yaw.add(Look(depth.t_ns, pair.left, pair.right, *seen, *self._late))
            findings += self._judge_yaw(f_px, nominal_m)
        findings += self._judge_late()
        report = self._report(offsets.median_px, offsets.count, self._fit, tuple(findings))
        if report.rig_changed:
            self._forget()
        return report

    @property
    def late(self) -> bool:
        """The eyes expose so far from when they should that depth is worth nothing, frame after frame."""
        return self._late_frames >= self.limits.frames

    def knows(self, depth: DepthMap) -> bool:
        """Return whether the baseline of a frame is known well enough for its rows to mean anything."""
        return depth.baseline_sigma_m < KNOWN_SHARE * depth.baseline_m

    def doubt_rad(self, baseline: BaselineEstimate) -> float:
        """Return by what angle rows may be apart since the baseline may be two sigmas off."""
        off_m = 2.0 * baseline.sigma_m
        places = np.clip([baseline.baseline_m - off_m, baseline.baseline_m + off_m], *self.rig.range_m)
        return max(rows_apart_rad(self.rig, baseline.baseline_m, float(place_m)) for place_m in places)

    def unexplained(self, offsets: RowOffsets, depth: DepthMap) -> RowOffsets:
        """Return row offsets less those of a small turn that is being watched."""
        fit = self._fit
        if fit is None or max(abs(fit.pitch_rad), abs(fit.roll_rad)) > self.limits.small_rad:
            return offsets
        return levelled(offsets, depth.pinhole, fit)

    @property
    def _late(self) -> tuple[float, float]:
        """The time offset and its sigma: as measured when that is sharp, as declared otherwise."""
        fit, limits = self._fit, self.limits
        if fit is None or fit.late_sigma_s > 0.25 * limits.late_change_s:
            return limits.late_s, limits.late_change_s
        return fit.late_s, math.hypot(fit.late_sigma_s, _LATE_MODEL * fit.late_s)

    def _forget(self) -> None:
        """Start collecting anew, since what was collected belongs to another rectification."""
        self._rows.forget_turn()
        self._yaw = YawEstimator(self._uncertain)
        self._fit = None
        self._agreeing = 0

    def _judge_rows(self, median_px: float, f_px: float, nominal_m: float) -> list[ExtrinsicsFinding]:
        fit, limits = self._fit, self.limits
        assert fit is not None
        turn_px = f_px * np.abs([fit.pitch_rad, 0.4 * fit.roll_rad])
        sure = np.abs([fit.pitch_rad, fit.roll_rad]) > limits.strong_sigmas * np.array(
            [fit.pitch_sigma_rad, fit.roll_sigma_rad]
        )
        if not np.any((turn_px > limits.rows_px) & sure):
            self._agreeing = 0
            return self._unexplained(fit, median_px)
        self._agreeing += 1
        if self._agreeing < (limits.frames if self._rows.sharp else limits.unsharp_frames):
            return self._once(
                ExtrinsicsFault.ROWS, f"rows differ by {median_px:.2f} px: watching whether an eye has turned"
            )
        turn = np.array([fit.pitch_rad if sure[0] else 0.0, 0.0, fit.roll_rad if sure[1] else 0.0])
        text = f"the right eye has turned by {math.degrees(turn[0]):+.3f} deg in pitch and "
        return self._turn(ExtrinsicsFault.TURNED, turn, nominal_m, f"{text}{math.degrees(turn[2]):+.3f} deg in roll")

    def _unexplained(self, fit: RowFit, median_px: float) -> list[ExtrinsicsFinding]:
        """Rows that differ though no turn and no time offset explains it."""
        if fit.residual_px < 2 * self.limits.rows_px or fit.count < 5 * self.limits.points:
            return []
        return self._once(
            ExtrinsicsFault.UNEXPLAINED, f"rows differ by {median_px:.2f} px and no turn of an eye explains it"
        )

    def _judge_yaw(self, f_px: float, nominal_m: float) -> list[ExtrinsicsFinding]:
        yaw, sigma, limits = self._yaw.yaw_rad, self._yaw.sigma_rad, self.limits
        sharp = sigma * f_px <= limits.yaw_sigma_px
        needed = limits.strong_sigmas * (0.5 if sharp else 1.0)
        if not abs(yaw) * f_px >= limits.yaw_px or abs(yaw) < needed * sigma:
            return []
        text = f"the right eye has turned by {math.degrees(yaw):+.3f} deg in yaw ({yaw * f_px:+.2f} px of disparity)"
        return self._turn(ExtrinsicsFault.YAW, np.array([0.0, yaw, 0.0]), nominal_m, text)

    def _late_off_s(self, fit: RowFit) -> float:
        return abs(abs(fit.late_s) - self.limits.late_s)

    def _is_late(self, fit: RowFit) -> bool:
        least_s = max(self.limits.late_largest_s, self.limits.strong_sigmas * fit.late_sigma_s)
        return self._late_off_s(fit) > least_s

    def _judge_late(self) -> list[ExtrinsicsFinding]:
        fit, limits = self._fit, self.limits
        if fit is None or fit.late_sigma_s > SHARP_S or self._agreeing:
            return []
        off_s = self._late_off_s(fit)
        if off_s < limits.late_change_s + 3.0 * fit.late_sigma_s:
            return []
        text = f"the right eye exposes {fit.late_s * 1e3:.1f} ms late, not {limits.late_s * 1e3:.1f} ms as declared"
        return self._once(ExtrinsicsFault.LATE, text)

    def _turn(self, what: ExtrinsicsFault, turn_rect_rad: Array, nominal_m: float, text: str) -> list[ExtrinsicsFinding]:
        """Turn the rig's right eye, unless it has turned so far in all that it must be broken."""
        turned = turned_rig(self.rig, turn_rect_rad, nominal_m)
        total = turn_between(self.rig, nominal_m, R_from_rotvec(turn_rect_rad)) @ self._turned
        angle = math.acos(max(-1.0, min(1.0, (float(np.trace(total)) - 1.0) / 2.0)))
        if angle > self.limits.largest_rad:
            if what is ExtrinsicsFault.YAW and self._yaw.pairs < self.limits.yaw_pairs:
                return self._once(ExtrinsicsFault.DOUBTED, f"{text}: more than a drift, if it is confirmed")
            self._agreeing, self.broken = 0, True
            return self._once(ExtrinsicsFault.BROKEN, f"{text}: too far for a drift; land and calibrate again")
        self.rig, self._turned = turned, total
        return [ExtrinsicsFinding(what, True, f"{text}; corrected")]

    def _once(self, what: ExtrinsicsFault, text: str) -> list[ExtrinsicsFinding]:
        if what in self._told:
            return []
        self._told.add(what)
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
            late_s=known.late_s,
            late_sigma_s=known.late_sigma_s,
            findings=findings,
        )


def turned_rig(rig: RigModel, turn_rect_rad: Array, nominal_m: float) -> RigModel:
    """Return the rig with its right eye turned by a rotation vector (3,) in the rectified axes at a baseline."""
    turn = turn_between(rig, nominal_m, R_from_rotvec(turn_rect_rad))
    return replace(rig, baselines=tuple(_turned(baseline, rig, turn) for baseline in rig.baselines))


def rows_apart_rad(rig: RigModel, nominal_m: float, true_m: float) -> float:
    """Return by what angle rows are apart, at most, when a rig at one baseline is rectified as if at another.

    Pitch counts in full; roll, and the slope of the line between the eyes, up to the edge of the view and to the
    disparity of near things, 0.4 focal lengths both.
    """
    T, T_true = rig.T_cam0_cam1(nominal_m), rig.T_cam0_cam1(true_m)
    R_rect_cam0 = rectifying_rotation(T[:3, 3])
    turn = R_rect_cam0 @ T_true[:3, :3] @ T[:3, :3].T @ R_rect_cam0.T
    slope = float((R_rect_cam0 @ T_true[:3, 3])[1]) / float(np.linalg.norm(T_true[:3, 3]))
    pitch, roll = (turn[2, 1] - turn[1, 2]) / 2.0, (turn[1, 0] - turn[0, 1]) / 2.0
    return abs(float(pitch)) + 0.4 * abs(float(roll)) + 0.4 * abs(slope)


def turn_between(rig: RigModel, nominal_m: float, R_turn_rect: Array) -> Array:
    """Return a turn given in rectified axes at a baseline in those of cam0."""
    R_rect_cam0 = rectifying_rotation(rig.T_cam0_cam1(nominal_m)[:3, 3])
    return np.asarray(R_rect_cam0.T @ R_turn_rect @ R_rect_cam0)


def _turned(baseline: CalibratedBaseline, rig: RigModel, turn: Array) -> CalibratedBaseline:
    T = rig.T_cam0_cam1(baseline.nominal_m)
    made = CalibratedBaseline.from_pose(baseline.nominal_m, pose(turn @ T[:3, :3], T[:3, 3]))
    return replace(baseline, q_cam0_cam1=made.q_cam0_cam1)
