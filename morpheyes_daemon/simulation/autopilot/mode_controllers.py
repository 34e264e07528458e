"""What each flight mode does with the sticks: from mode and pilot to the controls of the airframe.

Horizontally a reference motion is followed by `Tracking`, in the modes without position control the sticks set the
lean. Vertically a climb rate is followed, except in STABILIZE. Position is controlled on the estimate, so a drifting
estimate carries the vehicle along. Arming, failsafes and who chose the mode are the autopilot twin's business.
"""

from __future__ import annotations

import math
from enum import Enum, auto

from morpheyes_daemon.simulation.airframe.dynamics import STEP_S, Vehicle
from morpheyes_daemon.simulation.airframe.second_order import GRAVITY_M_S2
from morpheyes_daemon.simulation.autopilot.flight_modes import FlightSettings, Mode
from morpheyes_daemon.simulation.autopilot.position_controller import (
    LoiterReference,
    Reference,
    Tracking,
    VelocityReference,
)
from morpheyes_daemon.simulation.autopilot.rc_input import PilotInput

_BRAKE_ACCEL_M_S2 = 1.6
_BRAKE_JERK_M_S3 = 1.6
"""Fitted to the measured stop of BRAKE mode (field facts: 3.6 s and 5.2 m from 3 m/s)."""

_HEIGHT_P_1_S = 1.0
_CLIMB_P_1_S = 5.0
_SURFACE_TRACKING_S = 1.0
"""With a downward rangefinder Loiter keeps its height over what is below, smoothed over SURFTRAK_TC (ArduCopter 4)."""
_SPOOL_UP_S = 2.0
_LANDED_AFTER_S = 1.0
_HOME_M = 0.5


class Phase(Enum):
    """Where RTL is."""

    CLIMB = auto()
    RETURN = auto()
    WAIT = auto()
    LAND = auto()


