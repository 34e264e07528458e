"""The daemon in real time for a long time: does the stick beat hold, and does anything grow?

The simulated vehicle flies its mission and then holds at the goal: frames, depth, strategy and fifty stick messages
a second go on all the time.
"""

from __future__ import annotations

import asyncio
import os
import tempfile
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median
from typing import Any

from morpheyes_daemon.clock import S, running_clock
from morpheyes_daemon.daemon.service import real_time_runner
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.flights.lockstep import FlightPlan, Progress
from morpheyes_daemon.flights.realtime import RealtimeFlight, realtime_daemon
from morpheyes_daemon.flights.stick_timing import StickIntervals
from morpheyes_daemon.messages.safety import State

ENGAGE_LIMIT_S = 120.0
SAMPLE_S = 5.0
EDGE = 0.1
"""Share of the samples at either end that is compared with the other end."""
STEADY_FROM = 0.1
"""The first part of a soak is warm-up: caches of the rectifier, the allocator's arenas."""

Show = Callable[[Progress], None]


@dataclass(frozen=True, slots=True)
class StickBench:
    """The beat of the sticks over `minutes`; `frames` tells the load."""

    minutes: float
    beat: StickIntervals
    frames: int
    worst_lateness_ms: float
    final_state: str


@dataclass(frozen=True, slots=True)
class Sample:
    """What the process held at one moment; memory is resident, of the daemon and of its vision worker."""

    daemon_mb: float
    worker_mb: float
    tasks: int
    threads: int
    descriptors: int


@dataclass(frozen=True, slots=True)
class SoakBench:
    """First and last steady samples (medians) and what grew between them."""

    minutes: float
    first: Sample
    last: Sample
    memory_growth_pct: float
    leaked_tasks: int
    leaked_threads: int
    leaked_descriptors: int
    worker_restarts: int
    p99_s: float
    max_s: float

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def bench_sticks(plan: FlightPlan, minutes: float, show: Show) -> StickBench:
    """Measure the stick beat for `minutes` after engaging."""
    with real_time_runner() as runner, tempfile.TemporaryDirectory() as folder:
        return runner.run(_sticks(plan, minutes, show, Path(folder)))


def bench_soak(plan: FlightPlan, minutes: float, show: Show) -> SoakBench:
    """Watch memory, tasks, threads and descriptors for `minutes` after engaging."""
    with real_time_runner() as runner, tempfile.TemporaryDirectory() as folder:
        return runner.run(_soak(plan, minutes, show, Path(folder)))


async def _sticks(plan: FlightPlan, minutes: float, show: Show, folder: Path) -> StickBench:
    async with realtime_daemon(plan, folder / "flight.mcap", None, show) as flight:
        await _engaged(flight)
        await _live(flight, minutes * 60.0)
        health = flight.daemon.topics.health.get()
        return StickBench(
            minutes=minutes,
            beat=flight.beat.intervals(),
            frames=flight.tally.frames,
            worst_lateness_ms=health.worst_lateness_ms if health is not None else 0.0,
            final_state=str(flight.daemon.monitor.state),
        )


async def _soak(plan: FlightPlan, minutes: float, show: Show, folder: Path) -> SoakBench:
    samples: list[Sample] = []
    async with realtime_daemon(plan, folder / "flight.mcap", None, show) as flight:
        await _engaged(flight)
        rounds = max(20, round(minutes * 60.0 / SAMPLE_S))
        for _ in range(rounds):
            await _live(flight, minutes * 60.0 / rounds)
            samples.append(take_sample(flight.worker.pid))
        beat, restarts = flight.beat.intervals(), flight.worker.restarts
    return judge_soak(minutes, samples, restarts, beat.p99_s, beat.max_s)


def judge_soak(minutes: float, samples: list[Sample], restarts: int, p99_s: float, max_s: float) -> SoakBench:
    """Compare the two ends of the steady part."""
    steady = samples[round(STEADY_FROM * len(samples)) :]
    edge = max(1, round(EDGE * len(steady)))
    first, last = middle_of(steady[:edge]), middle_of(steady[-edge:])
    before_mb, after_mb = first.daemon_mb + first.worker_mb, last.daemon_mb + last.worker_mb
    return SoakBench(
        minutes=minutes,
        first=first,
        last=last,
        memory_growth_pct=100.0 * (after_mb - before_mb) / before_mb,
        leaked_tasks=last.tasks - first.tasks,
        leaked_threads=last.threads - first.threads,
        leaked_descriptors=last.descriptors - first.descriptors,
        worker_restarts=restarts,
        p99_s=p99_s,
        max_s=max_s,
    )


def middle_of(samples: list[Sample]) -> Sample:
    """Return the median of every field."""
    values = {field.name: median(getattr(sample, field.name) for sample in samples) for field in fields(Sample)}
    counts = {name: round(values[name]) for name in ("tasks", "threads", "descriptors")}
    return Sample(**{**values, **counts})


def take_sample(worker_pid: int | None) -> Sample:
    """Look at this process and at the worker."""
    return Sample(
        daemon_mb=resident_mb(os.getpid()),
        worker_mb=resident_mb(worker_pid) if worker_pid is not None else 0.0,
        tasks=len(asyncio.all_tasks()),
        threads=threading.active_count(),
        descriptors=len(os.listdir("/proc/self/fd")),
    )


def resident_mb(pid: int) -> float:
    """Return the memory that a process really holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


async def _engaged(flight: RealtimeFlight) -> None:
    clock = running_clock()
    end_ns = clock.now_ns() + round(ENGAGE_LIMIT_S * S)
    while flight.daemon.monitor.state is not State.ENGAGED:
        if clock.now_ns() > end_ns:
            raise DeviceTimeoutError(f"the daemon did not engage: {flight.daemon.monitor.reason.text}.")
        await _live(flight, 0.1)


async def _live(flight: RealtimeFlight, seconds: float) -> None:
    """Let it run; raises what ended the simulator or the daemon meanwhile."""
    done, _ = await asyncio.wait({flight.running}, timeout=seconds)
    for task in done:
        task.result()
    if flight.simulator.verdict.done():
        flight.simulator.verdict.result()
