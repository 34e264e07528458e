"""A sample of the fault matrix is flown in every run, and its rows end as docs/faults.md says."""

from __future__ import annotations

import os
import random
from dataclasses import replace

from morpheyes_daemon.fault_injection.matrix import FAULTS
from morpheyes_daemon.fault_injection.runner import Row, run_matrix
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.messages.safety import State

ROWS = 3
SAMPLE = int(os.environ.get("FAULT_SAMPLE", "1"))
"""Which sample: another number flies other rows."""


def test_a_sample_of_faults_in_flight_ends_as_the_matrix_says() -> None:
    in_flight = [
        replace(fault, endings={State.ENGAGED: fault.endings[State.ENGAGED]})
        for fault in FAULTS
        if State.ENGAGED in fault.endings and not fault.without_gps and fault.rig_seed == 0
    ]
    chosen = tuple(random.Random(SAMPLE).sample(in_flight, ROWS))
    plan = make_plan("forest", size="160x120", calibration="exact")
    flown: list[Row] = []
    rows = run_matrix(plan, chosen, (SAMPLE,), 1, flown.append)
    assert {(row.fault, row.state) for row in rows} == {(fault.name, "engaged") for fault in chosen}
    assert {row.fault: row.complaints for row in rows} == {fault.name: () for fault in chosen}
    assert len(flown) == ROWS
    for row in rows:
        # it was flown, not read: a vehicle in a forest has something near
        assert row.clearance_m is not None
        assert 0.0 < row.clearance_m < 20.0
