"""Camera and servo of a rig on the table: moves to a baseline, waits until the servo rests, and takes pairs.

Every baseline is approached from above, as in flight, so that the backlash of the servo is always on the same side.
"""

from __future__ import annotations

from types import TracebackType
from typing import Self

from morpheyes_daemon.clock import MS, Clock
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.control.baseline import baseline_model
from morpheyes_daemon.control.baseline_planner import OVERSHOOT_M
from morpheyes_daemon.devices.camera import Camera, build_camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.devices.servo import Servo, build_servo
from morpheyes_daemon.messages.core import RawPair

_POLL_NS = 20 * MS
"""Period at which the modelled motion is polled, nanoseconds; chosen: one period of a servo's control signal."""


class RigSession:
    """An open camera and servo; use it with `async with`."""

    def __init__(self, camera: Camera, servo: Servo, config: VehicleConfig, clock: Clock) -> None:
        self._camera, self._servo, self._clock = camera, servo, clock
        self._range_m = config.baseline_range_m
        self._model = baseline_model(config)

    @classmethod
    def of(cls, config: VehicleConfig, clock: Clock, opener: LinkOpener) -> Self:
        """Return the session of the configured devices, not yet open; raises ConfigError for an unknown backend."""
        context = DeviceContext.alone(clock, opener)
        servo = build_servo(config.servo, context)
        return cls(build_camera(config.camera, context), servo, config, clock)

    async def __aenter__(self) -> Self:
        await self._servo.open()
        await self._camera.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._camera.close()
        await self._servo.close()

    @property
    def range_m(self) -> tuple[float, float]:
        """Smallest and largest baseline of the rig, metres; equal for a fixed one."""
        return self._range_m

    async def place(self, nominal_m: float) -> None:
        """Move to a nominal baseline from above and wait until the modelled motion ends; raises DeviceError."""
        if self._range_m[0] == self._range_m[1]:
            return
        above_m = min(nominal_m + OVERSHOOT_M, self._range_m[1])
        for target_m in (above_m, nominal_m):
            await self._servo.move(target_m)
            self._model.on_acknowledged(target_m, self._clock.now_ns())
            while self._model.at(self._clock.now_ns()).moving:
                await self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS)

    async def pair(self) -> RawPair:
        """Return the next raw pair; raises DeviceError when the camera fails."""
        return await self._camera.read()
