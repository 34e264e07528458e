"""Branches of one flight share their pictures: what is read is, to the bit, what would have been rendered."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np

from morpheyes_daemon.clock import S, run_virtual, running_clock
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.render_cache import CachedVehicle
from morpheyes_daemon.flights.sim_vehicle import SimVehicle


def test_what_is_kept_is_what_would_be_rendered(tmp_path: Path) -> None:
    plan = make_plan("forest", size="160x120", calibration="exact")

    def kept() -> int:
        return len(list(tmp_path.iterdir()))

    async def live() -> None:
        clock = running_clock()
        shared = CachedVehicle(plan.scenario, plan.config, clock, tmp_path)
        plain = SimVehicle(plan.scenario, plan.config, clock)
        twins = [asyncio.create_task(stage.autopilot.run()) for stage in (shared, plain)]
        await clock.sleep_until_ns(clock.now_ns() + S)
        for twin in twins:
            twin.cancel()
        t_ns = clock.now_ns() - S // 2
        expected = plain.expose(3, t_ns)
        for _ in range(2):
            pair = shared.expose(3, t_ns)
            assert (pair.seq, pair.t_ns) == (3, t_ns)
            np.testing.assert_array_equal(pair.left, expected.left)
            np.testing.assert_array_equal(pair.right, expected.right)
        assert kept() == 1
        shared.expose(4, t_ns)
        shared.expose(3, t_ns + 1)
        shared.camera.sensor = replace(shared.camera.sensor, exposure=2.0)
        shared.expose(3, t_ns)
        assert kept() == 4, "another number, time or sensor is another picture"

    run_virtual(live())
