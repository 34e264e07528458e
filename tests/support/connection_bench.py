"""The autopilot connection on in-memory links to the autopilot twin, on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, S, running_clock
from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.link import Link, MemoryLink, OnBytes, OnLost
from morpheyes_daemon.errors import DeviceNotFoundError
from morpheyes_daemon.messages.core import Event, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.simulation.airframe.dynamics import Vehicle
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin

DELAY_S = 0.004


class ConnectionBench:
    """`async with ConnectionBench(...)`: connection and twin run; `link` is the twin's end of the newest connection."""

    def __init__(
        self,
        parameters: Mapping[str, float] | None = None,
        *,
        delay_s: float = DELAY_S,
        run_hub: bool = True,
        **config: Any,
    ) -> None:
        self.clock: Clock = running_clock()
        self.twin = AutopilotTwin(Vehicle(), self.clock, parameters)
        self.topics, self.log = Topics.create(), EventLog()
        self.events: list[Event] = []
        self.log.subscribe(self.events.append)
        self.plugged = True
        self.opened = 0
        self.link: MemoryLink | None = None
        self.sent: list[Any] = []
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._delay_s = delay_s
        self._run_hub = run_hub
        self._near: MemoryLink | None = None
        self._on_lost: OnLost = lambda reason: None
        self.connection = AutopilotConnection(AutopilotConfig(**config), self.clock, self.topics, self.log, self.open)
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(self.twin.run())]
        if self._run_hub:
            self._tasks.append(asyncio.create_task(self.connection.run()))
        return self

    async def __aexit__(self, *error: object) -> None:
        for task in self._tasks:
            task.cancel()
        for task in self._tasks:
            with suppress(asyncio.CancelledError):
                await task

    async def open(self, url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
        """The twin's port as a `LinkOpener`."""
        self.opened += 1
        if not self.plugged:
            raise DeviceNotFoundError(f"{url}: unplugged.")
        near, far = MemoryLink.pair(self._delay_s)
        near.on_bytes, self._on_lost = on_bytes, on_lost
        receive = self.twin.attach(far)

        def listen(data: bytes) -> None:
            self.sent += self._parser.parse_buffer(data) or []
            receive(data)

        far.on_bytes = listen
        self.link, self._near = far, near
        return near

    def pull(self) -> None:
        """Unplug the cable: both ends are dead and the connection is told so."""
        self.plugged = False
        self.mute()
        self._on_lost("unplugged")

    def mute(self) -> None:
        """Let the link die silently."""
        assert self.link is not None
        assert self._near is not None
        self.twin.detach(self.link)
        self.link.closed = self._near.closed = True

    async def sleep(self, seconds: float) -> None:
        await self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * S))

    async def until(self, done: Callable[[], bool], limit_s: float = 30.0) -> float:
        """Wait for `done` and return how long it took; fails after `limit_s`."""
        start_ns = self.clock.now_ns()
        while not done():
            assert self.clock.now_ns() - start_ns < limit_s * S, "did not happen"
            await self.sleep(0.01)
        return (self.clock.now_ns() - start_ns) / S

    async def ready(self) -> None:
        """Wait until parameters are read and everything streams."""
        await self.until(lambda: self.connection.parameters.complete and self.vehicle.position_t_ns > 0)

    @property
    def vehicle(self) -> VehicleState:
        return self.topics.vehicle.get() or VehicleState()

    @property
    def reasons(self) -> list[Reason]:
        return [event.reason for event in self.events]

    def sent_of(self, kind: str) -> list[Any]:
        """What the connection sent, by message type."""
        return [message for message in self.sent if message.get_type() == kind]
