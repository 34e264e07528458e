"""The vehicle's own motion between two frames: what the autopilot says, refined on the part of the scene that stands.

The static part is what agrees with the autopilot within its errors and covers most of the world, not most of the
image: a point's vote counts by the area it stands for, which grows with its depth squared, so that an object right
before the eyes does not become the frame of reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.strategies.imo.features import Mask
from morpheyes_daemon.strategies.imo.rectified_frame import Frame
from morpheyes_daemon.transforms import Array, R_from_rotvec, inverse, pose, skew

ATTITUDE_SIGMA_RAD = 0.008
"""Of the change between two frames; an EKF's attitude wanders by some tenths of a degree."""

POSITION_SIGMA_M_SQRT_S = 0.04
"""Of the displacement between two frames, per root second: a random walk and the jitter of the estimate."""

SIGMA_PX = np.array([0.3, 0.3, 0.4])
"""Of u, v and d of a feature followed from frame to frame and eye to eye (measured on rendered flights)."""

SYSTEMATIC = np.diag([2e-4**2] * 3 + [1.5e-3**2] * 3)
"""What the refined motion is off beyond the features' noise, per step: lenses and rows that are not quite straight."""

SYNC_SHARE = 0.005
"""Of a disparity: the vehicle moves sideways between the exposures of the eyes (0.5 m/s for 2 ms is 1 mm)."""

WIDTHS = (12.0, 6.0, 3.0)
"""Widths of the robust kernel in sigmas while votes count by area: from what the autopilot's errors explain down."""

SHARP_WIDTHS = (2.0, 2.0)
"""And when those points refine the motion, by their noise alone, that agree with what was voted."""

AGREES = 9.0
"""Squared Mahalanobis length up to which a point agrees, given what the vote leaves open."""

FULL_VOTE_AREA = 0.5
"""The farthest points that make up this share of the area have a full vote; of the area, not of the points, since
most of those may lie on an object right before the eyes."""

FEWEST = 8
"""With fewer static points than this the autopilot is taken as it is."""


@dataclass(frozen=True, slots=True, eq=False)
class EgoMotion:
    """Points move by `T_now_before` (4, 4) from one rect frame to the next; `covariance` (6, 6) of (turn, shift).

    `static` (N,) bool tells which of the points given agree with it.
    """

    T_now_before: Array
    covariance: Array
    static: np.ndarray[tuple[int], np.dtype[np.bool_]]


def told_motion(before: Frame, now: Frame) -> Array:
    """Return T_now_before as the autopilot has it."""
    return inverse(now.T_ned_rect) @ before.T_ned_rect


def prior_covariance(dt_s: float) -> Array:
    """Return (6, 6) how far the told motion over `dt_s` may be off."""
    shift = POSITION_SIGMA_M_SQRT_S * np.sqrt(max(dt_s, 1e-3))
    return np.diag([ATTITUDE_SIGMA_RAD**2] * 3 + [shift**2] * 3)


def refine(told: Array, dt_s: float, p_before: Array, uvd_now: Array, now: Frame) -> EgoMotion:
    """Return the motion that best explains observations uvd_now (N, 3) of points p_before (N, 3), near the told one.

    Iterated least squares with a Geman-McClure kernel that narrows from step to step, and the told motion as prior.
    """
    told_information = np.asarray(np.linalg.inv(prior_covariance(dt_s)), dtype=np.float64)
    scene = _Scene(p_before, uvd_now, now, told_information)
    fit = _Fit(told.copy(), np.zeros(6), scene.information)
    share = _area_share(p_before[:, 2])
    for width in WIDTHS:
        fit = scene.step(fit, width, share)
    agrees = scene.agrees(fit)
    for width in SHARP_WIDTHS:
        fit = scene.step(fit, width, agrees)
    residual, _ = _linearised(fit.T_now_before, p_before, uvd_now, now)
    with np.errstate(invalid="ignore"):
        static = np.asarray((np.abs(residual) < 3.0 * SIGMA_PX).all(axis=1)) & (agrees > 0.0)
    if static.sum() < FEWEST:
        return EgoMotion(told, prior_covariance(dt_s), np.zeros(len(p_before), dtype=np.bool_))
    return EgoMotion(fit.T_now_before, fit.covariance, static)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A motion on its way: the pose, its offset (6,) from what was told, and its information (6, 6)."""

    T_now_before: Array
    offset: Array
    information: Array

    @property
    def covariance(self) -> Array:
        return np.asarray(np.linalg.inv(self.information) + SYSTEMATIC)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Points (N, 3) before, their observations (N, 3) now, and the information (6, 6) of what was told."""

    p_before: Array
    uvd_now: Array
    now: Frame
    information: Array

    def step(self, fit: _Fit, width: float, votes: Array) -> _Fit:
        """Return a better fit: one Gauss-Newton step with a kernel of `width` sigmas and votes (N,)."""
        residual, J = _linearised(fit.T_now_before, self.p_before, self.uvd_now, self.now)
        size = np.sqrt(((residual / SIGMA_PX) ** 2).sum(axis=1))
        weight = np.where(np.isfinite(size), 1.0 / (1.0 + (size / width) ** 2) ** 2, 0.0) * votes
        scaled = np.where(np.isfinite(J), J, 0.0) / SIGMA_PX[:, None]
        information = self.information + np.einsum("n,nij,nik->jk", weight, scaled, scaled)
        gradient = np.einsum("n,nij,ni->j", weight, scaled, np.nan_to_num(residual / SIGMA_PX))
        change = np.linalg.solve(information, gradient - self.information @ fit.offset)
        T = pose(R_from_rotvec(change[:3]), change[3:]) @ fit.T_now_before
        return _Fit(T, fit.offset + change, information)

    def agrees(self, fit: _Fit) -> Array:
        """Return (N,) 1.0 for points that the fit explains within its own uncertainty and their noise, else 0.0."""
        residual, J = _linearised(fit.T_now_before, self.p_before, self.uvd_now, self.now)
        with np.errstate(invalid="ignore"):
            return np.asarray(_squared_length(residual, J, fit.covariance, np.diag(SIGMA_PX**2)) < AGREES, dtype=float)


