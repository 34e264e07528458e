"""What counts as an interval between stick messages, and what does not."""

import pytest

from morpheyes_daemon.benchmarks.soak import Sample, judge_soak
from morpheyes_daemon.bus import Latest
from morpheyes_daemon.clock import MS
from morpheyes_daemon.flights.stick_timing import StickTiming
from morpheyes_daemon.messages.safety import Action, GateOutput, State


def beat_of(*outputs: tuple[int, Action]) -> StickTiming:
    gate: Latest[GateOutput] = Latest("gate")
    beat = StickTiming(gate, lambda: 0.0)
    for t_ms, action in outputs:
        gate.publish(GateOutput(t_ms * MS, State.ENGAGED, action, None))
    return beat


def test_only_what_moves_or_holds_a_stick_counts() -> None:
    silent = [(0, Action.SILENT), (900, Action.SILENT)]
    held = [(1000, Action.STICKS), (1020, Action.NEUTRAL), (1110, Action.STICKS)]
    again = [(1130, Action.RELEASE), (5000, Action.STICKS), (5020, Action.STICKS)]
    found = beat_of(*silent, *held, *again).intervals()
    assert found.count == 3
    assert found.max_s == pytest.approx(0.090)
    assert found.p50_s == pytest.approx(0.020)


def test_what_the_machines_host_took_is_told_apart() -> None:
    gate: Latest[GateOutput] = Latest("gate")
    stolen = iter([0.0, 0.0, 0.3, 0.3, 0.31])
    beat = StickTiming(gate, lambda: next(stolen))
    for t_ms in (0, 20, 350, 372, 392):
        gate.publish(GateOutput(t_ms * MS, State.ENGAGED, Action.STICKS, None))
    found = beat.intervals()
    assert (found.count, found.max_s) == (4, pytest.approx(0.330))
    assert (found.own_count, found.own_max_s) == (2, pytest.approx(0.022))
    assert found.stolen_s == pytest.approx(0.31)


def test_nothing_held_is_no_interval() -> None:
    assert beat_of((0, Action.SILENT), (20, Action.RELEASE)).intervals().count == 0


def test_a_soak_compares_its_steady_ends() -> None:
    warming = [Sample(50.0, 50.0, 1, 1, 1)] * 10
    steady = [Sample(100.0 + 0.1 * k, 100.0, 12, 4, 30 + (k > 45)) for k in range(90)]
    found = judge_soak(8.0, warming + steady, 1, 0.021, 0.05)
    assert found.memory_growth_pct == pytest.approx(100.0 * 8.1 / 200.4, rel=0.01)
    assert (found.leaked_tasks, found.leaked_threads, found.leaked_descriptors) == (0, 0, 1)
    assert found.worker_restarts == 1
