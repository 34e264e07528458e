"""Monitor of the depth scale: compares stereo depth with structure from motion of the left camera.

A servo that sticks while it acknowledges its targets leaves rectified rows aligned and scales every depth by the
modelled over the true baseline. The displacement of a point between two left images depends on its true depth and on
the vehicle's translation, which the autopilot reports; the right camera is not involved. A hovering vehicle gives no
measurement. Nothing is corrected here.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import DepthMap, Image, Pinhole
from morpheyes_daemon.perception.camera_motion import CameraMotion
from morpheyes_daemon.stereo.lucas_kanade import LucasKanade
from morpheyes_daemon.transforms import Array, R_from_rotvec

_POINTS, _SPACING_PX, _CORNER_QUALITY = 160, 8, 0.01
"""Corners per frame, their least distance in pixels, and least response relative to the strongest (OpenCV's
goodFeaturesToTrack); chosen: more corners cost time."""
_TRACKER = LucasKanade(window_px=15, levels=3, return_px=0.5)
"""From frame to frame; chosen: larger windows blur depth edges, a looser return check admits false matches."""
_FEWEST_POINTS = 30
"""Points that a fit of four unknowns needs; chosen: with fewer a single moving object can dominate."""
_MAX_RELATIVE_DEPTH_ERROR = 0.1
"""Relative sigma of depth up to which a point is used; chosen: farther points add little to the scale."""
_SPEED_SIGMA_M_S = 0.1
"""One sigma of the reported velocity, m/s; chosen: that of the simulated autopilot (benchmarks.online_calibration)."""
_TURN_SIGMA_RAD, _TRACKING_SIGMA_RAD = 0.02, 1e-3
"""One sigma of the reported rotation between two frames, and of a tracked direction, rad; chosen: their ratio is the
weight of the reported rotation against the images."""
_LONGEST_S = 1.0
"""Longest time between two compared frames, seconds; chosen: the mean of two velocities is no translation beyond."""
_MIN_DEPTH_M = 0.1
"""Least depth in the second frame, metres; chosen: nearer than any near limit."""
_ROUNDS = 6
"""Gauss-Newton steps with outlier rejection; chosen: more cost time."""
_FACTOR_RANGE = (0.05, 20.0)
"""Scale factors beyond which the fit has diverged; chosen: the rig's baselines differ by a factor of 3."""
_OUTLIER_FACTOR, _OUTLIER_FLOOR_PX, _NOISE_FLOOR_PX = 3.0, 0.5, 0.2
"""Outlier limit in medians of the residual and its floor, and floor of the noise, pixels; chosen: tighter limits
reject points of a rotated view."""


@dataclass(frozen=True, slots=True)
class ScaleLimits:
    """M-of-N confirmation of a wrong depth scale; chosen: smaller limits alarm sooner and falsely more often."""

    factor: float = 1.3
    """Factor, or its inverse, beyond which a frame counts as wrong, with two sigmas on top."""
    sigma: float = 0.1
    """Largest relative sigma of a frame that counts."""
    frames: int = 4
    """M: wrong frames that raise the alarm."""
    of: int = 5
    """N: counted frames."""


@dataclass(frozen=True, slots=True)
class ScaleFit:
    """`factor`: stereo depth over true depth, with its relative sigma; `count` inliers."""

    factor: float
    sigma: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class ScaleObservation:
    """One frame: the rectified left grey image (H, W) uint8, its depth map, and the motion of the left camera."""

    left: Image
    depth: DepthMap
    motion: CameraMotion


class DepthScaleMonitor:
    """Compares every frame with the one before it and confirms a wrong scale by M of N frames."""

    def __init__(self, limits: ScaleLimits | None = None) -> None:
        self._limits = limits or ScaleLimits()
        self._last: ScaleObservation | None = None
        self._wrong: deque[bool] = deque(maxlen=self._limits.of)

    def check(self, observation: ScaleObservation) -> bool:
        """Add a frame; return whether the depth scale is confirmed as wrong."""
        last, self._last = self._last, observation
        fit = scale_between(last, observation) if last is not None else None
        if fit is not None and fit.sigma <= self._limits.sigma:
            self._wrong.append(abs(math.log(fit.factor)) > math.log(self._limits.factor) + 2.0 * fit.sigma)
        return sum(self._wrong) >= self._limits.frames


def scale_between(first: ScaleObservation, second: ScaleObservation) -> ScaleFit | None:
    """Return the factor by which the depth of `first` is too large; None when the frames give no measurement.

    Robust Gauss-Newton for the factor and a small rotation, with the reported rotation as prior.
    """
    dt_s = (second.depth.t_ns - first.depth.t_ns) * 1e-9
    if not 0.0 < dt_s <= _LONGEST_S:
        return None
    translation = _translation(first.motion, second.motion, dt_s)
    uv = _informative_points(first)
    if len(uv) < _FEWEST_POINTS:
        return None
    places = _rays(uv, first.depth.pinhole) * first.depth.depth_m[uv[:, 1], uv[:, 0]].astype(np.float64)[:, None]
    R_2_1 = second.motion.T_ned_rect[:3, :3].T @ first.motion.T_ned_rect[:3, :3]
    rotated = places @ R_2_1.T
    guess = _pixels(rotated - translation, second.depth.pinhole)
    seen, good = _TRACKER.track(first.left, second.left, uv, guess)
    if good.sum() < _FEWEST_POINTS:
        return None
    rays = _rays(seen[good], second.depth.pinhole)[:, :2]
    return _fit(rotated[good], translation, rays, second.depth.pinhole.f_px, _SPEED_SIGMA_M_S * dt_s)


