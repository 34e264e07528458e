"""The yaw between the eyes, from one static scene seen at two baselines: what no row of any image shows.

A yaw error adds nearly the same c to every disparity, so d1 = b1 f / Z + c and d2 = b2 f / Z + c give
c = (b2 d1 - b1 d2) / (b2 - b1) (paper-notes 14). In flight Z changes between the two frames; the change is predicted
from the vehicle's own motion, and what that prediction leaves open (translation, turn, ratio of the baselines) is
solved for along with the yaw. Only a rig whose baseline moves can do this.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.perception.camera_motion import CameraMotion, right_eye_rates
from morpheyes_daemon.stereo.lucas_kanade import follow
from morpheyes_daemon.transforms import Array, inverse

LEAST_CHANGE_M = 0.04
"""Change of baseline from which two frames say something."""
OLDEST_S = 4.0
_POINTS = 400
_SPACING_PX = 9
_WINDOW_PX = 15
_ROW_LIMIT_PX = 1.0
_FEWEST_POINTS = 40
_STATIC_PX = 0.8
"""A point of the static scene agrees with its prediction within this ..."""
_STATIC_SHARE = 0.75
"""... and this share of the points must, or the scene is taken to move."""
_NOISE_PX = 0.15
_TURN_RATE_SIGMA_RAD_S, _SPEED_SIGMA_M_S = 0.01, 0.05
"""How well the autopilot knows the vehicle's motion; with late eyes its error is one of all disparities."""
_REMEMBERED = 20
_WORTHWHILE = 1.1
"""A pair is only worth working out when it promises to tell this much more than those before it."""
_RATIO_BLUR = 0.01
"""Doubt in the ratio of two baselines that blurs disparities about as much as the matcher does."""
_SYSTEMATIC_PX = 0.04
"""What one pair of frames cannot average away: light, blur and perspective act on all points alike."""


@dataclass(frozen=True, slots=True)
class Uncertain:
    """How far one sigma of the prediction goes: the eye's translation and its turn."""

    translation_m: float = 0.10
    turn_rad: float = 0.01


STILL = Uncertain(translation_m=1e-3, turn_rad=1e-3)
"""A vehicle on the ground: servos shake it a little."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One rectified grey pair (H, W) with its disparity (H, W; NaN unknown), true baseline, sigma and the eye's motion.

    `late_s` is by how much the right eye exposes after the left one.
    """

    t_ns: int
    left: Image
    right: Image
    disparity_px: FloatMap
    baseline_m: float
    baseline_sigma_m: float
    pinhole: Pinhole
    motion: CameraMotion
    late_s: float = 0.0
    late_sigma_s: float = 0.0


@dataclass(frozen=True, slots=True)
class YawFit:
    """Turn of the right eye about the down axis from where it should be; `count` points agree, `share` of all."""

    yaw_rad: float
    sigma_rad: float
    count: int
    share: float
    residual_px: float

    @property
    def static(self) -> bool:
        """The scene held still: nearly all points follow one motion."""
        return self.count >= _FEWEST_POINTS and self.share >= _STATIC_SHARE


class YawEstimator:
    """Compares each frame with the recent one that is farthest off in baseline; keeps the weighted mean of the yaw.

    Of all pairs within the same few seconds only the most telling counts, since they share their errors.
    """

    def __init__(self, uncertain: Uncertain | None = None) -> None:
        self._uncertain = uncertain or Uncertain()
        self._looks: deque[Look] = deque()
        self._done: list[YawFit] = []
        self._best: YawFit | None = None
        self._best_promise = 0.0
        self._since_ns = 0
        self.moving = 0

    @property
    def yaw_rad(self) -> float:
        """The yaw found so far, 0 before any."""
        if not self._fits:
            return 0.0
        weights = [1.0 / fit.sigma_rad**2 for fit in self._fits]
        return float(np.average([fit.yaw_rad for fit in self._fits], weights=weights))

    @property
    def sigma_rad(self) -> float:
        """One sigma of it, inf before any."""
        weight = sum(1.0 / fit.sigma_rad**2 for fit in self._fits)
        return 1.0 / math.sqrt(weight) if weight else math.inf

    @property
    def pairs(self) -> int:
        """How many independent pairs of frames it rests on."""
        return len(self._fits)

    def add(self, look: Look) -> YawFit | None:
        """Take a frame; returns what it told with an earlier one, None for nothing."""
        self._close_epoch(look.t_ns)
        while self._looks and look.t_ns - self._looks[0].t_ns > OLDEST_S * 1e9:
            self._looks.popleft()
        first = max(self._looks, key=lambda one: promise(one, look), default=None)
        self._looks.append(look)
        if first is None or abs(first.baseline_m - look.baseline_m) < LEAST_CHANGE_M:
            return None
        if promise(first, look) < _WORTHWHILE * self._best_promise:
            return None
        fit = fit_yaw(first, look, self._uncertain)
        if fit is None:
            return None
        self._best_promise = promise(first, look)
        if not fit.static:
            self.moving += 1
        elif self._best is None or fit.sigma_rad < self._best.sigma_rad:
            self._best = fit
        return fit

    @property
    def _fits(self) -> list[YawFit]:
        return self._done if self._best is None else [*self._done, self._best]

    def _close_epoch(self, t_ns: int) -> None:
        """Keep the best pair of the last few seconds for good, and look for the next from new frames only."""
        if not self._looks:
            self._since_ns = t_ns
        if t_ns - self._since_ns > OLDEST_S * 1e9:
            if self._best is not None:
                self._done = self._fits[-_REMEMBERED:]
                self._looks.clear()
            self._best, self._best_promise, self._since_ns = None, 0.0, t_ns


