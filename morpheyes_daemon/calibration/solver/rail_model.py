"""Motion model of the linear rail: the right camera moves along a line, and its other components change smoothly.

Each of the six components of T_cam0_cam1 is a low-order polynomial of the nominal baseline plus a scatter of its own
(play, repeatability of the servo). Order and scatter are chosen per component by how well the other baselines
predict the one left out (leave-one-out predictive density of a Gaussian process with a flat prior on the
polynomial; Rasmussen and Williams, 2006, sections 2.7 and 5.4.2), so a rail that is not straight is not
smoothed. The result is a quadratic prior on the unknowns of the joint solve, weighed against the pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.calibration.solver.bundle_adjustment import CAMERA_UNKNOWNS, POSE_UNKNOWNS, Prior
from morpheyes_daemon.transforms import Array

COMPONENTS = ("rotation_x", "rotation_y", "rotation_z", "x", "y", "z")
FEWEST_BASELINES = 4
"""Fewest baselines for a rail model; chosen: with three a line leaves one degree of freedom."""
_HIGHEST_ORDER = 4
"""Highest polynomial order; chosen: higher ones oscillate between ten baselines."""
_SCATTER_RAD = _SCATTER_M = np.geomspace(1e-6, 1e-2, 25)
"""Candidates of the scatter, rad and metres; chosen: from far below to far above any servo, 1.5 times apart."""


@dataclass(frozen=True)
class RailComponent:
    """Model of one pose component along the rail: polynomial order and scatter about it (rad or m, one sigma)."""

    name: str
    order: int
    scatter: float


@dataclass(frozen=True, eq=False)
class Rail:
    """The motion model of all six components for the nominal baselines (M,) it was fitted at."""

    nominal_m: Array
    components: tuple[RailComponent, ...]

    def information(self) -> Array:
        """Return the information (6 M, 6 M) on the stacked poses: deviation from the best polynomial over scatter."""
        count = len(self.nominal_m)
        information = np.zeros((count, POSE_UNKNOWNS, count, POSE_UNKNOWNS))
        for index, component in enumerate(self.components):
            basis = polynomial(self.nominal_m, self.nominal_m, component.order)
            orthonormal, _ = np.linalg.qr(basis)
            away = np.eye(count) - orthonormal @ orthonormal.T
            information[:, index, :, index] = away / component.scatter**2
        return information.reshape(count * POSE_UNKNOWNS, count * POSE_UNKNOWNS)

    def at(self, poses: Array, covariance: Array, nominal_m: Array) -> Array:
        """Return the pose vectors (K, 6) at other nominal baselines (K,) from solved poses (M, 6).

        The polynomial is evaluated there, and the deviations of the neighbours from it are interpolated linearly.
        `covariance` (6 M, 6 M) is that of the poses.
        """
        count = len(self.nominal_m)
        blocks = covariance.reshape(count, POSE_UNKNOWNS, count, POSE_UNKNOWNS)
        predicted = np.empty((len(nominal_m), POSE_UNKNOWNS))
        for index, component in enumerate(self.components):
            basis = polynomial(self.nominal_m, self.nominal_m, component.order)
            spread = blocks[:, index, :, index] + np.eye(count) * component.scatter**2
            weighted = np.linalg.solve(spread, basis)
            coefficients = np.linalg.solve(basis.T @ weighted, weighted.T @ poses[:, index])
            away = poses[:, index] - basis @ coefficients
            smooth = polynomial(nominal_m, self.nominal_m, component.order) @ coefficients
            predicted[:, index] = smooth + np.interp(nominal_m, self.nominal_m, away)
        return predicted


def fit_rail(nominal_m: Array, poses: Array, covariance: Array) -> Rail | None:
    """Return the rail model that predicts left-out baselines best, None for fewer than four baselines (M,).

    `poses` (M, 6) are solved without a rail model, `covariance` (6 M, 6 M) is theirs with common errors (Rasmussen and
    Williams 2006, sections 2.7 and 5.4.2).
    """
    count = len(nominal_m)
    if count < FEWEST_BASELINES:
        return None
    blocks = covariance.reshape(count, POSE_UNKNOWNS, count, POSE_UNKNOWNS)
    components = tuple(
        _fit(name, nominal_m, poses[:, index], blocks[:, index, :, index], _SCATTER_RAD if index < 3 else _SCATTER_M)
        for index, name in enumerate(COMPONENTS)
    )
    return Rail(nominal_m, components)


def with_rail(prior: Prior, rail: Rail) -> Prior:
    """Return the prior of the cameras with the rail's information on the poses added."""
    information = prior.information.copy()
    information[CAMERA_UNKNOWNS:, CAMERA_UNKNOWNS:] += rail.information()
    return Prior(prior.mean, information)


def polynomial(nominal_m: Array, fitted_m: Array, order: int) -> Array:
    """Return Chebyshev polynomials 0..order (n, order + 1) of baselines (n,) scaled to the range of `fitted_m` (M,)."""
    low, high = float(fitted_m.min()), float(fitted_m.max())
    scaled = (2.0 * nominal_m - low - high) / (high - low)
    return np.asarray(np.polynomial.chebyshev.chebvander(scaled, order))


def _fit(name: str, nominal_m: Array, values: Array, covariance: Array, scatters: Array) -> RailComponent:
    orders = range(0 if name != "x" else 1, min(_HIGHEST_ORDER, len(nominal_m) - 3) + 1)
    choices = [(order, float(scatter)) for order in orders for scatter in scatters]
    scores = [_left_out_density(nominal_m, values, covariance, *choice) for choice in choices]
    order, scatter = choices[int(np.argmax(scores))]
    return RailComponent(name, order, scatter)


def _left_out_density(nominal_m: Array, values: Array, covariance: Array, order: int, scatter: float) -> float:
    """Return the summed log density of each value given all others, in closed form (Rasmussen and Williams, 5.4.2)."""
    basis = polynomial(nominal_m, nominal_m, order)
    inverse = np.linalg.inv(covariance + scatter**2 * np.eye(len(values)))
    weighted = inverse @ basis
    projected = inverse - weighted @ np.linalg.solve(basis.T @ weighted, weighted.T)
    precision = np.diag(projected)
    error = projected @ values / precision
    return float(0.5 * np.sum(np.log(precision) - precision * error**2))
