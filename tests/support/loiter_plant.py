"""A slow, scalar reference of the Loiter plant in two axes, written apart from control/stopping.py.

Dead time, lean through a critically damped second order, drag, brake after LOIT_BRK_DELAY, as identified on
ArduCopter. It is stepped at one millisecond and knows no optimisation.
"""

from __future__ import annotations

import math
from collections import deque

G = 9.80665
OMEGA = 1.0 / 0.075
DT = 0.001


class LoiterPlant:
    """State: velocity, lean, brake and yaw; `step_ms` moves one millisecond on with roll, pitch, yaw deflections."""

    def __init__(self, v_lim: float, theta: float, delay: float, accel: float = 2.5, jerk: float = 5.0) -> None:
        self.v_lim, self.theta = v_lim, theta
        self.brake_delay, self.brake_accel, self.brake_jerk = delay, accel, jerk
        self.v = [0.0, 0.0]
        self.p = [0.0, 0.0]
        self.lean = [0.0, 0.0]
        self.rate = [0.0, 0.0]
        self.brake = 0.0
        self.yaw = 0.0
        self.yaw_rate = 0.0
        self.wind_m_s2 = [0.0, 0.0]
        self.neutral_s = 0.0
        self._queue: deque[tuple[float, float, float]] = deque([(0.0, 0.0, 0.0)] * 20)

    def step_ms(self, forward: float, right: float, yaw_rate_rad_s: float = 0.0) -> None:
        """`forward`, `right`: deflections beyond the dead zone, -1 to 1."""
        self._queue.append((forward, right, yaw_rate_rad_s))
        n_forward, n_right, wanted_rate = self._queue.popleft()
        self.neutral_s = self.neutral_s + DT if n_forward == 0.0 and n_right == 0.0 else 0.0
        for i, n in enumerate((n_forward, n_right)):
            acceleration = OMEGA**2 * (n * self.theta - self.lean[i]) - 2 * OMEGA * self.rate[i]
            self.rate[i] += acceleration * DT
            self.lean[i] += self.rate[i] * DT
        self.yaw_rate += (wanted_rate - self.yaw_rate) * DT / 0.15
        self.yaw += self.yaw_rate * DT
        speed = math.hypot(*self.v)
        knee = self.brake_jerk
        curve = speed if speed < knee else math.sqrt(2 * self.brake_jerk * (speed - knee / 2))
        target = min(self.brake_accel, curve) if self.neutral_s > self.brake_delay else 0.0
        self.brake += max(-self.brake_jerk * DT, min(self.brake_jerk * DT, target - self.brake))
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        push = [G * math.tan(lean) for lean in self.lean]
        a = [cos * push[0] - sin * push[1], sin * push[0] + cos * push[1]]
        drag = G * math.tan(self.theta) / self.v_lim
        for i in range(2):
            along = self.v[i] / speed if speed > 1e-6 else 0.0
            self.v[i] += (a[i] + self.wind_m_s2[i] - drag * self.v[i] - self.brake * along) * DT
            self.p[i] += self.v[i] * DT
