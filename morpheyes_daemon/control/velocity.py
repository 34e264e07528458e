"""Velocity loop: wanted velocity, heading and height to stick positions, closed on the autopilot's velocity estimate.

Loiter's drag is fed forward, the rest is a PI loop on the velocity predicted to when a lean takes effect. The loop
bounds the lean, in accelerating and in braking; the speed has been bounded by the governor before.
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
"""A wanted speed below this is a stop: neutral sticks, and Loiter holds the position by itself.

Chosen: the noise of the measured velocity; a lower one keeps correcting a vehicle that stands."""

ACTIVE_STOP_M_S = 3 * STANDSTILL_M_S
"""A stop leans against the motion above this speed and is neutral sticks below.

Chosen: a lower one reverses the motion, a higher one stops later."""

RANGEFINDER_FRESH_S = 0.5
"""Age up to which the rangefinder's height is used.

Chosen: several periods of DISTANCE_SENSOR; an older height has left the ground below a moving vehicle."""

BRAKE_LEAN_RAD = math.radians(8.0)
"""Largest lean against the motion while slowing down.

Chosen: with Loiter's drag it gives 2 to 4 m/s2, and a camera tilted up by 8 degrees still sees the band it flies in; a
larger lean stops in less room without seeing it."""

MIN_STEP_S, MAX_STEP_S = 0.001, 0.1
"""Bounds of the loop's time step.

Chosen: around the stick period of 0.02 s; a longer step after a delay would jump the integral."""

FIRST_STEP_S = 0.02
"""Time step of the first call after a reset.

Chosen: the stick period, since there is no last call to measure from."""

MAX_STATE_AGE_S = 0.2
"""Longest age of the measured velocity that is predicted over.

Chosen: the longest latency that the loop is tuned for; a longer prediction amplifies noise."""


@dataclass(frozen=True, slots=True)
class VelocityTuning:
    """Gains and bounds; the defaults are tuned on the identified Loiter plant (tests/unit/control/test_velocity.py).

    `fast_response_1_s` replaces `response_1_s` for a setpoint with `fast_response`; there the measured velocity is
    filtered over `filter_s`. `lean_lag_s` is the time over which velocity is predicted, about the delay of the lean.
    `brake_lean_rad` bounds the lean against the motion while slowing down, `stop_lean_rad` while stopping (0: neutral
    sticks, Loiter brakes).
    """

    response_1_s: float = 2.5
    fast_response_1_s: float = 10.0
    filter_s: float = 0.7
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


@dataclass(frozen=True, slots=True)
class VelocitySetpoint:
    """What the loop is to reach: velocity (ned), heading and height above ground; None leaves heading or climb alone.

    With a height the vertical velocity is ignored. `coast` keeps pitch and roll neutral. `fast_response` selects the
    gain `fast_response_1_s`, for corrections towards a line rather than for flying a speed.
    """

    v_ned_m_s: tuple[float, float, float]
    yaw_rad: float | None = None
    height_m: float | None = None
    coast: bool = False
    fast_response: bool = False


def height_above_ground_m(vehicle: VehicleState, now_ns: int) -> float:
    """Return the rangefinder's height while it is fresh, else the height above the local origin, metres."""
    if math.isfinite(vehicle.height_m) and now_ns - vehicle.height_t_ns < RANGEFINDER_FRESH_S * S:
        return vehicle.height_m
    return -vehicle.p_ned_m[2]


