"""Whatever fails inside the daemon in flight: the autopilot hears no deflected stick afterwards, and a release last.

The witness is the autopilot's end of the link. After a fault neutral sticks come before the release.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields
from typing import Any

import pytest

from morpheyes_daemon.bus import Latest
from morpheyes_daemon.clock import S, run_virtual
from morpheyes_daemon.config.vehicle import NoServoConfig, SerialServoConfig, ServoConfig
from morpheyes_daemon.devices.link import MemoryLink
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.simulation.crew.scripted import GroundCrew
from tests.safety.noisy_daemon import NoisyDaemon

OVERRIDE_ID = 70
NEUTRAL, RELEASE, STICKS = "neutral", "release", "sticks"
LEAVES_S = 5.0
"""Longer than neutral before the release, and its repetition."""


class Flight:
    """A daemon in ENGAGED over the autopilot twin, its sticks fully deflected; `kinds` is what the twin heard."""

    def __init__(self, servo: ServoConfig) -> None:
        self.noisy = NoisyDaemon(servo)

    async def engage(self) -> None:
        """Take off and hand over as a ground crew does."""
        noisy = self.noisy
        ours, theirs = MemoryLink.pair(0.001)
        crew = GroundCrew(noisy.twin.radio, ours, noisy.clock)
        ours.on_bytes = crew.on_bytes
        theirs.on_bytes = noisy.twin.attach(theirs)
        self.background = [asyncio.create_task(crew.run()), asyncio.create_task(self.fresh())]
        await crew.take_off(2.0)
        await self.until(lambda: noisy.daemon.monitor.state is State.STANDBY)
        crew.engage()
        await self.until(lambda: noisy.daemon.monitor.state is State.ENGAGED)
        await self.sleep(0.5)
        assert self.kinds()[-1] == STICKS

    async def fresh(self) -> None:
        """Keep every lease that the missing camera and mission would renew, and offer sticks."""
        while True:
            await self.noisy.pass_time(0.02)

    async def brake(self) -> None:
        """Come to BRAKING by a mission lease that runs out."""
        self.background.pop().cancel()
        await self.until(lambda: self.noisy.daemon.monitor.state is State.BRAKING)

    async def until(self, done: Callable[[], bool], limit_s: float = 30.0) -> None:
        """Wait for something to become true."""
        for _ in range(round(limit_s * 50)):
            if done():
                return
            await self.sleep(0.02)
        raise AssertionError(f"it stays {self.noisy.daemon.monitor.state}: {self.noisy.daemon.monitor.reason}")

    async def sleep(self, seconds: float) -> None:
        """Let virtual time pass."""
        await self.noisy.clock.sleep_until_ns(self.noisy.clock.now_ns() + round(seconds * S))

    async def leave(self) -> None:
        """Ask the daemon to end, as SIGTERM does, and wait until it has; what it raises is its own business."""
        for task in self.background:
            task.cancel()
        await asyncio.gather(*self.background, return_exceptions=True)
        self.noisy._stop.set()
        life = self.noisy._lives.pop(0)
        with suppress(Exception):
            async with asyncio.timeout(LEAVES_S):
                await life

    def kinds(self) -> list[str]:
        """Every override that the autopilot has heard: its first four channels."""
        heard = []
        for data in self.noisy.links["autopilot"].sent:
            if len(data) > 18 and int.from_bytes(data[7:10], "little") == OVERRIDE_ID:
                widths = struct.unpack_from("<4H", data, 10)
                kind = {(1500,) * 4: NEUTRAL, (0,) * 4: RELEASE}.get(widths, STICKS)
                heard.append(kind)
        return heard


def raising(*_: object, **__: object) -> Any:
    """What fails."""
    raise MemoryError("no memory is left")


def break_task(flight: Flight, name: str) -> None:
    """The task meets something unforeseen at its next turn, and at every later one."""
    daemon = flight.noisy.daemon
    if name == "supervisor":
        real = daemon.gate.renew
        daemon.supervisor._gate.renew = lambda lease, t_ns: (  # type: ignore[method-assign, assignment]
            raising() if lease is Lease.SUPERVISOR else real(lease, t_ns)
        )
    else:
        daemon.supervisor.pulses[name].beat = raising  # type: ignore[method-assign]


def subscribers(flight: Flight) -> Iterator[tuple[str, list[Any], int]]:
    """Every callback that the daemon has given to topics, events and the connection: where it is kept."""
    daemon = flight.noisy.daemon
    kept: list[tuple[str, list[Any]]] = [
        ("events", daemon.events._handlers),
        ("vehicle state", daemon.connection._on_vehicle),
        ("parameters", daemon.connection.parameters._listeners),
    ]
    topics: list[tuple[str, Latest[Any]]] = [(f.name, getattr(daemon.topics, f.name)) for f in fields(daemon.topics)]
    kept += [(f"topic {name}", topic._taps) for name, topic in topics]
    for name, callbacks in kept:
        for index in range(len(callbacks)):
            yield f"{name} {index}", callbacks, index


async def flown(servo: ServoConfig, state: State, fail: Callable[[Flight], None]) -> tuple[list[str], int, Flight]:
    """Break something in a state; returns what the autopilot heard and how many messages of it before."""
    flight = Flight(servo)
    async with contextlib.AsyncExitStack() as stack:
        await stack.enter_async_context(flight.noisy)
        await flight.engage()
        if state is State.BRAKING:
            await flight.brake()
        before = len(flight.kinds())
        fail(flight)
        await flight.sleep(1.0)
        await flight.leave()
        return flight.kinds(), before, flight
    raise AssertionError


SERVOS: dict[bool, ServoConfig] = {
    False: NoServoConfig(backend="none"),
    True: SerialServoConfig(backend="serial", url="memory:servo"),
}
TASKS = ("autopilot", "sticks", "capture", "depth", "mission", "health", "obstacles", "supervisor")


@pytest.mark.parametrize("state", [State.ENGAGED, State.BRAKING])
@pytest.mark.parametrize("name", TASKS)
def test_an_exception_in_a_task_ends_in_a_release_on_the_open_link(name: str, state: State) -> None:
    kinds, before, _ = run_virtual(flown(SERVOS[False], state, lambda flight: break_task(flight, name)))
    after = kinds[before:]
    assert after[-1] == RELEASE, "the last thing that the autopilot hears"
    beats = {"sticks", "supervisor"}
    if state is State.BRAKING or name in beats:
        deflected = [index for index, kind in enumerate(after) if kind == STICKS]
        assert not deflected or max(deflected) < 15, "a deflected stick goes out for three periods of the supervisor"
        assert NEUTRAL in after, "and neutral comes before the release"
    release = after.index(RELEASE)
    assert set(after[release:]) == {RELEASE}, "after the release nothing else is sent"
    assert after[release - 1] == NEUTRAL


def names_of_subscribers() -> list[str]:
    """The subscribers of a daemon, in a flight of its own."""
    found: list[str] = []

    def look(flight: Flight) -> None:
        found.extend(name for name, _, _ in subscribers(flight))

    run_virtual(flown(SERVOS[False], State.ENGAGED, look))
    return found


def test_an_exception_in_any_subscriber_ends_in_neutral_and_release() -> None:
    names = names_of_subscribers()
    assert len(names) >= 6, names
    quiet = {"topic track 0", "parameters 0"}  # not called in this flight
    for wanted in names:

        def fail(flight: Flight, wanted: str = wanted) -> None:
            for name, callbacks, index in subscribers(flight):
                if name == wanted:
                    callbacks[index] = raising
            flight.noisy.daemon.events.publish(flight.noisy.events[-1])

        kinds, before, _ = run_virtual(flown(SERVOS[False], State.ENGAGED, fail))
        after = kinds[before:]
        assert after[-1] == RELEASE, wanted
        release = after.index(RELEASE)
        assert set(after[release:]) == {RELEASE}, wanted
        if wanted not in quiet and not wanted.startswith("topic"):
            assert STICKS not in after[1:], f"{wanted}: the flight goes on after a subscriber failed"
            assert after[release - 1] == NEUTRAL, wanted


def test_a_second_request_to_end_releases_at_once() -> None:
    async def run() -> list[str]:
        flight = Flight(SERVOS[False])
        async with flight.noisy:
            await flight.engage()
            for task in flight.background:
                task.cancel()
            before = len(flight.kinds())
            flight.noisy._stop.set()
            await flight.sleep(0.1)
            flight.noisy._lives[0].cancel()
            with suppress(asyncio.CancelledError):
                await flight.noisy._lives[0]
            return flight.kinds()[before:]

    after = run_virtual(run())
    assert after[-1] == RELEASE
    assert STICKS not in after[1:]
    assert NEUTRAL in after


def test_a_stop_from_the_page_brakes_and_waits_for_the_pilot() -> None:
    async def run() -> tuple[list[str], State, Reason]:
        flight = Flight(SERVOS[False])
        async with flight.noisy:
            await flight.engage()
            before = len(flight.kinds())
            monitor = flight.noisy.daemon.monitor
            monitor.stop_requested(flight.noisy.clock.now_ns())
            await flight.until(lambda: monitor.state is State.HOLD)
            seen = flight.kinds()[before:], monitor.state, monitor.reason
            await flight.leave()
            return seen

    kinds, state, reason = run_virtual(run())
    assert set(kinds) == {NEUTRAL}
    assert (state, reason) == (State.HOLD, Reason.STOP_REQUESTED)
