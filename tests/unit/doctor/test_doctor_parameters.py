"""Each bad parameter is found by name, and what the finding says to set removes it."""

from __future__ import annotations

import pytest

from morpheyes_daemon.config.vehicle import AutopilotConfig, NoServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.doctor.findings import Finding, Severity, Verdict, remedies, verdict
from morpheyes_daemon.doctor.parameter_rules import RULES, examine_parameters
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP, RECOMMENDED, ParameterTable

FLOW = {**FLOW_SETUP, "RNGFND1_TYPE": 10}


def config(**autopilot: object) -> VehicleConfig:
    return VehicleConfig(
        camera=SimCameraConfig(),
        servo=NoServoConfig(backend="none"),
        autopilot=AutopilotConfig(**autopilot),
    )


def examine(changes: dict[str, float], **autopilot: object) -> list[Finding]:
    return examine_parameters(ParameterTable({**RECOMMENDED, **changes}), config(**autopilot))


BAD: list[tuple[dict[str, float], str, Severity]] = [
    ({"FS_THR_ENABLE": 0}, "throttle-failsafe-off", Severity.STOP),
    ({"FS_THR_ENABLE": 1}, "throttle-failsafe-climbs", Severity.CARE),
    ({"FS_THR_ENABLE": 4}, "throttle-failsafe-climbs", Severity.CARE),
    ({"RC_OVERRIDE_TIME": 0}, "override-time-off", Severity.STOP),
    ({"RC_OVERRIDE_TIME": -1}, "override-time-off", Severity.STOP),
    ({"RC_OVERRIDE_TIME": 3}, "override-time-long", Severity.CARE),
    ({"RC_OVERRIDE_TIME": 3}, "reserve-too-short", Severity.STOP),
    ({"RC_FS_TIMEOUT": 5}, "radio-failsafe-late", Severity.CARE),
    ({"RSSI_TYPE": 0}, "radio-loss-unseen", Severity.NOTE),
    ({"BATT_FS_LOW_ACT": 2}, "battery-failsafe-climbs", Severity.CARE),
    ({"FS_GCS_ENABLE": 1}, "gcs-failsafe-climbs", Severity.CARE),
    ({"MAV_GCS_SYSID": 250}, "gcs-sysid", Severity.STOP),
    ({"RC_OPTIONS": 34}, "overrides-ignored", Severity.STOP),
    ({"RC_OPTIONS": 33}, "receiver-ignored", Severity.STOP),
    ({"FLTMODE_CH": 4}, "mode-channel-overridden", Severity.STOP),
    ({"RC7_OPTION": 7}, "switch-assigned", Severity.CARE),
    ({"LOIT_BRK_DELAY": 1.0}, "brake-delay", Severity.CARE),
    ({"LOIT_SPEED": 1250}, "loiter-speed", Severity.CARE),
    ({"LOIT_SPEED": 300}, "loiter-speed", Severity.CARE),
    ({"LOIT_BRK_ACCEL": 50}, "weak-brake", Severity.CARE),
    ({"AVOID_BEHAVE": 0}, "avoidance-slides", Severity.CARE),
    ({"AVOID_BACKUP_SPD": 0.75}, "avoidance-backs-up", Severity.CARE),
    ({"PRX1_TYPE": 2, "AVOID_MARGIN": 2}, "avoidance-margin", Severity.CARE),
    ({**FLOW, "RNGFND1_ORIENT": 0}, "rangefinder-not-down", Severity.STOP),
    ({**FLOW, "EK3_SRC1_POSXY": 3}, "flow-position-source", Severity.CARE),
    ({"EK3_SRC1_YAW": 0}, "no-yaw-source", Severity.STOP),
    ({"FS_EKF_THRESH": 0}, "ekf-failsafe-off", Severity.STOP),
    ({"FS_EKF_ACTION": 0}, "ekf-failsafe-only-reports", Severity.STOP),
    ({"ARMING_CHECK": 0}, "arming-checks-off", Severity.CARE),
    ({"FS_CRASH_CHECK": 0}, "crash-check-off", Severity.CARE),
]
BY_HAND: list[tuple[dict[str, float], str, Severity]] = [
    ({"FS_GCS_ENABLE": 5}, "gcs-loss-masked", Severity.CARE),
    ({"FLTMODE_CH": 7}, "switch-is-mode-channel", Severity.STOP),
    ({"FLTMODE1": 0}, "loiter-not-on-switch", Severity.CARE),
    ({"EK3_SRC1_VELXY": 0}, "no-velocity-source", Severity.STOP),
    ({"GPS1_TYPE": 0}, "gps-off", Severity.STOP),
    ({**FLOW, "FLOW_TYPE": 0}, "flow-off", Severity.STOP),
    ({**FLOW, "RNGFND1_TYPE": 0}, "flow-without-rangefinder", Severity.STOP),
    ({**FLOW, "RNGFND1_MAX": 4}, "low-ceiling", Severity.CARE),
    ({**FLOW}, "flow-slow-near-ground", Severity.NOTE),
    ({"PRX1_TYPE": 0}, "second-brake-unused", Severity.NOTE),
    ({"RC2_TRIM": 2000}, "sticks-unusable", Severity.STOP),
    ({"RCMAP_YAW": 6}, "sticks-unusable", Severity.STOP),
]


