"""Solver of a rig: one joint solve over all baselines with outlier rejection and a model of the rail.

The steps: an initial guess, a robust solve with the pose at every baseline free, removal of outliers, a rail model
fitted to those poses, and a last solve with the rail as prior. `solve_separately`, one solve per baseline, is the
reference it is compared with.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.solver import bundle_adjustment as bundle
from morpheyes_daemon.calibration.solver.bundle_adjustment import (
    CAMERA_UNKNOWNS,
    POSE_UNKNOWNS,
    Prior,
    RigState,
    Solution,
)
from morpheyes_daemon.calibration.solver.initial_guess import first_guess
from morpheyes_daemon.calibration.solver.outliers import Outlier, find_outliers, reject_outliers, without
from morpheyes_daemon.calibration.solver.rail_model import Rail, fit_rail, with_rail
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.transforms import Array, R_from_rotvec, pose

KNOT_SPACING_M = 0.012
"""Spacing of the interpolated baselines, metres; chosen: over it a straight segment of a rail with waves of a
decimetre is off by a hundredth of a pixel at most."""
_FIRST_SIGMA_PX = 0.3
"""Assumed corner noise of the first solve, pixels; chosen: the second solve uses the measured one."""
_OUTLIER_ROUNDS = 4
"""Most rounds of outlier rejection; chosen: each takes one solve."""
_CAMERA_SIGMA = {"alpha": 0.003, "k1": 1.0, "k2": 2.0, "k3": 0.02, "k4": 0.02, "k5": 3.0}
"""Prior sigmas of the lens coefficients about zero; chosen: the spread of real lenses, weak against any picture."""
_CENTRE_SHARE, _FOCAL_SHARE = 0.1, 1.0
"""Prior sigmas of the principal point over the image width, and of the focal length over its guess; chosen: weak."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A solved rig: observations used, solution, rail model (None for few baselines), outliers, stray corners."""

    observations: Observations
    solution: Solution
    rail: Rail | None
    outliers: tuple[Outlier, ...] = ()
    stray_corners: int = 0

    @property
    def poses(self) -> Array:
        """T_cam0_cam1 (M, 4, 4) of every baseline."""
        return np.array([pose(R_from_rotvec(p[:3]), p[3:]) for p in self.solution.state.stereo_poses])

    def knots(self) -> tuple[Array, Array]:
        """Return nominal baselines (K,) and poses (K, 4, 4) dense enough for ScLERP to follow the rail.

        They include the calibrated baselines; those in between come from the rail model, if there is one.
        """
        stereo_poses = self.solution.state.stereo_poses
        if self.rail is None:
            return self.nominal_m, self.poses
        steps = [
            np.linspace(a, b, int(np.ceil((b - a) / KNOT_SPACING_M)), endpoint=False)
            for a, b in itertools.pairwise(self.nominal_m)
        ]
        nominal = np.concatenate([*steps, self.nominal_m[-1:]])
        vectors = self.rail.at(stereo_poses, self.solution.covariance[CAMERA_UNKNOWNS:, CAMERA_UNKNOWNS:], nominal)
        return nominal, np.array([pose(R_from_rotvec(v[:3]), v[3:]) for v in vectors])

    @property
    def lengths_m(self) -> Array:
        """Solved distance between the cameras (M,)."""
        return np.asarray(np.linalg.norm(self.solution.state.stereo_poses[:, 3:], axis=1))

    @property
    def nominal_m(self) -> Array:
        """Nominal baselines (M,); a fixed rig without a name gets its solved length."""
        nominal = self.observations.nominal_m
        return np.where(np.isfinite(nominal), nominal, np.round(self.lengths_m, 4))

    @property
    def rms_px(self) -> Array:
        """Rms of the corner distance per baseline (M,), both cameras, outliers aside."""
        squared = np.sum(self.solution.residual_px**2, axis=-1)
        numbers = range(len(self.observations.nominal_m))
        return np.array([np.sqrt(np.nanmean(squared[self.observations.baseline == i])) for i in numbers])


