"""A fixed rig: the baseline never changes, and asking for another one is a mistake."""

from __future__ import annotations

from morpheyes_daemon.config.vehicle import NoServoConfig
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.errors import DeviceError

SAME_M = 1e-6


class NoServo:
    """Accepts its one baseline and refuses every other."""

    @classmethod
    def from_config(cls, config: NoServoConfig, context: DeviceContext) -> NoServo:
        """Build the backend `none`."""
        return cls(config.baseline_mm / 1e3)

    def __init__(self, baseline_m: float) -> None:
        self._baseline_m = baseline_m

    async def open(self) -> None:
        """Nothing to open."""

    async def move(self, baseline_m: float) -> None:
        """Accept the rig's own baseline; DeviceError for another one."""
        if abs(baseline_m - self._baseline_m) > SAME_M:
            fixed_mm, asked_mm = self._baseline_m * 1e3, baseline_m * 1e3
            raise DeviceError(
                f"This rig is fixed at {fixed_mm:g} mm and cannot go to {asked_mm:g} mm; "
                "set servo.backend to serial if it has servos."
            )

    async def close(self) -> None:
        """Nothing to close."""