def leverage(baseline_1_m: float, baseline_2_m: float) -> float:
    """Return how much a yaw moves the difference of two disparities, over the noise of that difference."""
    ratio = baseline_2_m / baseline_1_m
    return abs(1.0 - ratio) / math.hypot(1.0, ratio)


def promise(first: Look, second: Look) -> float:
    """Return how much two looks can tell: their leverage, less where the baselines are in doubt."""
    return leverage(first.baseline_m, second.baseline_m) / math.hypot(1.0, ratio_sigma(first, second) / _RATIO_BLUR)


def ratio_sigma(first: Look, second: Look) -> float:
    """Return one sigma, relative, of the ratio of the baselines of two looks."""
    return math.hypot(*(look.baseline_sigma_m / look.baseline_m for look in (first, second)))


def fit_yaw(first: Look, second: Look, uncertain: Uncertain) -> YawFit | None:
    """Return the yaw that two frames at different baselines tell; None with too few points seen in both."""
    uv_1 = textured_points(first.left, first.disparity_px)
    if len(uv_1) < _FEWEST_POINTS:
        return None
    d_1, seen_1 = _disparities(first, uv_1)
    x_1 = (uv_1 - [first.pinhole.cx_px, first.pinhole.cy_px]) / first.pinhole.f_px
    depth_1 = first.baseline_m * first.pinhole.f_px / np.maximum(d_1, 0.5)
    p_2 = _carried(np.column_stack([x_1, np.ones(len(x_1))]) * depth_1[:, None], first, second)
    uv_2, seen_2 = _followed(first, second, uv_1, p_2)
    d_2, seen_3 = _disparities(second, uv_2)
    good = seen_1 & seen_2 & seen_3 & (d_1 > 0.5) & (d_2 > 0.5) & (p_2[:, 2] > 0.3)
    if np.count_nonzero(good) < _FEWEST_POINTS:
        return None
    return _solve(first, second, x_1[good], d_1[good], depth_1[good], d_2[good], p_2[good, 2], uncertain)


def textured_points(left: Image, disparity_px: FloatMap) -> Array:
    """Return up to 400 points (n, 2) with texture and a known disparity, spread over the image."""
    mask = np.where(np.isfinite(disparity_px), 255, 0).astype(np.uint8)
    border = _WINDOW_PX // 2 + 1
    mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
    found = cv2.goodFeaturesToTrack(left, _POINTS, 0.01, _SPACING_PX, mask=mask)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


