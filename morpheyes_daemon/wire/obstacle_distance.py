"""Nearest obstacle per direction as OBSTACLE_DISTANCE, the autopilot's own second brake.

To ArduPilot 0, 65535, below the minimum and above the maximum all mean "no obstacle": what is too near to measure
must go out as a small valid distance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import SECTORS
from morpheyes_daemon.wire.mavlink import Message, dialect

MIN_CM = 5
UNKNOWN = 65535
_UNKNOWN_SENSOR = 4
_BODY_FRD = 12


def obstacle_distance_message(sectors_m: NDArray[np.float32], h_fov_rad: float, max_m: float, now_ns: int) -> Message:
    """Return the message for (72,) distances, left to right over the horizontal field of view; NaN: nothing known.

    Distances below the valid minimum become the smallest valid one; beyond `max_m` there is no obstacle.
    """
    if sectors_m.shape != (SECTORS,):
        raise ValueError(f"{SECTORS} sectors are needed, not {sectors_m.shape}")
    max_cm = min(UNKNOWN - 2, round(max_m * 100))
    return dialect.MAVLink_obstacle_distance_message(
        time_usec=now_ns // 1000,
        sensor_type=_UNKNOWN_SENSOR,
        distances=[_centimetres(float(d), max_cm) for d in sectors_m],
        increment=0,
        min_distance=MIN_CM,
        max_distance=max_cm,
        increment_f=math.degrees(h_fov_rad) / SECTORS,
        angle_offset=-math.degrees(h_fov_rad) / 2,
        frame=_BODY_FRD,
    )


def _centimetres(distance_m: float, max_cm: int) -> int:
    if math.isnan(distance_m):
        return UNKNOWN
    if distance_m * 100 > max_cm:
        return max_cm + 1
    return max(MIN_CM + 1, round(distance_m * 100))
