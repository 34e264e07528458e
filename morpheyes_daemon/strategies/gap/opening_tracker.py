"""Opening tracker: position of an opening now and in the next seconds, in the autopilot's local frame.

A standing opening seems to drift, since the autopilot's position does; a moving one oscillates, and when some seconds
show that the motion is periodic, a sinusoid is fitted, which predicts further. The measured position has an error
proportional to range, because the camera's direction on the body is known to half a degree and the attitude errs; a
Kalman filter separates it from the position as the range shrinks.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.transforms import Array

POSITION_WALK_M_SQRT_S = 0.025
"""Random walk of an opening's apparent position. Unit: m/sqrt(s).

Chosen: the autopilot's own position drifts by 0.02; larger averages over less time."""

POINTING_RAD = 0.008
"""One sigma of the camera's direction on the body.

Chosen: half a degree, the accuracy of a mount measured by hand; smaller keeps its error in the position."""

POINTING_WALK_RAD_SQRT_S = 0.004
"""Random walk of the pointing error, from the attitude's. Unit: rad/sqrt(s).

Chosen: an EKF's attitude changes by a quarter of a degree in a second; larger forgets the constant part."""

MOVING_M_S, MOVING_M_S2 = 0.5, 0.4
"""One sigma of the speed and acceleration of a moving wall.

Chosen: those of the worlds with moving gaps; smaller lags, larger follows noise."""

HISTORY_S = 26.0
"""Measurements are kept for this time.

Chosen: the error of the period falls with the history to the power of 1.5, so several periods must be in it; longer
would average over changes of the motion."""

MIN_OSCILLATION_S, MIN_MEASUREMENTS = 3.0, 10
"""Time and number of measurements from which a sinusoid is fitted. Unit: s, measurements.

Chosen: a half period of slow walls; less fits noise."""

PERIODS_S = np.geomspace(2.5, 16.0, 48)
"""Periods (48,) that are tried; the best is refined between its neighbours.

Chosen: those that a vehicle can wait for; 4 % apart, so that no minimum is missed."""

MAX_PERIODS_PER_HISTORY = 1.6
"""Longest period tried, as a multiple of the time observed. Unit: none.

Chosen: less than a period still shows its turning points; longer periods fit a straight motion."""

REFINEMENTS, REFINED_PERIODS = 3, 9
"""Rounds of the search for the period, and periods tried in each but the first. Unit: counts.

Chosen: resolves the period to a quarter of a percent."""

POINTING_CORRELATION_S = 1.0
"""Correlation time of the attitude's error.

Chosen: of the order of an EKF's; longer takes a slow error for motion."""

AMPLITUDE_SIGMA_M = 3.0
"""One sigma of an oscillation's amplitude before any measurement.

Chosen: wider than any gap's motion, so that it only stabilises the fit."""

MAX_RMS_M, RECENT_S = 0.10, 5.0
"""A sinusoid is accepted when its weighted residual is below this; the weight decays over the second.

Chosen: drift of some seconds included; lower refuses real oscillations, higher accepts irregular motion."""

MIN_SPREAD_MEASUREMENTS = 8
"""Measurements from which their spread is computed. Unit: measurements.

Chosen: the 10th and 90th percentile need about ten."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Position, velocity and acceleration (3,) at one time, in ned unless stated, and the position's sigma."""

    p_m: Array
    v_m_s: Array
    a_m_s2: Array
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PointMeasurement:
    """One measurement of the point: position (3,) and one sigma (3,) along, across and down, metres, and the range."""

    t_ns: int
    p_m: Array
    sigma_m: Array
    range_m: float


