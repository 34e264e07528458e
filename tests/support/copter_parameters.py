"""The parameters of a plain ArduCopter 4.6 that tests start from."""

from __future__ import annotations


def copter_parameters(**changes: float) -> dict[str, float]:
    """Return the stick, Loiter and failsafe parameters, with `changes` on top."""
    parameters: dict[str, float] = {}
    for number in range(1, 9):
        parameters |= {
            f"RC{number}_MIN": 1000.0,
            f"RC{number}_MAX": 2000.0,
            f"RC{number}_TRIM": 1500.0,
            f"RC{number}_DZ": 20.0,
            f"RC{number}_REVERSED": 0.0,
        }
    parameters |= {"RC3_DZ": 30.0, "RC3_TRIM": 1000.0}
    parameters |= {"RCMAP_ROLL": 1.0, "RCMAP_PITCH": 2.0, "RCMAP_THROTTLE": 3.0, "RCMAP_YAW": 4.0}
    parameters |= {"LOIT_SPEED": 500.0, "LOIT_ANG_MAX": 0.0, "ANGLE_MAX": 3000.0}
    parameters |= {"LOIT_BRK_ACCEL": 250.0, "LOIT_BRK_JERK": 500.0, "LOIT_BRK_DELAY": 0.2}
    parameters |= {"PILOT_Y_RATE": 202.5, "PILOT_SPEED_UP": 250.0, "PILOT_SPEED_DN": 0.0, "THR_DZ": 100.0}
    parameters |= {"PSC_VELXY_P": 2.0, "EK3_SRC1_VELXY": 3.0, "EK3_MAX_FLOW": 2.5}
    parameters |= {"SYSID_MYGCS": 255.0, "FS_THR_ENABLE": 3.0, "RC_OVERRIDE_TIME": 0.5, "RC_OPTIONS": 32.0}
    return parameters | changes