def _disparities(look: Look, uv: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the disparity (n,) of left points by following them into the right eye, lateness taken out."""
    column = np.clip(np.round(uv[:, 0]), 0, look.left.shape[1] - 1).astype(np.intp)
    row = np.clip(np.round(uv[:, 1]), 0, look.left.shape[0] - 1).astype(np.intp)
    start = look.disparity_px[row, column].astype(np.float64)
    known = np.isfinite(start)
    guess = uv - np.column_stack([np.where(known, start, 0.0), np.zeros(len(uv))])
    found, followed = _follow(look.left, look.right, uv, guess, levels=0)
    d = uv[:, 0] - found[:, 0]
    good = known & followed & (np.abs(found[:, 1] - uv[:, 1]) < _ROW_LIMIT_PX) & (np.abs(d - start) < 2.0)
    rates = right_eye_rates(uv, np.maximum(d, 0.5), look.pinhole, look.baseline_m, look.motion)
    return d + look.late_s * rates[:, 0], good


def _carried(p_1: Array, first: Look, second: Look) -> Array:
    """Return points (n, 3) of the first left eye in the second one's frame, as the vehicle says it moved."""
    T_2_1 = inverse(second.motion.T_ned_rect) @ first.motion.T_ned_rect
    return np.asarray(p_1 @ T_2_1[:3, :3].T + T_2_1[:3, 3])


def _followed(first: Look, second: Look, uv_1: Array, p_2: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return where (n, 2) the points are in the second left image, looked for where the motion puts them."""
    pinhole = second.pinhole
    ahead = p_2[:, 2] > 0.3
    xy = p_2[:, :2] / np.where(ahead, p_2[:, 2], 1.0)[:, None]
    guess = xy * pinhole.f_px + [pinhole.cx_px, pinhole.cy_px]
    inside = ahead & np.all((guess > 0) & (guess < [pinhole.width - 1, pinhole.height - 1]), axis=1)
    found, followed = _follow(first.left, second.left, uv_1, np.where(inside[:, None], guess, uv_1), levels=3)
    return found, followed & inside


def _follow(before: Image, after: Image, uv: Array, guess: Array, levels: int) -> tuple[Array, NDArray[np.bool_]]:
    found, followed = follow(before, after, uv, guess, window_px=_WINDOW_PX, levels=levels)
    inside = np.all((found > 0) & (found < [after.shape[1] - 1, after.shape[0] - 1]), axis=1)
    return found, followed & inside


def _solve(
    first: Look, second: Look, x: Array, d_1: Array, depth_1: Array, d_2: Array, depth_2: Array, uncertain: Uncertain
) -> YawFit:
    """Least squares on d2 against its prediction; columns: yaw, ratio of baselines, forward shift, turns."""
    f = second.pinhole.f_px
    ratio = second.baseline_m / first.baseline_m
    predicted = second.baseline_m * f / depth_2
    slope = ratio * (depth_1 / depth_2) ** 2
    x_right = x[:, 0] - d_1 / first.pinhole.f_px
    columns = np.column_stack(
        [
            f * (1.0 + x_right**2) * (1.0 - slope),
            predicted,
            -predicted / depth_2,
            -predicted * x[:, 0],
            -predicted * x[:, 1],
        ]
    )
    turn = uncertain.turn_rad
    prior = np.array([math.inf, ratio_sigma(first, second), uncertain.translation_m, turn, turn])
    noise = _NOISE_PX * np.sqrt(1.0 + slope**2)
    error = d_2 - predicted
    solution, covariance, kept = _robust(columns / noise[:, None], error / noise, 1.0 / prior)
    left = error - columns @ solution
    static = np.abs(left) < _STATIC_PX * np.sqrt(1.0 + slope**2)
    spread = float(np.sqrt(np.mean((left[kept] / noise[kept]) ** 2))) if kept.any() else math.inf
    by_time = math.hypot(ratio * _time_px(first, depth_1), _time_px(second, depth_2)) / math.hypot(1.0, ratio)
    systematic = math.hypot(_SYSTEMATIC_PX, by_time) / leverage(first.baseline_m, second.baseline_m) / f
    sigma = math.hypot(math.sqrt(covariance[0, 0]) * max(1.0, spread), systematic)
    residual = float(np.median(np.abs(left)))
    return YawFit(float(solution[0]), sigma, int(np.count_nonzero(static)), float(static.mean()), residual)


def _time_px(look: Look, depth_m: Array) -> float:
    """Return how wrong all disparities may be together since the eyes expose at different times, one sigma."""
    if not np.any(look.motion.w_rect_rad_s) and not np.any(look.motion.v_rect_m_s):
        return 0.0
    near_m = float(np.median(depth_m))
    rate = abs(float(look.motion.w_rect_rad_s[1])) + abs(float(look.motion.v_rect_m_s[0])) / near_m
    rate_sigma = math.hypot(_TURN_RATE_SIGMA_RAD_S, _SPEED_SIGMA_M_S / near_m)
    return look.pinhole.f_px * math.hypot(look.late_sigma_s * rate, look.late_s * rate_sigma)


def _robust(columns: Array, values: Array, prior: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return solution, covariance and which values were kept, far ones left out in four rounds.

    `prior` is one over the sigma that each unknown is known to beforehand.
    """
    kept = np.ones(len(values), dtype=np.bool_)
    solution: Array = np.zeros(columns.shape[1])
    covariance: Array = np.eye(columns.shape[1])
    for _ in range(4):
        normal = columns[kept].T @ columns[kept] + np.diag(prior**2)
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        solution = np.asarray(covariance @ (columns[kept].T @ values[kept]), np.float64)
        off = np.abs(values - columns @ solution)
        kept = off <= max(1.0, 2.5 * 1.4826 * float(np.median(off)))
    return solution, covariance, kept
