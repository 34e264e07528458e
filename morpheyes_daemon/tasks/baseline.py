"""The baseline the mission wants, to the servo; and the modelled baseline for everybody."""

from __future__ import annotations

from collections.abc import Callable

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import Clock, Ticker
from morpheyes_daemon.control.baseline import BaselineModel
from morpheyes_daemon.control.baseline_planner import BaselinePlanner
from morpheyes_daemon.devices.servo import Servo
from morpheyes_daemon.supervisor.supervisor import Pulse

RATE_HZ = 10.0


async def baseline(
    servo: Servo,
    model: BaselineModel,
    planner: BaselinePlanner,
    first_m: float,
    topics: Topics,
    clock: Clock,
    tell_known: Callable[[bool], None],
    pulse: Pulse,
) -> None:
    """Keep the servo where the mission wants it; raises the servo's DeviceError.

    After opening nobody knows where the eyes are: they first go to `first_m`, and `tell_known` hears when they must
    have been long enough on the way. Following a mission that changes its mind could take for ever to find out.
    """
    known = False
    tell_known(known)
    try:
        await servo.open()
        ticker = Ticker(clock, RATE_HZ)
        while True:
            command = topics.command.get()
            here = model.at(clock.now_ns())
            if here.known and not known:
                known = True
                tell_known(known)
            target_m = planner.plan(command.baseline_m if command and known else first_m, here)
            if target_m is not None:
                await _move(servo, model, target_m, clock)
            topics.baseline.publish(model.at(clock.now_ns()))
            pulse.beat()
            await ticker.wait()
    finally:
        await servo.close()


async def _move(servo: Servo, model: BaselineModel, target_m: float, clock: Clock) -> None:
    """Between sending a target and its acknowledgement the eyes may have begun to move, or not."""
    model.on_sent(target_m, clock.now_ns())
    await servo.move(target_m)
    model.on_acknowledged(target_m, clock.now_ns())
