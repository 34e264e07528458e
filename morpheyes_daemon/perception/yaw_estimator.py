"""Estimates the yaw between the two cameras in flight, which leaves no trace in the rows of any image.

A yaw error adds nearly the same c to every disparity, so one static scene seen at two baselines, d1 = b1 f / Z + c
and d2 = b2 f / Z + c, gives c = (b2 d1 - b1 d2) / (b2 - b1) (paper-notes 14). In flight Z changes between the two
frames; the change is predicted from the vehicle's own motion, and the errors of that prediction (translation,
rotation, ratio of the baselines) are solved for along with the yaw. It needs a rig whose baseline changes.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Image, Mask, Pinhole
from morpheyes_daemon.perception.camera_motion import CameraMotion, right_camera_rates
from morpheyes_daemon.stereo.lucas_kanade import LucasKanade
from morpheyes_daemon.transforms import Array, inverse

MIN_BASELINE_CHANGE_M = 0.04
"""Change of baseline in metres from which two frames are compared; chosen: below it `leverage` is under
0.24 for every baseline from 100 mm on."""
MAX_AGE_S = 4.0
"""Oldest frame that a new one is compared with, seconds; chosen: longer ages let the odometry drift."""
_POINTS = 400
"""Points tracked per frame; chosen: more cost time and share the systematic error `_SYSTEMATIC_PX`."""
_SPACING_PX = 9
"""Least distance between two points, pixels; chosen: their windows overlap by less than half."""
_CORNER_QUALITY = 0.01
"""Least corner response as a share of the strongest one (cv2.goodFeaturesToTrack); chosen: OpenCV's usual value."""
_TRACKER = LucasKanade(window_px=15, levels=3)
"""From frame to frame; chosen: three levels reach about 7 px times 2^3 from the
prediction; more levels lose small texture."""
_STEREO_TRACKER = LucasKanade(window_px=15, levels=0)
"""From left to right; chosen: the disparity map is a start within a pixel, so no pyramid is needed."""
_ROW_LIMIT_PX = 1.0
"""Largest row offset between left and right, pixels; chosen: as `CheckLimits.rows_bad_px`."""
_DISPARITY_LIMIT_PX = 2.0
"""Largest change of the matcher's disparity by tracking, pixels; chosen: beyond it another point was found."""
_MIN_DISPARITY_PX = 0.5
"""Least disparity of a point, pixels; chosen: a smaller one has no usable depth."""
_MIN_DEPTH_M = 0.3
"""Least predicted depth of a point in the second frame, metres; chosen: nearer than any near limit."""
_FEWEST_POINTS = 40
"""Points that a fit of five unknowns needs; chosen: with fewer a single moving object can dominate."""
_STATIC_PX = 0.8
"""Largest residual of a static point, pixels; chosen: five times `_NOISE_PX`."""
_STATIC_SHARE = 0.75
"""Share of static points from which the scene counts as static; chosen: lower lets a moving object in."""
_NOISE_PX = 0.15
"""One sigma of a tracked disparity, pixels; chosen: smaller makes single fits overconfident."""
_TURN_RATE_SIGMA_RAD_S, _SPEED_SIGMA_M_S = 0.01, 0.05
"""One sigma of the reported turn rate (rad/s) and velocity (m/s); chosen: with a time offset between the cameras
they bias all disparities alike, so a larger value weights down frames taken while turning."""
_REMEMBERED = 20
"""Independent fits that are averaged; chosen: 20 epochs of MAX_AGE_S are 80 s of flight."""
_MIN_INFORMATION_GAIN = 1.1
"""Factor by which a pair of frames must promise more information than the best one so far; chosen: saves fits."""
_BASELINE_RATIO_SIGMA = 0.01
"""Relative sigma of the ratio of the baselines at which the information halves in variance; chosen: its effect on
disparities of 15 px then equals `_NOISE_PX`."""
_SYSTEMATIC_PX = 0.04
"""Error common to all points of a pair of frames, one sigma in pixels: light, blur and perspective; chosen: it
bounds what averaging over points can promise."""
_ROUNDS = 4
"""Rounds of the robust fit; chosen: more cost time."""
_OUTLIER_SIGMAS = 2.5
"""Residual beyond which a point is left out, in sigmas (1.4826 times the median absolute residual)."""


@dataclass(frozen=True, slots=True)
class MotionUncertainty:
    """One sigma of the predicted motion of the camera between two frames: translation and rotation.

    chosen: larger values leave more to the images, smaller ones to the autopilot.
    """

    translation_m: float = 0.10
    turn_rad: float = 0.01