class VelocityController:
    """One per flight; call `step` at every stick period and `reset` whenever the daemon did not hold the sticks."""

    def __init__(self, model: LoiterModel, tuning: VelocityTuning | None = None) -> None:
        self.model = model
        self.tuning = tuning = tuning or VelocityTuning()
        normal = PidGains(tuning.response_1_s, tuning.integral_1_s2, i_limit=tuning.integral_limit_m_s2)
        fast = PidGains(tuning.fast_response_1_s, tuning.integral_1_s2, i_limit=tuning.integral_limit_m_s2)
        self._normal, self._fast = (Pid(normal), Pid(normal)), (Pid(fast), Pid(fast))
        self._modelled_m_s2: Vector2 = (0.0, 0.0)
        self._filtered_m_s: Vector2 | None = None
        self._last_ns = 0

    def reset(self) -> None:
        """Clear the integrals, the modelled lean and the filtered velocity."""
        self._reset_loops()
        self._modelled_m_s2 = (0.0, 0.0)
        self._filtered_m_s = None
        self._last_ns = 0

    def _reset_loops(self) -> None:
        for loop in (*self._normal, *self._fast):
            loop.reset()

    def step(self, setpoint: VelocitySetpoint, vehicle: VehicleState, now_ns: int) -> Sticks:
        """Return the sticks for a setpoint at `now_ns`."""
        above_m = height_above_ground_m(vehicle, now_ns)
        dt_s = min(MAX_STEP_S, max(MIN_STEP_S, (now_ns - self._last_ns) / S)) if self._last_ns else FIRST_STEP_S
        self._last_ns = now_ns
        acceleration = None if setpoint.coast else self._acceleration(setpoint, vehicle, above_m, now_ns, dt_s)
        self._update_modelled_lean(acceleration or (0.0, 0.0), dt_s)
        roll_us, pitch_us = self._lean_sticks(acceleration, vehicle.yaw_rad)
        height_m, yaw_rad = setpoint.height_m, setpoint.yaw_rad
        climb = -setpoint.v_ned_m_s[2] if height_m is None else self._climb_m_s(height_m - above_m)
        rate = 0.0 if yaw_rad is None else self._yaw_rate_rad_s(wrap_rad(yaw_rad - vehicle.yaw_rad))
        expires_ns = now_ns + round(self.tuning.expiry_s * S)
        return Sticks(
            now_ns, expires_ns, roll_us, pitch_us, self.model.throttle.width_us(climb), self.model.yaw_us(rate)
        )

    def filtered_state(self, vehicle: VehicleState, now_ns: int) -> VehicleState:
        """Return the state now with a filtered horizontal velocity: Loiter's model, corrected by the measured one.

        A complementary filter with time constant `filter_s`; call once before every `step`. The noise of the measured
        velocity alone moves a followed line by 17 mm.
        """
        above_m = height_above_ground_m(vehicle, now_ns)
        age_s = max(0.0, min(MAX_STATE_AGE_S, (now_ns - vehicle.position_t_ns) / S))
        dt_s = min(MAX_STEP_S, max(0.0, (now_ns - self._last_ns) / S)) if self._last_ns else 0.0
        share = 1.0 - math.exp(-dt_s / self.tuning.filter_s)
        filtered = []
        for axis, modelled in enumerate(self._modelled_m_s2):
            measured = vehicle.v_ned_m_s[axis]
            v = self._filtered_m_s[axis] if self._filtered_m_s else measured
            v += dt_s * (modelled - self.model.drag_m_s2(v, above_m))
            ahead = age_s * (modelled - self.model.drag_m_s2(measured, above_m))
            filtered.append(v + share * (measured + ahead - v))
        self._filtered_m_s = (filtered[0], filtered[1])
        return replace(vehicle, v_ned_m_s=(*self._filtered_m_s, vehicle.v_ned_m_s[2]), position_t_ns=now_ns)

    def _acceleration(
        self, setpoint: VelocitySetpoint, vehicle: VehicleState, above_m: float, now_ns: int, dt_s: float
    ) -> Vector2 | None:
        """Return the acceleration (north, east; m/s2) to lean for, drag not included; None for neutral sticks."""
        v_north, v_east, _ = setpoint.v_ned_m_s
        stopping = math.hypot(v_north, v_east) < STANDSTILL_M_S
        predicted = self._predicted_m_s(now_ns, vehicle, above_m)
        if stopping and (self.tuning.stop_lean_rad == 0.0 or math.hypot(*predicted) < ACTIVE_STOP_M_S):
            self._reset_loops()
            return None
        wanted = (0.0, 0.0) if stopping else (v_north, v_east)
        max_m_s2 = G_M_S2 * math.tan(min(self.tuning.max_lean_rad, self.model.lean_max_rad))
        loops = self._fast if setpoint.fast_response else self._normal
        errors = [want - have for want, have in zip(wanted, predicted, strict=True)]
        drag = [self.model.drag_m_s2(want, above_m) for want in wanted]
        bounds = _axis_bounds(loops, errors, drag, max_m_s2)
        north, east = (
            loop.step(error, dt_s, -bound, bound, ahead)
            for loop, error, ahead, bound in zip(loops, errors, drag, bounds, strict=True)
        )
        brake_lean = self.tuning.stop_lean_rad if stopping else self.tuning.brake_lean_rad
        return _bounded((north, east), predicted, self.tuning.max_lean_rad, brake_lean)

    def _predicted_m_s(self, now_ns: int, vehicle: VehicleState, above_m: float) -> Vector2:
        """Return the velocity at the time when a lean commanded now takes effect, by Loiter's model.

        The measured attitude cannot be used: it balances the airframe's drag, not the one that Loiter models.
        """
        age_s = max(0.0, min(MAX_STATE_AGE_S, (now_ns - vehicle.position_t_ns) / S))
        ahead_s = age_s + self.tuning.lean_lag_s
        north, east = (
            v + ahead_s * (modelled - self.model.drag_m_s2(v, above_m))
            for v, modelled in zip(vehicle.v_ned_m_s[:2], self._modelled_m_s2, strict=True)
        )
        return north, east

    def _update_modelled_lean(self, acceleration: Vector2, dt_s: float) -> None:
        """Pass the commanded acceleration through a first-order model of the lean."""
        share = 1.0 - math.exp(-dt_s / self.tuning.lean_lag_s)
        self._modelled_m_s2 = (
            self._modelled_m_s2[0] + share * (acceleration[0] - self._modelled_m_s2[0]),
            self._modelled_m_s2[1] + share * (acceleration[1] - self._modelled_m_s2[1]),
        )

    def _lean_sticks(self, acceleration: Vector2 | None, yaw_rad: float) -> tuple[int, int]:
        if acceleration is None:
            return self.model.roll.trim_us, self.model.pitch.trim_us
        north, east = acceleration
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        return self.model.sticks_for_acceleration(cos * north + sin * east, cos * east - sin * north)

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


