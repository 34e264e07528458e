"""What the autopilot reports about itself that forbids flying on: one row per vehicle_fault, worst first.

On the ground a vehicle_fault keeps the daemon from being ready; in flight it brakes and waits for the pilot. What the
autopilot itself does about it (RTL, LAND) comes as a mode change, which releases.
"""

from __future__ import annotations

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.messages.reasons import Reason

CRITICAL = 5
"""MAV_STATE_CRITICAL: ArduCopter reports it while any failsafe is triggered; what is above is worse."""

POSITION_FLAGS = 0x08 | 0x10
"""EKF_STATUS_REPORT: relative (optical flow) or absolute (GPS) horizontal position."""

CONSTANT_POSITION = 0x80
"""EKF_STATUS_REPORT: the EKF pretends not to move, for want of any aiding."""

GPS, OPTICAL_FLOW, VISION = 0x20, 0x40, 0x80
"""SYS_STATUS: what can aid the EKF in the horizontal."""

FIX_3D = 3
"""GPS_RAW_INT: what the EKF needs; SYS_STATUS calls a receiver without any fix healthy."""


def ekf_healthy(vehicle: VehicleState) -> bool:
    """Tell whether the autopilot has a position to hold; not before it has said so."""
    flags = vehicle.ekf_flags
    return bool(vehicle.ekf_t_ns and flags & POSITION_FLAGS and not flags & CONSTANT_POSITION)


def aided(vehicle: VehicleState) -> bool:
    """Tell whether a sensor delivers that aids the EKF; yes as long as none is known to be fitted.

    The EKF coasts for 0.9 s without flow and for 7.6 s without GPS before its flags tell, and brakes well meanwhile.
    """
    fitted = vehicle.sensors_present & (GPS | OPTICAL_FLOW | VISION)
    delivering = fitted & vehicle.sensors_health
    if 0 <= vehicle.gps_fix < FIX_3D:
        delivering &= ~GPS
    return not fitted or bool(delivering)


def vehicle_fault(vehicle: VehicleState, now_ns: int, battery_low: float, gcs_timeout_s: float | None) -> Reason | None:
    """Return the worst vehicle_fault, None when there is none.

    `battery_low` is a fraction of the charge; a battery that nobody measures (NaN) is no vehicle_fault.
    `gcs_timeout_s` None does not watch the ground station.
    """
    rows = (
        (Reason.RC_LOST, vehicle.rc_rssi == 0),
        (Reason.FAILSAFE, vehicle.system_status >= CRITICAL),
        (Reason.EKF_UNHEALTHY, not ekf_healthy(vehicle)),
        (Reason.AIDING_LOST, not aided(vehicle)),
        (Reason.BATTERY_LOW, 0.0 <= vehicle.battery_fraction < battery_low),
        (Reason.GCS_LOST, gcs_timeout_s is not None and now_ns - vehicle.gcs_t_ns >= gcs_timeout_s * S),
    )
    return next((reason for reason, holds in rows if holds), None)
