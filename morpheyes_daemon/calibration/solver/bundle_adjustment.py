"""Bundle adjustment of a stereo rig: sparse Levenberg-Marquardt with a Schur complement.

Unknown are the two cameras (shared by all baselines), the pose between them at each baseline, and the board's pose
in each view. A view touches 20 + 6 + 6 of them, so the normal equations are small dense blocks per view; the
board poses are eliminated first (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6) and a
system of 20 + 6 M unknowns remains. Prior knowledge enters as a quadratic on those. Files, rails and
outliers are handled elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.solver.projection import project
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.transforms import Array, R_from_rotvec, skew

CAMERA_UNKNOWNS, POSE_UNKNOWNS = 20, 6
"""Unknowns of the two cameras and of one pose; shared unknowns are the cameras, then one pose (rotation vector, metres)
per baseline."""
HUBER_SIGMAS = 3.0
"""Residual in sigmas from which the loss is linear (Huber 1964); chosen: 99.7 % of a Gaussian is below."""
_STEPS = 60
"""Most Levenberg-Marquardt steps."""
_FLAT = 1e-9
"""Relative decrease of the cost that ends a solve."""
_DAMPING, _DAMPING_FACTOR, _DAMPING_LIMITS = 1e-3, 10.0, (1e-12, 1e12)
"""Initial damping of Levenberg-Marquardt, its factor after a step, and its limits (Marquardt 1963); chosen: usual."""
_MAD_TO_SIGMA = 0.6745
"""Median absolute value of a standard normal variable."""
_NOISE_FLOOR_PX = 1e-6
"""Least corner noise, pixels; chosen: keeps exact data solvable."""


@dataclass(frozen=True, eq=False)
class RigState:
    """Values of all unknowns: `cameras` (2, 10), `stereo_poses` (M, 6), board poses T_cam0_board (V, 3, 3), (V, 3).

    `stereo_poses` is T_cam0_cam1 as rotation vector (rad) and translation (m).
    """

    cameras: Array
    stereo_poses: Array
    R_cam0_board: Array
    t_cam0_board_m: Array

    @property
    def shared(self) -> Array:
        """The unknowns that views share (20 + 6 M,)."""
        return np.concatenate([self.cameras.ravel(), self.stereo_poses.ravel()])


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of the G = 20 + 6 M shared unknowns, cost (x - mean)^T information (x - mean); (G,) and (G, G)."""

    mean: Array
    information: Array

    def cost(self, shared: Array) -> float:
        """Return the cost of shared unknowns (G,)."""
        away = shared - self.mean
        return float(np.sum(away * (self.information @ away)))


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved rig: the state, the noise of one corner coordinate, and the covariance of the shared unknowns.

    `covariance` (20 + 6 M, 20 + 6 M) includes the prior; `residual_px` (V, 2, N, 2) is detected minus predicted, NaN
    where unseen.
    """

    state: RigState
    sigma_px: float
    covariance: Array
    residual_px: Array


def solve(observations: Observations, start: RigState, prior: Prior, sigma_px: float) -> Solution:
    """Return the minimum of the Huber loss of the reprojection error and the prior, from the initial state `start`.

    `sigma_px` is the corner noise that scales the loss; the returned sigma is measured on the residuals (Triggs et al.
    2000, section 6).
    """
    state, damping = start, _DAMPING
    system = _linearise(observations, state, sigma_px)
    cost = system.cost + prior.cost(state.shared)
    for _ in range(_STEPS):
        trial = _step(system, state, prior, damping)
        trial_system = _linearise(observations, trial, sigma_px)
        trial_cost = trial_system.cost + prior.cost(trial.shared)
        if not trial_cost < cost:
            damping *= _DAMPING_FACTOR
            if damping > _DAMPING_LIMITS[1]:
                break
            continue
        flat = cost - trial_cost <= _FLAT * cost
        state, system, cost, damping = trial, trial_system, trial_cost, max(damping * 0.1, _DAMPING_LIMITS[0])
        if flat:
            break
    return _solution(observations, system, state, prior, sigma_px)


def residuals(observations: Observations, state: RigState) -> Array:
    """Return detected minus predicted pixels (V, 2 cameras, N, 2), NaN where unseen."""
    p_cam0, p_cam1, *_ = _points(observations, state)
    predicted = np.stack([project(p_cam0, state.cameras[0])[0], project(p_cam1, state.cameras[1])[0]], axis=1)
    return np.stack([observations.left, observations.right], axis=1) - predicted


def noise_px(residual: Array, unknowns: int = 0) -> float:
    """Return one sigma of a corner coordinate, pixels, from the median absolute residual (V, 2, N, 2)."""
    seen = np.abs(residual[np.isfinite(residual)])
    freedom = max(seen.size - unknowns, 1) / max(seen.size, 1)
    return max(float(np.median(seen)) / _MAD_TO_SIGMA / math.sqrt(freedom), _NOISE_FLOOR_PX)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations in units of sigma: `shared` (G, G), board poses (V, 6, 6) and what couples them."""

    cost: float
    shared: Array
    shared_gradient: Array
    coupling: Array
    own: Array
    own_gradient: Array
    columns: NDArray[np.intp]


