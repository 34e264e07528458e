"""The airframe of the simulated vehicle and the truth about it.

Takes leans, a vertical acceleration and a yaw rate, and moves: lean follows as a critically damped second-order lag,
air drags and wind pushes through that drag, propellers make the attitude shiver. Keeps the last
seconds of the truth, so that a camera can be rendered where it was. Decides nothing and knows no autopilot.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.simulation.airframe.second_order import GRAVITY_M_S2, LEAN_LAG_S, SecondOrder
from morpheyes_daemon.simulation.airframe.wind import CALM, Wind, WindConditions
from morpheyes_daemon.simulation.worlds.ground import LEVEL, Ground
from morpheyes_daemon.transforms import R_from_rpy, pose, wrap_rad

STEP_NS = 2_500_000
STEP_S = STEP_NS / 1e9
HISTORY_S = 4.0
_ROWS_KEPT = round(HISTORY_S / STEP_S)
AHEAD_NS = 100_000_000
"""How far past the newest step the truth may be extrapolated."""

_STEPS_PER_GUST = 4
_STEPS_PER_SHIVER = 2
_THRUST_LAG_S = 0.05
_YAW_LAG_S = 0.1
_SHIVER_TAU_S = 0.03


@dataclass(frozen=True, slots=True)
class Airframe:
    """What the vehicle is, as numbers.

    Drag per mass is `drag_1_s` v + `drag_1_m` v^2: what the propellers and the body of ArduCopter's simulated
    quadrotor show, fitted to recorded stops (6 degrees of lean hold 3 m/s).
    `thrust_to_weight`: 2:1 as the paper's vehicle. `shiver_rad`: one sigma of the vibration of each Euler angle.
    """

    drag_1_s: float = 0.16
    drag_1_m: float = 0.057
    thrust_to_weight: float = 2.0
    shiver_rad: float = math.radians(0.15)


@dataclass(slots=True)
class Controls:
    """What the autopilot asks of the airframe; leans are those of the thrust in body axes."""

    motors: bool = False
    lean_forward_rad: float = 0.0
    lean_right_rad: float = 0.0
    accel_up_m_s2: float = 0.0
    yaw_rate_rad_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Truth:
    """Where the vehicle really was at `t_ns`; `ground_m` is the height of the ground below it."""

    t_ns: int
    p_ned_m: tuple[float, float, float]
    v_ned_m_s: tuple[float, float, float]
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    ground_m: float = 0.0

    @property
    def T_ned_frd(self) -> NDArray[np.float64]:
        """Pose (4, 4) of the body."""
        return pose(R_from_rpy(self.roll_rad, self.pitch_rad, self.yaw_rad), np.array(self.p_ned_m))

    @property
    def height_m(self) -> float:
        """Height over the ground."""
        return -self.p_ned_m[2] - self.ground_m


_Row = tuple[float, ...]
"""Position, velocity, lean forward and right, yaw, shiver of roll, pitch and yaw: what a step leaves behind."""


class Vehicle:
    """State of the airframe; `step` moves it by `STEP_NS`."""

    def __init__(
        self,
        airframe: Airframe | None = None,
        wind: WindConditions = CALM,
        seed: int = 0,
        start_ned_m: tuple[float, float] = (0.0, 0.0),
        yaw_rad: float = 0.0,
        ground: Ground = LEVEL,
    ) -> None:
        self.airframe = airframe or Airframe()
        self.controls = Controls()
        self.wind = Wind(wind, seed)
        self.t_ns = 0
        self.ground = ground
        self.north_m, self.east_m = start_ned_m
        self.down_m = -ground.height_m(*start_ned_m)
        self.v_north_m_s = self.v_east_m_s = self.v_down_m_s = 0.0
        self.yaw_rad = yaw_rad
        self.heading = math.cos(yaw_rad), math.sin(yaw_rad)
        self.yaw_rate_rad_s = 0.0
        self.on_ground = True
        self._forward = SecondOrder(LEAN_LAG_S)
        self._right = SecondOrder(LEAN_LAG_S)
        self._accel_up = 0.0
        self._shiver = [0.0, 0.0, 0.0]
        self._random = random.Random(f"vehicle {seed}")
        self._keep = math.exp(-_STEPS_PER_SHIVER * STEP_S / _SHIVER_TAU_S)
        self._kick = self.airframe.shiver_rad * math.sqrt(1.0 - self._keep**2)
        self._count = 0
        self._newest = 0
        self._start_ns = 0
        self._rows: dict[int, _Row] = {}
        self._record()

    def start_at(self, t_ns: int) -> None:
        """Set the time of the present state, before the first step."""
        self._start_ns = self.t_ns = t_ns

    @property
    def height_m(self) -> float:
        """Height over the ground."""
        return -self.down_m - self.ground_m

    @property
    def ground_m(self) -> float:
        """Height of the ground below, over the start of the course."""
        return self.ground.height_m(self.north_m, self.east_m)

    @property
    def surface_m(self) -> float:
        """Height of what is right below, ground or a bush, over the start of the course."""
        below = self.ground.range_m((self.north_m, self.east_m, self.down_m), (0.0, 0.0, 1.0))
        return -self.down_m - below

    @property
    def lean_rad(self) -> tuple[float, float]:
        """Lean of the thrust, forward and right, without vibration."""
        return self._forward.value, self._right.value

    @property
    def accel_ne_m_s2(self) -> tuple[float, float]:
        """Acceleration that the present lean gives, north and east."""
        forward = GRAVITY_M_S2 * math.tan(self._forward.value)
        right = GRAVITY_M_S2 * math.tan(self._right.value)
        cos_yaw, sin_yaw = self.heading
        return forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw

    def step(self) -> None:
        """Move by `STEP_NS` under `controls`."""
        self.t_ns += STEP_NS
        self._count += 1
        if self._count % _STEPS_PER_GUST == 0 and not self.on_ground:
            speed = math.hypot(self.v_north_m_s, self.v_east_m_s)
            self.wind.advance(_STEPS_PER_GUST * STEP_S, self.height_m, speed)
        if self.on_ground and not self._lifts():
            self._rest()
        else:
            self._turn()
            self._fly()
        self._record()

    def _lifts(self) -> bool:
        return self.controls.motors and self.controls.accel_up_m_s2 > 0.0

    def _rest(self) -> None:
        self.v_north_m_s = self.v_east_m_s = self.v_down_m_s = 0.0
        self.yaw_rate_rad_s = self._accel_up = 0.0
        self._forward.step(0.0, STEP_S)
        self._right.step(0.0, STEP_S)
        self._shiver[:] = (0.0, 0.0, 0.0)

    def _turn(self) -> None:
        wanted = self.controls.yaw_rate_rad_s if self.controls.motors else 0.0
        if self._count % _STEPS_PER_SHIVER == 0:
            self._shake()
        self.yaw_rate_rad_s += (wanted - self.yaw_rate_rad_s) * STEP_S / _YAW_LAG_S
        self.yaw_rad = wrap_rad(self.yaw_rad + self.yaw_rate_rad_s * STEP_S)
        self.heading = math.cos(self.yaw_rad), math.sin(self.yaw_rad)

    def _shake(self) -> None:
        gauss, shiver = self._random.gauss, self._shiver
        for axis in (0, 1, 2):
            shiver[axis] = self._keep * shiver[axis] + self._kick * gauss()

    def _fly(self) -> None:
        controls = self.controls
        self._forward.step(controls.lean_forward_rad, STEP_S)
        self._right.step(controls.lean_right_rad, STEP_S)
        north, east = self.accel_ne_m_s2 if controls.motors else (0.0, 0.0)
        wind_north, wind_east, wind_down = self.wind.velocity_ned_m_s
        air_north, air_east = wind_north - self.v_north_m_s, wind_east - self.v_east_m_s
        drag = self.airframe.drag_1_s + self.airframe.drag_1_m * math.hypot(air_north, air_east)
        self.v_north_m_s += (north + drag * air_north) * STEP_S
        self.v_east_m_s += (east + drag * air_east) * STEP_S
        most = (self.airframe.thrust_to_weight - 1.0) * GRAVITY_M_S2
        wanted = max(-GRAVITY_M_S2, min(most, controls.accel_up_m_s2)) if controls.motors else -GRAVITY_M_S2
        self._accel_up += (wanted - self._accel_up) * STEP_S / _THRUST_LAG_S
        self.v_down_m_s += (-self._accel_up + drag * (wind_down - self.v_down_m_s)) * STEP_S
        self.north_m += self.v_north_m_s * STEP_S
        self.east_m += self.v_east_m_s * STEP_S
        self.down_m += self.v_down_m_s * STEP_S
        floor = -self.ground_m
        self.on_ground = self.down_m >= floor and self.v_down_m_s >= 0.0
        if self.on_ground:
            self.down_m = floor
            self._rest()

    def _record(self) -> None:
        """Keep what this step left behind; keyed by step, so that a render thread may read meanwhile."""
        position = self.north_m, self.east_m, self.down_m
        velocity = self.v_north_m_s, self.v_east_m_s, self.v_down_m_s
        self._rows[self._count] = (*position, *velocity, *self.lean_rad, self.yaw_rad, *self._shiver)
        self._rows.pop(self._count - _ROWS_KEPT, None)
        self._newest = self._count

    def attitude_rad(self) -> tuple[float, float, float]:
        """Return roll, pitch, yaw of the body, vibration included."""
        return _attitude(*self.lean_rad, self.yaw_rad, *self._shiver)

    def truth_at(self, t_ns: int) -> Truth:
        """Return the truth at `t_ns`, interpolated, or extrapolated by at most `AHEAD_NS`.

        Raises InputError for a time that is no longer, or not yet, known.
        """
        newest = self._newest
        steps = (t_ns - self._start_ns) / STEP_NS
        if 0 in self._rows:
            steps = max(steps, 0.0)  # before its first step the vehicle stood where it started
        index = min(math.floor(steps), newest - 1)
        before, after = self._rows.get(index), self._rows.get(index + 1)
        if steps > newest + AHEAD_NS / STEP_NS or after is None:
            raise InputError(f"the truth at {t_ns} ns is not known; the newest is of {self.t_ns} ns.")
        a, b, part = before or after, after, steps - index
        mix = [x + (y - x) * part for x, y in zip(a, b, strict=True)]
        mix[8] = a[8] + wrap_rad(b[8] - a[8]) * part
        ground_m = self.ground.height_m(mix[0], mix[1])
        return Truth(t_ns, (mix[0], mix[1], mix[2]), (mix[3], mix[4], mix[5]), *_attitude(*mix[6:]), ground_m)


def _attitude(
    forward_rad: float, right_rad: float, yaw_rad: float, d_roll: float, d_pitch: float, d_yaw: float
) -> tuple[float, float, float]:
    """Return roll, pitch, yaw of a thrust that leans forward and right, shaken by the last three."""
    roll = math.atan(math.tan(right_rad) * math.cos(forward_rad))
    return roll + d_roll, -forward_rad + d_pitch, wrap_rad(yaw_rad + d_yaw)
