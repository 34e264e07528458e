"""The autopilot's parameters that make stick overrides dangerous or useless, as a table of rules.

Each row comes from a trap that has crashed somebody, or from braking measured on ArduCopter. A rule that asks for a
parameter which this firmware does not have does not apply. Nothing is set here; a finding carries what to set.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.control import parameters as p
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.devices.autopilot.telemetry import DOWNWARD
from morpheyes_daemon.doctor.evidence import (
    AVOID_STOP,
    BRAKE_DELAY_S,
    GPS_VELOCITY,
    IGNORE_OVERRIDES,
    IGNORE_RECEIVER,
    LAND_FAILSAFE,
    LOITER_SPEED_M_S,
    PROXIMITY_MAVLINK,
    RTL_FAILSAFES,
    Broken,
    Changes,
    Subject,
    above,
    assigned_switch,
    at_most,
    climbs,
    contains,
    equals,
    is_not,
    low_ceiling,
    mode_channel,
    no_loiter_on_switch,
    odd_loiter_speed,
    other_gcs_sysid,
    outlives_reserve,
    shares_mode_channel,
    shorter_override,
    slow_brake,
    slow_over_flow,
    to,
    unwatched_gcs,
    weak_brake,
    where,
    without,
)
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.errors import DeviceError


@dataclass(frozen=True, slots=True)
class Rule:
    """`broken` returns the evidence, None when all is well; `changes` what to set."""

    id: str
    severity: Severity
    broken: Broken
    risk: str
    remedy: str
    changes: Changes = lambda subject: {}


def examine_parameters(values: Mapping[str, float], config: VehicleConfig) -> list[Finding]:
    """Return the findings on a complete set of autopilot parameters; raises nothing."""
    subject = Subject(values, config)
    findings = [_unusable_sticks(subject)]
    for rule in RULES:
        try:
            evidence = rule.broken(subject)
        except DeviceError:
            continue  # a parameter it needs does not exist; that it does not is the sticks' finding
        if evidence is not None:
            findings.append(Finding(rule.id, rule.severity, evidence, rule.risk, rule.remedy, rule.changes(subject)))
    return [finding for finding in findings if finding is not None]


def _unusable_sticks(subject: Subject) -> Finding | None:
    try:
        LoiterModel.from_parameters(subject.values)
    except DeviceError as error:
        return Finding(
            "sticks-unusable",
            Severity.STOP,
            str(error),
            "no stick position can be worked out for a wanted speed",
            "calibrate the radio in the ground station and check that this is an ArduCopter",
        )
    return None


RULES: tuple[Rule, ...] = (
    # -- what happens when we die -------------------------------------------------------------------------------
    Rule(
        "throttle-failsafe-off", Severity.STOP, equals("FS_THR_ENABLE", 0),
        "when the daemon or its link dies the vehicle flies on the last stick for ever",
        "set FS_THR_ENABLE to 3 (land)", to(FS_THR_ENABLE=LAND_FAILSAFE),
    ),
    Rule(
        "throttle-failsafe-climbs", Severity.CARE, climbs("FS_THR_ENABLE", RTL_FAILSAFES),
        "the failsafe climbs into whatever is above, indoors and under trees too",
        "set FS_THR_ENABLE to 3 (land)", to(FS_THR_ENABLE=LAND_FAILSAFE),
    ),
    Rule(
        "override-time-off", Severity.STOP,
        at_most("RC_OVERRIDE_TIME", 0.0, " s"),
        "0 ignores every override, a negative time holds the last stick for ever",
        "set RC_OVERRIDE_TIME to 1 or less", shorter_override,
    ),
    Rule(
        "override-time-long", Severity.CARE,
        above("RC_OVERRIDE_TIME", 1.0, " s"),
        "for so long the last stick is held after the daemon died",
        "set RC_OVERRIDE_TIME to 1 or less", shorter_override,
    ),
    Rule(
        "reserve-too-short", Severity.STOP,
        outlives_reserve,
        "the speed governor reserves less room than the vehicle needs when the daemon dies",
        "lower RC_OVERRIDE_TIME, or raise safety.dead_daemon_s", shorter_override,
    ),
    Rule(
        "radio-failsafe-late", Severity.CARE,
        above("RC_FS_TIMEOUT", 1.0, " s"),
        "without a receiver the last stick is held this long after the daemon died",
        "set RC_FS_TIMEOUT to 1", to(RC_FS_TIMEOUT=1.0),
    ),
    Rule(
        "radio-loss-unseen", Severity.NOTE, equals("RSSI_TYPE", 0),
        "overrides count as a radio, so while they stream neither autopilot nor daemon sees that the pilot's is gone",
        "set RSSI_TYPE to 3 where the receiver tells its signal, and its failsafe to put the engage switch off",
        to(RSSI_TYPE=3.0),
    ),
    Rule(
        "battery-failsafe-climbs", Severity.CARE, climbs("BATT_FS_LOW_ACT", (2, 3)),
        "a low battery makes it climb, indoors and under trees too",
        "set BATT_FS_LOW_ACT to 1 (land)", to(BATT_FS_LOW_ACT=1.0),
    ),
    Rule(
        "gcs-failsafe-climbs", Severity.CARE, climbs("FS_GCS_ENABLE", (1, 2, 3)),
        "a lost ground station makes it climb, indoors and under trees too",
        "set FS_GCS_ENABLE to 5 (land)", to(FS_GCS_ENABLE=5.0),
    ),
    Rule(
        "gcs-loss-masked", Severity.CARE,
        unwatched_gcs,
        "every override counts as a sign of the ground station, so the autopilot never notices its loss",
        "set autopilot.watch_gcs to true in config.yaml",
    ),
    # -- whether it obeys, and whom -----------------------------------------------------------------------------
    Rule(
        "gcs-sysid", Severity.STOP, other_gcs_sysid,
        "overrides from another system id are ignored without a word",
        "make them equal", lambda s: p.GCS_SYSID.change(s.values, s.config.autopilot.override_sysid),
    ),
    Rule(
        "overrides-ignored", Severity.STOP, contains("RC_OPTIONS", IGNORE_OVERRIDES),
        "the autopilot ignores overrides altogether",
        "take 2 out of RC_OPTIONS", without("RC_OPTIONS", IGNORE_OVERRIDES),
    ),
    Rule(
        "receiver-ignored", Severity.STOP, contains("RC_OPTIONS", IGNORE_RECEIVER),
        "the autopilot ignores the pilot's radio: nobody can take over",
        "take 1 out of RC_OPTIONS", without("RC_OPTIONS", IGNORE_RECEIVER),
    ),
    Rule(
        "mode-channel-overridden", Severity.STOP,
        lambda s: f"FLTMODE_CH is {mode_channel(s)}" if 1 <= mode_channel(s) <= 4 else None,
        "a stick override changes the flight mode, and releasing it drops out of Loiter in the air",
        "put the mode switch on channel 5 or above", to(FLTMODE_CH=5.0),
    ),
    Rule(
        "switch-is-mode-channel", Severity.STOP,
        shares_mode_channel,
        "engaging would change the flight mode",
        "set autopilot.engage_channel in config.yaml to a switch of its own",
    ),
    Rule(
        "switch-assigned", Severity.CARE, assigned_switch,
        "engaging would trigger another function",
        "free the channel", lambda s: {f"RC{s.config.autopilot.engage_channel}_OPTION": 0.0},
    ),
    Rule(
        "loiter-not-on-switch", Severity.CARE, no_loiter_on_switch,
        "the pilot cannot reach the one mode that the daemon flies in",
        "put 5 (Loiter) on one position of the mode switch, and another mode beside it to take over",
    ),
    # -- how it brakes ------------------------------------------------------------------------------------------
    Rule(
        "brake-delay", Severity.CARE, slow_brake,
        "neutral sticks coast before they brake, so the governor has to fly slowly",
        "set LOIT_BRK_DELAY to 0.2 or less", lambda s: p.LOIT_BRK_DELAY.change(s.values, BRAKE_DELAY_S),
    ),
    Rule(
        "loiter-speed", Severity.CARE, odd_loiter_speed,
        "large values answer and stop slowly, small ones cannot reach 3 m/s at a moderate lean",
        "set it to about 5 m/s", lambda s: p.LOIT_SPEED.change(s.values, LOITER_SPEED_M_S),
    ),
    Rule(
        "weak-brake", Severity.CARE, weak_brake,
        "stopping takes longer than it must",
        "set LOIT_BRK_ACCEL to 2.5 m/s2 and LOIT_BRK_JERK to 5 m/s3",
        lambda s: p.LOIT_BRK_ACCEL.change(s.values, 2.5) | p.LOIT_BRK_JERK.change(s.values, 5.0),
    ),
    # -- the autopilot's own avoidance --------------------------------------------------------------------------
    Rule(
        "avoidance-slides", Severity.CARE, where(lambda s: s.may_avoid, is_not("AVOID_BEHAVE", AVOID_STOP)),
        "sliding along an obstacle fights the mission's own way around it",
        "set AVOID_BEHAVE to 1 (stop)", to(AVOID_BEHAVE=AVOID_STOP),
    ),
    Rule(
        "avoidance-backs-up", Severity.CARE, where(lambda s: s.may_avoid, is_not("AVOID_BACKUP_SPD", 0.0)),
        "it backs away to where no camera looks",
        "set AVOID_BACKUP_SPD to 0", to(AVOID_BACKUP_SPD=0.0),
    ),
    Rule(
        "avoidance-margin", Severity.CARE,
        where(lambda s: s.avoids, above("AVOID_MARGIN", 1.0, " m")),
        "the autopilot stops before every gap narrower than twice the margin",
        "set AVOID_MARGIN to 0.5", to(AVOID_MARGIN=0.5),
    ),
    Rule(
        "second-brake-unused", Severity.NOTE,
        where(lambda s: s.config.autopilot.publish_obstacles, is_not("PRX1_TYPE", PROXIMITY_MAVLINK)),
        "the obstacles that the daemon publishes are not acted upon by the autopilot",
        "set PRX1_TYPE to 2, AVOID_ENABLE to 3, AVOID_BEHAVE to 1, AVOID_BACKUP_SPD to 0, AVOID_MARGIN to 0.5",
    ),
    # -- where it believes to be --------------------------------------------------------------------------------
    Rule(
        "no-velocity-source", Severity.STOP, equals("EK3_SRC1_VELXY", 0),
        "without a velocity there is no Loiter",
        "set EK3_SRC1_VELXY to 5 (optical flow) or 3 (GPS)",
    ),
    Rule(
        "gps-off", Severity.STOP,
        where(
            lambda s: round(p.VELOCITY_SOURCE.read(s.values)) == GPS_VELOCITY,
            lambda s: equals("GPS1_TYPE", 0)(s) or equals("GPS_TYPE", 0)(s),
        ),
        "velocity is to come from a GPS that is switched off",
        "set GPS1_TYPE (GPS_TYPE) to 1, or EK3_SRC1_VELXY to 5 for optical flow",
    ),
    Rule(
        "flow-off", Severity.STOP, where(lambda s: s.on_flow, equals("FLOW_TYPE", 0)),
        "velocity is to come from a flow sensor that is switched off",
        "set FLOW_TYPE to the type of the sensor",
    ),
    Rule(
        "flow-without-rangefinder", Severity.STOP, where(lambda s: s.on_flow, equals("RNGFND1_TYPE", 0)),
        "flow is an angle: without a height above ground it gives no velocity",
        "set RNGFND1_TYPE to the type of the rangefinder",
    ),
    Rule(
        "rangefinder-not-down", Severity.STOP, where(lambda s: s.on_flow, is_not("RNGFND1_ORIENT", DOWNWARD)),
        "the height above ground is unknown",
        "set RNGFND1_ORIENT to 25 (down)", to(RNGFND1_ORIENT=DOWNWARD),
    ),
    Rule(
        "flow-position-source", Severity.CARE, where(lambda s: s.on_flow, is_not("EK3_SRC1_POSXY", 0)),
        "the position waits for a sensor that a flow-only vehicle does not have",
        "set EK3_SRC1_POSXY to 0 (none)", to(EK3_SRC1_POSXY=0.0),
    ),
    Rule(
        "no-yaw-source", Severity.STOP, equals("EK3_SRC1_YAW", 0),
        "without a heading neither flow nor GPS gives a velocity over ground",
        "set EK3_SRC1_YAW to 1 (compass)", to(EK3_SRC1_YAW=1.0),
    ),
    Rule(
        "flow-slow-near-ground", Severity.NOTE, where(lambda s: s.on_flow, slow_over_flow),
        "the autopilot limits its speed by the height over the flow sensor",
        "fly higher where the mission is to be fast; EK3_MAX_FLOW is the sensor's limit",
    ),
    Rule(
        "low-ceiling", Severity.CARE, where(lambda s: s.on_flow, low_ceiling),
        "above it the vehicle refuses to climb without a message",
        "check RNGFND1_MAX against the sensor's data sheet",
    ),
    Rule(
        "ekf-failsafe-off", Severity.STOP,
        at_most("FS_EKF_THRESH", 0.0),
        "when the position is lost the vehicle drifts and nothing lands it",
        "set FS_EKF_THRESH to 0.8", to(FS_EKF_THRESH=0.8),
    ),
    Rule(
        "ekf-failsafe-only-reports", Severity.STOP, equals("FS_EKF_ACTION", 0),
        "when the position is lost the vehicle drifts and nothing lands it",
        "set FS_EKF_ACTION to 1 (land)", to(FS_EKF_ACTION=1.0),
    ),
    # -- the autopilot's own checks -----------------------------------------------------------------------------
    Rule(
        "arming-checks-off", Severity.CARE,
        lambda s: equals("ARMING_CHECK", 0)(s) or is_not("ARMING_SKIPCHK", 0)(s),
        "the autopilot arms with faults it knows of",
        "switch the arming checks on",
        lambda s: {"ARMING_SKIPCHK": 0.0} if s.has("ARMING_SKIPCHK") else {"ARMING_CHECK": 1.0},
    ),
    Rule(
        "crash-check-off", Severity.CARE, equals("FS_CRASH_CHECK", 0),
        "the motors go on after a crash",
        "set FS_CRASH_CHECK to 1", to(FS_CRASH_CHECK=1.0),
    ),
)  # fmt: skip
