"""The matcher hangs or dies in flight: neutral in time, a new one, and only the pilot flies on."""

from __future__ import annotations

from pathlib import Path

import pytest

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.fault_injection import faults as actions
from morpheyes_daemon.fault_injection.harness import FaultFlight, Sent
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.messages.safety import State


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lose", "neutral_within_s"),
    # hung: the depth lease of 0.7 s; killed: told at the next frame, 0.3 s; idle: told at once
    [(actions.hang_worker, 0.72), (actions.kill_worker, 0.32), (actions.kill_idle_worker, 0.02)],
)
def test_only_the_pilots_flip_flies_on(lose: actions.Act, neutral_within_s: float, tmp_path: Path) -> None:
    plan = make_plan("forest", size="160x120", calibration="exact")

    async def live() -> None:
        async with FaultFlight(plan, tmp_path) as flight:
            await flight.reach(State.ENGAGED)
            lose(flight)
            lost_ns = flight.clock.now_ns()
            await flight.sleep(1.2)
            actions.mend_worker(flight)  # the new one
            await flight.sleep(4.0)
            assert flight.state is State.HOLD
            sticks = [t_ns for t_ns, kind in flight.sent if kind is Sent.STICKS]
            assert sticks[-1] - lost_ns <= neutral_within_s * 1e9
            assert flight.daemon.topics.perception.get() is not None
            flight.crew.disengage()
            await flight.sleep(1.0)
            flight.crew.engage()
            await flight.sleep(1.0)
            assert flight.state is State.ENGAGED
            assert flight.sent[-1][1] is Sent.STICKS

    run_virtual(live())
