"""Where an opening is now and will be: its place over some seconds, in the autopilot's local frame.

A standing opening seems to drift, since the autopilot's position does; a moving one sways, and where some seconds show
that the motion repeats itself, a wave is fitted to it, which leads farther. Where it is seen is off in proportion to
its range, because the eyes' axis on the body is known to half a degree and the attitude errs; a Kalman filter tells
that from the place as the range shrinks.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.transforms import Array

POSITION_WALK_M_S = 0.025
"""Random walk of where an opening seems to be, metres per root second: the autopilot's own position drifts by 0.02."""

POINTING_RAD, POINTING_WALK_RAD_S = 0.008, 0.004
"""One sigma of the eyes' direction on the body, and its walk per root second: the attitude's."""

MOVING_M_S, MOVING_M_S2 = 0.5, 0.4
"""Speed and acceleration of a moving wall that the filter reckons with."""

KEEP_S = 26.0
"""The more periods of a sway are kept in mind, the better they tell the period, on which the place at the wall hangs."""

LEAST_WAVE_S = 3.0
PERIODS_S = np.geomspace(2.5, 16.0, 48)
POINTING_S = 1.0
"""For so long an attitude errs to the same side."""

WAVE_MOST_M = 3.0
"""One sigma of a wave's amplitude before anything is seen."""