class FlightControl:
    """Flies the vehicle in the present mode; `step` once per physics step."""

    def __init__(self, vehicle: Vehicle, settings: FlightSettings) -> None:
        self._vehicle = vehicle
        self.settings = settings
        self.mode = Mode.STABILIZE
        self.armed = False
        self.landed = True
        self.has_position = False
        self.dead_reckons = False
        self.drift_m = (0.0, 0.0)
        self.home_ne_m = (0.0, 0.0)
        self._armed_s = 0.0
        self._ground_s = 0.0
        self._loiter = LoiterReference()
        self._moving: VelocityReference | None = None
        self._north, self._east = Tracking(), Tracking()
        self._climb_m_s = 0.0
        self._height_m = self._surface_m = self._rise_m_s = 0.0
        self._takeoff_m: float | None = None
        self._phase = Phase.CLIMB
        self._phase_s = 0.0
        self._leaning: tuple[PilotInput | None, float, tuple[float, float]] = None, 0.0, (0.0, 0.0)
        self._wait_s = 0.0
        self._blind = False

    def arm(self) -> None:
        """Start the motors; they need a moment to spin up."""
        self.armed, self.landed, self._armed_s = True, True, 0.0
        self.home_ne_m = self._estimate()
        self._takeoff_m = None

    def disarm(self) -> None:
        """Stop the motors, in the air too."""
        self.armed = False

    def set_mode(self, mode: Mode, wait_s: float = 0.0) -> None:
        """Change the flight mode and start its motion from the present one; LAND descends after `wait_s`."""
        self.mode = mode
        self._wait_s = wait_s
        self._blind = not self.has_position
        self._takeoff_m = None
        self._phase, self._phase_s = Phase.CLIMB, 0.0
        self._start_horizontal()
        self._start_vertical()

    def take_off(self, height_m: float) -> None:
        """Climb to `height_m` over the ground; GUIDED only."""
        self._takeoff_m = height_m

    @property
    def taking_off(self) -> bool:
        """A commanded take-off has not reached its height."""
        return self._takeoff_m is not None and self._vehicle.height_m < self._takeoff_m - 0.2

    def _estimate(self) -> tuple[float, float]:
        return self._vehicle.north_m + self.drift_m[0], self._vehicle.east_m + self.drift_m[1]

    def _start_horizontal(self) -> None:
        vehicle, settings = self._vehicle, self.settings
        if self.mode is Mode.BRAKE:
            self._moving = VelocityReference(_BRAKE_ACCEL_M_S2, _BRAKE_JERK_M_S3)
        else:
            self._moving = VelocityReference(settings.position_accel_m_s2, settings.position_jerk_m_s3)
        north, east = self._estimate()
        for reference in (self._loiter, self._moving):
            reference.start(north, east, vehicle.v_north_m_s, vehicle.v_east_m_s)
        self._loiter.enter(*vehicle.lean_rad)
        for axis, accel in zip((self._north, self._east), vehicle.accel_ne_m_s2, strict=True):
            axis.start(accel)

    def _start_vertical(self) -> None:
        self._climb_m_s = -self._vehicle.v_down_m_s
        self._surface_m, self._rise_m_s = self._vehicle.surface_m, 0.0
        self._height_m = -self._vehicle.down_m - self._surface_m

    def step(self, pilot: PilotInput) -> None:
        """Set the vehicle's controls for the next physics step."""
        controls = self._vehicle.controls
        controls.motors = self.armed
        if not self.armed:
            self.landed = self._vehicle.on_ground
            return
        self._armed_s += STEP_S
        self._phase_s += STEP_S
        climb = self._wanted_climb_m_s(pilot)
        self._watch_ground(climb)
        if self.landed:
            self._idle()
            return
        controls.yaw_rate_rad_s = pilot.yaw * self.settings.yaw_rate_rad_s if self.mode is not Mode.BRAKE else 0.0
        controls.accel_up_m_s2 = self._vertical(climb, pilot)
        controls.lean_forward_rad, controls.lean_right_rad = self._horizontal(pilot)

    def _idle(self) -> None:
        controls = self._vehicle.controls
        controls.lean_forward_rad = controls.lean_right_rad = controls.yaw_rate_rad_s = 0.0
        controls.accel_up_m_s2 = 0.0
        self._start_horizontal()
        self._start_vertical()

    def _watch_ground(self, climb_m_s: float) -> None:
        """Leave the ground on a wish to climb, find it again after a second of resting on it without one."""
        if self.landed:
            if climb_m_s > 0.0 and self._armed_s > _SPOOL_UP_S:
                self.landed, self._ground_s = False, 0.0
        elif self._vehicle.on_ground and climb_m_s <= 0.0:
            self._ground_s += STEP_S
            self.landed = self._ground_s > _LANDED_AFTER_S
        else:
            self._ground_s = 0.0

    def _wanted_climb_m_s(self, pilot: PilotInput) -> float:
        if self.mode in (Mode.LAND, Mode.RTL, Mode.GUIDED, Mode.BRAKE):
            return self._automatic_climb_m_s()
        if not pilot.valid:
            return 0.0
        if self.mode.manual_throttle:
            return pilot.throttle - pilot.throttle_middle
        wanted = self.settings.climb_rate_m_s(pilot.throttle, pilot.throttle_middle)
        return min(wanted, max(0.0, self.settings.ceiling_m - self._vehicle.height_m))

    def _automatic_climb_m_s(self) -> float:
        if self.mode is Mode.LAND:
            return self._descent_m_s()
        if self.mode is Mode.RTL:
            return self._rtl_climb_m_s()
        if self._takeoff_m is None:
            return 0.0
        off = self._takeoff_m - self._vehicle.height_m
        return max(-self.settings.land_m_s, min(self.settings.takeoff_m_s, off))

    def _descent_m_s(self) -> float:
        if self.mode is Mode.LAND and self._phase_s < self._wait_s:
            return 0.0
        high = self._vehicle.height_m > self.settings.land_low_m
        return -(self.settings.descend_m_s if high else self.settings.land_m_s)

    def _rtl_climb_m_s(self) -> float:
        height, wanted = self._vehicle.height_m, self.settings.rtl_height_m
        north, east = self._estimate()
        if self._phase is Phase.CLIMB and height > wanted - 0.3:
            self._enter(Phase.RETURN)
        if self._phase is Phase.RETURN and math.hypot(north - self.home_ne_m[0], east - self.home_ne_m[1]) < _HOME_M:
            self._enter(Phase.WAIT)
        if self._phase is Phase.WAIT and self._phase_s > self.settings.rtl_wait_s:
            self._enter(Phase.LAND)
        if self._phase is Phase.CLIMB:
            return max(0.0, min(self.settings.takeoff_m_s, wanted - height))
        return self._descent_m_s() if self._phase is Phase.LAND else 0.0

    def _enter(self, phase: Phase) -> None:
        self._phase, self._phase_s = phase, 0.0

    def _vertical(self, climb_m_s: float, pilot: PilotInput) -> float:
        vehicle = self._vehicle
        if self.mode.manual_throttle:
            self._start_vertical()
            hover = max(1.0, pilot.throttle_middle)
            return GRAVITY_M_S2 * (pilot.throttle / hover - 1.0) if pilot.valid else -GRAVITY_M_S2
        most = self.settings.climb_accel_m_s2 * STEP_S
        change = max(-most, min(most, climb_m_s - self._climb_m_s))
        self._climb_m_s += change
        self._height_m += self._climb_m_s * STEP_S
        if self.settings.surface_tracking:
            rise_m_s = (vehicle.surface_m - self._surface_m) / _SURFACE_TRACKING_S
            self._surface_m += rise_m_s * STEP_S
            self._rise_m_s += max(-most, min(most, rise_m_s - self._rise_m_s))
        off_m = max(-1.0, min(1.0, self._height_m + self._surface_m + vehicle.down_m))
        wanted = self._climb_m_s + self._rise_m_s + _HEIGHT_P_1_S * off_m
        return change / STEP_S + _CLIMB_P_1_S * (wanted + vehicle.v_down_m_s)

    def _horizontal(self, pilot: PilotInput) -> tuple[float, float]:
        """Return the lean, forward and right."""
        if self.mode in (Mode.STABILIZE, Mode.ALT_HOLD):
            return self._stick_lean(pilot, self.settings.angle_rad)
        if not self.dead_reckons or (self._blind and self.mode is Mode.LAND):
            return 0.0, 0.0
        heading = self._vehicle.heading
        return self._follow(self._reference(pilot, heading), heading)

    def _reference(self, pilot: PilotInput, heading: tuple[float, float]) -> Reference:
        if self.mode is Mode.LOITER:
            law = self.settings.loiter
            lean = self._stick_lean(pilot, law.angle_rad)
            self._loiter.step(law, self.speed_limit_m_s, *lean, heading, STEP_S)
            return self._loiter
        assert self._moving is not None
        if self.mode is Mode.RTL and self._phase is not Phase.CLIMB:
            self._moving.step_to(*self.home_ne_m, self.settings.travel_m_s, STEP_S)
        else:
            self._moving.step(0.0, 0.0, STEP_S)
        return self._moving

    def _stick_lean(self, pilot: PilotInput, angle_rad: float) -> tuple[float, float]:
        """Return `_lean`, worked out again only when the sticks moved."""
        if pilot is not self._leaning[0] or angle_rad != self._leaning[1]:
            self._leaning = pilot, angle_rad, _lean(pilot, angle_rad)
        return self._leaning[2]

    @property
    def speed_limit_m_s(self) -> float:
        """The speed that a full stick gives in Loiter."""
        speed = self.settings.loiter.speed_m_s
        if math.isinf(self.settings.ceiling_m):
            return speed
        return max(0.2, min(speed, self.settings.flow_rate_rad_s * self._vehicle.height_m))

    def _follow(self, wanted: Reference, heading: tuple[float, float]) -> tuple[float, float]:
        vehicle, (cos_yaw, sin_yaw) = self._vehicle, heading
        at_north, at_east = self._estimate()
        north = self._north.step(
            wanted.north_m - at_north, wanted.v_north_m_s - vehicle.v_north_m_s, wanted.a_north_m_s2, STEP_S
        )
        east = self._east.step(
            wanted.east_m - at_east, wanted.v_east_m_s - vehicle.v_east_m_s, wanted.a_east_m_s2, STEP_S
        )
        most = GRAVITY_M_S2 * math.tan(self.settings.angle_rad)
        scale = min(1.0, most / max(1e-9, math.hypot(north, east)))
        forward = (north * cos_yaw + east * sin_yaw) * scale
        right = (east * cos_yaw - north * sin_yaw) * scale
        return math.atan(forward / GRAVITY_M_S2), math.atan(right / GRAVITY_M_S2)


def _lean(pilot: PilotInput, angle_rad: float) -> tuple[float, float]:
    """Return the lean, forward and right, that the sticks ask for, limited as one thrust vector."""
    forward, right = math.tan(-pilot.pitch * angle_rad), math.tan(pilot.roll * angle_rad)
    scale = min(1.0, math.tan(angle_rad) / max(1e-9, math.hypot(forward, right)))
    return math.atan(forward * scale), math.atan(right * scale)
