"""The connection on a real ArduPilot SITL, which nobody needs to have: `MORPHEYES_SITL=tcp:127.0.0.1:5760 pytest …`.

The vehicle stays disarmed on the ground; what the twin promises about the link is checked on the real thing.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from itertools import pairwise
from statistics import median

import pytest

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S, Ticker, running_clock
from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.link import open_link
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.wire.mavlink import RELEASE, ChannelOverride

URL = os.environ.get("MORPHEYES_SITL", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not URL, reason="no ArduPilot SITL: set MORPHEYES_SITL to its address"),
]


class Session:
    """A connection on the SITL, its events and its state."""

    def __init__(self, **config: object) -> None:
        self.clock = running_clock()
        self.topics, log = Topics.create(), EventLog()
        self.reasons: list[Reason] = []
        log.subscribe(lambda event: self.reasons.append(event.reason))
        settings = AutopilotConfig(url=URL, **config)
        self.connection = AutopilotConnection(settings, self.clock, self.topics, log, open_link)
        self.output = self.connection.claim_stick_output()

    @property
    def vehicle(self) -> VehicleState:
        return self.topics.vehicle.get() or VehicleState()

    async def stream(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Stream throttle-low sticks with a mark for `seconds` or until `done`; return whether it was done."""
        ticker = Ticker(self.clock, 50.0)
        end_ns = self.clock.now_ns() + round(seconds * S)
        while not done() and self.clock.now_ns() < end_ns:
            self.output(ChannelOverride((1537, 1500, 1000, 1500)))
            await ticker.wait()
        return done()


@asynccontextmanager
async def session(**config: object) -> AsyncIterator[Session]:
    current = Session(**config)
    running = asyncio.create_task(current.connection.run())
    try:
        ticker = Ticker(current.clock, 20.0)
        while not (current.connection.parameters.complete and current.vehicle.attitude_t_ns):
            await ticker.wait()
        yield current
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


async def test_parameters_streams_and_settings() -> None:
    async with session() as sitl:
        assert len(sitl.connection.parameters.values) > 800
        LoiterModel.from_parameters(sitl.connection.parameters.values)
        assert sitl.connection.refused_streams == []
        stamps: set[int] = set()
        sitl.connection.on_vehicle(lambda state: stamps.add(state.attitude_t_ns))
        await sitl.clock.sleep_until_ns(sitl.clock.now_ns() + 2 * S)
        order = sorted(stamps)
        # by the autopilot's own time: a loaded machine runs the SITL slower than real time
        assert median(b - a for a, b in pairwise(order)) / S == pytest.approx(0.02, abs=0.001)
        before = sitl.connection.parameters.values["LOIT_BRK_DELAY"]
        await sitl.connection.set_parameter("LOIT_BRK_DELAY", 0.15)
        await sitl.connection.set_parameter("LOIT_BRK_DELAY", before)
        with pytest.raises(DeviceTimeoutError):
            await sitl.connection.set_parameter("NO_SUCH_NAME", 1.0)
        await sitl.connection.set_aux_function(40, 2)


async def test_overrides_are_echoed_and_released() -> None:
    async with session() as sitl:
        assert await sitl.stream(3.0, lambda: sitl.vehicle.rc_us[:1] == (1537,))
        sitl.output(RELEASE)
        start_ns, ticker = sitl.clock.now_ns(), Ticker(sitl.clock, 100.0)
        while sitl.vehicle.rc_us[0] == 1537:
            assert sitl.clock.now_ns() - start_ns < S
            await ticker.wait()
        # one period of RC_CHANNELS at 20 Hz and the autopilot's own 50 Hz of radio
        assert sitl.clock.now_ns() - start_ns < 0.15 * S
        assert Reason.OVERRIDE_IGNORED not in sitl.reasons


async def test_overrides_from_another_id_are_ignored_and_we_notice() -> None:
    async with session(override_sysid=77) as sitl:
        assert await sitl.stream(4.0, lambda: Reason.OVERRIDE_IGNORED in sitl.reasons)
        assert sitl.vehicle.rc_us[0] != 1537
