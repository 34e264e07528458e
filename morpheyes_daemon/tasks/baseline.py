"""The baseline the mission wants, to the servo; and the modelled baseline for everybody."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import Clock, Ticker
from morpheyes_daemon.control.baseline import BaselineModel
from morpheyes_daemon.control.baseline_planner import BaselinePlanner
from morpheyes_daemon.devices.servo import Servo
from morpheyes_daemon.supervisor.supervisor import Pulse

RATE_HZ = 10.0
"""Chosen: the servos move at most 2.5 mm each in between, about what the baseline planner's dead band ignores."""


@dataclass(slots=True)
class BaselineTask:
    """Keeps the servo where the mission wants it.

    After opening the baseline is unknown: the servo first goes to `first_m`, and `on_known` is called when it must
    have arrived. Following a mission that changes its mind meanwhile could take for ever to find out.
    """

    servo: Servo
    model: BaselineModel
    planner: BaselinePlanner
    first_m: float
    topics: Topics
    clock: Clock
    on_known: Callable[[bool], None]

    async def run(self, pulse: Pulse) -> None:
        """Command the servo until cancelled; raises its DeviceError."""
        known = False
        self.on_known(known)
        try:
            await self.servo.open()
            ticker = Ticker(self.clock, RATE_HZ)
            while True:
                command = self.topics.command.get()
                here = self.model.at(self.clock.now_ns())
                if here.known and not known:
                    known = True
                    self.on_known(known)
                target_m = self.planner.plan(command.baseline_m if command and known else self.first_m, here)
                if target_m is not None:
                    await self._move(target_m)
                self.topics.baseline.publish(self.model.at(self.clock.now_ns()))
                pulse.beat()
                await ticker.wait()
        finally:
            await self.servo.close()

    async def _move(self, target_m: float) -> None:
        """Between sending a target and its acknowledgement the cameras may have begun to move, or not."""
        self.model.on_sent(target_m, self.clock.now_ns())
        await self.servo.move(target_m)
        self.model.on_acknowledged(target_m, self.clock.now_ns())
