"""How ArduCopter's position modes want the vehicle to move: reference motions and the controller that follows them.

`LoiterReference` is the Loiter law as measured (docs: field facts, "Sticks in Loiter"): a stick commands a lean, the
lean accelerates, a drag that grows with speed makes it settle at v_lim tan(n theta) / tan(theta), and neutral sticks
brake after a delay. `VelocityReference` is the jerk-limited motion of every other position mode. `Tracking` turns a
reference into an acceleration, as AC_PosControl's P and PID do; since it, not the reference, meets the real drag of
the airframe, a vehicle that was flying fast stops a little sooner than its reference and rocks back.

Pure, plain floats, north and east axes, one call per physics step. Knows nothing of sticks in microseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from morpheyes_daemon.simulation.airframe.second_order import GRAVITY_M_S2, LEAN_LAG_S, SecondOrder

BRAKE_GAIN_1_S = 1.06
"""AC_Loiter takes half of PSC_VELXY_P, 1.0; recorded brakes fit best with this."""


@dataclass(frozen=True, slots=True)
class LoiterLaw:
    """The parameters of Loiter in SI units (LOIT_SPEED, LOIT_ANG_MAX, LOIT_BRK_*)."""

    speed_m_s: float
    angle_rad: float
    brake_accel_m_s2: float
    brake_jerk_m_s3: float
    brake_delay_s: float


def square_root_gain(error: float, gain: float, limit: float) -> float:
    """Return gain * error, bent to a square root where that would ask for a change faster than `limit`.

    ArduPilot's sqrt_controller: linear for |error| <= limit / gain^2.
    """
    linear = limit / (gain * gain)
    size = abs(error)
    if size <= linear:
        return gain * error
    return math.copysign(math.sqrt(2.0 * limit * (size - 0.5 * linear)), error)


class Reference:
    """A wanted motion: position (m), velocity (m/s) and acceleration (m/s^2), north and east."""

    def __init__(self) -> None:
        self.north_m = self.east_m = 0.0
        self.v_north_m_s = self.v_east_m_s = 0.0
        self.a_north_m_s2 = self.a_east_m_s2 = 0.0

    def start(self, north_m: float, east_m: float, v_north_m_s: float, v_east_m_s: float) -> None:
        """Begin at the vehicle's present motion."""
        self.north_m, self.east_m = north_m, east_m
        self.v_north_m_s, self.v_east_m_s = v_north_m_s, v_east_m_s
        self.a_north_m_s2 = self.a_east_m_s2 = 0.0

    def _move(self, dt_s: float) -> None:
        self.north_m += self.v_north_m_s * dt_s
        self.east_m += self.v_east_m_s * dt_s


class LoiterReference(Reference):
    """Loiter's answer to the pitch and roll sticks."""

    def __init__(self) -> None:
        super().__init__()
        self._forward = SecondOrder(LEAN_LAG_S)
        self._right = SecondOrder(LEAN_LAG_S)
        self._brake_m_s2 = 0.0
        self._neutral_s = 0.0

    def enter(self, lean_forward_rad: float, lean_right_rad: float) -> None:
        """Take over from another mode at its present lean."""
        self._forward.reset(lean_forward_rad)
        self._right.reset(lean_right_rad)
        self._brake_m_s2 = self._neutral_s = 0.0

    def step(
        self,
        law: LoiterLaw,
        limit_m_s: float,
        lean_forward_rad: float,
        lean_right_rad: float,
        heading: tuple[float, float],
        dt_s: float,
    ) -> None:
        """Advance by `dt_s` under the sticks' leans.

        `limit_m_s`: v_lim, LOIT_SPEED or what optical flow allows; `heading`: (cos, sin) of the yaw.
        """
        cos_yaw, sin_yaw = heading
        forward = GRAVITY_M_S2 * math.tan(self._forward.step(lean_forward_rad, dt_s))
        right = GRAVITY_M_S2 * math.tan(self._right.step(lean_right_rad, dt_s))
        north = self.v_north_m_s + (forward * cos_yaw - right * sin_yaw) * dt_s
        east = self.v_east_m_s + (forward * sin_yaw + right * cos_yaw) * dt_s
        neutral = lean_forward_rad == 0.0 and lean_right_rad == 0.0
        speed = math.hypot(north, east)
        self._brake(law, speed, neutral, dt_s)
        drag = GRAVITY_M_S2 * math.tan(law.angle_rad) * speed / limit_m_s
        slowed = min(max(speed - (drag + self._brake_m_s2) * dt_s, 0.0), limit_m_s)
        unit_north, unit_east = (north / speed, east / speed) if speed > 0.0 else (0.0, 0.0)
        self.v_north_m_s, self.v_east_m_s = unit_north * slowed, unit_east * slowed
        forward, right = GRAVITY_M_S2 * math.tan(lean_forward_rad), GRAVITY_M_S2 * math.tan(lean_right_rad)
        self.a_north_m_s2 = forward * cos_yaw - right * sin_yaw - unit_north * self._brake_m_s2
        self.a_east_m_s2 = forward * sin_yaw + right * cos_yaw - unit_east * self._brake_m_s2
        self._move(dt_s)

    def _brake(self, law: LoiterLaw, speed_m_s: float, neutral: bool, dt_s: float) -> None:
        self._neutral_s = self._neutral_s + dt_s if neutral else 0.0
        target = 0.0
        if neutral and self._neutral_s > law.brake_delay_s:
            wanted = square_root_gain(speed_m_s, BRAKE_GAIN_1_S, law.brake_jerk_m_s3)
            target = min(wanted, law.brake_accel_m_s2, speed_m_s / dt_s)
        slew = law.brake_jerk_m_s3 * dt_s
        self._brake_m_s2 += max(-slew, min(slew, target - self._brake_m_s2))