def calibrate(observations: Observations, progress: Progress = silent) -> Calibration:
    """Return the least-squares rig of all observations; raises InputError when they are too few."""
    progress("first guess", 0, 3)
    start, usable = first_guess(observations)
    kept = observations.subset(usable)
    prior = camera_prior(kept, start)
    progress("joint solve", 1, 3)
    kept, solution, outliers, stray_corners = _robust(kept, start, prior)
    progress("fitting the rail", 2, 3)
    rail = _rail(kept, solution)
    if rail is not None:
        solution = bundle.solve(kept, solution.state, with_rail(prior, rail), solution.sigma_px)
    progress("fitting the rail", 3, 3)
    return Calibration(kept, solution, rail, tuple(outliers), stray_corners)


def resolve(calibration: Calibration, keep: NDArray[np.bool_]) -> Calibration:
    """Return the calibration from the views with a True in `keep` (V,), starting at the full solution.

    For cross-validation: baselines without a view are left out, and the rail is fitted again.
    """
    chosen = sorted(set(calibration.observations.baseline[keep].tolist()))
    before = calibration.solution.state
    observations = calibration.observations.subset(keep).at_baselines(chosen)
    state = RigState(before.cameras, before.stereo_poses[chosen], before.R_cam0_board[keep], before.t_cam0_board_m[keep])
    prior = camera_prior(observations, state)
    solution = bundle.solve(observations, state, prior, calibration.solution.sigma_px)
    rail = _rail(observations, solution)
    if rail is not None:
        solution = bundle.solve(observations, solution.state, with_rail(prior, rail), calibration.solution.sigma_px)
    return Calibration(observations, solution, rail)


def solve_separately(observations: Observations) -> list[Calibration]:
    """Return one calibration per baseline, cameras included, as a tool for fixed rigs would solve them."""
    return [calibrate(observations.at_baselines([number])) for number in range(len(observations.nominal_m))]


def camera_prior(observations: Observations, state: RigState) -> Prior:
    """Return the weak prior of both cameras; the poses between them are free."""
    width, height = observations.size
    count = CAMERA_UNKNOWNS + POSE_UNKNOWNS * len(state.stereo_poses)
    mean, sigma = np.zeros(count), np.full(count, np.inf)
    focal = float(np.mean(state.cameras[:, :2]))
    for side in (0, 1):
        mean[10 * side : 10 * side + 4] = focal, focal, (width - 1) / 2, (height - 1) / 2
        spread = [_FOCAL_SHARE * focal] * 2 + [_CENTRE_SHARE * width] * 2
        sigma[10 * side : 10 * side + 10] = spread + list(_CAMERA_SIGMA.values())
    return Prior(mean, np.diag(1.0 / sigma**2))


def _robust(
    observations: Observations, start: RigState, prior: Prior
) -> tuple[Observations, Solution, list[Outlier], int]:
    """Return observations and solution after removal of outliers, the outliers, and the number of stray corners."""
    rough = bundle.solve(observations, start, prior, _FIRST_SIGMA_PX)
    solution = bundle.solve(observations, rough.state, prior, rough.sigma_px)
    named: list[Outlier] = []
    stray_corners = 0
    for _ in range(_OUTLIER_ROUNDS):
        observations, more = reject_outliers(observations, solution)
        if more:
            solution = bundle.solve(observations, solution.state, prior, solution.sigma_px)
        found = find_outliers(observations, solution)
        if not found and not more:
            break
        stray_corners, named = stray_corners + more, named + found
        observations, kept = without(observations, found)
        state = solution.state
        state = replace(state, R_cam0_board=state.R_cam0_board[kept], t_cam0_board_m=state.t_cam0_board_m[kept])
        solution = bundle.solve(observations, state, prior, solution.sigma_px)
    return observations, solution, named, stray_corners


def _rail(observations: Observations, solution: Solution) -> Rail | None:
    return fit_rail(
        observations.nominal_m, solution.state.stereo_poses, solution.covariance[CAMERA_UNKNOWNS:, CAMERA_UNKNOWNS:]
    )