class PointTracker:
    """A point measured repeatedly, with one Kalman filter per axis; times must not go back.

    Axes are along (x), across (y) and down (z) for a heading: a wall moves across and down, never along. The state of
    each is position, velocity and pointing error. A wall's heading is tracked as the y axis of such a point.
    """

    def __init__(self, yaw_rad: float = 0.0, walk_sqrt_s: float = POSITION_WALK_M_SQRT_S) -> None:
        self._walk_sqrt_s = walk_sqrt_s
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        self._R_ned_wall: Array = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self._measured: deque[PointMeasurement] = deque()
        self._x: Array = np.zeros((3, 3))
        self._P: Array = np.zeros((3, 3, 3))
        self._t_ns = 0
        self._oscillation: Oscillation | None = None
        self._is_moving = False

    @property
    def count(self) -> int:
        """Number of measurements in the last HISTORY_S."""
        return len(self._measured)

    @property
    def oscillation(self) -> Oscillation | None:
        """The fitted periodic motion, None when there is none."""
        return self._oscillation

    @property
    def is_moving(self) -> bool:
        """Whether the point is modelled as moving; see `set_moving`."""
        return self._is_moving

    def set_moving(self) -> None:
        """Model the point as moving from now on."""
        if not self._is_moving:
            self._is_moving = True
            self._P[1:, 1, 1] = MOVING_M_S**2

    def update(self, t_ns: int, p_ned_m: Array, sigma_m: Array, range_m: float = 0.0) -> None:
        """Add a measured position (3,), ned metres, one sigma (3,), metres along, across and down, and its range."""
        measurement = PointMeasurement(t_ns, self._R_ned_wall.T @ p_ned_m, sigma_m, range_m)
        if self._measured:
            self._filter(measurement)
        else:
            self._begin(measurement)
        self._measured.append(measurement)
        while self._measured[0].t_ns < t_ns - HISTORY_S * S:
            self._measured.popleft()
        if self._is_moving:
            self._oscillation = fit_oscillation(list(self._measured), self._walk_sqrt_s)

    def at(self, t_ns: int) -> Motion:
        """Return the position (ned) at a present or future time."""
        x, P = self._predicted(t_ns)
        p, v, a, sigma_m = x[:, 0], x[:, 1], np.zeros(3), math.sqrt(float(P[1:, 0, 0].max()))
        if self._oscillation is not None:
            fitted = self._oscillation.at(t_ns)
            p, v, a = np.array([p[0], *fitted.p_m[1:]]), fitted.v_m_s, fitted.a_m_s2
            sigma_m = self._oscillation.rms_m
        R = self._R_ned_wall
        return Motion(R @ p, R @ v, R @ a, sigma_m)

    def _begin(self, measurement: PointMeasurement) -> None:
        """Start at a measurement, whose error is correlated with the pointing error."""
        r = measurement.range_m
        self._x = np.zeros((3, 3))
        self._x[:, 0] = measurement.p_m
        self._P = np.zeros((3, 3, 3))
        self._P[:, 0, 0] = measurement.sigma_m**2
        self._P[1:] += POINTING_RAD**2 * np.array([[r * r, 0.0, -r], [0.0, 0.0, 0.0], [-r, 0.0, 1.0]])
        self._t_ns = measurement.t_ns

    def _filter(self, measurement: PointMeasurement) -> None:
        self._x, self._P = self._predicted(measurement.t_ns)
        H = np.array([[1.0, 0.0, 0.0]] + 2 * [[1.0, 0.0, measurement.range_m]])
        PH = np.einsum("kij,kj->ki", self._P, H)
        gain = PH / (np.einsum("ki,ki->k", H, PH) + measurement.sigma_m**2)[:, None]
        innovation = measurement.p_m - np.einsum("ki,ki->k", H, self._x)
        self._x = self._x + gain * innovation[:, None]
        self._P = self._P - gain[:, :, None] * PH[:, None, :]
        self._t_ns = measurement.t_ns

    def _predicted(self, t_ns: int) -> tuple[Array, Array]:
        """Return states (3, 3) and covariances (3, 3, 3) of the three axes at a time."""
        dt = max(0.0, (t_ns - self._t_ns) / S)
        noise = np.zeros((3, 3, 3))
        noise[:, 0, 0] = self._walk_sqrt_s**2 * dt
        noise[1:, 2, 2] = POINTING_WALK_RAD_SQRT_S**2 * dt
        F = np.array([np.eye(3)] * 3)
        if self._is_moving:
            F[1:, 0, 1] = dt
            step = MOVING_M_S2 * np.array([dt * dt / 2, dt, 0.0])
            noise[1:] += np.outer(step, step)
        return np.einsum("kij,kj->ki", F, self._x), np.asarray(F @ self._P @ F.transpose(0, 2, 1) + noise)

    @property
    def centre(self) -> Array:
        """Mean position (3,), metres along, across and down: the oscillation's centre, or the measurements' mean."""
        if self._oscillation is not None:
            return self._oscillation.centre
        return np.mean([measurement.p_m for measurement in self._measured], axis=0) if self._measured else np.zeros(3)

    def centre_ned(self) -> Array:
        """Return the centre (3,) of the motion, ned metres, at the present distance along the heading."""
        return np.asarray(self._R_ned_wall @ np.array([self._x[0, 0], *self.centre[1:]]))

    def spread_m(self, last_s: float) -> float:
        """Return the spread of the last seconds' measurements across the heading, metres, 10th to 90th percentile."""
        since_ns = self._t_ns - last_s * S
        recent = np.array([measurement.p_m[1] for measurement in self._measured if measurement.t_ns > since_ns])
        if len(recent) < MIN_SPREAD_MEASUREMENTS:
            return 0.0
        low, high = np.percentile(recent, [10.0, 90.0])
        return float(high - low)


