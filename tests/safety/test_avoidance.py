"""The autopilot's own avoidance is off while a mission flies that says so, and on again whatever ends it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

import pytest

from morpheyes_daemon.clock import S, run_virtual, running_clock
from morpheyes_daemon.config.vehicle import MissionFile, NoServoConfig
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.safety.states import HOLDING
from morpheyes_daemon.supervisor.supervisor import Pulse
from morpheyes_daemon.tasks.avoidance import avoidance
from tests.safety.noisy_daemon import NoisyDaemon


class Switch:
    """An autopilot's aux functions; `up` while it is heard, `deaf` while it does not answer."""

    def __init__(self) -> None:
        self.up, self.deaf = True, False
        self.said: list[tuple[int, int]] = []

    async def set_aux_function(self, function: int, position: int) -> None:
        if self.deaf:
            raise DeviceTimeoutError("no answer")
        self.said.append((function, position))


class Flight:
    """Stands in for the monitor: a state."""

    state = State.STANDBY


def told(story: Callable[[Flight, Switch], list[State]]) -> list[tuple[int, int]]:
    """Run the task through the states of a story, a second each, and return what the autopilot was told."""

    async def live() -> list[tuple[int, int]]:
        clock, switch, flight = running_clock(), Switch(), Flight()
        task = asyncio.create_task(avoidance(switch, cast(SafetyMonitor, flight), clock, Pulse(clock)))
        for state in story(flight, switch):
            flight.state = state
            await clock.sleep_until_ns(clock.now_ns() + S)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return switch.said

    return run_virtual(live())


OFF, ON = (40, 0), (40, 2)


@pytest.mark.parametrize("state", HOLDING)
@pytest.mark.parametrize("end", [State.RELEASED, State.PILOT, State.PREFLIGHT])
def test_it_is_off_exactly_while_we_hold_the_sticks(state: State, end: State) -> None:
    assert told(lambda flight, switch: [State.STANDBY, State.ENGAGED, state, end, end]) == [ON, OFF, ON]


def test_it_is_switched_on_at_the_start_since_we_may_have_died_before() -> None:
    assert told(lambda flight, switch: [State.PILOT]) == [ON]


def test_an_autopilot_that_is_not_heard_is_not_asked() -> None:
    def story(flight: Flight, switch: Switch) -> list[State]:
        switch.up = False
        asyncio.get_running_loop().call_later(1.5, setattr, switch, "up", True)
        return [State.STANDBY, State.STANDBY]

    assert told(story) == [ON]


def test_a_refusal_is_raised_so_that_the_supervisor_tries_again() -> None:
    async def live() -> None:
        clock, switch = running_clock(), Switch()
        switch.deaf = True
        await avoidance(switch, cast(SafetyMonitor, Flight()), clock, Pulse(clock))

    with pytest.raises(DeviceTimeoutError):
        run_virtual(live())


@pytest.mark.parametrize(("avoid", "after"), [(True, False), (False, True)])
def test_only_missions_that_say_so_touch_it(avoid: bool, after: bool) -> None:
    """On the twin: a mission that leaves it alone does not switch it on, either."""

    async def live() -> None:
        mission = MissionFile(strategy="forest", avoidance=avoid)
        noisy = NoisyDaemon(NoServoConfig(backend="none"), mission)
        noisy.twin.autopilot.avoidance = False
        async with noisy:
            assert noisy.twin.autopilot.avoidance is after

    run_virtual(live())
