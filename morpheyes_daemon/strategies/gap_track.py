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

POSITION_WALK_M_S = 0.02
"""Random walk of the autopilot's position in the plane, metres per root second: that of optical flow."""

MOVING_M_S2 = 0.4
"""Acceleration of a moving wall that the filter reckons with."""

KEEP_S = 14.0
LEAST_WAVE_S = 3.0
PERIODS_S = np.geomspace(2.5, 16.0, 48)
WAVE_FITS_M = 0.05
"""A wave is believed when it leaves this little (rms) of what was seen."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Place, velocity and acceleration (ned) at one moment, and one sigma of the place."""

    p_m: Array
    v_m_s: Array
    a_m_s2: Array
    sigma_m: float


class PointTrack:
    """A point seen now and then, each axis filtered for itself; times must not go back."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, Array]] = deque()
        self._x: Array = np.zeros((3, 2))
        self._P: Array = np.zeros((3, 2, 2))
        self._t_ns = 0
        self._wave: Wave | None = None
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
        """Take in where it was seen, with one sigma (3,) of each axis."""
        if not self._seen:
            self._x[:, 0] = p_ned_m
            self._P[:, 0, 0] = sigma_m**2
        else:
            self._x, self._P = self._carried(t_ns)
            gain = self._P[:, :, 0] / (self._P[:, 0, 0] + sigma_m**2)[:, None]
            self._x = self._x + gain * (p_ned_m - self._x[:, 0])[:, None]
            self._P = self._P - gain[:, :, None] * self._P[:, None, 0]
        self._t_ns = t_ns
        self._seen.append((t_ns, p_ned_m))
        while self._seen[0][0] < t_ns - KEEP_S * S:
            self._seen.popleft()
        if self.moves:
            self._wave = fit_wave(list(self._seen))

    def at(self, t_ns: int) -> Motion:
        """Return where it is, or will be, at a time."""
        if self._wave is not None:
            return self._wave.at(t_ns)
        x, P = self._carried(t_ns)
        return Motion(x[:, 0], x[:, 1], np.zeros(3), math.sqrt(float(P[:, 0, 0].max())))

    def _carried(self, t_ns: int) -> tuple[Array, Array]:
        dt = max(0.0, (t_ns - self._t_ns) / S)
        noise = np.zeros((3, 2, 2))
        noise[:2, 0, 0] = POSITION_WALK_M_S**2 * dt
        noise[2, 0, 0] = (0.25 * POSITION_WALK_M_S) ** 2 * dt
        if not self.moves:
            return self._x * [1.0, 0.0], self._P * [[1.0, 0.0], [0.0, 0.0]] + noise
        F = np.array([[1.0, dt], [0.0, 1.0]])
        noise += MOVING_M_S2**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        return self._x @ F.T, np.asarray(F @ self._P @ F.T + noise)

    def spread_m(self, last_s: float) -> float:
        """Return how far apart the places of the last seconds lie, 5th to 95th percentile, on the widest axis."""
        recent = np.array([p for t, p in self._seen if t > self._t_ns - last_s * S])
        if len(recent) < 5:
            return 0.0
        low, high = np.percentile(recent[:, 1:], [5.0, 95.0], axis=0)
        return float((high - low).max())


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


def fit_wave(seen: list[tuple[int, Array]]) -> Wave | None:
    """Return the wave through places (t_ns, p (3,)), None when they are too few or do not repeat.

    Linear least squares for each of some periods, the best of them refined once; the newest places count most.
    """
    t0_ns = seen[-1][0]
    t = np.array([(t_ns - t0_ns) / S for t_ns, _ in seen])
    if len(t) < 10 or -t[0] < LEAST_WAVE_S:
        return None
    p = np.array([place for _, place in seen])
    weight = np.exp(t / 6.0)
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
    return Wave(t0_ns, 2 * math.pi / float(fine[best]), x[0], x[1], x[2], rms_m)


def _harmonic(t: Array, p: Array, weight: Array, rate: float) -> tuple[float, Array]:
    A = np.stack([np.ones_like(t), np.sin(rate * t), np.cos(rate * t)], axis=1)
    normal = (A * weight[:, None] ** 2).T
    x = np.linalg.solve(normal @ A + 1e-6 * np.eye(3), normal @ p)
    off = ((A @ x - p)[:, 1:] * weight[:, None]) ** 2
    return math.sqrt(float(off.sum() / (weight**2).sum())), np.asarray(x)