WAVE_FITS_M, LATELY_S = 0.10, 5.0
"""A wave is believed when it leaves this little (rms) of what was seen lately, drift of some seconds included."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Place, velocity and acceleration (ned) at one moment, and one sigma of the place."""

    p_m: Array
    v_m_s: Array
    a_m_s2: Array
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One sight of the point: place (3,) and one sigma (3,) along, across and down, and the range it was seen from."""

    t_ns: int
    p_m: Array
    sigma_m: Array
    range_m: float


class PointTrack:
    """A point seen now and then, each axis filtered for itself; times must not go back.

    Axes are along (x), across (y) and down (z) for a heading: a wall moves across and down, never along. The state of
    each is place, velocity and pointing error.
    """

    def __init__(self, yaw_rad: float = 0.0, walk_m_s: float = POSITION_WALK_M_S) -> None:
        self._walk_m_s = walk_m_s
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        self._R_ned_wall: Array = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self._seen: deque[Sighting] = deque()
        self._x: Array = np.zeros((3, 3))
        self._P: Array = np.zeros((3, 3, 3))
        self._t_ns = 0
        self._wave: Wave | None = None
        self._moves = False

    @property
    def count(self) -> int:
        """How often it was seen in the last seconds."""
        return len(self._seen)

    @property
    def wave(self) -> Wave | None:
        """The motion that repeats itself, None when there is none."""
        return self._wave

    @property
    def moves(self) -> bool:
        """It is taken for one that moves; see `move`."""
        return self._moves

    def move(self) -> None:
        """From now on it is one that moves."""
        if not self._moves:
            self._moves = True
            self._P[1:, 1, 1] = MOVING_M_S**2

    def see(self, t_ns: int, p_ned_m: Array, sigma_m: Array, range_m: float = 0.0) -> None:
        """Take in where it was seen, with one sigma (3,) along, across and down, and from how far."""
        sighting = Sighting(t_ns, self._R_ned_wall.T @ p_ned_m, sigma_m, range_m)
        if self._seen:
            self._filter(sighting)
        else:
            self._begin(sighting)
        self._seen.append(sighting)
        while self._seen[0].t_ns < t_ns - KEEP_S * S:
            self._seen.popleft()
        if self._moves:
            self._wave = fit_wave(list(self._seen), self._walk_m_s)

    def at(self, t_ns: int) -> Motion:
        """Return where it is, or will be, at a time."""
        x, P = self._carried(t_ns)
        p, v, a, sigma_m = x[:, 0], x[:, 1], np.zeros(3), math.sqrt(float(P[1:, 0, 0].max()))
        if self._wave is not None:
            swing = self._wave.at(t_ns)
            p, v, a, sigma_m = np.array([p[0], *swing.p_m[1:]]), swing.v_m_s, swing.a_m_s2, self._wave.rms_m
        R = self._R_ned_wall
        return Motion(R @ p, R @ v, R @ a, sigma_m)

    def _begin(self, sighting: Sighting) -> None:
        """Start at a sighting: what it is off by its pointing error is as unknown as that."""
        r = sighting.range_m
        self._x = np.zeros((3, 3))
        self._x[:, 0] = sighting.p_m
        self._P = np.zeros((3, 3, 3))
        self._P[:, 0, 0] = sighting.sigma_m**2
        self._P[1:] += POINTING_RAD**2 * np.array([[r * r, 0.0, -r], [0.0, 0.0, 0.0], [-r, 0.0, 1.0]])
        self._t_ns = sighting.t_ns

    def _filter(self, sighting: Sighting) -> None:
        self._x, self._P = self._carried(sighting.t_ns)
        H = np.array([[1.0, 0.0, 0.0]] + 2 * [[1.0, 0.0, sighting.range_m]])
        PH = np.einsum("kij,kj->ki", self._P, H)
        gain = PH / (np.einsum("ki,ki->k", H, PH) + sighting.sigma_m**2)[:, None]
        off = sighting.p_m - np.einsum("ki,ki->k", H, self._x)
        self._x = self._x + gain * off[:, None]
        self._P = self._P - gain[:, :, None] * PH[:, None, :]
        self._t_ns = sighting.t_ns

    def _carried(self, t_ns: int) -> tuple[Array, Array]:
        dt = max(0.0, (t_ns - self._t_ns) / S)
        noise = np.zeros((3, 3, 3))
        noise[:, 0, 0] = self._walk_m_s**2 * dt
        noise[1:, 2, 2] = POINTING_WALK_RAD_S**2 * dt
        F = np.array([np.eye(3)] * 3)
        if self._moves:
            F[1:, 0, 1] = dt
            push = MOVING_M_S2 * np.array([dt * dt / 2, dt, 0.0])
            noise[1:] += np.outer(push, push)
        return np.einsum("kij,kj->ki", F, self._x), np.asarray(F @ self._P @ F.transpose(0, 2, 1) + noise)

    @property
    def middle(self) -> Array:
        """Where it is on the average, along, across and down: the middle of its wave, or the mean of what was seen."""
        if self._wave is not None:
            return self._wave.centre
        return np.mean([seen.p_m for seen in self._seen], axis=0) if self._seen else np.zeros(3)

    def middle_ned(self) -> Array:
        """Return the place in ned that it sways about."""
        return np.asarray(self._R_ned_wall @ np.array([self._x[0, 0], *self.middle[1:]]))

    def spread_m(self, last_s: float) -> float:
        """Return how far apart the places of the last seconds lie, across, 10th to 90th percentile."""
        recent = np.array([seen.p_m[1] for seen in self._seen if seen.t_ns > self._t_ns - last_s * S])
        if len(recent) < 8:
            return 0.0
        low, high = np.percentile(recent, [10.0, 90.0])
        return float(high - low)


@dataclass(frozen=True, slots=True, eq=False)
class Wave:
    """p(t) = c + s sin(w t) + k cos(w t), fitted; `t0_ns` is its zero of time."""

    t0_ns: int
    rate_rad_s: float
    centre: Array
    sine: Array
    cosine: Array
    rms_m: float

    def at(self, t_ns: int) -> Motion:
        """Return place, velocity and acceleration."""
        phase = self.rate_rad_s * (t_ns - self.t0_ns) / S
        s, c, w = math.sin(phase), math.cos(phase), self.rate_rad_s
        swing = self.sine * s + self.cosine * c
        return Motion(self.centre + swing, w * (self.sine * c - self.cosine * s), -w * w * swing, self.rms_m)


def fit_wave(seen: list[Sighting], walk_m_s: float) -> Wave | None:
    """Return the wave through what was seen, None when that is too little or does not repeat.

    Generalised least squares for each of some periods, the best of them refined twice, across and down each weighted
    for itself. What was seen errs by its own sigma, by the drift of the autopilot's position since, and by its range
    times a pointing error, one part of which stays and is fitted, while the other comes and goes (an
    Ornstein-Uhlenbeck process).
    """
    t0_ns = seen[-1].t_ns
    t = np.array([(sighting.t_ns - t0_ns) / S for sighting in seen])
    if len(t) < 10 or -t[0] < LEAST_WAVE_S:
        return None
    p, r = np.array([sighting.p_m[1:] for sighting in seen]), np.array([sighting.range_m for sighting in seen])
    sigma_m = np.array([sighting.sigma_m[1:] for sighting in seen])
    covariances = [_covariance(t, r, sigma, walk_m_s) for sigma in sigma_m.T]
    known: list[Array] = [np.asarray(np.linalg.inv(covariance), np.float64) for covariance in covariances]
    periods = PERIODS_S[-1.6 * t[0] >= PERIODS_S]
    if not periods.size:
        return None
    for _ in range(3):
        costs, fits = _harmonics(t, r, p, known, 2 * math.pi / periods)
        best = int(np.argmin(costs))
        rate, x = 2 * math.pi / float(periods[best]), fits[best]
        periods = np.linspace(periods[max(0, best - 1)], periods[min(len(periods) - 1, best + 1)], 9)
    off = p - _columns(t, r, np.array([rate]))[0] @ x
    weight = (np.exp(t / LATELY_S)[:, None] * sigma_m.min(axis=0) / sigma_m) ** 2
    rms_m = math.sqrt(float((off**2 * weight).sum() / weight.sum()))
    centre, sine, cosine, _ = np.pad(x, ((0, 0), (1, 0)))
    return Wave(t0_ns, rate, centre, sine, cosine, rms_m) if rms_m < WAVE_FITS_M else None


def _covariance(t: Array, r: Array, sigma_m: Array, walk_m_s: float) -> Array:
    """Return (n, n) how what was seen at times t <= 0 from ranges r errs together."""
    drift = walk_m_s**2 * np.minimum(-t[:, None], -t[None, :])
    pointing = POINTING_S / 2 * POINTING_WALK_RAD_S**2 * np.exp(-np.abs(t[:, None] - t[None, :]) / POINTING_S)
    return np.asarray(drift + pointing * r[:, None] * r[None, :] + np.diag(sigma_m**2 + 1e-8))


def _columns(t: Array, r: Array, rates: Array) -> Array:
    """Return (rates, n, 4) what centre, sine, cosine and pointing error make of what is seen."""
    turns = rates[:, None] * t
    return np.stack([np.ones_like(turns), np.sin(turns), np.cos(turns), np.broadcast_to(r, turns.shape)], axis=2)


def _harmonics(t: Array, r: Array, p: Array, known: list[Array], rates: Array) -> tuple[Array, Array]:
    """Return the cost and (4, 2) centre, sine, cosine and pointing error, across and down, of each rate's wave.

    `known` are the inverse covariances (n, n) of what was seen across and down.
    """
    columns, prior = _columns(t, r, rates), np.diag(np.array([np.inf, WAVE_MOST_M, WAVE_MOST_M, POINTING_RAD]) ** -2.0)
    costs, fits = np.zeros(len(rates)), []
    for seen, information in zip(p.T, known, strict=True):
        weighted = (information @ columns).transpose(0, 2, 1)
        b = weighted @ seen
        x = np.linalg.solve(weighted @ columns + prior, b[..., None])[..., 0]
        costs += seen @ information @ seen - (b * x).sum(axis=1)
        fits.append(x)
    return costs, np.stack(fits, axis=2)