def _points(observations: Observations, state: RigState) -> tuple[Array, Array, Array, Array]:
    """Return board points in cam0 and cam1 (V, N, 3), their arm from the board's origin and from cam1 (V, N, 3)."""
    arm = observations.board.points_m @ np.swapaxes(state.R_cam0_board, 1, 2)
    p_cam0 = arm + state.t_cam0_board_m[:, None]
    rotation = np.array([R_from_rotvec(pose[:3]) for pose in state.stereo_poses])[observations.baseline]
    from_cam1 = p_cam0 - state.stereo_poses[observations.baseline, None, 3:]
    return p_cam0, from_cam1 @ rotation, arm, from_cam1


def _linearise(observations: Observations, state: RigState, sigma_px: float) -> _System:
    jacobian, residual = _jacobian(observations, state)
    weight, cost = _huber(residual / sigma_px)
    scale = np.sqrt(weight)[..., None] / sigma_px
    views = observations.view_count
    rows = (residual * scale).reshape(views, -1, 1)
    matrix = (jacobian * scale[..., None]).reshape(views, -1, jacobian.shape[-1])
    transposed = np.swapaxes(matrix, 1, 2)
    normal, gradient = transposed @ matrix, (transposed @ rows)[..., 0]
    columns = _columns(observations.baseline)
    size = CAMERA_UNKNOWNS + POSE_UNKNOWNS * len(state.stereo_poses)
    shared, shared_gradient = np.zeros((size, size)), np.zeros(size)
    cut = CAMERA_UNKNOWNS + POSE_UNKNOWNS
    np.add.at(shared, (columns[:, :, None], columns[:, None, :]), normal[:, :cut, :cut])
    np.add.at(shared_gradient, columns, gradient[:, :cut])
    return _System(
        cost, shared, shared_gradient, normal[:, :cut, cut:], normal[:, cut:, cut:], gradient[:, cut:], columns
    )


