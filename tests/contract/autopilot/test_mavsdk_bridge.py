"""mavsdk behind the connection: it hears the twin, its commands arrive, and what is the connection's alone is not let out.

mavsdk runs threads of its own, so these tests run in real time and wait for what they expect.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.devices.autopilot.mavsdk_bridge import MavsdkBridge
from morpheyes_daemon.wire.mavlink import Encoder, Identity
from tests.support.connection_bench import ConnectionBench

MAVSDK = Identity(1, 191)


async def test_mavsdk_hears_and_commands_through_the_hub() -> None:
    async with ConnectionBench(delay_s=0.0) as bench:
        bridge = MavsdkBridge(bench.connection, AutopilotConfig(), bench.clock)
        running = asyncio.create_task(bridge.run())
        try:
            await bench.ready()
            await bench.until(lambda: {"armed", "battery", "health", "in_air"} <= bridge.latest.keys())
            assert bridge.latest["armed"].value is False
            assert bridge.latest["in_air"].value is False
            assert bridge.latest["battery"].value.voltage_v > 10.0
            await bridge.action.arm()
            await bench.until(lambda: bench.vehicle.armed)
        finally:
            running.cancel()
            with suppress(asyncio.CancelledError):
                await running
        from_mavsdk = [m for m in bench.sent if Identity(m.get_srcSystem(), m.get_srcComponent()) == MAVSDK]
        kinds = {message.get_type() for message in from_mavsdk}
        assert "COMMAND_LONG" in kinds
        assert not kinds & {"HEARTBEAT", "TIMESYNC", "RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"}
        assert all(m.command != 511 for m in from_mavsdk if m.get_type() == "COMMAND_LONG")
        assert bridge.action is None


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
        mavlink.MAVLink_rc_channels_override_message(1, 1, *[1900] * 8),
        mavlink.MAVLink_manual_control_message(1, 900, 900, 900, 900, 0),
        mavlink.MAVLink_command_long_message(1, 1, 511, 0, 30, -1, 0, 0, 0, 0, 0),
    ],
)
def test_what_mavsdk_may_not_send(message: object) -> None:
    async def story() -> None:
        async with ConnectionBench() as bench:
            await bench.ready()
            bench.connection.relay(Encoder().pack(message, MAVSDK))
            bench.connection.relay(Encoder().pack(mavlink.MAVLink_ping_message(0, 0, 0, 0), MAVSDK) + b"\xfd garbage")
            bench.connection.relay(Encoder().pack(mavlink.MAVLink_param_request_list_message(1, 1), MAVSDK))
            await bench.sleep(0.1)
            from_mavsdk = [m.get_type() for m in bench.sent if m.get_srcComponent() == MAVSDK.compid]
            assert from_mavsdk == ["PARAM_REQUEST_LIST"]

    run_virtual(story())
