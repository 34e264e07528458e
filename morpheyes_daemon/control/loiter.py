"""Model of ArduCopter's Loiter: sticks to speed and back, from the vehicle's own parameters.

Loiter turns a stick into a lean angle with drag, so a held stick settles at a speed: with the deflection n beyond the
dead zone, v = v_lim tan(n theta) / tan(theta), with time constant v_lim / (g tan(theta)). Everything here is read
from the autopilot (RCMAP_*, RCn_*, LOIT_*, PILOT_*). No loop is closed here.

Sticks are always in the order roll, pitch, throttle, yaw; the autopilot link's stick output has the channel map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from morpheyes_daemon.control import parameters as p
from morpheyes_daemon.control.stopping import G_M_S2, Brake, StoppingTable
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.safety import Widths

MIN_LIMIT_M_S = 0.2
"""Smallest speed limit of Loiter, however low the vehicle flies over its flow sensor.

Source: data sheet, ArduCopter AC_Loiter.cpp, LOITER_SPEED_MIN."""

_FLOW_ROWS = 16
"""Speed limits for which stopping distances are tabulated when the flow sensor bounds the speed. Unit: rows.

Chosen: interpolation error against the time to compute the table."""


@dataclass(frozen=True, slots=True)
class StickAxis:
    """One channel as RCn_MIN, RCn_MAX, RCn_TRIM, RCn_DZ and RCn_REVERSED describe it."""

    number: int
    min_us: int
    max_us: int
    trim_us: int
    dead_us: int
    reversed: bool

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, float], number: int) -> StickAxis:
        """Read channel `number`; raises DeviceError naming a missing parameter or an impossible range."""

        def read(key: str) -> int:
            return round(p.Quantity(((f"RC{number}_{key}", 1.0),)).read(parameters))

        axis = cls(number, read("MIN"), read("MAX"), read("TRIM"), read("DZ"), read("REVERSED") != 0)
        if not axis.min_us + 2 * axis.dead_us < axis.max_us:
            raise DeviceError(
                f"RC{number}_MIN {axis.min_us} and RC{number}_MAX {axis.max_us} leave no room for a stick:"
                " calibrate the radio."
            )
        return axis

    def require_centred(self) -> StickAxis:
        """Return itself when the trim lies inside the range; raises DeviceError when it lies at an end."""
        room = min(self.trim_us - self.min_us, self.max_us - self.trim_us) - self.dead_us
        if room <= 0:
            raise DeviceError(
                f"RC{self.number}_TRIM {self.trim_us} lies at the end of the stick's range: calibrate the radio."
            )
        return self

    def deflection(self, width_us: float) -> float:
        """Return the deflection, -1 to 1, that Loiter takes from a pulse width (RC_Channel::pwm_to_angle_dz)."""
        if width_us > self.trim_us + self.dead_us:
            n = (width_us - self.trim_us - self.dead_us) / (self.max_us - self.trim_us - self.dead_us)
        elif width_us < self.trim_us - self.dead_us:
            n = (width_us - self.trim_us + self.dead_us) / (self.trim_us - self.dead_us - self.min_us)
        else:
            n = 0.0
        return max(-1.0, min(1.0, -n if self.reversed else n))

    def width_us(self, deflection: float) -> int:
        """Return the pulse width for a deflection, -1 to 1, outside the dead zone; 0 gives the trim."""
        n = max(-1.0, min(1.0, -deflection if self.reversed else deflection))
        if n == 0.0:
            return self.trim_us
        side = 1 if n > 0 else -1
        end_us = self.max_us if n > 0 else self.min_us
        start_us = self.trim_us + side * self.dead_us
        # one microsecond beyond the dead zone at least, or rounding would turn a small command into the trim
        beyond = max(1, round(abs(n) * abs(end_us - start_us)))
        return start_us + side * beyond


@dataclass(frozen=True, slots=True)
class ThrottleAxis:
    """The throttle stick: its dead band THR_DZ lies around mid-range, whatever its trim."""

    axis: StickAxis
    dead_band: float
    up_m_s: float
    down_m_s: float

    @property
    def neutral_us(self) -> int:
        """Mid-range; RC3_TRIM is often the minimum, which would be a full descent."""
        return (self.axis.min_us + self.axis.max_us) // 2

    def _control(self, width_us: float) -> float:
        axis = self.axis
        width_us = axis.max_us - (width_us - axis.min_us) if axis.reversed else width_us
        start_us = axis.min_us + axis.dead_us
        return max(0.0, min(1.0, (width_us - start_us) / (axis.max_us - start_us)))

    def climb_m_s(self, width_us: float) -> float:
        """Return the climb rate, positive up, of a pulse width (Mode::get_pilot_desired_climb_rate)."""
        middle = self._control(self.neutral_us)
        control = self._control(width_us)
        top, bottom = middle + self.dead_band, middle - self.dead_band
        if control > top:
            return self.up_m_s * (control - top) / (1.0 - top)
        if control < bottom:
            return -self.down_m_s * (bottom - control) / bottom
        return 0.0

    def width_us(self, climb_m_s: float) -> int:
        """Return the pulse width for a climb rate, clipped to PILOT_SPEED_UP and PILOT_SPEED_DN."""
        if climb_m_s == 0.0:
            return self.neutral_us
        middle = self._control(self.neutral_us)
        top, bottom = middle + self.dead_band, middle - self.dead_band
        if climb_m_s > 0.0:
            control = top + min(1.0, climb_m_s / self.up_m_s) * (1.0 - top)
        else:
            control = bottom - min(1.0, -climb_m_s / self.down_m_s) * bottom
        axis = self.axis
        start_us = axis.min_us + axis.dead_us
        width = start_us + control * (axis.max_us - start_us)
        width = axis.max_us - (width - axis.min_us) if axis.reversed else width
        return max(axis.min_us, min(axis.max_us, round(width)))


@dataclass(frozen=True, slots=True)
class LoiterModel:
    """Sticks to speed and back, and stopping distances. Immutable; make a new one when parameters change."""

    roll: StickAxis
    pitch: StickAxis
    throttle: ThrottleAxis
    yaw: StickAxis
    speed_limit_m_s: float
    lean_max_rad: float
    yaw_rate_max_rad_s: float
    flow_rate_1_s: float | None
    brake: Brake
    _stopping: StoppingTable

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, float]) -> LoiterModel:
        """Build the model from the autopilot's parameters by name; raises DeviceError naming what is missing."""
        axes = _mapped_axes(parameters)
        up = p.PILOT_SPEED_UP.read(parameters)
        throttle = ThrottleAxis(axes[2], p.THR_DZ.read(parameters), up, abs(p.PILOT_SPEED_DN.read(parameters)) or up)
        lean_max = p.LOIT_ANG_MAX.read(parameters) or p.ANGLE_MAX.read(parameters) * 2.0 / 3.0
        brake = Brake(
            p.LOIT_BRK_ACCEL.read(parameters),
            p.LOIT_BRK_JERK.read(parameters),
            p.LOIT_BRK_DELAY.read(parameters),
            p.VELOCITY_P.read(parameters) / 2.0,
        )
        limit, rate = p.LOIT_SPEED.read(parameters), p.PILOT_Y_RATE.read(parameters)
        on_flow = round(p.VELOCITY_SOURCE.read(parameters)) == p.OPTICAL_FLOW
        flow = max(0.0, p.FLOW_RATE.read(parameters) - 1.0) if on_flow else None
        _require_plausible(limit, lean_max, throttle, rate, brake)
        table = _stopping_table(tuple(_limit_grid(limit) if on_flow else [limit]), lean_max, brake)
        return cls(axes[0], axes[1], throttle, axes[3], limit, lean_max, rate, flow, brake, table)

    @property
    def neutral(self) -> Widths:
        """Neutral sticks: standing still at the present height."""
        return self.roll.trim_us, self.pitch.trim_us, self.throttle.neutral_us, self.yaw.trim_us

    @property
    def minimum(self) -> Widths:
        """Smallest pulse width of each stick."""
        return self.roll.min_us, self.pitch.min_us, self.throttle.axis.min_us, self.yaw.min_us

    @property
    def maximum(self) -> Widths:
        """Largest pulse width of each stick."""
        return self.roll.max_us, self.pitch.max_us, self.throttle.axis.max_us, self.yaw.max_us

    def limit_m_s(self, height_m: float) -> float:
        """Return v_lim: LOIT_SPEED, or the lower limit of the flow sensor at this height above ground.

        An unknown height (NaN) gives LOIT_SPEED, which means the smaller stick and the longer stop.
        """
        if self.flow_rate_1_s is None or not math.isfinite(height_m):
            return self.speed_limit_m_s
        return max(MIN_LIMIT_M_S, min(self.speed_limit_m_s, self.flow_rate_1_s * height_m))

    def time_constant_s(self, height_m: float) -> float:
        """Return the time constant with which a stick's speed is approached."""
        return self.limit_m_s(height_m) / (G_M_S2 * math.tan(self.lean_max_rad))

    def drag_m_s2(self, speed_m_s: float, height_m: float) -> float:
        """Return the deceleration that Loiter's drag gives at a speed."""
        return speed_m_s / self.time_constant_s(height_m)

    def sticks_for_acceleration(self, forward_m_s2: float, right_m_s2: float) -> tuple[int, int]:
        """Return (roll, pitch) pulse widths that lean for an acceleration in heading axes, drag not counted.

        Exactly zero gives the trim, which after LOIT_BRK_DELAY brakes; anything else stays out of the dead zone.
        """
        roll = math.atan(right_m_s2 / G_M_S2) / self.lean_max_rad
        pitch = -math.atan(forward_m_s2 / G_M_S2) / self.lean_max_rad
        size = math.hypot(roll, pitch)
        if size > 1.0:
            roll, pitch = roll / size, pitch / size
        return self.roll.width_us(roll), self.pitch.width_us(pitch)

    def sticks_for_speed(self, forward_m_s: float, right_m_s: float, height_m: float) -> tuple[int, int]:
        """Return (roll, pitch) pulse widths that settle at a velocity in heading axes, clipped at full lean."""
        scale = 1.0 / self.time_constant_s(height_m)
        return self.sticks_for_acceleration(forward_m_s * scale, right_m_s * scale)

    def speed_for_sticks(self, roll_us: float, pitch_us: float, height_m: float) -> tuple[float, float]:
        """Return the (forward, right) speed at which these pulse widths settle."""
        limit = self.limit_m_s(height_m) / math.tan(self.lean_max_rad)
        roll, pitch = self.roll.deflection(roll_us), self.pitch.deflection(pitch_us)
        size = max(1.0, math.hypot(roll, pitch))
        return (
            -limit * math.tan(pitch / size * self.lean_max_rad),
            limit * math.tan(roll / size * self.lean_max_rad),
        )

    def yaw_us(self, rate_rad_s: float) -> int:
        """Return the yaw pulse width for a turn rate, clockwise from above positive."""
        return self.yaw.width_us(rate_rad_s / self.yaw_rate_max_rad_s)

    def yaw_rate_rad_s(self, width_us: float) -> float:
        """Return the turn rate of a yaw pulse width."""
        return self.yaw.deflection(width_us) * self.yaw_rate_max_rad_s

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the distance to standstill: `reaction_s` at the same speed, then neutral sticks."""
        return self._stopping.distance_m(speed_m_s, self.limit_m_s(height_m), reaction_s)

    def speed_for_distance_m(self, distance_m: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the largest speed from which the vehicle stops within `distance_m`; 0 when none does."""
        return self._stopping.speed_m_s(distance_m, self.limit_m_s(height_m), reaction_s)


