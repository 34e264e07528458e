"""Whether depth is to scale: the vehicle's own motion makes near points move in the image faster than far ones.

A servo that sticks while its targets are acknowledged leaves a pair whose rows align and whose depths are all wrong
by the same factor, modelled over true baseline. How far a point moves from one left image to the next depends on its
true depth and on the way flown, which the autopilot knows; the right eye takes no part in it. Only a vehicle that
flies tells anything, and nothing is corrected here.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.messages.core import DepthMap, Image, Pinhole
from morpheyes_daemon.perception.camera_motion import CameraMotion
from morpheyes_daemon.stereo.lucas_kanade import follow
from morpheyes_daemon.transforms import Array, R_from_rotvec

_POINTS, _SPACING_PX, _WINDOW_PX = 160, 8, 15
_FEWEST_POINTS = 30
_FARTHEST_ERROR = 0.1
"""Points whose depth is uncertain by more than this share say little."""
_RETURN_PX = 0.5
"""How near the way back from the second image must end."""
_SPEED_SIGMA_M_S = 0.1
"""How well the autopilot knows the vehicle's velocity."""
_TURN_SIGMA_RAD, _SEEN_SIGMA_RAD = 0.02, 1e-3
"""How well it knows the turn from one image to the next, and how well a point is found again."""
_LONGEST_S = 1.0


@dataclass(frozen=True, slots=True)
class ScaleLimits:
    """When depth counts as out of scale: the factor, the sigma that a frame may have, and the share of such frames."""

    factor: float = 1.3
    sigma: float = 0.1
    frames: int = 4
    of: int = 5


@dataclass(frozen=True, slots=True)
class ScaleFit:
    """`factor`: measured depth over true depth, one sigma of it relative; `count` points agree."""

    factor: float
    sigma: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What one frame shows: the rectified left grey image (H, W), its depth, and how the eye moves."""

    left: Image
    depth: DepthMap
    motion: CameraMotion


class DepthScaleMonitor:
    """Fed with every frame; True once most of the latest telling frames agree that depth is out of scale."""

    def __init__(self, limits: ScaleLimits | None = None) -> None:
        self._limits = limits or ScaleLimits()
        self._last: Sight | None = None
        self._wrong: deque[bool] = deque(maxlen=self._limits.of)

    def check(self, sight: Sight) -> bool:
        """Take a frame; returns whether depth is out of scale, by it and the frames before."""
        last, self._last = self._last, sight
        fit = scale_between(last, sight) if last is not None else None
        if fit is not None and fit.sigma <= self._limits.sigma:
            self._wrong.append(abs(math.log(fit.factor)) > math.log(self._limits.factor) + 2.0 * fit.sigma)
        return sum(self._wrong) >= self._limits.frames


def scale_between(first: Sight, second: Sight) -> ScaleFit | None:
    """Return by what factor the depth of `first` is too large; None when the two frames tell nothing."""
    seconds = (second.depth.t_ns - first.depth.t_ns) * 1e-9
    if not 0.0 < seconds <= _LONGEST_S:
        return None
    flown = _flown(first.motion, second.motion, seconds)
    uv = _telling_points(first)
    if len(uv) < _FEWEST_POINTS:
        return None
    places = _rays(uv, first.depth.pinhole) * first.depth.depth_m[uv[:, 1], uv[:, 0]].astype(np.float64)[:, None]
    R_2_1 = second.motion.T_ned_rect[:3, :3].T @ first.motion.T_ned_rect[:3, :3]
    turned = places @ R_2_1.T
    seen, good = follow(
        first.left,
        second.left,
        uv,
        _pixels(turned - flown, second.depth.pinhole),
        window_px=_WINDOW_PX,
        levels=3,
        return_px=_RETURN_PX,
    )
    if good.sum() < _FEWEST_POINTS:
        return None
    rays = _rays(seen[good], second.depth.pinhole)[:, :2]
    return _fit(turned[good], flown, rays, second.depth.pinhole.f_px, _SPEED_SIGMA_M_S * seconds)


def _flown(first: CameraMotion, second: CameraMotion, seconds: float) -> Array:
    """Return the way (3,) of the eye from frame to frame, in the second frame's axes."""
    v_ned = first.T_ned_rect[:3, :3] @ first.v_rect_m_s + second.T_ned_rect[:3, :3] @ second.v_rect_m_s
    return np.asarray(second.T_ned_rect[:3, :3].T @ v_ned * (seconds / 2.0))


def _telling_points(sight: Sight) -> Array:
    """Return (n, 2) well-textured pixels whose depth is known well enough."""
    depth = sight.depth
    limit_m = _FARTHEST_ERROR * depth.baseline_m * depth.pinhole.f_px / depth.sigma_disparity_px
    mask = (depth.depth_m < limit_m).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(sight.left, _POINTS, 0.01, _SPACING_PX, mask=mask)
    return np.empty((0, 2), np.int64) if corners is None else np.rint(corners.reshape(-1, 2)).astype(np.int64)


def _fit(turned: Array, flown: Array, rays: Array, f_px: float, flown_sigma_m: float) -> ScaleFit | None:
    """Solve for the factor k and a small turn w by least squares on ever fewer points.

    A point at true depth Z/k is seen at turned/k - flown, in the same direction as turned - k flown.
    """
    k, w, believed = 1.0, np.zeros(3), (_SEEN_SIGMA_RAD / _TURN_SIGMA_RAD) ** 2
    kept = np.ones(len(turned), dtype=np.bool_)
    for _ in range(6):
        points = turned @ R_from_rotvec(w).T - k * flown
        kept &= points[:, 2] > 0.1
        if kept.sum() < _FEWEST_POINTS:
            return None
        off = rays - points[:, :2] / points[:, 2:]
        by_k, by_w = _derivatives(points, flown)
        columns = np.concatenate([by_k[:, :, None], by_w], axis=2)[kept].reshape(-1, 4)
        normal = columns.T @ columns + np.diag([0.0, believed, believed, believed])
        moment = columns.T @ off[kept].reshape(-1) - np.array([0.0, *(believed * w)])
        try:
            step = np.linalg.solve(normal, moment)
        except np.linalg.LinAlgError:
            return None
        k, w = k + float(step[0]), w + step[1:]
        size = np.abs(off).max(axis=1)
        kept = size <= max(0.5 / f_px, 3.0 * float(np.median(size)))
        if not 0.05 < k < 20.0:
            return None
    noise = max(0.2 / f_px, 1.4826 * float(np.median(np.abs(off[kept]))))
    variance = noise**2 * float(np.linalg.inv(normal)[0, 0])
    sigma = math.hypot(math.sqrt(variance) / k, flown_sigma_m / max(float(np.linalg.norm(flown)), 1e-9))
    return ScaleFit(k, sigma, int(kept.sum()))


def _derivatives(points: Array, flown: Array) -> tuple[Array, Array]:
    """Return how the directions (n, 2) of points move with the factor (n, 2) and with a small turn (n, 2, 3)."""
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
    return direction @ -flown, direction @ turning


def _rays(uv: Array, pinhole: Pinhole) -> Array:
    x = (uv[:, 0] - pinhole.cx_px) / pinhole.f_px
    y = (uv[:, 1] - pinhole.cy_px) / pinhole.f_px
    return np.stack([x, y, np.ones(len(uv))], axis=1)


def _pixels(places: Array, pinhole: Pinhole) -> Array:
    z = np.maximum(places[:, 2], 0.1)
    u = pinhole.f_px * places[:, 0] / z + pinhole.cx_px
    return np.stack([u, pinhole.f_px * places[:, 1] / z + pinhole.cy_px], axis=1)
