"""Real mavsdk over TCP against the autopilot twin: connect, arm, take off, land. Real time."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from morpheyes_daemon.clock import MonotonicClock
from morpheyes_daemon.simulation.airframe.dynamics import Vehicle
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.tcp_server import MavlinkServer
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from morpheyes_daemon.simulation.crew.mavsdk import MavsdkCrew

pytest.importorskip("mavsdk")


@asynccontextmanager
async def served_twin() -> AsyncIterator[tuple[AutopilotTwin, str]]:
    twin = AutopilotTwin(Vehicle(), MonotonicClock())
    async with MavlinkServer(twin, port=0) as server:
        beat = asyncio.create_task(twin.run())
        try:
            yield twin, server.url
        finally:
            beat.cancel()
            await asyncio.gather(beat, return_exceptions=True)


async def first(stream: Any, wanted: Any, limit_s: float = 30.0) -> Any:
    """Return the first value of a mavsdk subscription that `wanted` accepts."""
    async with asyncio.timeout(limit_s):
        try:
            async for value in stream:
                if wanted(value):
                    return value
        finally:
            await stream.aclose()
    raise AssertionError("the subscription ended")


@pytest.mark.slow
@pytest.mark.timeout(120)
async def test_mavsdk_connects_arms_takes_off_and_lands() -> None:
    from mavsdk.asyncio import Configuration, Mavsdk
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
    from mavsdk.component_type import ComponentType

    async with served_twin() as (twin, url):
        settings = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        async with Mavsdk(settings) as native:
            await native.add_any_connection(url.replace("tcp:", "tcpout://"))
            system = await native.first_autopilot(10.0)
            assert system is not None
            action, telemetry = ActionAsync(system), TelemetryAsync(system)
            await telemetry.set_rate_health(5.0)
            await telemetry.set_rate_position(10.0)
            await telemetry.set_rate_in_air(5.0)
            health = await first(telemetry.subscribe_health(), lambda h: h.is_local_position_ok and h.is_armable)
            assert health.is_armable
            twin.set_mode(Mode.GUIDED)
            await action.set_takeoff_altitude(2.0)
            await action.arm()
            assert twin.autopilot.armed
            await action.takeoff()
            await first(telemetry.subscribe_position(), lambda p: p.relative_altitude_m > 1.8)
            assert twin.truth_at(twin.autopilot.t_ns).height_m == pytest.approx(2.0, abs=0.4)
            assert await first(telemetry.subscribe_in_air(), bool)
            await action.land()
            await first(telemetry.subscribe_armed(), lambda armed: not armed)
            assert twin.truth_at(twin.autopilot.t_ns).height_m == 0.0


@pytest.mark.slow
async def test_clients_come_and_go_while_the_twin_beats() -> None:
    async with served_twin() as (twin, url):
        host, port = url.removeprefix("tcp:").split(":")
        for _ in range(3):
            reader, writer = await asyncio.open_connection(host, int(port))
            assert (await asyncio.wait_for(reader.readexactly(1), 5.0)) == b"\xfd"
            writer.close()
        assert twin.autopilot.boot_ms > 0


@pytest.mark.slow
@pytest.mark.timeout(120)
async def test_the_mavsdk_ground_crew_hands_over_in_loiter_and_lands() -> None:
    async with served_twin() as (twin, url), MavsdkCrew(twin.radio, url, MonotonicClock()) as crew:
        await crew.take_off(1.5)
        assert twin.autopilot.mode is Mode.LOITER
        assert twin.truth_at(twin.autopilot.t_ns).height_m == pytest.approx(1.5, abs=0.3)
        crew.engage()
        assert twin.radio.channels_us[Radio.SWITCH_CHANNEL - 1] > 1700
        await crew.land()
        assert twin.radio.channels_us[Radio.SWITCH_CHANNEL - 1] < 1200
        assert not twin.autopilot.armed
