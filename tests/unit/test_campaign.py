"""Campaigns: what was flown is never flown again, what was killed goes on, and no folder is mixed up with another."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from morpheyes_daemon.cli.experiment import table
from morpheyes_daemon.errors import InputError, UsageError
from morpheyes_daemon.experiments import campaign as campaigns
from morpheyes_daemon.experiments.campaign import FLIGHTS, Campaign, Row, cells, parse_seeds, run_campaign, wilson
from morpheyes_daemon.experiments.plan import make_plan


class Killed(BaseException):
    """Stands for a signal."""


@pytest.fixture
def campaign() -> Campaign:
    return Campaign(make_plan("forest", size="160x120", calibration="exact"), ("variable", "0.2"), (0, 1, 2))


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """What was flown, in order, instead of flying it."""
    flights: list[tuple[str, int]] = []

    def fly_one(plan: Any, key: str, folder: Path | None = None) -> Row:
        fixed_m = plan.config.baseline_range_m[0]
        mode = "variable" if fixed_m != plan.config.baseline_range_m[1] else f"{fixed_m:g}"
        flights.append((mode, plan.scenario.seed))
        if len(flights) == 4:
            raise Killed
        return {"baseline_mode": mode, "seed": plan.scenario.seed, "campaign": key}

    monkeypatch.setattr(campaigns, "fly_one", fly_one)
    return flights


def fly(campaign: Campaign, folder: Path) -> list[Row]:
    return run_campaign(campaign, folder, 1, None, lambda row, have, total: None)


def test_a_killed_campaign_goes_on_where_it_was(
    campaign: Campaign, flown: list[tuple[str, int]], tmp_path: Path
) -> None:
    with pytest.raises(Killed):
        fly(campaign, tmp_path)
    assert flown == [("variable", 0), ("variable", 1), ("variable", 2), ("0.2", 0)]
    rows = fly(campaign, tmp_path)
    assert flown[4:] == [("0.2", 0), ("0.2", 1), ("0.2", 2)], "only the flight in the air was lost"
    assert [(row["baseline_mode"], row["seed"]) for row in rows] == flown[:3] + flown[4:]
    assert fly(campaign, tmp_path) == rows
    assert len(flown) == 7, "nothing is left to fly"


def test_a_line_cut_off_is_flown_again_and_no_other(
    campaign: Campaign, flown: list[tuple[str, int]], tmp_path: Path
) -> None:
    with pytest.raises(Killed):
        fly(campaign, tmp_path)
    file = tmp_path / FLIGHTS
    file.write_text(file.read_text()[:-5])
    fly(campaign, tmp_path)
    assert sorted(flown[4:]) == [("0.2", 0), ("0.2", 1), ("0.2", 2), ("variable", 2)]
    assert len([json.loads(line) for line in file.read_text().splitlines()]) == 6


def test_another_campaign_s_folder_is_left_alone(
    campaign: Campaign, flown: list[tuple[str, int]], tmp_path: Path
) -> None:
    one = replace(campaign, seeds=(0,))
    fly(one, tmp_path)
    before = (tmp_path / FLIGHTS).read_bytes()
    other = replace(one, plan=replace(one.plan, limit_s=one.plan.limit_s + 1.0))
    with pytest.raises(InputError, match="another campaign"):
        fly(other, tmp_path)
    with campaigns._lock(tmp_path), pytest.raises(InputError, match="is running there"):
        fly(one, tmp_path)
    assert (tmp_path / FLIGHTS).read_bytes() == before


def test_a_file_that_holds_no_flights_is_named_with_its_line(campaign: Campaign, tmp_path: Path) -> None:
    (tmp_path / FLIGHTS).write_text("not a flight\n{}\n")
    with pytest.raises(InputError, match=r"flights\.jsonl:1"):
        fly(campaign, tmp_path)


def test_seeds_are_a_number_or_a_range_with_both_ends() -> None:
    assert parse_seeds("7") == (7,)
    assert parse_seeds("3-5") == (3, 4, 5)
    for wrong in ("", "5-3", "a", "-1", "1-", "1,2"):
        with pytest.raises(UsageError, match="--seeds"):
            parse_seeds(wrong)


def test_intervals_of_a_success_rate() -> None:
    """Wilson's, as tabulated for 95 %: 10 of 10 and 0 of 10."""
    assert wilson(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-3)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


def test_a_cell_says_why_flights_failed() -> None:
    usual = {"mean_speed_m_s": 2.0, "peak_speed_m_s": 3.0, "time_s": 40.0, "min_clearance_m": 0.5, "braking_events": 0}
    rows = [
        {**usual, "baseline_mode": "variable", "seed": 0, "outcome": "reached", "reason": ""},
        {**usual, "baseline_mode": "variable", "seed": 1, "outcome": "collided", "reason": "bar"},
        {**usual, "baseline_mode": "variable", "seed": 2, "outcome": "aborted", "reason": "depth_stale"},
    ]
    (cell,) = cells(rows)
    assert (cell["flights"], cell["reached"], cell["collided"]) == (3, 1, 1)
    assert cell["causes"] == {"collided in seed 1: bar": 1, "aborted: depth_stale": 1}


def test_baselines_are_compared_by_the_flights_of_the_same_seed() -> None:
    rows = [
        {
            "baseline_mode": mode,
            "seed": seed,
            "outcome": outcome,
            "reason": "goal_reached" if outcome == "reached" else "blind",
            "mean_speed_m_s": speed,
            "peak_speed_m_s": 4.0,
            "time_s": 25.0,
            "min_clearance_m": 0.3,
            "braking_events": 0,
        }
        for mode, seed, outcome, speed in [
            ("variable", 0, "reached", 3.0), ("variable", 1, "reached", 2.0), ("variable", 2, "timeout", 1.0),
            ("0.1", 0, "reached", 1.5), ("0.1", 1, "reached", 1.0), ("0.1", 2, "reached", 3.0),
            ("0.3", 0, "timeout", 0.1),
        ]
    ]  # fmt: skip
    lines = table(cells(rows)).splitlines()
    assert lines[0].endswith("| variable faster (95 %) |")
    assert [line.split("|")[-2].strip() for line in lines[2:5]] == ["–", "2.00× (2.00 to 2.00)", "–"]
    assert "variable faster" not in table(cells(rows[:3]))