class VelocityReference(Reference):
    """A velocity reached under limited acceleration and jerk (ArduPilot's shape_vel_accel_xy)."""

    def __init__(self, accel_m_s2: float, jerk_m_s3: float) -> None:
        super().__init__()
        self._accel = accel_m_s2
        self._jerk = jerk_m_s3

    def step(self, v_north_m_s: float, v_east_m_s: float, dt_s: float) -> None:
        """Advance by `dt_s` towards the velocity."""
        gain = self._jerk / self._accel
        off_north, off_east = v_north_m_s - self.v_north_m_s, v_east_m_s - self.v_east_m_s
        off = math.hypot(off_north, off_east)
        accel = min(square_root_gain(off, gain, self._jerk), self._accel, off / dt_s)
        scale = accel / off if off > 0.0 else 0.0
        change_north = off_north * scale - self.a_north_m_s2
        change_east = off_east * scale - self.a_east_m_s2
        change = math.hypot(change_north, change_east)
        allowed = min(1.0, self._jerk * dt_s / change) if change > 0.0 else 0.0
        self.a_north_m_s2 += change_north * allowed
        self.a_east_m_s2 += change_east * allowed
        self.v_north_m_s += self.a_north_m_s2 * dt_s
        self.v_east_m_s += self.a_east_m_s2 * dt_s
        self._move(dt_s)

    def step_to(self, north_m: float, east_m: float, speed_m_s: float, dt_s: float) -> None:
        """Advance by `dt_s` towards a place, at most at `speed_m_s`."""
        off_north, off_east = north_m - self.north_m, east_m - self.east_m
        off = math.hypot(off_north, off_east)
        speed = min(square_root_gain(off, 1.0, 0.5 * self._accel), speed_m_s)
        scale = speed / off if off > 1e-6 else 0.0
        self.step(off_north * scale, off_east * scale, dt_s)


class Tracking:
    """AC_PosControl along one axis: P on position, PID on velocity, the reference's acceleration ahead.

    Gains are ArduCopter's defaults (PSC_POSXY_P, PSC_VELXY_P, _I, _D); the error's filter and the airframe's drag are
    fitted to recorded stops from 3 m/s, which are then reproduced to 0.02 m/s rms.
    """

    __slots__ = ("_derivative", "_error", "_integral")

    POSITION_P_1_S = 1.0
    VELOCITY_P_1_S = 2.0
    VELOCITY_I_1_S2 = 1.0
    VELOCITY_D = 0.25
    FILTER_HZ = 30.0
    FILTER_D_HZ = 5.0

    def __init__(self) -> None:
        self._error = self._derivative = self._integral = 0.0

    def start(self, accel_m_s2: float) -> None:
        """Begin with the acceleration that the vehicle is given at this moment."""
        self._error = self._derivative = 0.0
        self._integral = accel_m_s2

    def step(self, offset_m: float, v_offset_m_s: float, a_wanted_m_s2: float, dt_s: float) -> float:
        """Return the acceleration to ask for; offsets are wanted minus present."""
        raw = v_offset_m_s + self.POSITION_P_1_S * max(-2.0, min(2.0, offset_m))
        before = self._error
        self._error += (raw - self._error) * dt_s / (dt_s + 1.0 / (2.0 * math.pi * self.FILTER_HZ))
        slope = (self._error - before) / dt_s
        self._derivative += (slope - self._derivative) * dt_s / (dt_s + 1.0 / (2.0 * math.pi * self.FILTER_D_HZ))
        self._integral += self.VELOCITY_I_1_S2 * self._error * dt_s
        pid = self.VELOCITY_P_1_S * self._error + self._integral + self.VELOCITY_D * self._derivative
        return a_wanted_m_s2 + pid
