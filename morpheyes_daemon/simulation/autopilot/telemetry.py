"""The messages that the autopilot twin can stream, each built from its present state.

Values and units as ArduCopter fills them. Which message goes to which link at which rate is the twin's business.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.core import Autopilot
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode

Message = Any
"""A pymavlink message; the dialect module is untyped."""

HOME_LAT_DEG, HOME_LON_DEG, HOME_ALT_M = -35.363262, 149.165237, 584.0
"""Where ArduPilot's own simulator starts."""

_METRES_PER_DEG = 111_319.49
_FIRMWARE = 4 << 24 | 7 << 16
_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_SENSOR_YAW_POSITION
    | mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
)
_RC_HEALTH = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER


def heartbeat(autopilot: Autopilot) -> Message:
    """HEARTBEAT with ArduCopter's custom mode."""
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    base |= mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED if autopilot.mode is not Mode.GUIDED else 0
    base |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED if autopilot.mode in (Mode.GUIDED, Mode.RTL, Mode.LOITER) else 0
    base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if autopilot.armed else 0
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base,
        int(autopilot.mode),
        _state(autopilot),
        3,
    )


def _state(autopilot: Autopilot) -> int:
    if autopilot.in_failsafe:
        return int(mavlink.MAV_STATE_CRITICAL)
    return int(mavlink.MAV_STATE_STANDBY if autopilot.control.landed else mavlink.MAV_STATE_ACTIVE)


def _attitude(autopilot: Autopilot) -> Message:
    e = autopilot.estimate
    return mavlink.MAVLink_attitude_message(autopilot.boot_ms, e.roll_rad, e.pitch_rad, e.yaw_rad, *e.rates_frd_rad_s)


def _local_position(autopilot: Autopilot) -> Message | None:
    if not autopilot.estimator.dead_reckons:
        return None
    e = autopilot.estimate
    return mavlink.MAVLink_local_position_ned_message(autopilot.boot_ms, *e.p_ned_m, *e.v_ned_m_s)


def _lat_lon_e7(autopilot: Autopilot) -> tuple[int, int]:
    north, east, _ = autopilot.estimate.p_ned_m
    lat = HOME_LAT_DEG + north / _METRES_PER_DEG
    lon = HOME_LON_DEG + east / (_METRES_PER_DEG * math.cos(math.radians(HOME_LAT_DEG)))
    return round(lat * 1e7), round(lon * 1e7)


def _global_position(autopilot: Autopilot) -> Message:
    e = autopilot.estimate
    height_mm = round(-e.p_ned_m[2] * 1e3)
    vx, vy, vz = (round(v * 100) for v in e.v_ned_m_s)
    heading = round(math.degrees(e.yaw_rad) * 100) % 36000
    altitude_mm = round(HOME_ALT_M * 1e3) + height_mm
    return mavlink.MAVLink_global_position_int_message(
        autopilot.boot_ms, *_lat_lon_e7(autopilot), altitude_mm, height_mm, vx, vy, vz, heading
    )


def _fix(autopilot: Autopilot) -> int:
    if autopilot.table["GPS1_TYPE"] == 0:
        return int(mavlink.GPS_FIX_TYPE_NO_GPS)
    return int(mavlink.GPS_FIX_TYPE_RTK_FIXED if autopilot.estimator.aided else mavlink.GPS_FIX_TYPE_NO_FIX)


def _gps_raw(autopilot: Autopilot) -> Message:
    fitted = autopilot.table["GPS1_TYPE"] != 0
    lat, lon = _lat_lon_e7(autopilot) if fitted else (0, 0)
    vn, ve, _ = autopilot.estimate.v_ned_m_s
    return mavlink.MAVLink_gps_raw_int_message(
        autopilot.t_ns // 1000,
        _fix(autopilot),
        lat,
        lon,
        round((HOME_ALT_M - autopilot.estimate.p_ned_m[2]) * 1e3) if fitted else 0,
        121 if fitted else 65535,
        200 if fitted else 65535,
        round(math.hypot(vn, ve) * 100) if fitted else 0,
        round(math.degrees(math.atan2(ve, vn)) * 100) % 36000 if fitted else 0,
        10 if fitted else 0,
    )


def _sys_status(autopilot: Autopilot) -> Message:
    flow_only = autopilot.table.flow_only
    aiding = mavlink.MAV_SYS_STATUS_SENSOR_OPTICAL_FLOW if flow_only else mavlink.MAV_SYS_STATUS_SENSOR_GPS
    delivers = autopilot.estimator.aided or not flow_only  # a GPS receiver without a fix counts as healthy
    present = _SENSORS | _RC_HEALTH | aiding | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    health = _SENSORS
    health |= _RC_HEALTH if autopilot.rc.ever_seen and not autopilot.rc.failsafe else 0
    health |= aiding if delivers else 0
    health |= mavlink.MAV_SYS_STATUS_PREARM_CHECK if autopilot.ready_to_arm else 0
    battery = autopilot.battery
    return mavlink.MAVLink_sys_status_message(
        present,
        present,
        health,
        210,
        round(battery.voltage_v * 1000),
        round(battery.current_a * 100),
        round(battery.fraction * 100),
        0,
        0,
        0,
        0,
        0,
        0,
    )


