"""What the autopilot says, gathered into one VehicleState; each message touches its own group and stamp.

Messages that are not finite are taken as not received, so that their group goes stale. Nothing is judged here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from morpheyes_daemon.devices.autopilot.boot_clock import BootClock
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.wire.mavlink import Message

ARMED_FLAG = 128
DOWNWARD = 25
"""MAV_SENSOR_ROTATION_PITCH_270: a rangefinder that looks at the ground."""
ON_GROUND = 1
CHANNELS = 16


class Telemetry:
    """Holds the newest state; `take` returns the new one, None for a message that changes nothing."""

    def __init__(self) -> None:
        self.state = VehicleState()
        self.boot = BootClock()
        self._takers: dict[str, Callable[[Message, int], dict[str, Any] | None]] = {
            "HEARTBEAT": self._heartbeat,
            "ATTITUDE": self._attitude,
            "LOCAL_POSITION_NED": self._position,
            "RC_CHANNELS": self._rc,
            "DISTANCE_SENSOR": self._distance,
            "EKF_STATUS_REPORT": self._ekf,
            "GPS_RAW_INT": self._gps,
            "SYS_STATUS": self._status,
            "EXTENDED_SYS_STATE": self._landed,
        }

    def take(self, message: Message, now_ns: int) -> VehicleState | None:
        """Fold a message of the vehicle, received at `now_ns`, into the state."""
        taker = self._takers.get(message.get_type())
        changes = None if taker is None else taker(message, now_ns)
        if changes is None:
            return None
        self.state = replace(self.state, t_ns=now_ns, **changes)
        return self.state

    def take_gcs(self, now_ns: int) -> VehicleState:
        """The ground station's heartbeat came through."""
        self.state = replace(self.state, t_ns=now_ns, gcs_t_ns=now_ns)
        return self.state

    def _heartbeat(self, message: Message, now_ns: int) -> dict[str, Any]:
        return {
            "heartbeat_t_ns": now_ns,
            "armed": bool(message.base_mode & ARMED_FLAG),
            "custom_mode": message.custom_mode,
            "system_status": message.system_status,
        }

    def _attitude(self, message: Message, now_ns: int) -> dict[str, Any] | None:
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        if not _finite(message.roll, message.pitch, message.yaw, *rates):
            return None
        return {
            "attitude_t_ns": self.boot.stamp_ns(message.time_boot_ms, now_ns),
            "roll_rad": message.roll,
            "pitch_rad": message.pitch,
            "yaw_rad": message.yaw,
            "rates_frd_rad_s": rates,
        }

    def _position(self, message: Message, now_ns: int) -> dict[str, Any] | None:
        p = (message.x, message.y, message.z)
        v = (message.vx, message.vy, message.vz)
        if not _finite(*p, *v):
            return None
        return {
            "position_t_ns": self.boot.stamp_ns(message.time_boot_ms, now_ns),
            "p_ned_m": p,
            "v_ned_m_s": v,
        }

    def _rc(self, message: Message, now_ns: int) -> dict[str, Any]:
        widths = (getattr(message, f"chan{i}_raw") for i in range(1, CHANNELS + 1))
        return {
            "rc_t_ns": self.boot.stamp_ns(message.time_boot_ms, now_ns),
            "rc_us": tuple(0 if width == 65535 else width for width in widths),
            "rc_rssi": message.rssi,
        }

    def _distance(self, message: Message, now_ns: int) -> dict[str, Any] | None:
        """The rangefinder measures along the body; what counts is straight down."""
        if message.orientation != DOWNWARD:
            return None
        if not message.min_distance <= message.current_distance <= message.max_distance:
            return None
        upright = math.cos(self.state.roll_rad) * math.cos(self.state.pitch_rad)
        return {
            "height_t_ns": self.boot.stamp_ns(message.time_boot_ms, now_ns),
            "height_m": message.current_distance / 100.0 * upright,
        }

    def _ekf(self, message: Message, now_ns: int) -> dict[str, Any]:
        return {"ekf_t_ns": now_ns, "ekf_flags": message.flags}

    def _gps(self, message: Message, now_ns: int) -> dict[str, Any]:
        return {"gps_fix": message.fix_type}

    def _status(self, message: Message, now_ns: int) -> dict[str, Any]:
        known_v, known_share = message.voltage_battery != 65535, message.battery_remaining >= 0
        return {
            "battery_v": message.voltage_battery / 1000.0 if known_v else math.nan,
            "battery_fraction": message.battery_remaining / 100.0 if known_share else math.nan,
            "sensors_present": message.onboard_control_sensors_present,
            "sensors_health": message.onboard_control_sensors_health,
        }

    def _landed(self, message: Message, now_ns: int) -> dict[str, Any]:
        return {"landed": message.landed_state == ON_GROUND}


def _finite(*values: float) -> bool:
    return all(math.isfinite(value) for value in values)
