"""The parameters that the autopilot twin knows, with ArduCopter's defaults, and the sets that flights start from.

Only what the twin obeys, what the daemon reads, and what a preflight check asks for is here. A name that is not in
the table is answered with silence, as ArduCopter does. Meaning and defaults: ArduCopter's parameter documentation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType

INT8, INT16, INT32, REAL32 = 2, 4, 6, 9
"""MAV_PARAM_TYPE of ArduPilot's AP_Int8, AP_Int16, AP_Int32 and AP_Float."""

CHANNELS = 16

_GENERAL: dict[str, tuple[float, int]] = {
    "MAV_GCS_SYSID": (255, INT16),
    "MAV_GCS_SYSID_HI": (0, INT16),
    "MAV_SYSID": (1, INT16),
    "MAV_TELEM_DELAY": (0, INT8),
    "ANGLE_MAX": (3000, INT16),
    "ARMING_CHECK": (1, INT32),
    "ATC_INPUT_TC": (0.15, REAL32),
    "AVOID_ACCEL_MAX": (3.0, REAL32),
    "AVOID_ANG_MAX": (1000, INT16),
    "AVOID_BACKUP_SPD": (0.75, REAL32),
    "AVOID_BACKZ_SPD": (0.75, REAL32),
    "AVOID_BACKUP_DZ": (0.10, REAL32),
    "AVOID_BEHAVE": (0, INT8),
    "AVOID_DIST_MAX": (5.0, REAL32),
    "AVOID_ENABLE": (3, INT8),
    "AVOID_MARGIN": (2.0, REAL32),
    "BATT_CAPACITY": (3300, INT32),
    "BATT_CRT_VOLT": (0.0, REAL32),
    "BATT_FS_CRT_ACT": (0, INT8),
    "BATT_FS_LOW_ACT": (0, INT8),
    "BATT_LOW_TIMER": (10, INT8),
    "BATT_LOW_VOLT": (10.5, REAL32),
    "BATT_MONITOR": (4, INT8),
    "BRD_BOOT_DELAY": (0, INT16),
    "BRD_SAFETY_DEFLT": (0, INT8),
    "DISARM_DELAY": (10, INT8),
    "EK3_ENABLE": (1, INT8),
    "EK3_MAX_FLOW": (2.5, REAL32),
    "EK3_SRC1_POSXY": (3, INT8),
    "EK3_SRC1_POSZ": (1, INT8),
    "EK3_SRC1_VELXY": (3, INT8),
    "EK3_SRC1_VELZ": (3, INT8),
    "EK3_SRC1_YAW": (1, INT8),
    "FENCE_ENABLE": (0, INT8),
    "FLOW_TYPE": (0, INT8),
    "FLTMODE_CH": (5, INT8),
    "FLTMODE1": (0, INT8),
    "FLTMODE2": (0, INT8),
    "FLTMODE3": (0, INT8),
    "FLTMODE4": (0, INT8),
    "FLTMODE5": (0, INT8),
    "FLTMODE6": (0, INT8),
    "FRAME_CLASS": (1, INT8),
    "FS_CRASH_CHECK": (1, INT8),
    "FS_EKF_ACTION": (1, INT8),
    "FS_EKF_THRESH": (0.8, REAL32),
    "FS_GCS_ENABLE": (0, INT8),
    "FS_GCS_TIMEOUT": (5.0, REAL32),
    "FS_OPTIONS": (16, INT32),
    "FS_THR_ENABLE": (1, INT8),
    "FS_THR_VALUE": (975, INT16),
    "GPS1_TYPE": (1, INT8),
    "INITIAL_MODE": (0, INT8),
    "LAND_ALT_LOW": (1000, INT16),
    "LAND_SPEED": (50, INT16),
    "LAND_SPEED_HIGH": (0, INT16),
    "LOG_DISARMED": (0, INT8),
    "LOIT_ACC_MAX": (500, REAL32),
    "LOIT_ANG_MAX": (0, REAL32),
    "LOIT_BRK_ACCEL": (250, REAL32),
    "LOIT_BRK_DELAY": (1.0, REAL32),
    "LOIT_BRK_JERK": (500, REAL32),
    "LOIT_SPEED": (1250, REAL32),
    "PILOT_ACCEL_Z": (250, INT16),
    "PILOT_SPEED_DN": (0, INT16),
    "PILOT_SPEED_UP": (250, INT16),
    "PILOT_TKOFF_ALT": (0, REAL32),
    "PILOT_Y_EXPO": (0, REAL32),
    "PILOT_Y_RATE": (202.5, REAL32),
    "PRX1_TYPE": (0, INT8),
    "PSC_JERK_XY": (5, REAL32),
    "PSC_POSXY_P": (1.0, REAL32),
    "PSC_VELXY_I": (1.0, REAL32),
    "PSC_VELXY_P": (2.0, REAL32),
    "RCMAP_PITCH": (2, INT8),
    "RCMAP_ROLL": (1, INT8),
    "RCMAP_THROTTLE": (3, INT8),
    "RCMAP_YAW": (4, INT8),
    "RC_FS_TIMEOUT": (1.0, REAL32),
    "RC_OPTIONS": (32, INT32),
    "RC_OVERRIDE_TIME": (3.0, REAL32),
    "RNGFND1_MAX": (40.0, REAL32),
    "RNGFND1_MIN": (0.2, REAL32),
    "RNGFND1_ORIENT": (25, INT8),
    "RNGFND1_TYPE": (0, INT8),
    "RSSI_TYPE": (0, INT8),
    "RTL_ALT": (1500, INT32),
    "RTL_ALT_FINAL": (0, INT16),
    "RTL_LOIT_TIME": (5000, INT32),
    "RTL_SPEED": (0, INT16),
    "SERIAL1_PROTOCOL": (2, INT8),
    "SERIAL2_PROTOCOL": (2, INT8),
    "THR_DZ": (100, INT16),
    "WPNAV_ACCEL": (250, REAL32),
    "WPNAV_SPEED": (1000, REAL32),
    "WPNAV_SPEED_DN": (150, REAL32),
    "WPNAV_SPEED_UP": (250, REAL32),
}