STATIONARY = MotionUncertainty(translation_m=1e-3, turn_rad=1e-3)
"""Of a vehicle on the ground, which the servo moves by a millimetre at most (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class YawObservation:
    """One rectified grey pair (H, W) uint8 with its disparity (H, W) float32 pixels, NaN unknown.

    `baseline_m` is the true baseline with its sigma, `motion` that of the rectified left camera at its mid-exposure;
    `time_offset_s` is the mid-exposure of the right camera minus that of the left one, with its sigma.
    """

    t_ns: int
    left: Image
    right: Image
    disparity_px: FloatMap
    baseline_m: float
    baseline_sigma_m: float
    pinhole: Pinhole
    motion: CameraMotion
    time_offset_s: float = 0.0
    time_offset_sigma_s: float = 0.0


@dataclass(frozen=True, slots=True)
class YawFit:
    """Yaw of the right camera about the down axis (y of rect) relative to the calibration, with one sigma.

    `count` points are static, `share` of all; `residual_px` is the median absolute residual.
    """

    yaw_rad: float
    sigma_rad: float
    count: int
    share: float
    residual_px: float

    @property
    def static(self) -> bool:
        """Whether the scene is static: nearly all points agree with one motion of the camera."""
        return self.count >= _FEWEST_POINTS and self.share >= _STATIC_SHARE


class YawEstimator:
    """Weighted mean of the yaw over pairs of frames at different baselines.

    Each frame is compared with the recent one that promises most information (`expected_information`). Of all pairs
    within an epoch of `MAX_AGE_S` only the one with the smallest sigma counts, since they share their errors.
    `moving` counts the pairs rejected because the scene moved.
    """

    def __init__(self, uncertainty: MotionUncertainty | None = None) -> None:
        self._uncertainty = uncertainty or MotionUncertainty()
        self._observations: deque[YawObservation] = deque()
        self._done: list[YawFit] = []
        self._best: YawFit | None = None
        self._best_information = 0.0
        self._since_ns = 0
        self.moving = 0

    @property
    def yaw_rad(self) -> float:
        """Estimated yaw, rad; 0 before the first fit."""
        if not self._fits:
            return 0.0
        weights = [1.0 / fit.sigma_rad**2 for fit in self._fits]
        return float(np.average([fit.yaw_rad for fit in self._fits], weights=weights))

    @property
    def sigma_rad(self) -> float:
        """One sigma of the yaw, rad; inf before the first fit."""
        weight = sum(1.0 / fit.sigma_rad**2 for fit in self._fits)
        return 1.0 / math.sqrt(weight) if weight else math.inf

    @property
    def pairs(self) -> int:
        """Number of independent pairs of frames in the estimate."""
        return len(self._fits)

    def add(self, observation: YawObservation) -> YawFit | None:
        """Add a frame; return the fit with an earlier frame, None when there was none to compare with."""
        self._close_epoch(observation.t_ns)
        while self._observations and observation.t_ns - self._observations[0].t_ns > MAX_AGE_S * 1e9:
            self._observations.popleft()
        first = max(self._observations, key=lambda one: expected_information(one, observation), default=None)
        self._observations.append(observation)
        if first is None or abs(first.baseline_m - observation.baseline_m) < MIN_BASELINE_CHANGE_M:
            return None
        if expected_information(first, observation) < _MIN_INFORMATION_GAIN * self._best_information:
            return None
        fit = fit_yaw(first, observation, self._uncertainty)
        if fit is None:
            return None
        self._best_information = expected_information(first, observation)
        if not fit.static:
            self.moving += 1
        elif self._best is None or fit.sigma_rad < self._best.sigma_rad:
            self._best = fit
        return fit

    @property
    def _fits(self) -> list[YawFit]:
        return self._done if self._best is None else [*self._done, self._best]

    def _close_epoch(self, t_ns: int) -> None:
        """Store the best fit of an epoch that is over; the next epoch uses new frames only."""
        if not self._observations:
            self._since_ns = t_ns
        if t_ns - self._since_ns > MAX_AGE_S * 1e9:
            if self._best is not None:
                self._done = self._fits[-_REMEMBERED:]
                self._observations.clear()
            self._best, self._best_information, self._since_ns = None, 0.0, t_ns


def leverage(baseline_1_m: float, baseline_2_m: float) -> float:
    """Return the sensitivity of d2 - d1 b2 / b1 to a yaw over its noise (paper-notes 14): 0 at equal baselines."""
    ratio = baseline_2_m / baseline_1_m
    return abs(1.0 - ratio) / math.hypot(1.0, ratio)


def expected_information(first: YawObservation, second: YawObservation) -> float:
    """Return the leverage of two observations, reduced by the uncertainty of the ratio of their baselines."""
    return leverage(first.baseline_m, second.baseline_m) / math.hypot(
        1.0, ratio_sigma(first, second) / _BASELINE_RATIO_SIGMA
    )


def ratio_sigma(first: YawObservation, second: YawObservation) -> float:
    """Return the relative sigma of the ratio of the baselines of two observations."""
    return math.hypot(*(observation.baseline_sigma_m / observation.baseline_m for observation in (first, second)))


def fit_yaw(first: YawObservation, second: YawObservation, uncertainty: MotionUncertainty) -> YawFit | None:
    """Return the yaw from two frames at different baselines; None with fewer than 40 points found in both.

    Robust linear least squares on the disparities of the second frame (paper-notes 14).
    """
    uv_1 = textured_points(first.left, first.disparity_px)
    if len(uv_1) < _FEWEST_POINTS:
        return None
    d_1, seen_1 = _disparities(first, uv_1)
    x_1 = (uv_1 - [first.pinhole.cx_px, first.pinhole.cy_px]) / first.pinhole.f_px
    depth_1 = first.baseline_m * first.pinhole.f_px / np.maximum(d_1, _MIN_DISPARITY_PX)
    p_2 = _transformed(np.column_stack([x_1, np.ones(len(x_1))]) * depth_1[:, None], first, second)
    uv_2, seen_2 = _tracked(first, second, uv_1, p_2)
    d_2, seen_3 = _disparities(second, uv_2)
    good = seen_1 & seen_2 & seen_3 & (p_2[:, 2] > _MIN_DEPTH_M)
    good &= (d_1 > _MIN_DISPARITY_PX) & (d_2 > _MIN_DISPARITY_PX)
    if np.count_nonzero(good) < _FEWEST_POINTS:
        return None
    points = _Points(x_1[good], d_1[good], depth_1[good], d_2[good], p_2[good, 2])
    return _solve(first, second, points, uncertainty)


def textured_points(left: Image, disparity_px: FloatMap) -> Array:
    """Return up to 400 pixels (n, 2), spread over the grey image (H, W), with texture and a known disparity (H, W)."""
    mask = np.where(np.isfinite(disparity_px), 255, 0).astype(np.uint8)
    border = _TRACKER.window_px // 2 + 1
    mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
    found = cv2.goodFeaturesToTrack(left, _POINTS, _CORNER_QUALITY, _SPACING_PX, mask=mask)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


def _disparities(observation: YawObservation, uv: Array) -> tuple[Array, Mask]:
    """Return the disparity (n,) of left pixels (n, 2) by tracking into the right image, corrected for the time offset,
    and which were found."""
    column = np.clip(np.round(uv[:, 0]), 0, observation.left.shape[1] - 1).astype(np.intp)
    row = np.clip(np.round(uv[:, 1]), 0, observation.left.shape[0] - 1).astype(np.intp)
    start = observation.disparity_px[row, column].astype(np.float64)
    known = np.isfinite(start)
    guess = uv - np.column_stack([np.where(known, start, 0.0), np.zeros(len(uv))])
    found, tracked = _track(_STEREO_TRACKER, observation.left, observation.right, uv, guess)
    d = uv[:, 0] - found[:, 0]
    good = known & tracked & (np.abs(found[:, 1] - uv[:, 1]) < _ROW_LIMIT_PX)
    good &= np.abs(d - start) < _DISPARITY_LIMIT_PX
    pinhole, baseline_m = observation.pinhole, observation.baseline_m
    rates = right_camera_rates(uv, np.maximum(d, _MIN_DISPARITY_PX), pinhole, baseline_m, observation.motion)
    return d + observation.time_offset_s * rates[:, 0], good


def _transformed(p_1: Array, first: YawObservation, second: YawObservation) -> Array:
    """Return points (n, 3) of the first left camera in the axes of the second one, by the reported poses."""
    T_2_1 = inverse(second.motion.T_ned_rect) @ first.motion.T_ned_rect
    return np.asarray(p_1 @ T_2_1[:3, :3].T + T_2_1[:3, 3])


def _tracked(first: YawObservation, second: YawObservation, uv_1: Array, p_2: Array) -> tuple[Array, Mask]:
    """Return the pixels (n, 2) in the second left image and which were found; the points p_2 (n, 3) give the start."""
    pinhole = second.pinhole
    ahead = p_2[:, 2] > _MIN_DEPTH_M
    xy = p_2[:, :2] / np.where(ahead, p_2[:, 2], 1.0)[:, None]
    guess = xy * pinhole.f_px + [pinhole.cx_px, pinhole.cy_px]
    inside = ahead & np.all((guess > 0) & (guess < [pinhole.width - 1, pinhole.height - 1]), axis=1)
    found, tracked = _track(_TRACKER, first.left, second.left, uv_1, np.where(inside[:, None], guess, uv_1))
    return found, tracked & inside


def _track(tracker: LucasKanade, before: Image, after: Image, uv: Array, guess: Array) -> tuple[Array, Mask]:
    found, tracked = tracker.track(before, after, uv, guess)
    inside = np.all((found > 0) & (found < [after.shape[1] - 1, after.shape[0] - 1]), axis=1)
    return found, tracked & inside


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """n points seen in both frames: normalised coordinates (n, 2) in the first left camera, disparities (n,) and depths
    (n,) in both frames, the second depth predicted from the motion."""

    xy_1: Array
    d_1_px: Array
    depth_1_m: Array
    d_2_px: Array
    depth_2_m: Array


def _solve(first: YawObservation, second: YawObservation, points: _Points, uncertainty: MotionUncertainty) -> YawFit:
    """Return the least-squares fit of d_2; unknowns: yaw, relative error of the ratio of the baselines, error of the
    forward translation (m), errors of the rotation (rad)."""
    f = second.pinhole.f_px
    ratio = second.baseline_m / first.baseline_m
    predicted = second.baseline_m * f / points.depth_2_m
    slope = ratio * (points.depth_1_m / points.depth_2_m) ** 2
    x_right = points.xy_1[:, 0] - points.d_1_px / first.pinhole.f_px
    columns = np.column_stack(
        [
            f * (1.0 + x_right**2) * (1.0 - slope),
            predicted,
            -predicted / points.depth_2_m,
            -predicted * points.xy_1[:, 0],
            -predicted * points.xy_1[:, 1],
        ]
    )
    turn = uncertainty.turn_rad
    prior = np.array([math.inf, ratio_sigma(first, second), uncertainty.translation_m, turn, turn])
    noise = _NOISE_PX * np.sqrt(1.0 + slope**2)
    error = points.d_2_px - predicted
    solution, covariance, kept = _robust(columns / noise[:, None], error / noise, 1.0 / prior)
    residual_px = error - columns @ solution
    static = np.abs(residual_px) < _STATIC_PX * np.sqrt(1.0 + slope**2)
    spread = float(np.sqrt(np.mean((residual_px[kept] / noise[kept]) ** 2))) if kept.any() else math.inf
    by_time = math.hypot(ratio * _time_px(first, points.depth_1_m), _time_px(second, points.depth_2_m))
    by_time = by_time / math.hypot(1.0, ratio)
    systematic = math.hypot(_SYSTEMATIC_PX, by_time) / leverage(first.baseline_m, second.baseline_m) / f
    sigma = math.hypot(math.sqrt(covariance[0, 0]) * max(1.0, spread), systematic)
    residual = float(np.median(np.abs(residual_px)))
    return YawFit(float(solution[0]), sigma, int(np.count_nonzero(static)), float(static.mean()), residual)


def _time_px(observation: YawObservation, depth_m: Array) -> float:
    """Return one sigma, pixels, of the bias of all disparities by the time offset between the cameras."""
    if not np.any(observation.motion.w_rect_rad_s) and not np.any(observation.motion.v_rect_m_s):
        return 0.0
    near_m = float(np.median(depth_m))
    rate = abs(float(observation.motion.w_rect_rad_s[1])) + abs(float(observation.motion.v_rect_m_s[0])) / near_m
    rate_sigma = math.hypot(_TURN_RATE_SIGMA_RAD_S, _SPEED_SIGMA_M_S / near_m)
    return observation.pinhole.f_px * math.hypot(
        observation.time_offset_sigma_s * rate, observation.time_offset_s * rate_sigma
    )


def _robust(columns: Array, values: Array, prior: Array) -> tuple[Array, Array, Mask]:
    """Return solution (k,), covariance (k, k) and inliers (n,) of a least-squares fit with outlier rejection.

    `columns` (n, k) and `values` (n,) are in units of sigma; `prior` (k,) is one over the prior sigma of each unknown.
    """
    kept = np.ones(len(values), dtype=np.bool_)
    solution: Array = np.zeros(columns.shape[1])
    covariance: Array = np.eye(columns.shape[1])
    for _ in range(_ROUNDS):
        normal = columns[kept].T @ columns[kept] + np.diag(prior**2)
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        solution = np.asarray(covariance @ (columns[kept].T @ values[kept]), np.float64)
        residual = np.abs(values - columns @ solution)
        kept = residual <= max(1.0, _OUTLIER_SIGMAS * 1.4826 * float(np.median(residual)))
    return solution, covariance, kept
