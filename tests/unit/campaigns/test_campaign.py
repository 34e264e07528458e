"""Campaigns: what was flown is never flown again, what was killed goes on, and no folder is mixed up with another."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from morpheyes_daemon.campaigns import runner as campaigns
from morpheyes_daemon.campaigns.forest_table import Row
from morpheyes_daemon.campaigns.results import RESULTS, SETTINGS, TABLE, Results
from morpheyes_daemon.campaigns.results_page import write_page
from morpheyes_daemon.campaigns.runner import (
    FLIGHTS,
    Campaign,
    parse_baselines,
    parse_seeds,
    require_jobs,
    run_campaign,
)
from morpheyes_daemon.cli import main
from morpheyes_daemon.errors import InputError, MorphEyesError, UsageError
from morpheyes_daemon.flights import flight_plan as plans
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.lockstep import FlightPlan

WRITTEN = (SETTINGS, RESULTS, TABLE)


class Killed(BaseException):
    """Stands for a signal."""


class Sky:
    """Stands for flying: keeps what was flown, in order; raises what is in `raising` by baseline and seed."""

    def __init__(self) -> None:
        self.flights: list[tuple[str, int]] = []
        self.raising: dict[tuple[str, int], BaseException] = {}

    def fly_one(self, plan: FlightPlan, key: str, folder: Path | None = None) -> Row:
        fixed_m = plan.config.baseline_range_m[0]
        mode = "variable" if fixed_m != plan.config.baseline_range_m[1] else f"{fixed_m:g}"
        self.flights.append((mode, plan.scenario.seed))
        if error := self.raising.get(self.flights[-1]):
            raise error
        return {
            "baseline_mode": mode, "seed": plan.scenario.seed, "campaign": key, "outcome": "reached", "reason": "",
            "mean_speed_m_s": 2.0, "peak_speed_m_s": 3.0, "time_s": 40.0, "min_clearance_m": 0.5, "braking_events": 0,
        }  # fmt: skip


@pytest.fixture
def campaign() -> Campaign:
    return Campaign(make_plan("forest", size="160x120", calibration="exact"), ("variable", "0.2"), (0, 1, 2))


@pytest.fixture
def sky(monkeypatch: pytest.MonkeyPatch) -> Sky:
    sky = Sky()
    monkeypatch.setattr(campaigns, "fly_one", sky.fly_one)
    return sky


def fly(campaign: Campaign, folder: Path, scheduler: str | None = None) -> Results:
    return run_campaign(campaign, folder, 1, scheduler, lambda row, have, total: None)


def flights_of(results: Results) -> list[tuple[str, int]]:
    return [(row["baseline_mode"], row["seed"]) for row in results.flights]


def contents(folder: Path, names: Sequence[str] = WRITTEN) -> list[bytes | None]:
    return [(folder / name).read_bytes() if (folder / name).exists() else None for name in names]


def test_a_killed_campaign_goes_on_where_it_was(campaign: Campaign, sky: Sky, tmp_path: Path) -> None:
    sky.raising["0.2", 0] = Killed()
    with pytest.raises(Killed):
        fly(campaign, tmp_path)
    assert sky.flights == [("variable", 0), ("variable", 1), ("variable", 2), ("0.2", 0)]
    sky.raising.clear()
    results = fly(campaign, tmp_path)
    assert sky.flights[4:] == [("0.2", 0), ("0.2", 1), ("0.2", 2)], "only the flight in the air was lost"
    assert flights_of(results) == sky.flights[:3] + sky.flights[4:]
    assert fly(campaign, tmp_path) == results
    assert len(sky.flights) == 7, "nothing is left to fly"


def test_a_line_cut_off_is_flown_again_and_no_other(campaign: Campaign, sky: Sky, tmp_path: Path) -> None:
    sky.raising["0.2", 0] = Killed()
    with pytest.raises(Killed):
        fly(campaign, tmp_path)
    sky.raising.clear()
    file = tmp_path / FLIGHTS
    file.write_text(file.read_text()[:-5])
    fly(campaign, tmp_path)
    assert sorted(sky.flights[4:]) == [("0.2", 0), ("0.2", 1), ("0.2", 2), ("variable", 2)]
    assert len([json.loads(line) for line in file.read_text().splitlines()]) == 6


def test_settings_results_and_table_stay_those_of_the_last_campaign_that_was_finished(
    campaign: Campaign, sky: Sky, tmp_path: Path
) -> None:
    folder, page = tmp_path / "out", tmp_path / "results.md"
    fly(replace(campaign, baselines=("variable",), seeds=(0, 1)), folder)
    before = contents(folder)
    sky.raising["0.2", 0] = Killed()
    with pytest.raises(Killed):
        fly(campaign, folder)
    assert contents(folder) == before
    write_page([folder], page)
    assert "--seeds 0-1 " in page.read_text()
    sky.raising.clear()
    fly(campaign, folder)
    write_page([folder], page)
    assert "--seeds 0-2 --size 160x120 --baselines variable,0.2 " in page.read_text()
    assert len(json.loads((folder / RESULTS).read_text())["flights"]) == 6


def test_a_campaign_that_was_never_finished_has_no_results_to_make_a_page_of(
    campaign: Campaign, sky: Sky, tmp_path: Path
) -> None:
    sky.raising["variable", 1] = Killed()
    with pytest.raises(Killed):
        fly(campaign, tmp_path)
    assert contents(tmp_path) == [None] * 3
    with pytest.raises(InputError, match=r"has no campaign\.json; is it the --out of a finished"):
        write_page([tmp_path], tmp_path / "results.md")


def test_results_are_replaced_all_or_none_and_while_nobody_else_may_fly_there(
    campaign: Campaign, sky: Sky, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = replace(campaign, seeds=(0,))
    fly(one, tmp_path)
    before = contents(tmp_path)
    (tmp_path / f"{TABLE}.part").mkdir()
    with pytest.raises(IsADirectoryError):
        fly(campaign, tmp_path)
    assert contents(tmp_path) == before
    (tmp_path / f"{TABLE}.part").rmdir()

    def draw_figures(plan: FlightPlan, rows: list[Row], folder: Path) -> None:
        assert all(text != old for text, old in zip(contents(folder), before, strict=True))
        with pytest.raises(InputError, match="is running there"), campaigns._lock(folder):
            pass

    monkeypatch.setattr(campaigns, "draw_figures", draw_figures)
    fly(campaign, tmp_path)
    assert not list(tmp_path.glob("*.part"))


def test_a_scheduler_that_does_not_answer_leaves_the_results_alone(campaign: Campaign, sky: Sky, tmp_path: Path) -> None:
    fly(replace(campaign, seeds=(0,)), tmp_path)
    before = contents(tmp_path)
    with pytest.raises(UsageError, match="--scheduler"):
        fly(campaign, tmp_path, scheduler="carrier-pigeon://7")
    assert contents(tmp_path) == before


def test_another_campaign_s_folder_is_left_alone(campaign: Campaign, sky: Sky, tmp_path: Path) -> None:
    one = replace(campaign, seeds=(0,))
    fly(one, tmp_path)
    before = (tmp_path / FLIGHTS).read_bytes()
    other = replace(one, plan=replace(one.plan, limit_s=one.plan.limit_s + 1.0))
    with pytest.raises(InputError, match="another campaign"):
        fly(other, tmp_path)
    with campaigns._lock(tmp_path), pytest.raises(InputError, match="is running there"):
        fly(one, tmp_path)
    assert (tmp_path / FLIGHTS).read_bytes() == before


def test_a_world_that_was_edited_makes_another_campaign_and_its_description_does_not(sky: Sky, tmp_path: Path) -> None:
    world = tmp_path / "my.yaml"
    world.write_text("world: {kind: forest, trees_per_ha: 100}\n")
    plan = make_plan("forest", size="160x120", calibration="exact", world=str(world))
    campaign = Campaign(plan, ("variable",), (0,))
    fly(campaign, tmp_path / "out")
    world.write_text("description: mine\nworld: {kind: forest, trees_per_ha: 100}\n")
    fly(campaign, tmp_path / "out")
    for edited in ("world: {kind: forest, trees_per_ha: 200}\n", world.read_text() + "light: {sun: 0.5}\n"):
        world.write_text(edited)
        with pytest.raises(InputError, match="another campaign"):
            fly(campaign, tmp_path / "out")


def test_a_flight_that_cannot_be_flown_is_named_when_all_others_have_been(
    campaign: Campaign, sky: Sky, tmp_path: Path
) -> None:
    sky.raising = {
        ("variable", 0): ValueError("no such tree"),
        ("variable", 2): ValueError("no such tree"),
        ("0.2", 1): InputError("the picture is black."),
    }
    with pytest.raises(MorphEyesError) as raised:
        fly(campaign, tmp_path)
    said = str(raised.value)
    assert said.startswith("3 of 6 flights could not be flown: variable, seeds 0, 2: ValueError: no such tree (test_c")
    assert "; 0.2, seed 1: InputError: the picture is black. (test_campaign.py:" in said
    assert said.endswith("; they are tried again when the campaign is started again.")
    assert (len(sky.flights), contents(tmp_path)) == (6, [None] * 3)
    sky.raising.clear()
    results = fly(campaign, tmp_path)
    assert sorted(sky.flights[6:]) == [("0.2", 1), ("variable", 0), ("variable", 2)]
    assert flights_of(results) == [(mode, seed) for mode in ("variable", "0.2") for seed in range(3)]


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


def test_baselines_are_told_as_rows_name_them_and_none_twice() -> None:
    assert parse_baselines("variable, 0.10,0.2") == ("variable", "0.1", "0.2")
    for wrong, why in (
        ("variable,variable", "variable is there twice"), ("0.1,0.2,0.10", "0.1 is there twice"),
        ("variable,", "an item is empty"), ("", "an item is empty"), ("wide", "give 'variable' or a length"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=why):
            parse_baselines(wrong)


@pytest.mark.parametrize("option", ["--jobs=0", "--jobs=-2", "--baselines=0.1,0.10", "--seeds=3-1"])
def test_a_wrong_option_is_one_sentence_before_anything_is_made(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(plans, "make_plan", lambda *_, **__: pytest.fail("it was planned"))
    monkeypatch.setattr(sys, "argv", ["morpheyes", "experiment", "forest", option, "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert (ended.value.code, said.count("\n")) == (2, 1)
    assert option.replace("=", " ") in said
    assert not (tmp_path / "out").exists()


def test_any_number_of_flights_at_once_and_one_per_core_are_allowed() -> None:
    for jobs in (-1, 1, 40):
        require_jobs(jobs)
    for jobs in (0, -2):
        with pytest.raises(UsageError):
            require_jobs(jobs)