def _columns(baseline: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the indices (V, 26) of the shared unknowns of each view."""
    cameras = np.broadcast_to(np.arange(CAMERA_UNKNOWNS), (len(baseline), CAMERA_UNKNOWNS))
    return np.concatenate(
        [cameras, CAMERA_UNKNOWNS + POSE_UNKNOWNS * baseline[:, None] + np.arange(POSE_UNKNOWNS)], axis=1
    )


def _jacobian(observations: Observations, state: RigState) -> tuple[Array, Array]:
    """Return d predicted / d unknowns of a view (V, 2, N, 2, 32) and the residual (V, 2, N, 2), 0 where unseen."""
    p_cam0, p_cam1, arm, from_cam1 = _points(observations, state)
    views, corners = p_cam0.shape[:2]
    jacobian = np.zeros((views, 2, corners, 2, CAMERA_UNKNOWNS + 2 * POSE_UNKNOWNS))
    R_cam1_cam0, d_turn = _rotation_jacobians(state.stereo_poses)
    R_cam1_cam0, d_turn = R_cam1_cam0[observations.baseline], d_turn[observations.baseline]

    left, jacobian[:, 0, :, :, :10], d_left = project(p_cam0, state.cameras[0])
    right, jacobian[:, 1, :, :, 10:20], d_right = project(p_cam1, state.cameras[1])
    d_right_cam0 = d_right @ R_cam1_cam0[:, None]
    jacobian[:, 1, :, :, 20:23] = (d_right_cam0 @ _skews(from_cam1)) @ d_turn[:, None]
    jacobian[:, 1, :, :, 23:26] = -d_right_cam0
    for side, d_point in ((0, d_left), (1, d_right_cam0)):
        jacobian[:, side, :, :, 26:29] = -d_point @ _skews(arm)
        jacobian[:, side, :, :, 29:32] = d_point
    residual = np.stack([observations.left - left, observations.right - right], axis=1)
    unseen = ~np.isfinite(residual[..., 0])
    residual[unseen] = 0.0
    jacobian[unseen] = 0.0
    return jacobian, residual


def _rotation_jacobians(stereo_poses: Array) -> tuple[Array, Array]:
    """Return R_cam1_cam0 (M, 3, 3) and the left Jacobian (M, 3, 3) of each rotation vector.

    With them d(R_cam1_cam0 q)/d(rotation vector) = R_cam1_cam0 [q]x J_left.
    """
    rotations, jacobians = [], []
    for r in stereo_poses[:, :3]:
        angle = float(np.linalg.norm(r))
        cross = skew(r)
        a, b = 0.5, 1.0 / 6.0
        if angle > 1e-6:
            a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
        rotations.append(R_from_rotvec(-r))
        jacobians.append(np.eye(3) + a * cross + b * cross @ cross)
    return np.array(rotations), np.array(jacobians)


def _skews(v: Array) -> Array:
    """Return the cross-product matrices (..., 3, 3) of v (..., 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def _huber(residual_sigmas: Array) -> tuple[Array, float]:
    """Return the weight of each corner (V, 2, N) and the total robust cost of residuals (V, 2, N, 2) in sigmas."""
    length = np.linalg.norm(residual_sigmas, axis=-1)
    beyond = length > HUBER_SIGMAS
    weight = np.where(beyond, HUBER_SIGMAS / np.maximum(length, HUBER_SIGMAS), 1.0)
    cost = np.where(beyond, 2.0 * HUBER_SIGMAS * length - HUBER_SIGMAS**2, length**2)
    return weight, float(np.sum(cost))


def _step(system: _System, state: RigState, prior: Prior, damping: float) -> RigState:
    shared = system.shared + prior.information
    gradient = system.shared_gradient + prior.information @ (prior.mean - state.shared)
    damped = shared + damping * np.diag(np.diag(shared))
    own = system.own + damping * np.eye(POSE_UNKNOWNS) * np.einsum("vii->vi", system.own)[:, None, :]
    reduced, right = _reduce(system, damped, gradient, own)
    d_shared = _solve_scaled(reduced, right)
    touched = np.einsum("vgp,vg->vp", system.coupling, d_shared[system.columns])
    d_own = np.linalg.solve(own, (system.own_gradient - touched)[..., None])[..., 0]
    return _moved(state, d_shared, d_own)


def _reduce(system: _System, shared: Array, gradient: Array, own: Array) -> tuple[Array, Array]:
    """Return the normal equations of the shared unknowns with the board poses eliminated."""
    inverse_coupling = np.linalg.solve(own, np.swapaxes(system.coupling, 1, 2))
    inverse_gradient = np.linalg.solve(own, system.own_gradient[..., None])
    reduced, right = shared.copy(), gradient.copy()
    columns = system.columns
    np.subtract.at(reduced, (columns[:, :, None], columns[:, None, :]), system.coupling @ inverse_coupling)
    np.subtract.at(right, columns, (system.coupling @ inverse_gradient)[..., 0])
    return reduced, right


def _solve_scaled(matrix: Array, right: Array) -> Array:
    """Return the solution (G,) with the matrix scaled to unit diagonal: its unknowns differ by many powers of ten."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(scale * np.linalg.solve(matrix * np.outer(scale, scale), right * scale))


def _moved(state: RigState, d_shared: Array, d_own: Array) -> RigState:
    turns = np.array([R_from_rotvec(turn) for turn in d_own[:, :3]])
    return replace(
        state,
        cameras=state.cameras + d_shared[:CAMERA_UNKNOWNS].reshape(2, 10),
        stereo_poses=state.stereo_poses + d_shared[CAMERA_UNKNOWNS:].reshape(-1, POSE_UNKNOWNS),
        R_cam0_board=turns @ state.R_cam0_board,
        t_cam0_board_m=state.t_cam0_board_m + d_own[:, 3:],
    )


def _solution(observations: Observations, system: _System, state: RigState, prior: Prior, sigma_px: float) -> Solution:
    reduced, _ = _reduce(system, system.shared + prior.information, system.shared_gradient, system.own)
    scale = 1.0 / np.sqrt(np.diag(reduced))
    covariance = np.linalg.inv(reduced * np.outer(scale, scale)) * np.outer(scale, scale)
    residual = residuals(observations, state)
    measured = noise_px(residual, len(state.shared) + POSE_UNKNOWNS * observations.view_count)
    return Solution(state, measured, covariance * max(1.0, (measured / sigma_px) ** 2), residual)
