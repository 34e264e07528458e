"""ArduCopter's flight modes as far as the twin flies them, and the parameters they fly by in SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from morpheyes_daemon.simulation.autopilot.parameters import ParameterTable
from morpheyes_daemon.simulation.autopilot.position_controller import LoiterLaw

_LOITER_SPEED_LEAST_M_S = 0.2


class Mode(IntEnum):
    """Custom mode numbers."""

    STABILIZE = 0
    ALT_HOLD = 2
    GUIDED = 4
    LOITER = 5
    RTL = 6
    LAND = 9
    BRAKE = 17

    @property
    def needs_position(self) -> bool:
        """The mode cannot be entered, or kept, without a position estimate."""
        return self in (Mode.GUIDED, Mode.LOITER, Mode.RTL, Mode.BRAKE)

    @property
    def manual_throttle(self) -> bool:
        """The throttle stick is thrust, not climb rate."""
        return self is Mode.STABILIZE

    @property
    def landing(self) -> bool:
        """The mode ends on the ground by itself."""
        return self in (Mode.LAND, Mode.RTL)


@dataclass(frozen=True, slots=True)
class FlightSettings:
    """What the modes need of the parameter table."""

    loiter: LoiterLaw
    angle_rad: float
    yaw_rate_rad_s: float
    climb_m_s: float
    sink_m_s: float
    climb_accel_m_s2: float
    throttle_dead: float
    flow_rate_rad_s: float
    ceiling_m: float
    position_accel_m_s2: float
    position_jerk_m_s3: float
    takeoff_m_s: float
    travel_m_s: float
    descend_m_s: float
    land_m_s: float
    land_low_m: float
    rtl_height_m: float
    rtl_wait_s: float
    surface_tracking: bool

    @classmethod
    def of(cls, table: ParameterTable) -> FlightSettings:
        """Read the table; see ArduCopter's documentation for each name."""
        angle = math.radians(table["ANGLE_MAX"] / 100.0)
        up = table["PILOT_SPEED_UP"] / 100.0
        return cls(
            loiter=LoiterLaw(
                speed_m_s=max(_LOITER_SPEED_LEAST_M_S, table["LOIT_SPEED"] / 100.0),
                angle_rad=math.radians(table["LOIT_ANG_MAX"]) or angle * 2.0 / 3.0,
                brake_accel_m_s2=table["LOIT_BRK_ACCEL"] / 100.0,
                brake_jerk_m_s3=max(0.1, table["LOIT_BRK_JERK"] / 100.0),
                brake_delay_s=table["LOIT_BRK_DELAY"],
            ),
            angle_rad=angle,
            yaw_rate_rad_s=math.radians(table["PILOT_Y_RATE"]),
            climb_m_s=up,
            sink_m_s=table["PILOT_SPEED_DN"] / 100.0 or up,
            climb_accel_m_s2=table["PILOT_ACCEL_Z"] / 100.0,
            throttle_dead=table["THR_DZ"],
            flow_rate_rad_s=max(0.0, table["EK3_MAX_FLOW"] - 1.0),
            ceiling_m=max(1.0, 0.7 * table["RNGFND1_MAX"] - 1.0) if table.flow_only else math.inf,
            position_accel_m_s2=table["WPNAV_ACCEL"] / 100.0,
            position_jerk_m_s3=table["PSC_JERK_XY"],
            takeoff_m_s=table["WPNAV_SPEED_UP"] / 100.0,
            travel_m_s=(table["RTL_SPEED"] or table["WPNAV_SPEED"]) / 100.0,
            descend_m_s=(table["LAND_SPEED_HIGH"] or table["WPNAV_SPEED_DN"]) / 100.0,
            land_m_s=table["LAND_SPEED"] / 100.0,
            land_low_m=table["LAND_ALT_LOW"] / 100.0,
            rtl_height_m=table["RTL_ALT"] / 100.0,
            rtl_wait_s=table["RTL_LOIT_TIME"] / 1000.0,
            surface_tracking=table["RNGFND1_TYPE"] != 0,
        )

    def climb_rate_m_s(self, throttle: float, middle: float) -> float:
        """Return the climb rate that the throttle stick asks for; `throttle` and `middle` are 0 to 1000."""
        top, bottom = middle + self.throttle_dead, middle - self.throttle_dead
        if throttle > top:
            return self.climb_m_s * (throttle - top) / (1000.0 - top)
        if throttle < bottom:
            return self.sink_m_s * (throttle - bottom) / bottom
        return 0.0
