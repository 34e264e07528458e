"""Servo backends: each moves the two cameras to a baseline, without feedback of where they are."""

from __future__ import annotations

from typing import Protocol

from morpheyes_daemon.config.vehicle import ServoConfig
from morpheyes_daemon.devices.family import DeviceContext, Family


class Servo(Protocol):
    """The two linear servos behind the Teensy. All verbs raise DeviceLostError or DeviceTimeoutError."""

    async def open(self) -> None:
        """Open the link and wait for the first answer; raises DeviceNotFoundError."""

    async def move(self, baseline_m: float) -> None:
        """Ask for a baseline and wait for the acknowledgement."""

    async def close(self) -> None:
        """Close; may be called twice."""


SERVOS = Family(
    "servo",
    {
        "none": "morpheyes_daemon.devices.servo.none:NoServo",
        "serial": "morpheyes_daemon.devices.servo.teensy:SerialServo",
    },
)


def build_servo(config: ServoConfig, context: DeviceContext) -> Servo:
    """Return the configured backend, not yet open; losses and recoveries go to the context's events."""
    servo: Servo = SERVOS.build(config, context)
    return servo