def surprise(
    T: Array, covariance: Array, steps: int, p_before: Array, uvd_now: Array, now: Frame, static: Mask
) -> tuple[Array, Array]:
    """Return how far (N, 3) pixels observations are from standing still, and how unlikely (N,) that is.

    The second is the squared Mahalanobis length; the noise is that of features followed over `steps` frames, of the
    baseline, and what `covariance` leaves open. What all `static` disparities have in common is taken out: the eyes
    do not expose at the same instant, and turning in between shifts the right image.
    """
    residual, J = _linearised(T, p_before, uvd_now, now)
    known = static & np.isfinite(residual[:, 2])
    if known.sum() >= FEWEST:
        residual[:, 2] -= np.median(residual[known, 2])
    residual = np.where(np.isfinite(residual), residual, 0.0)
    noise = np.tile(np.diag(SIGMA_PX * (0.5 + 0.5 * steps)) ** 2, (len(residual), 1, 1))
    stretch = SYNC_SHARE + now.baseline_sigma_m / now.baseline_m
    noise[:, 2, 2] += 2.0 * (stretch * uvd_now[:, 2]) ** 2
    return residual, _squared_length(residual, J, covariance, noise)


def _squared_length(residual: Array, J: Array, covariance: Array, noise: Array) -> Array:
    """Return the squared Mahalanobis length (N,) of residuals (N, 3), given the motion's covariance (6, 6) through J.

    `noise` (3, 3) or (N, 3, 3) is the points' own; NaN residuals stay NaN.
    """
    J = np.nan_to_num(J)
    S = np.einsum("nij,jk,nlk->nil", J, covariance, J) + noise
    solved = np.linalg.solve(S, residual[..., None])[..., 0]
    return np.asarray((residual * solved).sum(axis=1))


def _area_share(depth_m: Array) -> Array:
    """Return (N,) votes between 0 and 1 that grow with the fourth power of depth, up to the farthest half of the area.

    Squared since what is far stands for more area, and squared again since what is near pulls more pixels per metre.
    """
    known = np.sort(depth_m[np.isfinite(depth_m)])
    if not known.size:
        return np.ones_like(depth_m)
    area = np.cumsum(known**2)
    full_m = known[np.searchsorted(area, FULL_VOTE_AREA * area[-1])]
    return np.asarray(np.minimum(1.0, (np.nan_to_num(depth_m) / full_m) ** 4))


def _linearised(T: Array, p_before: Array, uvd_now: Array, now: Frame) -> tuple[Array, Array]:
    """Return residuals (N, 3) and how the predicted observations change with (turn, shift) (N, 3, 6)."""
    p_now = p_before @ T[:3, :3].T + T[:3, 3]
    p_now = np.where(p_now[:, 2:3] > 0.05, p_now, np.nan)
    to_pixels = now.derivative(p_now)
    turned = -np.stack([skew(p) for p in p_now]) if len(p_now) else np.zeros((0, 3, 3))
    J = np.concatenate([to_pixels @ turned, to_pixels], axis=2)
    return uvd_now - now.project(p_now), J
