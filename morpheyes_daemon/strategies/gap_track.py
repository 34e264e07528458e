"""Where an opening is now and will be: its place over some seconds, in the autopilot's local frame.

A standing opening seems to drift, since the autopilot's position does; a moving one sways. Both are one Kalman filter
per opening, and where some seconds show that the motion repeats itself, a wave fitted to them, which leads farther.
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

MOVING_M_S2 = 0.4
"""Acceleration of a moving wall that the filter reckons with."""

DRIFT_M_S, DRIFTING_M_S2 = 0.03, 0.03
"""How fast a standing opening seems to drift: half a degree aside at 3 m/s is 0.026 m/s."""

KEEP_S = 14.0
LEAST_WAVE_S = 3.0
PERIODS_S = np.geomspace(2.5, 16.0, 48)
WAVE_MEMORY_S, LATELY_S = 5.0, 0.4
WAVE_FITS_M = 0.06
"""A wave is believed when it leaves this little (rms) of what was seen."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Place, velocity and acceleration (ned) at one moment, and one sigma of the place."""

    p_m: Array
    v_m_s: Array
    a_m_s2: Array
    sigma_m: float


class PointTrack:
    """A point seen now and then, each axis filtered for itself; times must not go back.

    Axes are along (x), across (y) and down (z) for a heading: a wall moves across and down, never along.
    """

    def __init__(self, yaw_rad: float = 0.0) -> None:
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        self._R_ned_wall: Array = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self._seen: deque[tuple[int, Array]] = deque()
        self._x: Array = np.zeros((3, 2))
        self._P: Array = np.zeros((3, 2, 2))
        self._t_ns = 0
        self._wave: Wave | None = None
        self._accel_m_s2: float | None = None
        self.moves = False

    @property
    def count(self) -> int:
        """How often it was seen in the last seconds."""
        return len(self._seen)

    @property
    def wave(self) -> Wave | None:
        """The motion that repeats itself, None when there is none."""
        return self._wave

    def see(self, t_ns: int, p_ned_m: Array, sigma_m: Array) -> None:
        """Take in where it was seen, with one sigma (3,) along, across and down."""
        p = self._R_ned_wall.T @ p_ned_m
        if not self._seen:
            self._x[:, 0] = p
            self._P[:, 0, 0] = sigma_m**2
        else:
            self._x, self._P = self._carried(t_ns)
            gain = self._P[:, :, 0] / (self._P[:, 0, 0] + sigma_m**2)[:, None]
            self._x = self._x + gain * (p - self._x[:, 0])[:, None]
            self._P = self._P - gain[:, :, None] * self._P[:, None, 0]
        self._t_ns = t_ns
        self._seen.append((t_ns, p))
        while self._seen[0][0] < t_ns - KEEP_S * S:
            self._seen.popleft()
        if self.moves:
            self._wave = fit_wave(list(self._seen))

    def at(self, t_ns: int) -> Motion:
        """Return where it is, or will be, at a time."""
        x, P = self._carried(t_ns)
        p, v, a, sigma_m = x[:, 0], x[:, 1], np.zeros(3), math.sqrt(float(P[1:, 0, 0].max()))
        if self._wave is not None:
            swing = self._wave.at(t_ns)
            p, v, a, sigma_m = np.array([p[0], *swing.p_m[1:]]), swing.v_m_s, swing.a_m_s2, self._wave.rms_m
        R = self._R_ned_wall
        return Motion(R @ p, R @ v, R @ a, sigma_m)

    def _carried(self, t_ns: int) -> tuple[Array, Array]:
        dt = max(0.0, (t_ns - self._t_ns) / S)
        noise = np.zeros((3, 2, 2))
        noise[:, 0, 0] = POSITION_WALK_M_S**2 * dt
        F = np.array([np.eye(2)] * 3)
        accel_m_s2 = MOVING_M_S2 if self.moves else self._accel_m_s2
        if accel_m_s2 is not None:
            F[1:, 0, 1] = dt
            noise[1:] += accel_m_s2**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        return np.einsum("kij,kj->ki", F, self._x), np.asarray(F @ self._P @ F.transpose(0, 2, 1) + noise)

    def near(self) -> None:
        """From now on a standing point is flown at: what an eye that looks aside makes it drift by is followed."""
        if self._accel_m_s2 is None:
            self._accel_m_s2 = DRIFTING_M_S2
            self._P[1:, 1, 1] = DRIFT_M_S**2

    @property
    def middle(self) -> Array:
        """Where it is on the average, along, across and down: the middle of its wave, or the mean of what was seen."""
        if self._wave is not None:
            return self._wave.centre
        return np.mean([p for _, p in self._seen], axis=0) if self._seen else np.zeros(3)

    def spread_m(self, last_s: float) -> float:
        """Return how far apart the places of the last seconds lie, across, 10th to 90th percentile."""
        recent = np.array([p[1] for t, p in self._seen if t > self._t_ns - last_s * S])
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
        still = np.array([0.0, 1.0, 1.0])
        v = w * (self.sine * c - self.cosine * s)
        return Motion(self.centre + swing, still * v, -w * w * still * swing, self.rms_m)


def fit_wave(seen: list[tuple[int, Array]]) -> Wave | None:
    """Return the wave through places (t_ns, p (3,)), None when they are too few or do not repeat.

    Linear least squares for each of some periods, the best of them refined once; the newest places count most. The
    autopilot's position drifts meanwhile, so the wave is then shifted onto the last places.
    """
    t0_ns = seen[-1][0]
    t = np.array([(t_ns - t0_ns) / S for t_ns, _ in seen])
    if len(t) < 10 or -t[0] < LEAST_WAVE_S:
        return None
    p = np.array([place for _, place in seen])
    weight = np.exp(t / WAVE_MEMORY_S)
    longest_s = 1.6 * float(-t[0])
    periods = PERIODS_S[longest_s >= PERIODS_S]
    if not periods.size:
        return None
    fits = [_harmonic(t, p, weight, 2 * math.pi / period) for period in periods]
    best = int(np.argmin([cost for cost, _ in fits]))
    fine = np.linspace(periods[max(0, best - 1)], periods[min(len(periods) - 1, best + 1)], 9)
    fits = [_harmonic(t, p, weight, 2 * math.pi / period) for period in fine]
    best = int(np.argmin([cost for cost, _ in fits]))
    rms_m, x = fits[best]
    if rms_m > WAVE_FITS_M:
        return None
    rate = 2 * math.pi / float(fine[best])
    off = p - np.stack([np.ones_like(t), np.sin(rate * t), np.cos(rate * t)], axis=1) @ x
    lately = np.exp(t / LATELY_S)
    return Wave(t0_ns, rate, x[0] + lately @ off / lately.sum(), x[1], x[2], rms_m)


def _harmonic(t: Array, p: Array, weight: Array, rate: float) -> tuple[float, Array]:
    A = np.stack([np.ones_like(t), np.sin(rate * t), np.cos(rate * t)], axis=1)
    normal = (A * weight[:, None] ** 2).T
    x = np.linalg.solve(normal @ A + 1e-6 * np.eye(3), normal @ p)
    off = ((A @ x - p)[:, 1:] * weight[:, None]) ** 2
    return math.sqrt(float(off.sum() / (weight**2).sum())), np.asarray(x)
