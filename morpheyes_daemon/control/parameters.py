"""The autopilot's parameters in SI units, whatever their name and unit in the firmware at hand.

ArduPilot renames parameters and changes their units between releases (4.6: LOIT_SPEED in cm/s, 4.8: LOIT_SPEED_MS
in m/s). Only this table holds names and units; it does not talk to an autopilot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from morpheyes_daemon.errors import DeviceError

CENTI = 0.01
"""Hundredths to whole units (cm/s to m/s, centidegrees to degrees). Unit: none. Source: equation, 1/100."""
DEG = math.pi / 180.0
"""One degree. Unit: rad. Source: equation, pi/180."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One autopilot parameter: its (name, factor to SI) in each firmware generation, and the SI value when absent."""

    names: tuple[tuple[str, float], ...]
    default: float | None = None

    def find(self, parameters: Mapping[str, float]) -> tuple[str, float] | None:
        """Return (name, SI value) of the first generation present in `parameters`, None when none is present."""
        for name, factor in self.names:
            if name in parameters:
                return name, parameters[name] * factor
        return None

    def read(self, parameters: Mapping[str, float]) -> float:
        """Return the SI value; raises DeviceError naming the parameter when it is missing and has no default."""
        found = self.find(parameters)
        if found is not None:
            return found[1]
        if self.default is None:
            names = " nor ".join(name for name, _ in self.names)
            raise DeviceError(f"The autopilot has no parameter {names}: check that it runs ArduCopter 4.0 or newer.")
        return self.default

    def change(self, parameters: Mapping[str, float], si: float) -> dict[str, float]:
        """Return {name: value} that sets the SI value `si`, in the name and unit of this autopilot's generation."""
        name, factor = next((row for row in self.names if row[0] in parameters), self.names[0])
        return {name: round(si / factor, 9)}


LOIT_SPEED = Quantity((("LOIT_SPEED", CENTI), ("LOIT_SPEED_MS", 1.0)))
"""Speed of full stick in Loiter. Unit: m/s. Source: data sheet, ArduCopter parameter list, LOIT_SPEED."""
LOIT_ANG_MAX = Quantity((("LOIT_ANG_MAX", DEG),), 0.0)
"""Largest lean in Loiter; 0 means two thirds of ANGLE_MAX.

Unit: rad. Source: data sheet, ArduCopter parameter list, LOIT_ANG_MAX."""
ANGLE_MAX = Quantity((("ANGLE_MAX", CENTI * DEG), ("ATC_ANGLE_MAX", DEG)), 30.0 * DEG)
"""Largest lean in any mode. Unit: rad. Source: data sheet, ArduCopter parameter list, ANGLE_MAX."""
LOIT_BRK_ACCEL = Quantity((("LOIT_BRK_ACCEL", CENTI), ("LOIT_BRK_ACC_M", 1.0)))
"""Deceleration of Loiter's brake. Unit: m/s2. Source: data sheet, ArduCopter parameter list, LOIT_BRK_ACCEL."""
LOIT_BRK_JERK = Quantity((("LOIT_BRK_JERK", CENTI), ("LOIT_BRK_JRK_M", 1.0)))
"""Jerk of Loiter's brake. Unit: m/s3. Source: data sheet, ArduCopter parameter list, LOIT_BRK_JERK."""
LOIT_BRK_DELAY = Quantity((("LOIT_BRK_DELAY", 1.0),))
"""Time from neutral stick to the brake. Unit: s. Source: data sheet, ArduCopter parameter list, LOIT_BRK_DELAY."""
VELOCITY_P = Quantity((("PSC_VELXY_P", 1.0), ("PSC_NE_VEL_P", 1.0)), 2.0)
"""P gain of the horizontal velocity controller.

Unit: 1/s. Source: data sheet, ArduCopter parameter list, PSC_VELXY_P."""
PILOT_Y_RATE = Quantity((("PILOT_Y_RATE", DEG),), 202.5 * DEG)
"""Yaw rate of full stick. Unit: rad/s. Source: data sheet, ArduCopter parameter list, PILOT_Y_RATE."""
PILOT_SPEED_UP = Quantity((("PILOT_SPEED_UP", CENTI), ("PILOT_SPD_UP", 1.0)))
"""Climb rate of full throttle stick. Unit: m/s. Source: data sheet, ArduCopter parameter list, PILOT_SPEED_UP."""
PILOT_SPEED_DN = Quantity((("PILOT_SPEED_DN", CENTI), ("PILOT_SPD_DN", 1.0)), 0.0)
"""Descent rate of zero throttle stick; 0 means PILOT_SPEED_UP.

Unit: m/s. Source: data sheet, ArduCopter parameter list, PILOT_SPEED_DN."""
THR_DZ = Quantity((("THR_DZ", 1e-3), ("PILOT_THR_DZ", 1e-3)), 0.1)
"""Half width of the throttle's dead band, as a share of the stick's range.

Unit: none. Source: data sheet, ArduCopter parameter list, THR_DZ."""
FLOW_RATE = Quantity((("EK3_MAX_FLOW", 1.0), ("EK3_FLOW_MAX", 1.0)), 2.5)
"""Largest optical flow rate that the EKF takes.

Unit: rad/s. Source: data sheet, ArduCopter parameter list, EK3_MAX_FLOW."""
VELOCITY_SOURCE = Quantity((("EK3_SRC1_VELXY", 1.0),), 3.0)
"""The EKF's source of horizontal velocity, an enumeration.

Unit: none. Source: data sheet, ArduCopter parameter list, EK3_SRC1_VELXY."""
RTL_ALTITUDE = Quantity((("RTL_ALT", CENTI), ("RTL_ALT_M", 1.0)), 15.0)
"""Height of the return to launch. Unit: m. Source: data sheet, ArduCopter parameter list, RTL_ALT."""
GCS_SYSID = Quantity((("MAV_GCS_SYSID", 1.0), ("SYSID_MYGCS", 1.0)))
"""System id whose overrides are accepted. Unit: none. Source: data sheet, ArduCopter parameter list, MAV_GCS_SYSID."""

OPTICAL_FLOW = 5
"""Value of EK3_SRC1_VELXY for optical flow.

Unit: none. Source: data sheet, ArduCopter parameter list, EK3_SRC1_VELXY."""