def _translation(first: CameraMotion, second: CameraMotion, dt_s: float) -> Array:
    """Return the translation (3,) m of the left camera between two frames, in rect axes of the second one."""
    v_ned = first.T_ned_rect[:3, :3] @ first.v_rect_m_s + second.T_ned_rect[:3, :3] @ second.v_rect_m_s
    return np.asarray(second.T_ned_rect[:3, :3].T @ v_ned * (dt_s / 2.0))


def _informative_points(observation: ScaleObservation) -> Array:
    """Return (n, 2) corners whose depth is known within `_MAX_RELATIVE_DEPTH_ERROR`: Z < share b f / sigma_d."""
    depth = observation.depth
    limit_m = _MAX_RELATIVE_DEPTH_ERROR * depth.baseline_m * depth.pinhole.f_px / depth.sigma_disparity_px
    mask = (depth.depth_m < limit_m).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(observation.left, _POINTS, _CORNER_QUALITY, _SPACING_PX, mask=mask)
    return np.empty((0, 2), np.int64) if corners is None else np.rint(corners.reshape(-1, 2)).astype(np.int64)


def _fit(rotated: Array, translation: Array, rays: Array, f_px: float, translation_sigma_m: float) -> ScaleFit | None:
    """Solve for the factor k and a small rotation w.

    A point (n, 3) at true depth Z / k lies at rotated / k - translation in the second frame, in the same direction as
    rotated - k translation; `rays` (n, 2) are the measured directions.
    """
    k, w, prior = 1.0, np.zeros(3), (_TRACKING_SIGMA_RAD / _TURN_SIGMA_RAD) ** 2
    kept = np.ones(len(rotated), dtype=np.bool_)
    for _ in range(_ROUNDS):
        points = rotated @ R_from_rotvec(w).T - k * translation
        kept &= points[:, 2] > _MIN_DEPTH_M
        if kept.sum() < _FEWEST_POINTS:
            return None
        residual = rays - points[:, :2] / points[:, 2:]
        by_k, by_w = _derivatives(points, translation)
        columns = np.concatenate([by_k[:, :, None], by_w], axis=2)[kept].reshape(-1, 4)
        normal = columns.T @ columns + np.diag([0.0, prior, prior, prior])
        moment = columns.T @ residual[kept].reshape(-1) - np.array([0.0, *(prior * w)])
        try:
            step = np.linalg.solve(normal, moment)
        except np.linalg.LinAlgError:
            return None
        k, w = k + float(step[0]), w + step[1:]
        size = np.abs(residual).max(axis=1)
        kept = size <= max(_OUTLIER_FLOOR_PX / f_px, _OUTLIER_FACTOR * float(np.median(size)))
        if not _FACTOR_RANGE[0] < k < _FACTOR_RANGE[1]:
            return None
    noise = max(_NOISE_FLOOR_PX / f_px, 1.4826 * float(np.median(np.abs(residual[kept]))))
    variance = noise**2 * float(np.linalg.inv(normal)[0, 0])
    sigma = math.hypot(math.sqrt(variance) / k, translation_sigma_m / max(float(np.linalg.norm(translation)), 1e-9))
    return ScaleFit(k, sigma, int(kept.sum()))


def _derivatives(points: Array, translation: Array) -> tuple[Array, Array]:
    """Return the derivatives of the directions of points (n, 3) by factor (n, 2) and by small rotation (n, 2, 3)."""
    x, y, z = points.T
    zero, one = np.zeros_like(z), 1.0 / z
    direction = np.stack([np.stack([one, zero, -x / z**2], axis=1), np.stack([zero, one, -y / z**2], axis=1)], axis=1)
    turning = np.stack(
        [
            np.stack([zero, z, -y], axis=1),
            np.stack([-z, zero, x], axis=1),
            np.stack([y, -x, zero], axis=1),
        ],
        axis=1,
    )
    return direction @ -translation, direction @ turning


def _rays(uv: Array, pinhole: Pinhole) -> Array:
    x = (uv[:, 0] - pinhole.cx_px) / pinhole.f_px
    y = (uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    return np.stack([x, y, np.ones(len(uv))], axis=1)


def _pixels(places: Array, pinhole: Pinhole) -> Array:
    z = np.maximum(places[:, 2], _MIN_DEPTH_M)
    u = pinhole.f_px * places[:, 0] / z + pinhole.cx_px
    return np.stack([u, pinhole.f_px * places[:, 1] / z + pinhole.cy_px], axis=1)
