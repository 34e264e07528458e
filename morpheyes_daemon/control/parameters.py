"""The autopilot's parameters in SI units, whatever their name and unit in the firmware at hand.

ArduPilot renames parameters and changes their units between releases (4.6: LOIT_SPEED in cm/s, 4.8: LOIT_SPEED_MS
in m/s). This table is the only place that knows; it asks no autopilot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from morpheyes_daemon.errors import DeviceError

CENTI = 0.01
DEG = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a parameter means: its (name, factor to SI) in each generation, and its value where it does not exist."""

    names: tuple[tuple[str, float], ...]
    default: float | None = None

    def find(self, parameters: Mapping[str, float]) -> tuple[str, float] | None:
        """Return (name, SI value) of the first generation that the autopilot knows, None when it knows none."""
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
        """Return {name: value} that sets it on this autopilot, in the name and unit of its generation."""
        name, factor = next((row for row in self.names if row[0] in parameters), self.names[0])
        return {name: round(si / factor, 9)}


LOIT_SPEED = Quantity((("LOIT_SPEED", CENTI), ("LOIT_SPEED_MS", 1.0)))
LOIT_ANG_MAX = Quantity((("LOIT_ANG_MAX", DEG),), 0.0)
ANGLE_MAX = Quantity((("ANGLE_MAX", CENTI * DEG), ("ATC_ANGLE_MAX", DEG)), 30.0 * DEG)
LOIT_BRK_ACCEL = Quantity((("LOIT_BRK_ACCEL", CENTI), ("LOIT_BRK_ACC_M", 1.0)))
LOIT_BRK_JERK = Quantity((("LOIT_BRK_JERK", CENTI), ("LOIT_BRK_JRK_M", 1.0)))
LOIT_BRK_DELAY = Quantity((("LOIT_BRK_DELAY", 1.0),))
VELOCITY_P = Quantity((("PSC_VELXY_P", 1.0), ("PSC_NE_VEL_P", 1.0)), 2.0)
PILOT_Y_RATE = Quantity((("PILOT_Y_RATE", DEG),), 202.5 * DEG)
PILOT_SPEED_UP = Quantity((("PILOT_SPEED_UP", CENTI), ("PILOT_SPD_UP", 1.0)))
PILOT_SPEED_DN = Quantity((("PILOT_SPEED_DN", CENTI), ("PILOT_SPD_DN", 1.0)), 0.0)
THR_DZ = Quantity((("THR_DZ", 1e-3), ("PILOT_THR_DZ", 1e-3)), 0.1)
FLOW_RATE = Quantity((("EK3_MAX_FLOW", 1.0), ("EK3_FLOW_MAX", 1.0)), 2.5)
VELOCITY_SOURCE = Quantity((("EK3_SRC1_VELXY", 1.0),), 3.0)
RTL_ALTITUDE = Quantity((("RTL_ALT", CENTI), ("RTL_ALT_M", 1.0)), 15.0)
GCS_SYSID = Quantity((("MAV_GCS_SYSID", 1.0), ("SYSID_MYGCS", 1.0)))

OPTICAL_FLOW = 5
"""EK3_SRC1_VELXY: optical flow."""