@dataclass(frozen=True, slots=True, eq=False)
class Oscillation:
    """A fitted sinusoid p(t) = c + s sin(w t) + k cos(w t), each (3,) along, across, down; `t0_ns` is its time zero."""

    t0_ns: int
    rate_rad_s: float
    centre: Array
    sine: Array
    cosine: Array
    rms_m: float

    def at(self, t_ns: int) -> Motion:
        """Return position, velocity and acceleration along, across and down."""
        phase = self.rate_rad_s * (t_ns - self.t0_ns) / S
        s, c, w = math.sin(phase), math.cos(phase), self.rate_rad_s
        swing = self.sine * s + self.cosine * c
        return Motion(self.centre + swing, w * (self.sine * c - self.cosine * s), -w * w * swing, self.rms_m)


def fit_oscillation(measured: list[PointMeasurement], walk_sqrt_s: float) -> Oscillation | None:
    """Return the sinusoid through measurements, None when they are too few or not periodic.

    Generalised least squares for each of PERIODS_S, the best of them refined twice; across and down are weighted
    separately. The errors are each measurement's own sigma, the drift of the autopilot's position since then, and the
    range times a pointing error, whose constant part is fitted and whose varying part is an Ornstein-Uhlenbeck process.
    """
    t0_ns = measured[-1].t_ns
    t = np.array([(measurement.t_ns - t0_ns) / S for measurement in measured])
    if len(t) < MIN_MEASUREMENTS or -t[0] < MIN_OSCILLATION_S:
        return None
    p = np.array([measurement.p_m[1:] for measurement in measured])
    r = np.array([measurement.range_m for measurement in measured])
    sigma_m = np.array([measurement.sigma_m[1:] for measurement in measured])
    covariances = [_covariance(t, r, sigma, walk_sqrt_s) for sigma in sigma_m.T]
    information: list[Array] = [np.asarray(np.linalg.inv(covariance), np.float64) for covariance in covariances]
    periods = PERIODS_S[-MAX_PERIODS_PER_HISTORY * t[0] >= PERIODS_S]
    if not periods.size:
        return None
    for _ in range(REFINEMENTS):
        costs, fits = _harmonics(t, r, p, information, 2 * math.pi / periods)
        best = int(np.argmin(costs))
        rate, x = 2 * math.pi / float(periods[best]), fits[best]
        periods = np.linspace(periods[max(0, best - 1)], periods[min(len(periods) - 1, best + 1)], REFINED_PERIODS)
    residual = p - _columns(t, r, np.array([rate]))[0] @ x
    weight = (np.exp(t / RECENT_S)[:, None] * sigma_m.min(axis=0) / sigma_m) ** 2
    rms_m = math.sqrt(float((residual**2 * weight).sum() / weight.sum()))
    centre, sine, cosine, _ = np.pad(x, ((0, 0), (1, 0)))
    return Oscillation(t0_ns, rate, centre, sine, cosine, rms_m) if rms_m < MAX_RMS_M else None


def _covariance(t: Array, r: Array, sigma_m: Array, walk_sqrt_s: float) -> Array:
    """Return the covariance (n, n) of measurements at times t <= 0 from ranges r."""
    drift = walk_sqrt_s**2 * np.minimum(-t[:, None], -t[None, :])
    correlation = np.exp(-np.abs(t[:, None] - t[None, :]) / POINTING_CORRELATION_S)
    pointing = POINTING_CORRELATION_S / 2 * POINTING_WALK_RAD_SQRT_S**2 * correlation
    return np.asarray(drift + pointing * r[:, None] * r[None, :] + np.diag(sigma_m**2 + 1e-8))


def _columns(t: Array, r: Array, rates: Array) -> Array:
    """Return the design matrices (rates, n, 4): columns of centre, sine, cosine and pointing error."""
    turns = rates[:, None] * t
    return np.stack([np.ones_like(turns), np.sin(turns), np.cos(turns), np.broadcast_to(r, turns.shape)], axis=2)


def _harmonics(t: Array, r: Array, p: Array, information: list[Array], rates: Array) -> tuple[Array, Array]:
    """Return for each rate the cost, and (4, 2) centre, sine, cosine and pointing error, across and down.

    `information` are the inverse covariances (n, n) of the measurements across and down.
    """
    columns = _columns(t, r, rates)
    prior = np.diag(np.array([np.inf, AMPLITUDE_SIGMA_M, AMPLITUDE_SIGMA_M, POINTING_RAD]) ** -2.0)
    costs, fits = np.zeros(len(rates)), []
    for axis, inverse in zip(p.T, information, strict=True):
        weighted = (inverse @ columns).transpose(0, 2, 1)
        b = weighted @ axis
        x = np.linalg.solve(weighted @ columns + prior, b[..., None])[..., 0]
        costs += axis @ inverse @ axis - (b * x).sum(axis=1)
        fits.append(x)
    return costs, np.stack(fits, axis=2)
