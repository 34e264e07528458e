"""Wanted velocity, heading and height to stick positions, closed on the autopilot's own velocity estimate.

Loiter's drag is fed forward, the rest is a PI loop on the velocity predicted to when a lean takes hold. The loop
bounds the lean, forwards and in braking, and does not know why a velocity is wanted: the governor has bounded it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from morpheyes_daemon.clock import S
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.pid import Pid, PidGains
from morpheyes_daemon.control.stopping import G_M_S2
from morpheyes_daemon.messages.core import Sticks, VehicleState
from morpheyes_daemon.transforms import wrap_rad

Vector2 = tuple[float, float]
"""North and east, or forward and right."""

STANDSTILL_M_S = 0.05
"""A wanted speed below this is a stop: neutral sticks, and Loiter holds the place by itself."""
RANGEFINDER_FRESH_S = 0.5
BRAKE_LEAN_RAD = math.radians(8.0)
"""With the drag it slows down by 2 to 4 m/s2, and a camera tilted up by 8 degrees still sees the band it flies in."""


@dataclass(frozen=True, slots=True)
class VelocityTuning:
    """Gains and bounds; the defaults are tuned on the identified Loiter plant (tests/unit/test_velocity.py).

    `quick_response_1_s` takes the place of `response_1_s` on a line, where what is missing is steered by often; there,
    the measured velocity is steadied over `steady_s`. `lean_lag_s` is how far ahead velocity is predicted, about the
    delay of the lean. `brake_lean_rad` bounds the lean against the motion while slowing down, `stop_lean_rad` while
    stopping (0: neutral sticks, Loiter brakes).
    """

    response_1_s: float = 2.5
    quick_response_1_s: float = 10.0
    steady_s: float = 0.7
    integral_1_s2: float = 0.3
    integral_limit_m_s2: float = 0.8
    lean_lag_s: float = 0.15
    max_lean_rad: float = math.radians(20.0)
    brake_lean_rad: float = BRAKE_LEAN_RAD
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
        quick = PidGains(tuning.quick_response_1_s, tuning.integral_1_s2, i_limit=tuning.integral_limit_m_s2)
        self._calm, self._quick = (Pid(gains), Pid(gains)), (Pid(quick), Pid(quick))
        self._felt: Vector2 = (0.0, 0.0)
        self._steady: Vector2 | None = None
        self._last_ns = 0

    def reset(self) -> None:
        """Forget the integrals and what was commanded."""
        self._forget()
        self._felt = (0.0, 0.0)
        self._steady = None
        self._last_ns = 0

    def _forget(self) -> None:
        for loop in (*self._calm, *self._quick):
            loop.reset()

    def step(
        self,
        now_ns: int,
        v_ned_m_s: tuple[float, float, float],
        yaw_rad: float | None,
        height_m: float | None,
        vehicle: VehicleState,
        coast: bool = False,
        quick: bool = False,
    ) -> Sticks:
        """Return the sticks for a wanted velocity (ned), heading and height; None leaves heading or climb alone.

        With a height the wanted vertical speed is ignored. `coast` keeps pitch and roll neutral; `quick`
        answers faster than is needed to fly a speed.
        """
        above_m = height_above_ground_m(vehicle, now_ns)
        dt_s = min(0.1, max(0.001, (now_ns - self._last_ns) / S)) if self._last_ns else 0.02
        self._last_ns = now_ns
        push = None if coast else self._push(now_ns, dt_s, v_ned_m_s, vehicle, above_m, quick)
        self._feel(push or (0.0, 0.0), dt_s)
        roll_us, pitch_us = self._lean_sticks(push, vehicle.yaw_rad)
        climb = -v_ned_m_s[2] if height_m is None else self._climb_m_s(height_m - above_m)
        rate = 0.0 if yaw_rad is None else self._yaw_rate_rad_s(wrap_rad(yaw_rad - vehicle.yaw_rad))
        expires_ns = now_ns + round(self.tuning.expiry_s * S)
        return Sticks(
            now_ns, expires_ns, roll_us, pitch_us, self.model.throttle.width_us(climb), self.model.yaw_us(rate)
        )

    def steadied(self, vehicle: VehicleState, now_ns: int) -> VehicleState:
        """Return the state now, its horizontal velocity by Loiter's law on what was commanded, drawn to the measured.

        Call once before every `step`. The noise of a measured velocity alone takes a line 17 mm off.
        """
        above_m = height_above_ground_m(vehicle, now_ns)
        age_s = max(0.0, min(0.2, (now_ns - vehicle.position_t_ns) / S))
        dt_s = min(0.1, max(0.0, (now_ns - self._last_ns) / S)) if self._last_ns else 0.0
        share = 1.0 - math.exp(-dt_s / self.tuning.steady_s)
        steady = []
        for axis, felt in enumerate(self._felt):
            measured = vehicle.v_ned_m_s[axis]
            v = self._steady[axis] if self._steady else measured
            v += dt_s * (felt - self.model.drag_m_s2(v, above_m))
            ahead = age_s * (felt - self.model.drag_m_s2(measured, above_m))
            steady.append(v + share * (measured + ahead - v))
        self._steady = (steady[0], steady[1])
        return replace(vehicle, v_ned_m_s=(*self._steady, vehicle.v_ned_m_s[2]), position_t_ns=now_ns)

    def _push(
        self,
        now_ns: int,
        dt_s: float,
        v_ned_m_s: tuple[float, float, float],
        vehicle: VehicleState,
        above_m: float,
        quick: bool,
    ) -> Vector2 | None:
        """Return the acceleration (north, east) to lean for, drag not counted; None for neutral sticks."""
        stopping = math.hypot(v_ned_m_s[0], v_ned_m_s[1]) < STANDSTILL_M_S
        predicted = self._predicted_m_s(now_ns, vehicle, above_m)
        if stopping and (self.tuning.stop_lean_rad == 0.0 or math.hypot(*predicted) < 3 * STANDSTILL_M_S):
            self._forget()
            return None
        wanted = (0.0, 0.0) if stopping else (v_ned_m_s[0], v_ned_m_s[1])
        most = G_M_S2 * math.tan(min(self.tuning.max_lean_rad, self.model.lean_max_rad))
        loops = self._quick if quick else self._calm
        errors = [want - have for want, have in zip(wanted, predicted, strict=True)]
        drag = [self.model.drag_m_s2(want, above_m) for want in wanted]
        room = _room(loops, errors, drag, most)
        north, east = (
            loop.step(error, dt_s, -bound, bound, ahead)
            for loop, error, ahead, bound in zip(loops, errors, drag, room, strict=True)
        )
        brake_lean = self.tuning.stop_lean_rad if stopping else self.tuning.brake_lean_rad
        return _bounded((north, east), predicted, self.tuning.max_lean_rad, brake_lean)

    def _predicted_m_s(self, now_ns: int, vehicle: VehicleState, above_m: float) -> Vector2:
        """Velocity at the time when a lean commanded now takes hold, by Loiter's own law on what was commanded.

        The attitude would not do: it shows the airframe's drag, not Loiter's.
        """
        age_s = max(0.0, min(0.2, (now_ns - vehicle.position_t_ns) / S))
        ahead_s = age_s + self.tuning.lean_lag_s
        north, east = (
            v + ahead_s * (felt - self.model.drag_m_s2(v, above_m))
            for v, felt in zip(vehicle.v_ned_m_s[:2], self._felt, strict=True)
        )
        return north, east

    def _feel(self, push: Vector2, dt_s: float) -> None:
        """Follow what was commanded through the lag of the lean."""
        share = 1.0 - math.exp(-dt_s / self.tuning.lean_lag_s)
        self._felt = (
            self._felt[0] + share * (push[0] - self._felt[0]),
            self._felt[1] + share * (push[1] - self._felt[1]),
        )

    def _lean_sticks(self, push: Vector2 | None, yaw_rad: float) -> tuple[int, int]:
        if push is None:
            return self.model.roll.trim_us, self.model.pitch.trim_us
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        return self.model.sticks_for_acceleration(cos * push[0] + sin * push[1], cos * push[1] - sin * push[0])

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


def _room(loops: tuple[Pid, Pid], errors: list[float], drag: list[float], most: float) -> Vector2:
    """Bounds of both axes that shorten an acceleration beyond `most` without turning it.

    Each axis bounded for itself would fly 21 degrees off north at 45 degrees until the faster axis is there.
    """
    north, east = (
        abs(ahead + loop.gains.kp * error + loop.integral)
        for loop, error, ahead in zip(loops, errors, drag, strict=True)
    )
    size = math.hypot(north, east)
    return (most, most) if size <= most else (north * most / size, east * most / size)


def _bounded(acceleration: Vector2, velocity: Vector2, max_lean_rad: float, brake_lean_rad: float) -> Vector2:
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
