"""mavsdk beside the connection: health, battery, texts and actions for doctor, dashboard and ground crews.

mavsdk gets the frames that the connection received over its `raw://` connection, and what it wants to send goes back
through the connection, which filters, numbers and signs it; mavsdk opens no port. It runs threads of its own, so it
has no place in lockstep, and nothing that keeps the vehicle safe or steers it depends on it: its flight mode reads
Loiter, Brake and FlowHold all as HOLD, and its `hold()` sends BRAKE.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass
from typing import Any

from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.errors import DeviceError

MAVSDK_COMPONENT = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER, a component of the vehicle."""
FOR_EVER = -1.0
WARNING_LEVEL = 2
_RAW = "raw://"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Received:
    """The newest value of one subscription and when it came."""

    t_ns: int
    value: Any


class MavsdkBridge:
    """`run` is its task; `latest` holds what mavsdk says by name, `action` its commands once the vehicle is seen."""

    def __init__(self, connection: AutopilotConnection, config: AutopilotConfig, clock: Clock) -> None:
        self._hub = connection
        self._config = config
        self._clock = clock
        self.latest: dict[str, Received] = {}
        self.action: Any = None

    async def run(self) -> None:
        """Serve until cancelled; raises DeviceError when mavsdk cannot be started."""
        from mavsdk.logging import log_subscribe
        from mavsdk.mavsdk import Configuration, Mavsdk

        log_subscribe(_log)
        settings = Configuration.create_manual(self._config.vehicle_sysid, MAVSDK_COMPONENT, False)
        native = Mavsdk(settings)
        loop = asyncio.get_running_loop()
        try:
            if native.add_any_connection(_RAW) != 0:
                raise DeviceError("mavsdk cannot open its raw connection; set autopilot.mavsdk to false.")
            native.subscribe_raw_bytes_to_be_sent(lambda data: loop.call_soon_threadsafe(self._hub.relay, data))
            self._hub.on_frame(native.pass_received_raw_bytes)
            await self._follow(native)
        finally:
            self._hub.forget_frames(native.pass_received_raw_bytes)
            self.action = None
            await loop.run_in_executor(None, native.destroy)
            settings.destroy()

    async def _follow(self, native: Any) -> None:
        """Wait for the vehicle, then drain every subscription into `latest`."""
        from mavsdk.asyncio import System
        from mavsdk.asyncio.plugins.action import ActionAsync
        from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

        system = System(await _first_autopilot(native))
        telemetry = TelemetryAsync(system)
        self.action = ActionAsync(system)
        streams: dict[str, Callable[[], AsyncGenerator[Any, None]]] = {
            "health": telemetry.subscribe_health,
            "health_all_ok": telemetry.subscribe_health_all_ok,
            "in_air": telemetry.subscribe_in_air,
            "armed": telemetry.subscribe_armed,
            "battery": telemetry.subscribe_battery,
            "rc_status": telemetry.subscribe_rc_status,
            "gps_info": telemetry.subscribe_gps_info,
            "status_text": telemetry.subscribe_status_text,
        }
        async with asyncio.TaskGroup() as group:
            for name, stream in streams.items():
                group.create_task(self._drain(name, stream()))

    async def _drain(self, name: str, stream: AsyncGenerator[Any, None]) -> None:
        """Keep the newest value; mavsdk's own queue is unbounded, so nothing may wait in it."""
        try:
            async for value in stream:
                self.latest[name] = Received(self._clock.now_ns(), value)
        finally:
            await stream.aclose()


async def _first_autopilot(native: Any) -> Any:
    """Wait, without a thread, for mavsdk to see the autopilot."""
    loop = asyncio.get_running_loop()
    found: asyncio.Future[Any] = loop.create_future()

    def take(system: Any) -> None:
        if not found.done():
            found.set_result(system)

    handle = native.first_autopilot_async(FOR_EVER, lambda system: loop.call_soon_threadsafe(take, system))
    try:
        return await found
    finally:
        native.cancel_first_autopilot(handle)


def _log(level: int, message: str, file: str | None, line: int) -> bool:
    """Take mavsdk's log off standard output, which may be somebody's JSON."""
    logger.log(logging.WARNING if level >= WARNING_LEVEL else logging.DEBUG, message)
    return True
