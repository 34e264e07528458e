"""What the autopilot believes about its motion: truth with delay, noise, slow drift, and the health of it.

Stands for the EKF, the rangefinder and the optical-flow sensor. The velocity error is a first-order process, since an
EKF's error is not white; the position error is a random walk, as it is for any estimator without an absolute sensor.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from enum import IntFlag

from morpheyes_daemon.clock import S
from morpheyes_daemon.simulation.airframe.dynamics import Truth, Vehicle
from morpheyes_daemon.simulation.autopilot.parameters import ParameterTable


class Ekf(IntFlag):
    """EKF_STATUS_FLAGS."""

    ATTITUDE = 0x01
    VELOCITY_HORIZ = 0x02
    VELOCITY_VERT = 0x04
    POS_HORIZ_REL = 0x08
    POS_HORIZ_ABS = 0x10
    POS_VERT_ABS = 0x20
    POS_VERT_AGL = 0x40
    CONST_POS_MODE = 0x80
    PRED_POS_HORIZ_REL = 0x100
    PRED_POS_HORIZ_ABS = 0x200


_COMMON = Ekf.ATTITUDE | Ekf.VELOCITY_VERT | Ekf.POS_VERT_ABS
_WAITING = _COMMON | Ekf.CONST_POS_MODE
_WITH_GPS = (
    _COMMON
    | Ekf.VELOCITY_HORIZ
    | Ekf.POS_HORIZ_REL
    | Ekf.POS_HORIZ_ABS
    | Ekf.PRED_POS_HORIZ_REL
    | Ekf.PRED_POS_HORIZ_ABS
)
_COASTING = _COMMON | Ekf.VELOCITY_HORIZ | Ekf.POS_VERT_AGL
_WITH_FLOW = _COMMON | Ekf.VELOCITY_HORIZ | Ekf.POS_HORIZ_REL | Ekf.POS_VERT_AGL | Ekf.PRED_POS_HORIZ_REL


@dataclass(frozen=True, slots=True)
class Coasting:
    """What the autopilot says, and when, after the aiding is lost.

    `told_s`: the sensor counts as lost; `flags_s`: the EKF's flags say so, and ten counts of the failsafe at 10 Hz
    later it lands; `reported_s`: until then velocity and position are reported.
    """

    told_s: float
    flags_s: float
    reported_s: float


WITHOUT_FLOW = Coasting(told_s=0.5, flags_s=0.9, reported_s=5.0)
WITHOUT_GPS = Coasting(told_s=0.0, flags_s=7.6, reported_s=16.8)
"""As ArduCopter 4.7 does in its own simulator."""

_UNAIDED_M_S_SQRT_S = 0.1
"""How fast the velocity estimate walks away without aiding."""


@dataclass(frozen=True, slots=True)
class EstimatorNoise:
    """How wrong the estimates are; sigmas of one axis."""

    velocity_m_s: float = 0.05
    velocity_tau_s: float = 0.3
    drift_m_sqrt_s: float = 0.02
    attitude_rad: float = math.radians(0.2)
    attitude_tau_s: float = 1.0
    height_m: float = 0.02
    delay_ns: int = 20_000_000


NOISELESS = EstimatorNoise(velocity_m_s=0.0, drift_m_sqrt_s=0.0, attitude_rad=0.0, height_m=0.0, delay_ns=0)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Believed motion: ned relative to the start, attitude, body rates, height by the rangefinder."""

    p_ned_m: tuple[float, float, float]
    v_ned_m_s: tuple[float, float, float]
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rates_frd_rad_s: tuple[float, float, float]
    range_m: float


class _Coloured:
    """Independent first-order noise on several axes."""

    def __init__(self, count: int, sigma: float, tau_s: float, rng: random.Random) -> None:
        self.values = [0.0] * count
        self._sigma, self._tau_s, self._random = sigma, tau_s, rng

    def advance(self, dt_s: float) -> None:
        keep = math.exp(-dt_s / self._tau_s)
        kick = self._sigma * math.sqrt(1.0 - keep * keep)
        self.values = [keep * value + kick * self._random.gauss() for value in self.values]


