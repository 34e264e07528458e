"""How tasks meet: latest-value topics where the newest wins, and an event log that drops nothing.

A slow reader sees the newest value and a count of what it missed; nobody ever waits for a reader.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar

from morpheyes_daemon.messages.core import (
    BaselineEstimate,
    Event,
    Governed,
    MissionCommand,
    Perception,
    StereoFrame,
    Sticks,
    Track,
    VehicleState,
)
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.safety import GateOutput, Health

T = TypeVar("T")

OnError = Callable[[Exception], None]


def raise_it(error: Exception) -> None:
    """Raise the error: what subscribers get where nobody has said what becomes of their mistakes."""
    raise error


class Latest(Generic[T]):
    """One slot; `publish` replaces what is there and wakes whoever waits."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.count = 0
        self._value: T | None = None
        self.on_error: OnError = raise_it
        self._waiting: list[asyncio.Future[None]] = []
        self._taps: list[Callable[[T], None]] = []

    def publish(self, value: T) -> None:
        """Put `value` in the slot; taps see it at once, readers when they run."""
        self._value = value
        self.count += 1
        waiting, self._waiting = self._waiting, []
        for future in waiting:
            if not future.done():
                future.set_result(None)
        call_each(self._taps, value, self.on_error)

    def get(self) -> T | None:
        """Return the newest value, None before the first."""
        return self._value

    def tap(self, callback: Callable[[T], None]) -> None:
        """Call `callback` with every value; it must be quick. What it raises goes to `on_error`."""
        self._taps.append(callback)

    def reader(self) -> Reader[T]:
        """Return a reader that has seen nothing published so far."""
        return Reader(self)

    async def _changed(self) -> None:
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(future)
        await future


class Reader(Generic[T]):
    """One task's view of a topic: each value at most once, `dropped` counts those it was too slow for."""

    def __init__(self, topic: Latest[T]) -> None:
        self._topic = topic
        self._seen = topic.count
        self.dropped = 0

    async def next(self) -> T:
        """Wait for a value newer than the last one read and return the newest."""
        while self._topic.count == self._seen:
            await self._topic._changed()
        return self.newest()

    def newest(self) -> T:
        """Return the newest value at once, which counts as read; there must have been one."""
        self.dropped += max(0, self._topic.count - self._seen - 1)
        self._seen = self._topic.count
        value = self._topic.get()
        assert value is not None
        return value


def call_each(callbacks: list[Callable[[T], None]], value: T, on_error: OnError) -> None:
    """Call every callback, whatever those before it raised: a subscriber cannot raise into a publisher."""
    for callback in callbacks:
        try:
            callback(value)
        except Exception as error:  # noqa: BLE001 -- the subscriber's boundary
            on_error(error)


class EventLog:
    """Events in order; handlers are called on the spot, so that the gate hears of an edge on reception.

    What a handler raises goes to `on_error`, and the others are called all the same. Without one it is raised, so that
    tests and lockstep see it.
    """

    def __init__(self) -> None:
        self.on_error: OnError = raise_it
        self._handlers: list[Callable[[Event], None]] = []

    def subscribe(self, handler: Callable[[Event], None]) -> None:
        """Call `handler` for every event from now on, in order of subscription."""
        self._handlers.append(handler)

    def publish(self, event: Event) -> None:
        """Hand the event to every handler before returning."""
        call_each(self._handlers, event, self.on_error)


class StickPulse:
    """Struck by the stick task right after each stick message; tasks with milliseconds of work wait for it."""

    def __init__(self) -> None:
        self._waiting: list[asyncio.Future[None]] = []

    def strike(self) -> None:
        """Wake whoever waits."""
        waiting, self._waiting = self._waiting, []
        for future in waiting:
            if not future.done():
                future.set_result(None)

    async def next(self) -> None:
        """Wait for the next strike."""
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(future)
        await future


def _topic(log_every: int, description: str) -> Any:
    return field(metadata={"log_every": log_every, "description": description})


@dataclass(slots=True)
class Topics:
    """Every topic of the daemon; `log_every` n keeps each n-th value in the flight log, 0 none."""

    frame: Latest[StereoFrame] = _topic(5, "stereo frames as captured, with their baseline")
    perception: Latest[Perception] = _topic(1, "depth summary and the strategy's percept per frame")
    vehicle: Latest[VehicleState] = _topic(5, "attitude, velocity, mode, RC as the autopilot reports them")
    observation: Latest[Observation] = _topic(1, "what the strategy decided on, for replay")
    track: Latest[Track] = _topic(1, "the moving object that is being followed")
    command: Latest[MissionCommand] = _topic(1, "what the mission wants")
    governed: Latest[Governed] = _topic(5, "speed limit and the bound that set it")
    sticks: Latest[Sticks] = _topic(1, "stick positions offered to the gate")
    gate: Latest[GateOutput] = _topic(1, "what the gate let out: sticks, neutral, or released")
    baseline: Latest[BaselineEstimate] = _topic(2, "modelled baseline")
    health: Latest[Health] = _topic(1, "ages, rates and lateness of everything")

    @classmethod
    def create(cls) -> Topics:
        """Return a fresh set of empty topics."""
        return cls(**{f.name: Latest(f.name) for f in fields(cls)})

    def on_error(self, handler: OnError) -> None:
        """Hand what subscribers raise to `handler`."""
        for f in fields(self):
            getattr(self, f.name).on_error = handler
