"""What the autopilot says about itself that forbids to fly."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.safety.vehicle_health import vehicle_fault

NOW_NS = 1000 * S
WELL = VehicleState(system_status=4, ekf_t_ns=1, ekf_flags=0x08, battery_fraction=0.8, gcs_t_ns=NOW_NS)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, None),
        ({"system_status": 3}, None),
        ({"system_status": 5}, Reason.FAILSAFE),
        ({"system_status": 6}, Reason.FAILSAFE),
        ({"ekf_flags": 0x10}, None),
        ({"ekf_flags": 0x33F}, None),
        ({"ekf_flags": 0x08 | 0x80}, Reason.EKF_UNHEALTHY),
        ({"ekf_flags": 0x07}, Reason.EKF_UNHEALTHY),
        ({"ekf_flags": 0x20}, Reason.EKF_UNHEALTHY),
        ({"ekf_flags": 0}, Reason.EKF_UNHEALTHY),
        ({"ekf_t_ns": 0}, Reason.EKF_UNHEALTHY),
        ({"battery_fraction": 0.2}, None),
        ({"battery_fraction": 0.19}, Reason.BATTERY_LOW),
        ({"battery_fraction": 0.0}, Reason.BATTERY_LOW),
        ({"battery_fraction": math.nan}, None),
        ({"battery_fraction": -0.01}, None),
        ({"gcs_t_ns": NOW_NS - 5 * S + 1}, None),
        ({"gcs_t_ns": NOW_NS - 5 * S}, Reason.GCS_LOST),
        ({"gcs_t_ns": 0}, Reason.GCS_LOST),
        ({"rc_rssi": 0}, Reason.RC_LOST),
        ({"rc_rssi": 1}, None),
        ({"rc_rssi": 0, "system_status": 5}, Reason.RC_LOST),
        ({"system_status": 5, "ekf_flags": 0}, Reason.FAILSAFE),
        ({"ekf_flags": 0, "battery_fraction": 0.1}, Reason.EKF_UNHEALTHY),
        ({"battery_fraction": 0.1, "gcs_t_ns": 0}, Reason.BATTERY_LOW),
        ({"sensors_present": 0x40, "sensors_health": 0x40}, None),
        ({"sensors_present": 0x40}, Reason.AIDING_LOST),
        ({"sensors_present": 0x40, "sensors_health": 0x3F}, Reason.AIDING_LOST),
        ({"sensors_present": 0x80, "sensors_health": 0x80}, None),
        ({"sensors_present": 0x80}, Reason.AIDING_LOST),
        ({"sensors_present": 0x20, "sensors_health": 0x20}, None),
        ({"sensors_present": 0x20, "sensors_health": 0x20, "gps_fix": 3}, None),
        ({"sensors_present": 0x20, "sensors_health": 0x20, "gps_fix": 2}, Reason.AIDING_LOST),
        ({"sensors_present": 0x20, "sensors_health": 0x20, "gps_fix": 0}, Reason.AIDING_LOST),
        ({"sensors_present": 0x20, "sensors_health": 0x00, "gps_fix": 3}, Reason.AIDING_LOST),
        ({"sensors_present": 0x60, "sensors_health": 0x60, "gps_fix": 1}, None),
        ({"sensors_present": 0x60, "sensors_health": 0x20, "gps_fix": 1}, Reason.AIDING_LOST),
        ({"sensors_present": 0x1F, "gps_fix": 0}, None),
        ({"ekf_flags": 0, "sensors_present": 0x40}, Reason.EKF_UNHEALTHY),
        ({"sensors_present": 0x40, "battery_fraction": 0.1}, Reason.AIDING_LOST),
    ],
)
def test_each_concern(changes: dict[str, Any], reason: Reason | None) -> None:
    assert vehicle_fault(replace(WELL, **changes), NOW_NS, battery_low=0.2, gcs_timeout_s=5.0) is reason


def test_the_ground_station_is_watched_only_when_asked() -> None:
    assert vehicle_fault(replace(WELL, gcs_t_ns=0), NOW_NS, battery_low=0.2, gcs_timeout_s=None) is None


def test_a_vehicle_never_heard_is_not_healthy() -> None:
    assert vehicle_fault(VehicleState(), NOW_NS, 0.2, None) is Reason.EKF_UNHEALTHY
