"""Visual odometry: camera motion between two frames, the autopilot's pose refined on the static part of the scene.

The static part agrees with the autopilot within its errors and covers most of the world, not most of the image: each
point is weighted by the area it represents, which grows with its depth squared, so that an object close to the camera
does not become the frame of reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.messages.core import Mask
from morpheyes_daemon.strategies.imo.rectified_frame import RectifiedFrame
from morpheyes_daemon.transforms import Array, R_from_rotvec, inverse, pose, skew

ATTITUDE_SIGMA_RAD = 0.008
"""One sigma of the autopilot's change of attitude between two frames.

Chosen: some tenths of a degree, as an EKF's attitude wanders; smaller keeps its error in the motion."""

POSITION_SIGMA_M_SQRT_S = 0.04
"""Random walk of the autopilot's displacement between two frames. Unit: m/sqrt(s).

Chosen: drift and jitter of the estimate; smaller keeps them in the motion, larger lets objects pull it."""

SIGMA_PX = np.array([0.3, 0.3, 0.4])
"""One sigma (3,) of u, v and d of a feature tracked between frames and cameras.

Chosen: as seen on rendered flights; smaller rejects static features, larger hides slow objects."""

SYSTEMATIC = np.diag([2e-4**2] * 3 + [1.5e-3**2] * 3)
"""Covariance (6, 6) per step beyond the features' noise, from lens and rectification errors. Unit: rad², m².

Chosen: 0.2 mrad and 1.5 mm; smaller takes them for motion of distant objects."""

SYNC_SHARE = 0.005
"""One sigma of a disparity from sideways motion between the exposures, as a share of it. Unit: none.

Source: equation, v dt / b: 0.5 m/s for 2 ms are 1 mm of 0.2 m (MorphEyes paper, synchronization)."""

AREA_KERNEL_SIGMAS = (12.0, 6.0, 3.0)
"""Kernel widths of the steps weighted by area: from the autopilot's errors down to the noise. Unit: sigmas.

Chosen: halving converges from a degree; a narrow first kernel rejects the whole scene."""

FINAL_KERNEL_SIGMAS = (2.0, 2.0)
"""Kernel widths of the steps on the points that agree with the weighted fit. Unit: sigmas.

Chosen: wider lets mismatches pull, narrower uses few of the static points."""

AGREEMENT_MAHALANOBIS2 = 9.0
"""Squared Mahalanobis distance up to which a point agrees with the weighted fit. Unit: none.

Chosen: 3 sigma; larger admits slow objects."""

STATIC_SIGMAS = 3.0
"""Residual in each of u, v and d up to which a point is static, after the final fit. Unit: sigmas.

Chosen: 1 % of static points are lost; larger takes slow objects for static."""

FULL_WEIGHT_AREA = 0.5
"""Share of the area whose farthest points have full weight. Unit: none.

Chosen: of the area, not of the points, since most of those may lie on an object close to the camera."""

MIN_STATIC_POINTS = 8
"""Static points from which the refined motion is used. Unit: points.

Chosen: 24 observations for 6 unknowns; with fewer the autopilot's motion is used."""

MIN_DEPTH_M = 0.05
"""Depth below which a predicted point is discarded.

Chosen: nearer than the near limit of every baseline."""

MIN_INTERVAL_S = 1e-3
"""Smallest time between two frames.

Chosen: keeps the prior invertible; below every frame period."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Camera motion: `T_now_before` (4, 4) takes points from one rect frame to the next, metres.

    `covariance` (6, 6) is that of (rotation, translation), rad and m; `static` (N,) marks the points that agree.
    """

    T_now_before: Array
    covariance: Array
    static: Mask


def autopilot_motion(before: RectifiedFrame, now: RectifiedFrame) -> Array:
    """Return T_now_before (4, 4), metres, from the autopilot's poses."""
    return inverse(now.T_ned_rect) @ before.T_ned_rect


def prior_covariance(dt_s: float) -> Array:
    """Return the covariance (6, 6), rad² and m², of the autopilot's motion over `dt_s`."""
    shift = POSITION_SIGMA_M_SQRT_S * np.sqrt(max(dt_s, MIN_INTERVAL_S))
    return np.diag([ATTITUDE_SIGMA_RAD**2] * 3 + [shift**2] * 3)


