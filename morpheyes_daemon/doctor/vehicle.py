"""The vehicle over its link, on the ground: is it there, does it stream, what do its own checks say?

It asks and listens; sticks are moved by the take-over test alone.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.autopilot.mavsdk_bridge import MavsdkBridge
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.doctor.parameter_rules import examine_parameters
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import Event, VehicleState
from morpheyes_daemon.safety.vehicle_health import GPS, aided, ekf_healthy
from morpheyes_daemon.wire.mavlink import dialect

LINK_S, PARAMETERS_S = 8.0, 60.0
"""How long to wait for a first word, and for the last parameter over a slow radio."""
FIRST_STREAM_S, LISTEN_S = 3.0, 3.0
SLOWEST_HZ = {"attitude_t_ns": 40.0, "rc_t_ns": 10.0, "heartbeat_t_ns": 8.0}
PRE_ARM = "PreArm: "


class VehicleExamination:
    """Holds the connection for one examination; use it as an async context manager, then `examine`."""

    def __init__(self, config: VehicleConfig, clock: Clock, opener: LinkOpener) -> None:
        self._config = config
        self._clock = clock
        self._topics, self._events = Topics.create(), EventLog()
        self._last_event: Event | None = None
        self._events.subscribe(self._remember)
        self.connection = AutopilotConnection(config.autopilot, clock, self._topics, self._events, opener)
        self._stamps: dict[str, set[int]] = {name: set() for name in SLOWEST_HZ}
        self._words: list[str] = []
        self._bridge: MavsdkBridge | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> VehicleExamination:
        self._tasks = [asyncio.create_task(self.connection.run(), name="autopilot")]
        return self

    async def __aexit__(self, *error: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def with_mavsdk(self) -> None:
        """Let mavsdk listen too; it needs real time."""
        self._bridge = MavsdkBridge(self.connection, self._config.autopilot, self._clock)
        self._tasks.append(asyncio.create_task(self._bridge.run(), name="mavsdk"))

    @property
    def vehicle(self) -> VehicleState:
        """The newest state."""
        return self._topics.vehicle.get() or VehicleState()

    async def examine(self) -> list[Finding]:
        """Return the findings on link, parameters, state and the autopilot's own checks."""
        if not await self.wait(lambda: self.connection.up, LINK_S):
            return [self._missing()]
        if not await self.wait(lambda: self.connection.parameters.complete, PARAMETERS_S):
            return [self._unread()]
        await self.wait(lambda: self.vehicle.attitude_t_ns > 0, FIRST_STREAM_S)
        self.connection.on_text(self._listen)
        await self._ask_for_checks()
        self.connection.on_vehicle(self._count)
        await self._clock.sleep_until_ns(self._clock.now_ns() + round(LISTEN_S * S))
        return [
            *examine_parameters(self.connection.parameters.values, self._config),
            *self._streams(),
            *self._state(),
            *self._own_checks(),
            *self._mavsdk_health(),
        ]

    async def wait(self, done: Callable[[], bool], limit_s: float) -> bool:
        """Wait until `done()` is true or `limit_s` is over, return which; what ended the connection is raised here."""
        end_ns = self._clock.now_ns() + round(limit_s * S)
        while not done():
            if self._tasks[0].done():
                self._tasks[0].result()
            if self._clock.now_ns() >= end_ns:
                return False
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 50)
        return True

    def _remember(self, event: Event) -> None:
        self._last_event = event

    def _count(self, state: VehicleState) -> None:
        for name, stamps in self._stamps.items():
            stamps.add(getattr(state, name))

    def _listen(self, severity: int, text: str) -> None:
        if text.startswith(PRE_ARM) and text not in self._words:
            self._words.append(text)

    async def _ask_for_checks(self) -> None:
        try:
            await self.connection.send_command(dialect.MAV_CMD_RUN_PREARM_CHECKS)
        except DeviceError:
            pass  # older firmware says its words unasked, every 30 s

    def _missing(self) -> Finding:
        why = self._last_event.text if self._last_event else "the port is open and silent"
        return Finding(
            "autopilot-missing",
            Severity.STOP,
            f"{self._config.autopilot.url}: {why.removeprefix(self._config.autopilot.url + ': ')}",
            "nothing can be flown",
            "check power, cable, autopilot.url and the SERIALn_PROTOCOL (2) and SERIALn_BAUD of the autopilot's port",
        )

    def _unread(self) -> Finding:
        return Finding(
            "parameters-unread",
            Severity.STOP,
            f"{len(self.connection.parameters.values)} parameters came in {PARAMETERS_S:g} s, then no more",
            "stick ranges and braking of this vehicle are unknown",
            "raise the baud rate of the link (921600) or shorten the radio path",
        )

    def _streams(self) -> list[Finding]:
        findings = []
        for name, least_hz in SLOWEST_HZ.items():
            rate_hz = len(self._stamps[name]) / LISTEN_S
            if rate_hz < least_hz:
                what = name.removesuffix("_t_ns")
                findings.append(
                    Finding(
                        "link-slow",
                        Severity.STOP if rate_hz < least_hz / 2 else Severity.CARE,
                        f"{what} comes {rate_hz:.1f} times a second instead of {least_hz:g} and more",
                        "the daemon flies on old attitude, or hears the pilot late",
                        "raise the baud rate of the link to 921600 and let no radio share it",
                    )
                )
        return findings

    def _state(self) -> list[Finding]:
        state, findings = self.vehicle, []
        channel = self._config.autopilot.engage_channel
        switch_us = state.rc_us[channel - 1] if len(state.rc_us) >= channel else 0
        if state.armed:
            findings.append(_finding("armed", Severity.STOP, "the motors are armed", "doctor is for the ground",
                                     "disarm first"))  # fmt: skip
        if switch_us == 0:
            findings.append(_finding("no-switch", Severity.STOP, f"RC channel {channel} has no signal",
                                     "the pilot cannot engage, and cannot take over by the switch",
                                     "bind the radio, or set autopilot.engage_channel to a switch"))  # fmt: skip
        elif switch_us > self._config.autopilot.engage_above_us:
            findings.append(_finding("switch-on", Severity.CARE, f"RC channel {channel} is at {switch_us} us",
                                     "the daemon engages only after it has seen the switch off",
                                     "flip the engage switch off"))  # fmt: skip
        low = self._config.safety.battery_low_pct / 100.0
        if math.isfinite(state.battery_fraction) and state.battery_fraction < low:
            findings.append(_finding("battery-low", Severity.STOP,
                                     f"{state.battery_fraction:.0%} left, {state.battery_v:.1f} V",
                                     "the battery failsafe takes the flight over", "change the battery"))  # fmt: skip
        if not (ekf_healthy(state) and aided(state)):
            fix = f", the GPS fix is of type {state.gps_fix}" if state.sensors_present & GPS else ""
            findings.append(_finding("no-position-yet", Severity.CARE, f"EKF flags are {state.ekf_flags:#x}{fix}",
                                     "Loiter cannot be entered",
                                     "wait for GPS; without one send the origin once and stand within the"
                                     " rangefinder's reach"))  # fmt: skip
        return findings

    def _own_checks(self) -> list[Finding]:
        if not self._words:
            return []
        words = "; ".join(text.removeprefix(PRE_ARM) for text in self._words)
        return [_finding("pre-arm", Severity.CARE, words, "the autopilot will refuse to arm", "do what it says")]

    def _mavsdk_health(self) -> list[Finding]:
        received = self._bridge.latest.get("health") if self._bridge else None
        if received is None:
            return []
        bad = [name for name in _CALIBRATIONS if not getattr(received.value, name)]
        if not bad:
            return []
        parts = ", ".join(name.removeprefix("is_").removesuffix("_calibration_ok") for name in bad)
        return [_finding("sensors-uncalibrated", Severity.CARE, f"mavsdk reports: {parts}",
                         "attitude and heading drift", "calibrate the sensors in the ground station")]  # fmt: skip


_CALIBRATIONS = (
    "is_gyrometer_calibration_ok",
    "is_accelerometer_calibration_ok",
    "is_magnetometer_calibration_ok",
)


def _finding(name: str, severity: Severity, evidence: str, risk: str, remedy: str) -> Finding:
    return Finding(name, severity, evidence, risk, remedy)