def _battery_status(autopilot: Autopilot) -> Message:
    battery = autopilot.battery
    cells = [round(battery.voltage_v * 1000)] + [65535] * 9
    charge = mavlink.MAV_BATTERY_CHARGE_STATE_LOW if battery.low else mavlink.MAV_BATTERY_CHARGE_STATE_OK
    used_mah = round((1.0 - battery.fraction) * autopilot.table["BATT_CAPACITY"])
    return mavlink.MAVLink_battery_status_message(
        0, 0, 0, 32767, cells, round(battery.current_a * 100), used_mah, -1, round(battery.fraction * 100), 0, charge
    )


def _ekf_status(autopilot: Autopilot) -> Message:
    v = autopilot.estimator.variance
    return mavlink.MAVLink_ekf_status_report_message(int(autopilot.estimator.flags), v, v, 0.02, 0.02, 0.0, 0.0)


def _extended_sys_state(autopilot: Autopilot) -> Message:
    control = autopilot.control
    state = mavlink.MAV_LANDED_STATE_IN_AIR
    if control.landed:
        state = mavlink.MAV_LANDED_STATE_ON_GROUND
    elif control.taking_off:
        state = mavlink.MAV_LANDED_STATE_TAKEOFF
    elif autopilot.mode is Mode.LAND:
        state = mavlink.MAV_LANDED_STATE_LANDING
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, state)


def _distance_sensor(autopilot: Autopilot) -> Message | None:
    table = autopilot.table
    if table["RNGFND1_TYPE"] == 0:
        return None
    low, high = round(table["RNGFND1_MIN"] * 100), round(table["RNGFND1_MAX"] * 100)
    return mavlink.MAVLink_distance_sensor_message(
        autopilot.boot_ms, low, high, round(autopilot.estimate.range_m * 100), 0, 0, int(table["RNGFND1_ORIENT"]), 0
    )


def _rangefinder(autopilot: Autopilot) -> Message | None:
    if autopilot.table["RNGFND1_TYPE"] == 0:
        return None
    return mavlink.MAVLink_rangefinder_message(autopilot.estimate.range_m, 0.0)


def _rc_channels(autopilot: Autopilot) -> Message:
    rc = autopilot.rc
    count = len(rc.channels_us) if autopilot.radio.present else 0
    rssi = 255 if autopilot.table["RSSI_TYPE"] == 0 else 254 * rc.receiver_frames
    return mavlink.MAVLink_rc_channels_message(autopilot.boot_ms, count, *rc.channels_us, 0, 0, rssi)


def _vfr_hud(autopilot: Autopilot) -> Message:
    e = autopilot.estimate
    speed = math.hypot(e.v_ned_m_s[0], e.v_ned_m_s[1])
    heading = round(math.degrees(e.yaw_rad)) % 360
    throttle = 40 if autopilot.armed and not autopilot.control.landed else 0
    return mavlink.MAVLink_vfr_hud_message(speed, speed, heading, throttle, HOME_ALT_M - e.p_ned_m[2], -e.v_ned_m_s[2])


def _autopilot_version(autopilot: Autopilot) -> Message:
    capabilities = (
        mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    git = list(b"twin0000")
    return mavlink.MAVLink_autopilot_version_message(capabilities, _FIRMWARE, 0, 0, 0, git, git, git, 0, 0, 1)


def _home_position(autopilot: Autopilot) -> Message | None:
    if not autopilot.estimator.has_origin:
        return None
    lat, lon, alt = round(HOME_LAT_DEG * 1e7), round(HOME_LON_DEG * 1e7), round(HOME_ALT_M * 1e3)
    north, east = autopilot.control.home_ne_m
    return mavlink.MAVLink_home_position_message(
        lat, lon, alt, north, east, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, autopilot.t_ns // 1000
    )


def _gps_global_origin(autopilot: Autopilot) -> Message | None:
    if not autopilot.estimator.has_origin:
        return None
    lat, lon, alt = round(HOME_LAT_DEG * 1e7), round(HOME_LON_DEG * 1e7), round(HOME_ALT_M * 1e3)
    return mavlink.MAVLink_gps_global_origin_message(lat, lon, alt, autopilot.t_ns // 1000)


def _system_time(autopilot: Autopilot) -> Message:
    return mavlink.MAVLink_system_time_message(0, autopilot.boot_ms)


def _sim_state(autopilot: Autopilot) -> Message:
    truth = autopilot.vehicle.truth_at(autopilot.t_ns)
    zeros = [0.0] * 10
    north, east, down = truth.p_ned_m
    lat = HOME_LAT_DEG + north / _METRES_PER_DEG
    lon = HOME_LON_DEG + east / (_METRES_PER_DEG * math.cos(math.radians(HOME_LAT_DEG)))
    attitude = (truth.roll_rad, truth.pitch_rad, truth.yaw_rad)
    return mavlink.MAVLink_sim_state_message(
        *zeros[:4], *attitude, *zeros[:6], lat, lon, HOME_ALT_M - down, 0.0, 0.0, *truth.v_ned_m_s
    )


STREAMS: dict[int, Callable[[Autopilot], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: _system_time,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: _gps_raw,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _local_position,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _global_position,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _gps_global_origin,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: _rc_channels,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: _vfr_hud,
    mavlink.MAVLINK_MSG_ID_SIM_STATE: _sim_state,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: _distance_sensor,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: _battery_status,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _autopilot_version,
    mavlink.MAVLINK_MSG_ID_RANGEFINDER: _rangefinder,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _ekf_status,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: _home_position,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _extended_sys_state,
}
"""Message id to builder; a builder returns None while the autopilot would not send the message."""
