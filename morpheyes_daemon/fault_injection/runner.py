"""Flies the fault matrix: one simulated flight per state and seed, forked at the moment of the fault.

All faults of a state share the way into it; each then goes on in a process of its own (fork), so that a row costs
only the seconds after its fault. Rows are independent of each other and of the number of jobs.
"""

from __future__ import annotations

import asyncio
import json
import math
import tempfile
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.errors import CalibrationError, UsageError, mistake
from morpheyes_daemon.fault_injection.expectations import REACTION_S, RELEASE_S, Fault, FaultOutcome, complaints
from morpheyes_daemon.fault_injection.fork import ForkedFlight, branch
from morpheyes_daemon.fault_injection.harness import FaultFlight, Measured
from morpheyes_daemon.fault_injection.matrix import FAULTS
from morpheyes_daemon.flights.flight_plan import with_seed
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.messages.safety import State

STATES = (State.PREFLIGHT, State.STANDBY, State.ENGAGED, State.BRAKING, State.HOLD)


@dataclass(frozen=True, slots=True)
class Row:
    """One fault in one state at one seed: what was measured and what was wrong with it (empty: nothing)."""

    fault: str
    kind: str
    state: str
    seed: int
    ending: str
    allowed_s: float
    ended: str
    reason: str
    reaction_s: float | None
    release_s: float | None
    stop_m: float | None
    reserved_m: float | None
    clearance_m: float | None
    complaints: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """It ended as the table says."""
        return not self.complaints

    def as_json(self) -> dict[str, Any]:
        """Return plain values, `passed` among them."""
        return {**asdict(self), "passed": self.passed}


def choose(only: str | None) -> tuple[Fault, ...]:
    """Return the faults whose name is, or begins with, `only`; all for None. Raises UsageError."""
    chosen = tuple(fault for fault in FAULTS if only is None or fault.name.startswith(only))
    if not chosen:
        raise UsageError(f"there is no fault {only!r}; there are: {', '.join(fault.name for fault in FAULTS)}.")
    return chosen


def flights(faults: tuple[Fault, ...]) -> int:
    """Return how many flights one seed takes."""
    return sum(len(fault.endings) for fault in faults)


def run_matrix(
    plan: FlightPlan,
    faults: tuple[Fault, ...],
    seeds: tuple[int, ...],
    jobs: int,
    done: Callable[[Row], None],
    known: Iterable[Row] = (),
) -> list[Row]:
    """Fly every fault in every state that it can happen in, at every seed; `done` hears of each row.

    What is `known` from before is not flown again.
    """
    cv2.setNumThreads(1)  # a pool of threads would not survive the fork
    watched = plan.config.autopilot.model_copy(update={"watch_gcs": True})
    plan = replace(plan, config=plan.config.model_copy(update={"autopilot": watched}))
    names = {fault.name for fault in faults}
    rows = {(row.fault, row.state, row.seed): row for row in known if row.fault in names and row.seed in seeds}

    def note(row: Row) -> None:
        rows[row.fault, row.state, row.seed] = row
        done(row)

    for seed in seeds:
        for state in STATES:
            waiting = [fault for fault in faults if state in fault.endings and (fault.name, state, seed) not in rows]
            _fly_seed(with_seed(plan, seed), state, waiting, jobs, note)
    order = {fault.name: number for number, fault in enumerate(FAULTS)}
    return sorted(rows.values(), key=lambda row: (order[row.fault], STATES.index(State(row.state)), row.seed))


