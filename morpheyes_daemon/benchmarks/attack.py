"""The stick interval while the page is attacked and the observer is stopped or killed, beside quiet time in turn.

An empty 50 Hz timer in a process of its own tells what the machine itself holds up.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import socket
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from morpheyes_daemon.benchmarks.attackers import ATTACKS, LOOPBACK
from morpheyes_daemon.clock import MonotonicClock, S, Ticker, running_clock
from morpheyes_daemon.config.vehicle import DashboardConfig
from morpheyes_daemon.daemon.service import real_time_runner
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.flights.lockstep import FlightPlan, Progress
from morpheyes_daemon.flights.realtime import RealtimeFlight, realtime_daemon
from morpheyes_daemon.messages.safety import Action, GateOutput, State

TIMER_HZ = 50.0
ENGAGE_LIMIT_S = 120.0
Show = Callable[[Progress], None]


@dataclass(frozen=True, slots=True)
class Interval:
    """Seconds between stick messages, or between the beats of the empty timer, in one stretch of time."""

    p99_s: float
    max_s: float


@dataclass(frozen=True, slots=True)
class AttackRow:
    """One attack: medians over the pairs of quiet and attacked time; the largest intervals are those of any pair.

    `timer_max_s` is the empty timer's largest interval while attacked.
    """

    attack: str
    pairs: int
    quiet_p99_s: float
    attacked_p99_s: float
    quiet_max_s: float
    attacked_max_s: float
    timer_max_s: float
    state: str

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def bench_attack(plan: FlightPlan, seconds: float, pairs: int, show: Show) -> list[AttackRow]:
    """Fly in real time with the page on and return a row for each attack."""
    with real_time_runner() as runner, tempfile.TemporaryDirectory() as folder:
        return runner.run(_bench(plan, seconds, pairs, show, Path(folder)))


class _Sticks:
    """Collects when sticks or neutral went out."""

    def __init__(self) -> None:
        self.times_ns: list[int] = []

    def take(self, out: GateOutput) -> None:
        """Take one output of the gate."""
        if out.action in (Action.STICKS, Action.NEUTRAL):
            self.times_ns.append(out.t_ns)

    def interval(self, from_ns: int) -> Interval:
        """Return what happened since."""
        return interval([t_ns for t_ns in self.times_ns if t_ns >= from_ns])


def interval(times_ns: list[int]) -> Interval:
    """Return p99 and maximum of the differences; zeros for fewer than two times."""
    steps = np.diff(np.array(times_ns, dtype=np.int64)) / S
    return Interval(float(np.percentile(steps, 99)), float(steps.max())) if steps.size else Interval(0.0, 0.0)


async def _bench(plan: FlightPlan, seconds: float, pairs: int, show: Show, folder: Path) -> list[AttackRow]:
    page = DashboardConfig(enabled=True, host=LOOPBACK, port=_free_port())
    async with realtime_daemon(plan, folder / "flight.mcap", None, show, page) as flight:
        sticks = _Sticks()
        flight.daemon.topics.gate.tap(sticks.take)
        await _engaged(flight)
        rows = []
        for name in (*ATTACKS, "observer stopped", "observer killed"):
            rows.append(await _attack(flight, sticks, name, page.port, (seconds, pairs)))
        return rows


async def _attack(
    flight: RealtimeFlight, sticks: _Sticks, name: str, port: int, how_long: tuple[float, int]
) -> AttackRow:
    seconds, pairs = how_long
    quiet, attacked, timers = [], [], []
    for _ in range(pairs):
        quiet.append((await _stretch(flight, sticks, None, port, seconds))[0])
        sticks_seen, timer = await _stretch(flight, sticks, name, port, seconds)
        attacked.append(sticks_seen)
        timers.append(timer)
    return AttackRow(
        attack=name,
        pairs=pairs,
        quiet_p99_s=median(found.p99_s for found in quiet),
        attacked_p99_s=median(found.p99_s for found in attacked),
        quiet_max_s=max(found.max_s for found in quiet),
        attacked_max_s=max(found.max_s for found in attacked),
        timer_max_s=max(found.max_s for found in timers),
        state=str(flight.daemon.monitor.state),
    )


async def _stretch(
    flight: RealtimeFlight, sticks: _Sticks, attack: str | None, port: int, seconds: float
) -> tuple[Interval, Interval]:
    """Let `seconds` pass, attacked or not; returns the intervals of the sticks and of the empty timer."""
    context = multiprocessing.get_context("spawn")
    found: Queue[list[int]] = context.Queue()
    timer = context.Process(target=_empty_timer, args=(found, seconds), daemon=True)
    attackers: list[BaseProcess] = [timer]
    if attack in ATTACKS:
        attackers.append(context.Process(target=ATTACKS[attack], args=(port, seconds), daemon=True))
    for process in attackers:
        await asyncio.to_thread(process.start)
    from_ns = running_clock().now_ns()
    observer = flight.observer.pid
    if attack == "observer stopped" and observer is not None:
        os.kill(observer, signal.SIGSTOP)
    if attack == "observer killed" and observer is not None:
        os.kill(observer, signal.SIGKILL)
    await asyncio.sleep(seconds)
    seen = sticks.interval(from_ns)
    if attack == "observer stopped" and observer is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(observer, signal.SIGCONT)
    beats = await asyncio.to_thread(found.get)
    for process in attackers:
        await asyncio.to_thread(process.join, 10.0)
        if process.is_alive():
            process.kill()
    return seen, interval(beats)


def _empty_timer(found: Queue[list[int]], seconds: float) -> None:
    async def beat() -> list[int]:
        clock = MonotonicClock()
        ticker = Ticker(clock, TIMER_HZ)
        beats = []
        for _ in range(round(seconds * TIMER_HZ)):
            await ticker.wait()
            beats.append(clock.now_ns())
        return beats

    found.put(asyncio.run(beat()))


async def _engaged(flight: RealtimeFlight) -> None:
    clock = running_clock()
    end_ns = clock.now_ns() + round(ENGAGE_LIMIT_S * S)
    while flight.daemon.monitor.state is not State.ENGAGED:
        if clock.now_ns() > end_ns:
            raise DeviceTimeoutError(f"the daemon did not engage: {flight.daemon.monitor.reason.text}.")
        await asyncio.sleep(0.1)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
