"""Wanted velocity, heading and height to stick positions, closed on the autopilot's own velocity estimate.

Loiter's drag is fed forward, the rest is a PI loop on the velocity predicted to when a lean takes hold. The loop
bounds the lean, forwards and in braking, and does not know why a velocity is wanted: the governor has bounded it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from morpheyes_daemon.clock import S
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.pid import Pid, PidGains
from morpheyes_daemon.control.stopping import G_M_S2
from morpheyes_daemon.messages import Sticks, VehicleState
from morpheyes_daemon.transforms import wrap_rad

STANDSTILL_M_S = 0.05
"""A wanted speed below this is a stop: neutral sticks, and Loiter holds the place by itself."""
RANGEFINDER_FRESH_S = 0.5


@dataclass(frozen=True, slots=True)
class VelocityTuning:
    """Gains and bounds; the defaults are tuned on the identified Loiter plant (tests/unit/test_velocity.py).

    `lean_lag_s` is how far ahead velocity is predicted, about the delay of the lean. `brake_lean_rad` bounds the lean
    against the motion while slowing down, `stop_lean_rad` while stopping (0: neutral sticks, Loiter brakes).
    """

    response_1_s: float = 2.5
    integral_1_s2: float = 0.3
    integral_limit_m_s2: float = 0.8
    lean_lag_s: float = 0.15
    max_lean_rad: float = math.radians(20.0)
    brake_lean_rad: float = math.radians(12.0)
    stop_lean_rad: float = 0.0
    yaw_gain_1_s: float = 2.0
    yaw_rate_max_rad_s: float = math.radians(60.0)
    yaw_tolerance_rad: float = math.radians(0.5)
    climb_gain_1_s: float = 0.8
    climb_max_m_s: float = 0.5
    height_tolerance_m: float = 0.08
    expiry_s: float = 0.1


def height_above_ground_m(vehicle: VehicleState, now_ns: int) -> float:
    """Return the rangefinder's height while it is fresh, else the height over the local origin."""
    if math.isfinite(vehicle.height_m) and now_ns - vehicle.height_t_ns < RANGEFINDER_FRESH_S * S:
        return vehicle.height_m
    return -vehicle.p_ned_m[2]


