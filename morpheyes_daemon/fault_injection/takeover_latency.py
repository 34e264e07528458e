"""How soon the pilot has the sticks: take-overs at random moments of forest flights, read off the wire.

The flight goes on as if nothing had happened; each take-over lives in a process of its own (`branch`). Times count
from the pilot's hand, and from the arrival of the message that tells of it.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import S, run_virtual
from morpheyes_daemon.fault_injection import faults as actions
from morpheyes_daemon.fault_injection.fork import branch
from morpheyes_daemon.fault_injection.harness import FaultFlight, Sent
from morpheyes_daemon.flights.flight_plan import with_seed
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.monitor import LOITER
from morpheyes_daemon.safety.states import HOLDING
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode

WAYS: dict[str, actions.Act] = {
    "switch": actions.switch_off,
    "mode": actions.switch_mode(Mode.ALT_HOLD),
}
PER_FLIGHT = 200
BETWEEN_S = (0.0, 0.2)
WATCHED_S = 1.1
"""A release is repeated for a second."""
AUTOPILOT = (1, mavlink.MAV_COMP_ID_AUTOPILOT1)
"""System and component; a ground station's heartbeats pass by as well."""

LIMIT_S = 0.05
"""From the arrival of the pilot's message to the release."""


@dataclass(frozen=True, slots=True)
class TakeOver:
    """One take-over: seconds from the pilot's hand to his message's arrival and to the release.

    `held_after` counts messages after that which hold a stick, deflected or not.
    """

    seed: int
    way: str
    state: str
    arrived_s: float | None
    released_s: float | None
    held_after: int

    @property
    def reaction_s(self) -> float | None:
        """From the message's arrival to the release."""
        told = self.arrived_s is not None and self.released_s is not None
        return self.released_s - self.arrived_s if told else None  # type: ignore[operator]

    @property
    def passed(self) -> bool:
        """Released in time, and for good."""
        reaction_s = self.reaction_s
        return reaction_s is not None and reaction_s <= LIMIT_S and self.held_after == 0


@dataclass(frozen=True, slots=True)
class TakeOverFigures:
    """The figures over all: milliseconds from arrival, and from the pilot's hand by way."""

    trials: int
    failed: int
    held_after: int
    arrival_to_release_max_ms: float
    hand_to_release_ms: dict[str, dict[str, float]]


def bench_takeover(plan: FlightPlan, trials: int, report: Callable[[str, int, int], None]) -> TakeOverFigures:
    """Take over `trials` times, in as many flights as that takes."""
    cv2.setNumThreads(1)  # a pool of threads would not survive the fork
    done: list[TakeOver] = []

    def note(one: TakeOver) -> None:
        done.append(one)
        report("take-overs", len(done), trials)

    for seed in itertools.count():
        if len(done) >= trials:
            return figures(done)
        run_virtual(_fly(with_seed(plan, seed), min(PER_FLIGHT, trials - len(done)), note))
    raise AssertionError


def figures(done: list[TakeOver]) -> TakeOverFigures:
    """Put the take-overs together."""
    reactions = [1e3 * one.reaction_s for one in done if one.reaction_s is not None]
    return TakeOverFigures(
        trials=len(done),
        failed=sum(not one.passed for one in done),
        held_after=sum(one.held_after for one in done),
        arrival_to_release_max_ms=max(reactions, default=float("nan")),
        hand_to_release_ms={way: _spread([one for one in done if one.way == way]) for way in WAYS},
    )


def _spread(done: list[TakeOver]) -> dict[str, float]:
    times_ms = [1e3 * one.released_s for one in done if one.released_s is not None]
    if not times_ms:
        return {"count": 0}
    median, p99 = np.percentile(times_ms, (50, 99))
    return {"count": len(times_ms), "median": float(median), "p99": float(p99), "max": max(times_ms)}


async def _fly(plan: FlightPlan, count: int, note: Callable[[TakeOver], None]) -> None:
    """One flight, left by the pilot at up to `count` moments, as long as it lasts."""
    with tempfile.TemporaryDirectory() as folder:
        async with FaultFlight(plan, Path(folder)) as flight:
            await flight.reach(State.ENGAGED)
            for _ in range(count):
                await flight.sleep(flight.rng.uniform(*BETWEEN_S))
                if flight.state not in HOLDING:
                    return
                way = flight.rng.choice(list(WAYS))
                told = (await branch(partial(_take_over, flight, way))).result()
                note(TakeOver(**told) if told else TakeOver(plan.scenario.seed, way, flight.state, None, None, 0))


async def _take_over(flight: FaultFlight, way: str) -> dict[str, Any]:
    began_ns, state = flight.clock.now_ns(), flight.state
    arrivals: list[int] = []

    def passage(data: bytes, deliver: Callable[[bytes], None]) -> None:
        if tells_of_the_pilot(data, flight.plan.config.autopilot.engage_channel):
            arrivals.append(flight.clock.now_ns())
        deliver(data)

    flight.wire.incoming = passage
    WAYS[way](flight)
    await flight.sleep(WATCHED_S)
    sent = [(t_ns, kind) for t_ns, kind in flight.sent if t_ns >= began_ns]
    released_ns = next((t_ns for t_ns, kind in sent if kind is Sent.RELEASE), None)
    after = [kind for t_ns, kind in sent if released_ns is not None and t_ns >= released_ns]
    return asdict(
        TakeOver(
            seed=flight.plan.scenario.seed,
            way=way,
            state=state,
            arrived_s=(arrivals[0] - began_ns) / S if arrivals else None,
            released_s=(released_ns - began_ns) / S if released_ns is not None else None,
            held_after=sum(kind is not Sent.RELEASE for kind in after),
        )
    )


def tells_of_the_pilot(data: bytes, channel: int) -> bool:
    """Tell whether a MAVLink 2 frame comes from the autopilot and says that the switch is off, or the mode another."""
    if tuple(data[5:7]) != AUTOPILOT:
        return False
    number = int.from_bytes(data[7:10], "little")
    if number == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
        return int.from_bytes(data[10:14], "little") != LOITER
    if number == mavlink.MAVLINK_MSG_ID_RC_CHANNELS:
        at = 14 + 2 * (channel - 1)
        return int.from_bytes(data[at : at + 2], "little") < 1500
    return False