def _axis_bounds(loops: tuple[Pid, Pid], errors: list[float], drag: list[float], max_m_s2: float) -> Vector2:
    """Return bounds of both axes that shorten an acceleration beyond `max_m_s2` without changing its direction.

    With each axis bounded by `max_m_s2` itself, a velocity 21 degrees off north would first be approached at 45 degrees.
    """
    north, east = (
        abs(ahead + loop.gains.kp * error + loop.integral)
        for loop, error, ahead in zip(loops, errors, drag, strict=True)
    )
    size = math.hypot(north, east)
    return (max_m_s2, max_m_s2) if size <= max_m_s2 else (north * max_m_s2 / size, east * max_m_s2 / size)


def _bounded(acceleration: Vector2, velocity: Vector2, max_lean_rad: float, brake_lean_rad: float) -> Vector2:
    """Shorten an acceleration (m/s2) to the largest lean, and its part against the motion to the brake's lean."""
    north, east = acceleration
    speed = math.hypot(*velocity)
    if speed > STANDSTILL_M_S:
        along = (north * velocity[0] + east * velocity[1]) / speed
        excess = min(0.0, along + G_M_S2 * math.tan(brake_lean_rad))
        north, east = north - excess * velocity[0] / speed, east - excess * velocity[1] / speed
    size = math.hypot(north, east)
    max_m_s2 = G_M_S2 * math.tan(max_lean_rad)
    scale = max_m_s2 / size if size > max_m_s2 else 1.0
    return north * scale, east * scale
