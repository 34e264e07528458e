"""One examination of the whole vehicle: machine, calibration, servo, camera, autopilot, in this order.

The order matters: the servo moves the eyes to where the calibration is looked up for the images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.devices.camera import build_camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.doctor.machine import examine_machine
from morpheyes_daemon.doctor.rig import examine_calibration, examine_camera, examine_servo
from morpheyes_daemon.doctor.takeover import HandOver, TakeoverTest
from morpheyes_daemon.doctor.vehicle import VehicleExamination

STOPPED_BY = frozenset({"armed", "autopilot-missing", "parameters-unread", "sticks-unusable"})
"""Findings with which no take-over can be tried."""


@dataclass(slots=True)
class Examination:
    """What was looked at and what was found; `handovers` is empty unless the take-over test was asked for."""

    findings: list[Finding] = field(default_factory=list)
    examined: list[str] = field(default_factory=list)
    handovers: list[HandOver] = field(default_factory=list)

    def add(self, part: str, findings: list[Finding]) -> None:
        """Note that a part was looked at."""
        self.examined.append(part)
        self.findings += findings


async def examine(
    config: VehicleConfig,
    clock: Clock,
    opener: LinkOpener,
    tell: Callable[[str], None],
    take_over: bool = False,
) -> Examination:
    """Examine everything, telling `tell` what is looked at; raises ConfigError for addresses that cannot be meant."""
    report = Examination()
    tell("the machine")
    report.add("machine", examine_machine(config))
    tell("the calibration")
    findings, rig = examine_calibration(config)
    report.add("calibration", findings)
    tell("the servo")
    servo = build_servo(config.servo, DeviceContext.alone(clock, opener))
    findings, placed = await examine_servo(servo, config)
    report.add("servo", findings)
    tell("the camera")
    eyes = rig if placed else None
    report.add(
        "camera", await examine_camera(lambda: build_camera(config.camera, DeviceContext.alone(clock)), config, eyes)
    )
    tell("the autopilot")
    async with VehicleExamination(config, clock, opener) as vehicle:
        if config.autopilot.mavsdk:
            vehicle.with_mavsdk()
        report.add("autopilot", await vehicle.examine())
        if take_over:
            await _take_over(report, vehicle, config, clock, tell)
    return report


async def _take_over(
    report: Examination, vehicle: VehicleExamination, config: VehicleConfig, clock: Clock, tell: Callable[[str], None]
) -> None:
    stopped = [finding for finding in report.findings if finding.id in STOPPED_BY]
    if stopped:
        report.add("take-over", [_untested(stopped[0])])
        return
    test = TakeoverTest(vehicle.connection, vehicle.connection.claim_stick_output(), config.autopilot, clock, tell)
    report.handovers, findings = await test.run()
    report.add("take-over", findings)


def _untested(cause: Finding) -> Finding:
    return Finding(
        "takeover-untested",
        Severity.STOP,
        f"it was not tried because of {cause.id}",
        "the pilot may not get the sticks back",
        "remedy the other finding, then repeat `doctor --takeover-test`",
    )
