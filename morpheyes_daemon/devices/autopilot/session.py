"""An autopilot connection outside the daemon, for as long as an `async with` lasts: doctor and mount capture."""

from __future__ import annotations

import asyncio
from types import TracebackType
from typing import Self

from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.devices.autopilot import build_connection
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.messages.core import VehicleState


class AutopilotSession:
    """Runs a connection of its own; `connection` is it, `context` has its topics and events."""

    def __init__(self, config: AutopilotConfig, context: DeviceContext) -> None:
        self.context = context
        self.connection = build_connection(config, context)
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self.connection.run(), name="autopilot")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self.connection.close()

    @property
    def vehicle(self) -> VehicleState:
        """The newest state."""
        return self.context.topics.vehicle.get() or VehicleState()

    def check(self) -> None:
        """Raise what ended the connection, if anything did."""
        if self._task is not None and self._task.done():
            self._task.result()