_OLD_NAMES = {"MAV_GCS_SYSID": "SYSID_MYGCS", "MAV_SYSID": "SYSID_THISMAV", "MAV_TELEM_DELAY": "TELEM_DELAY"}
"""What the parameters were called before ArduCopter 4.7; MAV_GCS_SYSID_HI did not exist."""

FLOW_SETUP: Mapping[str, float] = MappingProxyType(
    {
        "GPS1_TYPE": 0,
        "FLOW_TYPE": 10,
        "RNGFND1_TYPE": 100,
        "EK3_SRC1_POSXY": 0,
        "EK3_SRC1_VELXY": 5,
        "EK3_SRC1_VELZ": 0,
    }
)
"""Optical flow and a downward rangefinder instead of GPS."""

RECOMMENDED: Mapping[str, float] = MappingProxyType(
    {
        "LOIT_SPEED": 500,
        "LOIT_BRK_DELAY": 0.2,
        "RC_OVERRIDE_TIME": 1.0,
        "FS_THR_ENABLE": 3,
        "FLTMODE1": 5,
        "FLTMODE4": 2,
        "FLTMODE6": 0,
        "RNGFND1_TYPE": 10,
        "AVOID_BEHAVE": 1,
        "AVOID_BACKUP_SPD": 0,
    }
)
"""What the simulated flights start from: the settings that `doctor` asks for."""


def _channel_defaults() -> dict[str, tuple[float, int]]:
    """Return RCn_* of all channels; dead zones as ArduCopter sets them for roll, pitch, throttle and yaw."""
    dead_zone_us = {1: 20, 2: 20, 3: 30, 4: 20}
    table: dict[str, tuple[float, int]] = {}
    for n in range(1, CHANNELS + 1):
        table[f"RC{n}_MIN"] = (1000, INT16)
        table[f"RC{n}_TRIM"] = (1500, INT16)
        table[f"RC{n}_MAX"] = (2000, INT16)
        table[f"RC{n}_REVERSED"] = (0, INT8)
        table[f"RC{n}_DZ"] = (dead_zone_us.get(n, 0), INT16)
        table[f"RC{n}_OPTION"] = (0, INT16)
    return table


class ParameterTable(Mapping[str, float]):
    """Names, values and types; every value passes through its wire type, as it would on the autopilot.

    `old_names` gives the table of ArduCopter 4.6 and before (SYSID_MYGCS). `changes` are set on top of the defaults.
    """

    def __init__(self, changes: Mapping[str, float] | None = None, *, old_names: bool = False) -> None:
        table = {**_GENERAL, **_channel_defaults()}
        if old_names:
            del table["MAV_GCS_SYSID_HI"]
            table = {_OLD_NAMES.get(name, name): entry for name, entry in table.items()}
        self._types = {name: table[name][1] for name in sorted(table)}
        self._values = {name: float(table[name][0]) for name in self._types}
        self._names = list(self._types)
        self._index = {name: index for index, name in enumerate(self._names)}
        self.version = 0
        for name, value in (changes or {}).items():
            if not self.set(name, value):
                raise KeyError(name)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def set(self, name: str, value: float) -> bool:
        """Set a known parameter; integers are rounded. Returns False for an unknown name or no number."""
        if name not in self._types or not math.isfinite(value):
            return False
        self._values[name] = value if self._types[name] == REAL32 else float(round(value))
        self.version += 1
        return True

    def name_at(self, index: int) -> str | None:
        """Return the name at a MAVLink parameter index, None outside the table."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def index_of(self, name: str) -> int:
        """Return the MAVLink index of a known name."""
        return self._index[name]

    def type_of(self, name: str) -> int:
        """Return the MAV_PARAM_TYPE of a known name."""
        return self._types[name]

    def gcs_sysids(self) -> range:
        """Return the system ids whose overrides and commands are obeyed."""
        low = int(self._values.get("MAV_GCS_SYSID", self._values.get("SYSID_MYGCS", 255)))
        high = int(self._values.get("MAV_GCS_SYSID_HI", 0))
        return range(low, max(low, high) + 1)

    @property
    def flow_only(self) -> bool:
        """Optical flow without GPS."""
        return self._values["GPS1_TYPE"] == 0 and self._values["FLOW_TYPE"] != 0
