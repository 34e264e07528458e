"""From corners to a rig: one joint solve over all baselines, outliers taken out, the rail's motion learned.

The steps: a first guess, a robust solve with every baseline's pose free, outliers named and removed, the rail fitted
to those free poses, and a last solve with the rail as prior. `solve_separately` is the ten-separate-solves way that
this is measured against.
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
"""The rail's waves are decimetres long: over this, a straight piece is off by a hundredth of a pixel at most."""
_FIRST_SIGMA_PX = 0.3
_OUTLIER_ROUNDS = 4
_CAMERA_SIGMA = {"alpha": 0.003, "k1": 1.0, "k2": 2.0, "k3": 0.02, "k4": 0.02, "k5": 3.0}
"""How far lens coefficients of real cameras lie from zero; decides only what the pictures do not tell."""
_CENTRE_SHARE = 0.1
_FOCAL_SHARE = 1.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """A solved rig with all it was solved from: views kept, solution, rail (None for few baselines), outliers."""

    observations: Observations
    solution: Solution
    rail: Rail | None
    outliers: tuple[Outlier, ...] = ()
    stray_corners: int = 0

    @property
    def poses(self) -> Array:
        """T_cam0_cam1 (M, 4, 4) of every baseline."""
        return np.array([pose(R_from_rotvec(p[:3]), p[3:]) for p in self.solution.state.between])

    def knots(self) -> tuple[Array, Array]:
        """Return nominal baselines (K,) and poses (K, 4, 4) dense enough for ScLERP to follow the rail between.

        They hold the calibrated baselines themselves; those between come from the rail, where there is one.
        """
        between = self.solution.state.between
        if self.rail is None:
            return self.nominal_m, self.poses
        steps = [
            np.linspace(a, b, int(np.ceil((b - a) / KNOT_SPACING_M)), endpoint=False)
            for a, b in itertools.pairwise(self.nominal_m)
        ]
        nominal = np.concatenate([*steps, self.nominal_m[-1:]])
        vectors = self.rail.at(between, self.solution.covariance[CAMERA_UNKNOWNS:, CAMERA_UNKNOWNS:], nominal)
        return nominal, np.array([pose(R_from_rotvec(v[:3]), v[3:]) for v in vectors])

    @property
    def lengths_m(self) -> Array:
        """Solved distance between the cameras (M,)."""
        return np.asarray(np.linalg.norm(self.solution.state.between[:, 3:], axis=1))

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
    """Return the rig that explains all observations best; raises InputError when they are too few."""
    progress("first guess", 0, 3)
    start, usable = first_guess(observations)
    kept = observations.subset(usable)
    prior = camera_prior(kept, start)
    progress("joint solve", 1, 3)
    kept, solution, outliers, stray_corners = _robust(kept, start, prior)
    progress("learning the rail", 2, 3)
    rail = _rail(kept, solution)
    if rail is not None:
        solution = bundle.solve(kept, solution.state, with_rail(prior, rail), solution.sigma_px)
    progress("learning the rail", 3, 3)
    return Calibration(kept, solution, rail, tuple(outliers), stray_corners)


def resolve(calibration: Calibration, keep: NDArray[np.bool_]) -> Calibration:
    """Solve again from the chosen views (V,) only, starting where the full solve ended; for cross-validation.

    Baselines without a view are left out, and the rail is learned anew without them.
    """
    chosen = sorted(set(calibration.observations.baseline[keep].tolist()))
    before = calibration.solution.state
    observations = calibration.observations.subset(keep).at_baselines(chosen)
    state = RigState(before.cameras, before.between[chosen], before.R_cam0_board[keep], before.t_cam0_board_m[keep])
    prior = camera_prior(observations, state)
    solution = bundle.solve(observations, state, prior, calibration.solution.sigma_px)
    rail = _rail(observations, solution)
    if rail is not None:
        solution = bundle.solve(observations, solution.state, with_rail(prior, rail), calibration.solution.sigma_px)
    return Calibration(observations, solution, rail)


def solve_separately(observations: Observations) -> list[Calibration]:
    """Solve every baseline by itself, cameras included: what a tool for fixed rigs would do."""
    return [calibrate(observations.at_baselines([number])) for number in range(len(observations.nominal_m))]


def camera_prior(observations: Observations, state: RigState) -> Prior:
    """Return the weak prior of both cameras; the poses between the cameras are free."""
    width, height = observations.size
    count = CAMERA_UNKNOWNS + POSE_UNKNOWNS * len(state.between)
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
    """Solve and take stray corners and outlier pictures out until none is left."""
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
        observations.nominal_m, solution.state.between, solution.covariance[CAMERA_UNKNOWNS:, CAMERA_UNKNOWNS:]
    )
