"""Campaigns on a Dask scheduler: a worker in a process of its own flies, and need not have our files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from morpheyes_daemon.campaigns.forest_table import Row
from morpheyes_daemon.campaigns.runner import FLIGHTS, Campaign, run_campaign
from morpheyes_daemon.errors import MorphEyesError
from morpheyes_daemon.flights.flight_plan import make_plan

dask = pytest.importorskip("dask", reason="a scheduler needs the extra `campaign`")
distributed = pytest.importorskip("distributed", reason="a scheduler needs the extra `campaign`")

FLOWN = {
    "baseline_mode": "variable", "outcome": "reached", "reason": "goal_reached", "mean_speed_m_s": 2.0,
    "peak_speed_m_s": 3.0, "time_s": 40.0, "min_clearance_m": 0.5, "braking_events": 0,
}  # fmt: skip


@pytest.fixture
def cluster() -> Iterator[Any]:
    """One worker process with one slot; a flight that it dies of is not tried on another one."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
        ) as cluster,
    ):
        yield cluster


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    """A campaign with calibration and world in files of its own."""
    world, rig = tmp_path / "my.yaml", tmp_path / "rig.yaml"
    world.write_text("world: {kind: forest, trees_per_ha: 250}\n")
    plan = make_plan("forest", size="160x120", calibration="exact", world=str(world))
    rig.write_bytes(plan.calibration.read_bytes())
    return Campaign(replace(plan, calibration=rig), ("variable",), (0, 1, 2))


def run(campaign: Campaign, folder: Path, cluster: Any, fly_one: Callable[..., Row]) -> list[Row]:
    """Run a campaign whose flights are `fly_one` in the worker, where it is sent by its value."""

    def in_the_worker() -> None:
        from morpheyes_daemon.campaigns import runner as campaign

        campaign.fly_one = fly_one

    with distributed.Client(cluster) as client:
        client.run(in_the_worker)
    return run_campaign(campaign, folder, 1, cluster.scheduler_address, lambda row, have, total: None).flights


def test_the_only_worker_flies_with_our_calibration_and_world_in_files_of_its_own(
    campaign: Campaign, cluster: Any, tmp_path: Path
) -> None:
    flown = FLOWN

    def fly_one(plan: Any, key: str, folder: Any = None) -> Row:
        import os

        from morpheyes_daemon.simulation.worlds.loader import load_world

        world: Any = load_world(plan.scenario.world).world
        return {
            **flown, "seed": plan.scenario.seed, "campaign": key, "process": os.getpid(), "folder": folder,
            "world": plan.scenario.world, "files": [str(plan.calibration), plan.scenario.world],
            "rig": plan.calibration.read_text(), "trees": world.trees_per_ha,
        }  # fmt: skip

    rows = run(campaign, tmp_path / "out", cluster, fly_one)
    assert [row["seed"] for row in rows] == [0, 1, 2]
    for row in rows:
        assert row["process"] != os.getpid()
        assert (row["rig"], row["trees"]) == (campaign.plan.calibration.read_text(), 250.0)
        assert not any(Path(path).exists() for path in row["files"]), "they were the flight's own"
        assert (row["world"], row["folder"]) == (campaign.plan.scenario.world, None)


def test_a_flight_that_raises_and_one_that_ends_its_worker_are_named_and_nothing_is_flown_twice(
    campaign: Campaign, cluster: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    flown, kept = FLOWN, tmp_path / "out" / FLIGHTS

    def fly_one(plan: Any, key: str, folder: Any = None) -> Row:
        import os
        import time

        if plan.scenario.seed == 0:
            raise ValueError("no such tree")
        if plan.scenario.seed == 2:
            while not kept.read_text().endswith("\n"):
                time.sleep(0.05)
            time.sleep(0.5)  # until the scheduler has heard that the others are not needed any more
            os._exit(1)
        return {**flown, "seed": plan.scenario.seed, "campaign": key}

    with pytest.raises(MorphEyesError) as raised:
        run(campaign, kept.parent, cluster, fly_one)
    said = str(raised.value)
    assert said.startswith("2 of 3 flights could not be flown: variable, seed 0: ValueError: no such tree (")
    assert "; variable, seed 2: KilledWorker: " in said
    assert kept.read_text().count("\n") == 1
    assert "lose already computed" not in caplog.text