def load_rows(path: Path) -> list[Row]:
    """Return the rows that a run before has left in a file, one JSON object a line; none when there is no file."""
    if not path.exists():
        return []
    return [_row_of(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines() if line]


def store_row(path: Path, row: Row) -> None:
    """Append a row to the file."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(row)) + "\n")


def _row_of(values: dict[str, Any]) -> Row:
    return Row(**{**values, "complaints": tuple(values["complaints"])})


def _fly_seed(plan: FlightPlan, state: State, faults: list[Fault], jobs: int, done: Callable[[Row], None]) -> None:
    for rig_seed, without_gps in dict.fromkeys((fault.rig_seed, fault.without_gps) for fault in faults):
        alike = [fault for fault in faults if (fault.rig_seed, fault.without_gps) == (rig_seed, without_gps)]
        scenario = replace(plan.scenario, rig_seed=rig_seed or 0, without_gps=without_gps)
        calibration = plan.calibration if rig_seed is not None else plan.calibration.with_name("missing.yaml")
        try:
            run_virtual(_fly_state(replace(plan, scenario=scenario, calibration=calibration), state, alike, jobs, done))
        except CalibrationError as error:
            for fault in alike:
                refused = fault.endings[state] is FaultOutcome.REFUSES
                done(make_row(fault, state, scenario.seed, None, () if refused else (str(error),)))


async def _fly_state(
    plan: FlightPlan, state: State, faults: list[Fault], jobs: int, done: Callable[[Row], None]
) -> None:
    running: deque[tuple[Fault, ForkedFlight]] = deque()

    def collect() -> None:
        fault, child = running.popleft()
        told = child.result()
        died = make_row(fault, state, plan.scenario.seed, None, ("the simulation died",))
        done(_row_of(told) if told is not None else died)

    with tempfile.TemporaryDirectory() as folder:
        async with FaultFlight(plan, Path(folder)) as flight:
            await flight.reach(state)
            for fault in faults:
                if len(running) == jobs:
                    collect()
                running.append((fault, await branch(partial(_report, flight, state, fault))))
            while running:
                collect()


async def _report(flight: FaultFlight, state: State, fault: Fault) -> dict[str, Any]:
    """Try one fault in a process of its own; whatever happens there is a row."""
    try:
        row = await _try(flight, state, fault)
    except Exception as error:  # noqa: BLE001 -- the whole life of a process
        row = make_row(fault, state, flight.plan.scenario.seed, None, (mistake(error),))
    return asdict(row)


async def _try(flight: FaultFlight, state: State, fault: Fault) -> Row:
    loop = asyncio.get_running_loop()
    watching = asyncio.create_task(flight.measure(fault.watched_s(state)))
    await asyncio.sleep(0)
    fault.begin(flight)
    if fault.lasts_s is not None:
        loop.call_later(fault.lasts_s, fault.end, flight)
    seen = await watching
    return make_row(fault, state, flight.plan.scenario.seed, seen, tuple(complaints(fault, state, seen)))


def make_row(fault: Fault, state: State, seed: int, seen: Measured | None, wrong: tuple[str, ...]) -> Row:
    """Return the row of one fault; `seen` is None when no flight came of it."""
    in_flight = seen is not None and state is State.ENGAGED
    return Row(
        fault=fault.name,
        kind=fault.kind,
        state=state,
        seed=seed,
        ending=fault.endings[state],
        allowed_s=round(
            fault.notice_s + (RELEASE_S if fault.endings[state] is FaultOutcome.RELEASES else REACTION_S), 3
        ),
        ended=seen.state if seen else "",
        reason=seen.reason if seen else "",
        reaction_s=_rounded(_reaction_s(fault, state, seen) if seen and in_flight else None),
        release_s=_rounded(seen.release_s if seen else None),
        stop_m=_rounded(seen.stop_m if seen and in_flight else None),
        reserved_m=_rounded(seen.reserved_m if seen and in_flight else None),
        clearance_m=_rounded(seen.clearance_m if seen else None),
        complaints=wrong,
    )


def _reaction_s(fault: Fault, state: State, seen: Measured) -> float | None:
    """When it was neutral for good; where it flies on, when it was neutral first."""
    return seen.reaction_s if fault.endings[state] is FaultOutcome.RESUMES else seen.quiet_s


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 3)