def refine_motion(prior: Array, dt_s: float, p_before: Array, uvd_now: Array, now: RectifiedFrame) -> CameraMotion:
    """Return the motion that best explains observations uvd_now (N, 3), px, of points p_before (N, 3), rect metres.

    Gauss-Newton with a Geman-McClure kernel that narrows from step to step. `prior` (4, 4) is the autopilot's motion
    over `dt_s`; it is returned when too few points are static.
    """
    prior_information = np.asarray(np.linalg.inv(prior_covariance(dt_s)), dtype=np.float64)
    scene = _Scene(p_before, uvd_now, now, prior_information)
    fit = _Fit(prior.copy(), np.zeros(6), scene.information)
    weight = _area_weight(p_before[:, 2])
    for width in AREA_KERNEL_SIGMAS:
        fit = scene.step(fit, width, weight)
    agrees = scene.agrees(fit)
    for width in FINAL_KERNEL_SIGMAS:
        fit = scene.step(fit, width, agrees)
    residual, _ = _linearised(fit.T_now_before, p_before, uvd_now, now)
    with np.errstate(invalid="ignore"):
        static = np.asarray((np.abs(residual) < STATIC_SIGMAS * SIGMA_PX).all(axis=1)) & (agrees > 0.0)
    if static.sum() < MIN_STATIC_POINTS:
        return CameraMotion(prior, prior_covariance(dt_s), np.zeros(len(p_before), dtype=np.bool_))
    return CameraMotion(fit.T_now_before, fit.covariance, static)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A motion being fitted: the pose, its offset (6,) from the prior, and its information (6, 6)."""

    T_now_before: Array
    offset: Array
    information: Array

    @property
    def covariance(self) -> Array:
        return np.asarray(np.linalg.inv(self.information) + SYSTEMATIC)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Points (N, 3) before, their observations (N, 3) now, and the information (6, 6) of the prior."""

    p_before: Array
    uvd_now: Array
    now: RectifiedFrame
    information: Array

    def step(self, fit: _Fit, width: float, weights: Array) -> _Fit:
        """Return the fit after one Gauss-Newton step with a kernel of `width` sigmas and weights (N,)."""
        residual, J = _linearised(fit.T_now_before, self.p_before, self.uvd_now, self.now)
        size = np.sqrt(((residual / SIGMA_PX) ** 2).sum(axis=1))
        weight = np.where(np.isfinite(size), 1.0 / (1.0 + (size / width) ** 2) ** 2, 0.0) * weights
        scaled = np.where(np.isfinite(J), J, 0.0) / SIGMA_PX[:, None]
        information = self.information + np.einsum("n,nij,nik->jk", weight, scaled, scaled)
        gradient = np.einsum("n,nij,ni->j", weight, scaled, np.nan_to_num(residual / SIGMA_PX))
        change = np.linalg.solve(information, gradient - self.information @ fit.offset)
        T = pose(R_from_rotvec(change[:3]), change[3:]) @ fit.T_now_before
        return _Fit(T, fit.offset + change, information)

    def agrees(self, fit: _Fit) -> Array:
        """Return (N,) 1.0 for points that agree with the fit within its uncertainty and their noise, else 0.0."""
        residual, J = _linearised(fit.T_now_before, self.p_before, self.uvd_now, self.now)
        with np.errstate(invalid="ignore"):
            distance2 = _mahalanobis2(residual, J, fit.covariance, np.diag(SIGMA_PX**2))
            return np.asarray(distance2 < AGREEMENT_MAHALANOBIS2, dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class PastView:
    """Points (N, 3) as seen `steps` frames ago, and the camera motion since: (4, 4), with its covariance (6, 6)."""

    p_rect: Array
    T_now_then: Array
    covariance: Array
    steps: int


def static_residuals(past: PastView, uvd_now: Array, now: RectifiedFrame, static: Mask) -> tuple[Array, Array]:
    """Return residuals (N, 3), px, of observations against a static scene, and their squared Mahalanobis distances (N,).

    uvd_now: (N, 3), px. The noise is that of features tracked over several frames, of the baseline, and of the camera
    motion. The median disparity residual of the `static` (N,) points is subtracted: the cameras do not expose at the
    same instant, and rotation in between shifts the right image.
    """
    residual, J = _linearised(past.T_now_then, past.p_rect, uvd_now, now)
    known = static & np.isfinite(residual[:, 2])
    if known.sum() >= MIN_STATIC_POINTS:
        residual[:, 2] -= np.median(residual[known, 2])
    residual = np.where(np.isfinite(residual), residual, 0.0)
    noise = np.tile(np.diag(SIGMA_PX * (0.5 + 0.5 * past.steps)) ** 2, (len(residual), 1, 1))
    stretch = SYNC_SHARE + now.baseline_sigma_m / now.baseline_m
    noise[:, 2, 2] += 2.0 * (stretch * uvd_now[:, 2]) ** 2
    return residual, _mahalanobis2(residual, J, past.covariance, noise)


def _mahalanobis2(residual: Array, J: Array, covariance: Array, noise: Array) -> Array:
    """Return the squared Mahalanobis distance (N,) of residuals (N, 3), given the motion's covariance (6, 6) through J.

    `noise` (3, 3) or (N, 3, 3) is the covariance of the observations; NaN residuals stay NaN.
    """
    J = np.nan_to_num(J)
    S = np.einsum("nij,jk,nlk->nil", J, covariance, J) + noise
    solved = np.linalg.solve(S, residual[..., None])[..., 0]
    return np.asarray((residual * solved).sum(axis=1))


def _area_weight(depth_m: Array) -> Array:
    """Return weights (N,), 0 to 1, that grow with the fourth power of depth up to the farthest half of the area.

    Squared since a far point represents more area, and squared again since a near one moves more pixels per metre.
    """
    known = np.sort(depth_m[np.isfinite(depth_m)])
    if not known.size:
        return np.ones_like(depth_m)
    area = np.cumsum(known**2)
    full_m = known[np.searchsorted(area, FULL_WEIGHT_AREA * area[-1])]
    return np.asarray(np.minimum(1.0, (np.nan_to_num(depth_m) / full_m) ** 4))


def _linearised(T: Array, p_before: Array, uvd_now: Array, now: RectifiedFrame) -> tuple[Array, Array]:
    """Return residuals (N, 3), px, and the derivatives (N, 3, 6) of the predictions by (rotation, translation)."""
    p_now = p_before @ T[:3, :3].T + T[:3, 3]
    p_now = np.where(p_now[:, 2:3] > MIN_DEPTH_M, p_now, np.nan)
    to_pixels = now.derivative(p_now)
    rotated = -np.stack([skew(p) for p in p_now]) if len(p_now) else np.zeros((0, 3, 3))
    J = np.concatenate([to_pixels @ rotated, to_pixels], axis=2)
    return uvd_now - now.project(p_now), J