class Estimator:
    """Errors of the estimates and the EKF's flags; `advance` once per autopilot tick."""

    def __init__(
        self, vehicle: Vehicle, table: ParameterTable, noise: EstimatorNoise, seed: int, ready_after_s: float
    ) -> None:
        self._vehicle, self._table, self.noise = vehicle, table, noise
        self._random = random.Random(f"estimator {seed}")
        self._velocity = _Coloured(3, noise.velocity_m_s, noise.velocity_tau_s, self._random)
        self._attitude = _Coloured(3, noise.attitude_rad, noise.attitude_tau_s, self._random)
        self.drift_m = [0.0, 0.0, 0.0]
        self._boot_ns = 0
        self._ready_after_ns = round(ready_after_s * S)
        self._origin_set = False
        self._aiding_lost_ns: int | None = None
        self._unaided_m_s = [0.0, 0.0]
        self.variance = 0.05
        self._t_ns = 0

    def boot(self, t_ns: int) -> None:
        """Start over: no origin, not ready."""
        self._boot_ns = self._t_ns = t_ns
        self._origin_set = False

    def set_origin(self) -> bool:
        """Set the EKF origin; returns False when there is one already.

        Before the EKF is aiding it is taken and then lost, as on the real one.
        """
        if self.has_origin:
            return False
        if self._started():
            self._origin_set = True
        return True

    @property
    def has_origin(self) -> bool:
        """The EKF knows where on Earth it is."""
        return self._origin_set or (not self._table.flow_only and self._warm())

    def lose_aiding(self) -> None:
        """The flow sensor (or GPS) stops delivering."""
        self._aiding_lost_ns = self._aiding_lost_ns or self._t_ns

    def regain_aiding(self) -> None:
        """The sensor delivers again."""
        self._aiding_lost_ns = None
        self._unaided_m_s = [0.0, 0.0]

    def _warm(self) -> bool:
        return self._t_ns - self._boot_ns >= self._ready_after_ns

    @property
    def _coasting(self) -> Coasting:
        return WITHOUT_FLOW if self._table.flow_only else WITHOUT_GPS

    def _lost_for(self, time_s: float) -> bool:
        return self._aiding_lost_ns is not None and self._t_ns - self._aiding_lost_ns >= round(time_s * S)

    @property
    def aided(self) -> bool:
        """The flow sensor, or GPS, is believed to deliver."""
        return self._started() and not self._lost_for(self._coasting.told_s)

    def _started(self) -> bool:
        """The EKF has once been given all it needs."""
        return self._warm() and not (self._table.flow_only and self._table["RNGFND1_TYPE"] == 0)

    @property
    def flags(self) -> Ekf:
        """Return EKF_STATUS_REPORT.flags."""
        if not self._started() or self._lost_for(self._coasting.reported_s):
            return _WAITING
        if self._lost_for(self._coasting.flags_s):
            return _COASTING
        return _WITH_FLOW if self._table.flow_only else _WITH_GPS

    @property
    def has_position(self) -> bool:
        """Position control is possible."""
        return bool(self.flags & Ekf.POS_HORIZ_REL)

    @property
    def dead_reckons(self) -> bool:
        """Velocity and position are still reported and flown on, perhaps without aiding."""
        return self._started() and not self._lost_for(self._coasting.reported_s)

    @property
    def healthy(self) -> bool:
        """What the EKF failsafe looks at: a position and variances below FS_EKF_THRESH."""
        return self.has_position and self.variance < self._table["FS_EKF_THRESH"]

    def advance(self, t_ns: int, dt_s: float) -> None:
        """Step the errors."""
        self._t_ns = t_ns
        self._velocity.advance(dt_s)
        self._attitude.advance(dt_s)
        kick = self.noise.drift_m_sqrt_s * math.sqrt(dt_s)
        self.drift_m[0] += kick * self._random.gauss()
        self.drift_m[1] += kick * self._random.gauss()
        if self._aiding_lost_ns is not None:
            self._walk_away(dt_s)

    def _walk_away(self, dt_s: float) -> None:
        kick = _UNAIDED_M_S_SQRT_S * math.sqrt(dt_s)
        for axis in (0, 1):
            self._unaided_m_s[axis] += kick * self._random.gauss()
            self.drift_m[axis] += self._unaided_m_s[axis] * dt_s

    def estimate(self) -> Estimate:
        """Return what the autopilot reports now."""
        t_ns = self._vehicle.t_ns - self.noise.delay_ns
        truth, before = self._vehicle.truth_at(t_ns), self._vehicle.truth_at(t_ns - 10_000_000)
        v, e, walk = truth.v_ned_m_s, self._velocity.values, self._unaided_m_s
        p, drift = truth.p_ned_m, self.drift_m
        errors = self._attitude.values
        return Estimate(
            p_ned_m=(p[0] + drift[0], p[1] + drift[1], p[2] + drift[2]),
            v_ned_m_s=(v[0] + e[0] + walk[0], v[1] + e[1] + walk[1], v[2] + e[2]),
            roll_rad=truth.roll_rad + errors[0],
            pitch_rad=truth.pitch_rad + errors[1],
            yaw_rad=_wrapped(truth.yaw_rad + errors[2]),
            rates_frd_rad_s=_body_rates(before, truth),
            range_m=self._range_m(truth),
        )

    def _range_m(self, truth: Truth) -> float:
        tilt = math.cos(truth.roll_rad) * math.cos(truth.pitch_rad)
        north, east, _ = truth.T_ned_frd[:3, 2]
        distance = self._vehicle.ground.range_m(truth.p_ned_m, (float(north), float(east), max(0.3, tilt)))
        distance += self.noise.height_m * self._random.gauss()
        return min(max(distance, self._table["RNGFND1_MIN"]), self._table["RNGFND1_MAX"])


def _wrapped(angle_rad: float) -> float:
    return math.atan2(math.sin(angle_rad), math.cos(angle_rad))


def _body_rates(before: Truth, now: Truth) -> tuple[float, float, float]:
    """Return p, q, r from two attitudes (Euler rates to body rates)."""
    dt_s = (now.t_ns - before.t_ns) / S
    roll = (now.roll_rad - before.roll_rad) / dt_s
    pitch = (now.pitch_rad - before.pitch_rad) / dt_s
    yaw = _wrapped(now.yaw_rad - before.yaw_rad) / dt_s
    cr, sr, cp, sp = (
        math.cos(now.roll_rad),
        math.sin(now.roll_rad),
        math.cos(now.pitch_rad),
        math.sin(now.pitch_rad),
    )
    return roll - yaw * sp, pitch * cr + yaw * sr * cp, yaw * cr * cp - pitch * sr
