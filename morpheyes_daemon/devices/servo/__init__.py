"""Servo backends: each moves the two cameras to a baseline, without feedback of where they are."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import NoServoConfig, ServoConfig
from morpheyes_daemon.devices.link import LinkOpener


class Servo(Protocol):
    """The two linear servos behind the Teensy. All verbs raise DeviceLostError or DeviceTimeoutError."""

    async def open(self) -> None:
        """Open the link and wait for the first answer; raises DeviceNotFoundError."""

    async def move(self, baseline_m: float) -> None:
        """Ask for a baseline and wait for the acknowledgement."""

    async def close(self) -> None:
        """Close; may be called twice."""


def build_servo(config: ServoConfig, opener: LinkOpener, clock: Clock, events: EventLog) -> Servo:
    """Return the configured backend, not yet open; losses and recoveries go to `events`."""
    if isinstance(config, NoServoConfig):
        from morpheyes_daemon.devices.servo.none import NoServo

        return NoServo(config.baseline_mm / 1e3)
    from morpheyes_daemon.devices.servo.teensy import SerialServo

    return SerialServo(config.url, config.motion, opener, clock, events)