def _require_plausible(
    limit_m_s: float, lean_rad: float, throttle: ThrottleAxis, yaw_rad_s: float, brake: Brake
) -> None:
    """Raise DeviceError for implausible parameters; the bounds lie well outside ArduCopter's own."""
    rows = (
        ("LOIT_SPEED", limit_m_s, 0.1, 100.0, "m/s"),
        ("LOIT_ANG_MAX, or two thirds of ANGLE_MAX,", lean_rad, 0.01, 1.5, "rad"),
        ("LOIT_BRK_ACCEL", brake.accel_m_s2, 0.0, 100.0, "m/s2"),
        ("LOIT_BRK_JERK", brake.jerk_m_s3, 0.1, 1000.0, "m/s3"),
        ("LOIT_BRK_DELAY", brake.delay_s, 0.0, 10.0, "s"),
        ("half of PSC_VELXY_P", brake.gain_1_s, 0.01, 100.0, "1/s"),
        ("PILOT_SPEED_UP", throttle.up_m_s, 0.01, 100.0, "m/s"),
        ("PILOT_SPEED_DN", throttle.down_m_s, 0.01, 100.0, "m/s"),
        ("THR_DZ", throttle.dead_band, 0.0, 0.45, "of the stick's range"),
        ("PILOT_Y_RATE", yaw_rad_s, 0.01, 100.0, "rad/s"),
    )
    for name, value, low, high, unit in rows:
        if not low <= value <= high:
            raise DeviceError(f"{name} is {value:g} {unit}, outside {low:g} to {high:g}: correct the parameter.")