def test_recommended_parameters_may_fly() -> None:
    assert verdict(examine({})) is Verdict.FLY
    assert verdict(examine(FLOW)) is Verdict.FLY


@pytest.mark.parametrize(("changes", "name", "severity"), BAD + BY_HAND)
def test_bad_parameter_is_found_and_named(changes: dict[str, float], name: str, severity: Severity) -> None:
    finding = next(finding for finding in examine(changes) if finding.id == name)
    assert finding.severity is severity
    assert any(parameter in finding.evidence + finding.remedy for parameter in changes) or "flow" in name
    assert finding.risk
    assert finding.remedy


@pytest.mark.parametrize(("changes", "name", "severity"), BAD)
def test_remedy_removes_the_finding(changes: dict[str, float], name: str, severity: Severity) -> None:
    table = ParameterTable({**RECOMMENDED, **changes})
    findings = examine_parameters(table, config())
    assert name in {finding.id for finding in findings}
    for parameter, value in remedies(findings).items():
        assert table.set(parameter, value), parameter
    assert name not in {finding.id for finding in examine_parameters(table, config())}


def test_every_rule_is_tried() -> None:
    tried = {name for _, name, _ in BAD + BY_HAND}
    assert {rule.id for rule in RULES} <= tried


def test_plain_arducopter_may_not_fly() -> None:
    found = {finding.id for finding in examine_parameters(ParameterTable(), config())}
    assert {"throttle-failsafe-climbs", "reserve-too-short", "brake-delay", "loiter-speed"} <= found


def test_remedies_use_the_names_and_units_of_the_firmware() -> None:
    old = ParameterTable({**RECOMMENDED, "RSSI_TYPE": 3, "LOIT_SPEED": 1250}, old_names=True)
    old.set("SYSID_MYGCS", 10)
    assert remedies(examine_parameters(old, config())) == {"SYSID_MYGCS": 255, "LOIT_SPEED": 500}
    values = {**old, "LOIT_SPEED_MS": 12.5}
    del values["LOIT_SPEED"]
    assert remedies(examine_parameters(values, config()))["LOIT_SPEED_MS"] == 5.0


def test_range_of_ground_station_ids_is_honoured() -> None:
    changes = {"MAV_GCS_SYSID": 250.0, "MAV_GCS_SYSID_HI": 255.0}
    assert "gcs-sysid" not in {finding.id for finding in examine(changes)}


def test_foreign_autopilot_is_one_finding_not_an_exception() -> None:
    [finding] = [f for f in examine_parameters({"SYS_AUTOSTART": 4001.0}, config()) if f.severity is Severity.STOP]
    assert finding.id == "sticks-unusable"
    assert "ArduCopter" in finding.evidence


def test_graver_finding_wins_where_two_ask_for_one_parameter() -> None:
    light = Finding("a", Severity.CARE, "", "", "", {"X": 1.0, "Y": 2.0})
    grave = Finding("b", Severity.STOP, "", "", "", {"X": 3.0})
    assert remedies([light, grave]) == {"X": 3.0, "Y": 2.0}
