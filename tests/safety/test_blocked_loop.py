"""The event loop is held up for 300 ms in flight: noticed, logged, and neutral is the first thing afterwards."""

from __future__ import annotations

import asyncio

import pytest

from morpheyes_daemon.clock import MS, VirtualLoop, run_virtual
from morpheyes_daemon.config.vehicle import NoServoConfig
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.tasks.health import LISTEN_HZ
from tests.safety.noisy_daemon import NoisyDaemon


@pytest.mark.parametrize(("held_up_s", "noticed"), [(0.3, True), (0.15, True), (0.04, False)])
def test_neutral_is_the_first_thing_after(held_up_s: float, noticed: bool) -> None:
    async def life() -> None:
        async with NoisyDaemon(NoServoConfig(backend="none")) as noisy:
            await noisy.pass_time(0.51)  # between two stick periods
            noisy.links["autopilot"].on_bytes = lambda data: None  # it would say that nobody has armed it
            machine = noisy.daemon.monitor.machine
            machine.state, machine.since_ns = State.ENGAGED, noisy.clock.now_ns()
            for _ in range(3):
                await noisy.pass_time(0.02)
            before = len(noisy.overrides)
            assert noisy.overrides[-1] not in ((1500,) * 4, (0,) * 4), "it flies"
            loop = asyncio.get_running_loop()
            assert isinstance(loop, VirtualLoop)
            loop.leap(held_up_s)
            await noisy.clock.sleep_until_ns(noisy.clock.now_ns() + MS)
            late = [event for event in noisy.events if event.reason is Reason.LOOP_LATE]
            assert bool(late) is noticed
            if noticed:
                assert noisy.overrides[before] == (1500, 1500, 1500, 1500)
                assert "held up for" in late[0].text
            await noisy.pass_time(0.3)
            health = noisy.daemon.topics.health.get()
            assert held_up_s - 1.0 / LISTEN_HZ <= health.worst_lateness_ms / 1e3 <= held_up_s

    run_virtual(life())