def _mapped_axes(parameters: Mapping[str, float]) -> tuple[StickAxis, StickAxis, StickAxis, StickAxis]:
    names = ("RCMAP_ROLL", "RCMAP_PITCH", "RCMAP_THROTTLE", "RCMAP_YAW")
    numbers = [round(p.Quantity(((name, 1.0),)).read(parameters)) for name in names]
    if sorted(numbers) != [1, 2, 3, 4]:
        found = ", ".join(f"{name} {number}" for name, number in zip(names, numbers, strict=True))
        raise DeviceError(f"The four sticks must be on channels 1 to 4, but it has {found}.")
    roll, pitch, throttle, yaw = (StickAxis.from_parameters(parameters, number) for number in numbers)
    return roll.require_centred(), pitch.require_centred(), throttle, yaw.require_centred()


@lru_cache(maxsize=16)
def _stopping_table(limits_m_s: tuple[float, ...], lean_max_rad: float, brake: Brake) -> StoppingTable:
    """Cached: parameters that do not matter here change in flight, and the table takes long to compute."""
    return StoppingTable(list(limits_m_s), lean_max_rad, brake)


def _limit_grid(limit_m_s: float) -> list[float]:
    """Return speed limits from the smallest to `limit_m_s`, equally spaced in their logarithm."""
    low = min(MIN_LIMIT_M_S, limit_m_s / 2)
    ratio = (limit_m_s / low) ** (1.0 / (_FLOW_ROWS - 1))
    return [low * ratio**i for i in range(_FLOW_ROWS - 1)] + [limit_m_s]