class VelocityController:
    """One per flight; call `step` at every stick period and `reset` whenever the sticks were not ours."""

    def __init__(self, model: LoiterModel, tuning: VelocityTuning | None = None) -> None:
        self.model = model
        self.tuning = tuning = tuning or VelocityTuning()
        gains = PidGains(tuning.response_1_s, tuning.integral_1_s2, i_limit=tuning.integral_limit_m_s2)
        self._north, self._east = Pid(gains), Pid(gains)
        self._last_ns = 0

    def reset(self) -> None:
        """Forget the integrals."""
        self._north.reset()
        self._east.reset()
        self._last_ns = 0

    def step(
        self,
        now_ns: int,
        v_ned_m_s: tuple[float, float, float],
        yaw_rad: float | None,
        height_m: float | None,
        vehicle: VehicleState,
        coast: bool = False,
    ) -> Sticks:
        """Return the sticks for a wanted velocity (ned), heading and height; None leaves heading or climb alone.

        With a height the wanted vertical speed is ignored. `coast` keeps pitch and roll neutral.
        """
        above_m = height_above_ground_m(vehicle, now_ns)
        roll_us, pitch_us = self._lean_sticks(now_ns, v_ned_m_s, vehicle, above_m, coast)
        climb = -v_ned_m_s[2] if height_m is None else self._climb_m_s(height_m - above_m)
        rate = 0.0 if yaw_rad is None else self._yaw_rate_rad_s(wrap_rad(yaw_rad - vehicle.yaw_rad))
        expires_ns = now_ns + round(self.tuning.expiry_s * S)
        return Sticks(
            now_ns, expires_ns, roll_us, pitch_us, self.model.throttle.width_us(climb), self.model.yaw_us(rate)
        )

    def _lean_sticks(
        self, now_ns: int, v_ned_m_s: tuple[float, float, float], vehicle: VehicleState, above_m: float, coast: bool
    ) -> tuple[int, int]:
        neutral = self.model.roll.trim_us, self.model.pitch.trim_us
        if coast:
            return neutral
        stopping = math.hypot(v_ned_m_s[0], v_ned_m_s[1]) < STANDSTILL_M_S
        predicted = self._predicted_m_s(now_ns, vehicle, above_m)
        if stopping and (self.tuning.stop_lean_rad == 0.0 or math.hypot(*predicted) < 3 * STANDSTILL_M_S):
            self.reset()
            return neutral
        wanted = (0.0, 0.0) if stopping else (v_ned_m_s[0], v_ned_m_s[1])
        acceleration = self._acceleration(now_ns, wanted, predicted, above_m)
        brake_lean = self.tuning.stop_lean_rad if stopping else self.tuning.brake_lean_rad
        north, east = _bounded(acceleration, predicted, self.tuning.max_lean_rad, brake_lean)
        cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
        return self.model.sticks_for_acceleration(cos * north + sin * east, cos * east - sin * north)

    def _acceleration(
        self, now_ns: int, wanted: tuple[float, float], predicted: tuple[float, float], above_m: float
    ) -> tuple[float, float]:
        """Drag at the wanted speed fed forward, PI on what is missing."""
        dt_s = min(0.1, max(0.001, (now_ns - self._last_ns) / S)) if self._last_ns else 0.02
        self._last_ns = now_ns
        most = G_M_S2 * math.tan(min(self.tuning.max_lean_rad, self.model.lean_max_rad))
        north, east = (
            loop.step(want - have, dt_s, -most, most, self.model.drag_m_s2(want, above_m))
            for loop, want, have in zip((self._north, self._east), wanted, predicted, strict=True)
        )
        return north, east

    def _predicted_m_s(self, now_ns: int, vehicle: VehicleState, above_m: float) -> tuple[float, float]:
        """Velocity (north, east) at the time when a lean commanded now takes hold, from the present lean and drag."""
        age_s = max(0.0, min(0.2, (now_ns - vehicle.position_t_ns) / S))
        ahead_s = age_s + self.tuning.lean_lag_s
        v_north, v_east, _ = vehicle.v_ned_m_s
        forward = -G_M_S2 * math.tan(vehicle.pitch_rad)
        right = G_M_S2 * math.tan(vehicle.roll_rad)
        cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
        a_north = cos * forward - sin * right - self.model.drag_m_s2(v_north, above_m)
        a_east = sin * forward + cos * right - self.model.drag_m_s2(v_east, above_m)
        return v_north + ahead_s * a_north, v_east + ahead_s * a_east

    def _climb_m_s(self, error_m: float) -> float:
        tuning = self.tuning
        if abs(error_m) < tuning.height_tolerance_m:
            return 0.0
        return max(-tuning.climb_max_m_s, min(tuning.climb_max_m_s, tuning.climb_gain_1_s * error_m))

    def _yaw_rate_rad_s(self, error_rad: float) -> float:
        tuning = self.tuning
        if abs(error_rad) < tuning.yaw_tolerance_rad:
            return 0.0
        return max(-tuning.yaw_rate_max_rad_s, min(tuning.yaw_rate_max_rad_s, tuning.yaw_gain_1_s * error_rad))


def _bounded(
    acceleration: tuple[float, float], velocity: tuple[float, float], max_lean_rad: float, brake_lean_rad: float
) -> tuple[float, float]:
    """Shorten an acceleration to the largest lean, and its part against the motion to the brake's lean."""
    north, east = acceleration
    speed = math.hypot(*velocity)
    if speed > STANDSTILL_M_S:
        along = (north * velocity[0] + east * velocity[1]) / speed
        excess = min(0.0, along + G_M_S2 * math.tan(brake_lean_rad))
        north, east = north - excess * velocity[0] / speed, east - excess * velocity[1] / speed
    size = math.hypot(north, east)
    most = G_M_S2 * math.tan(max_lean_rad)
    scale = most / size if size > most else 1.0
    return north * scale, east * scale
