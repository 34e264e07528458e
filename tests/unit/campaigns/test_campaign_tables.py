"""Tables of campaigns: what was wanted, how often it came about, and why not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from morpheyes_daemon.campaigns.forest_table import Row, flight_cells, flight_table, wilson
from morpheyes_daemon.campaigns.results import results_of
from morpheyes_daemon.flights.flight_plan import make_plan

FLOWN = {
    "baseline_mode": "variable", "seed": 0, "outcome": "reached", "reason": "goal_reached", "mean_speed_m_s": 2.0,
    "peak_speed_m_s": 3.0, "time_s": 40.0, "min_clearance_m": 0.5, "braking_events": 0,
}  # fmt: skip
THROUGH = {
    **FLOWN, "motion": "none", "shape": "blob", "crossing_speed_m_s": 2.9, "clearance_m": 0.04, "contour_iou": 0.9,
    "sequence": [],
}  # fmt: skip
WATCHED = {**FLOWN, "samples": [[1.0, 2.5, 2.5, 0.2]], "longest_loss_s": 0.2, "frames_watched": 5, "false_frames": 0}


def tabled(mission: str, rows: list[Row], **changes: Any) -> tuple[list[Row], list[str]]:
    """Return cells and the lines of the table of a mission's campaign."""
    results = results_of(make_plan(mission, size="160x120", calibration="exact", **changes), rows)
    return results.cells, results.table.splitlines()


def columns(lines: list[str], number: int = 2) -> dict[str, str]:
    """Return a line of a table by the names of its columns."""
    names, values = ([part.strip() for part in line.split("|")[1:-1]] for line in (lines[0], lines[number]))
    return dict(zip(names, values, strict=True))


def test_intervals_of_a_success_rate() -> None:
    """Wilson's, as tabulated for 95 %: 10 of 10 and 0 of 10."""
    assert wilson(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-3)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


def test_a_cell_says_why_flights_failed() -> None:
    rows = [
        FLOWN,
        {**FLOWN, "seed": 1, "outcome": "collided", "reason": "bar"},
        {**FLOWN, "seed": 2, "outcome": "aborted", "reason": "depth_stale"},
    ]
    (cell,), lines = tabled("forest", rows)
    assert (cell["flights"], cell["reached"], cell["collided"]) == (3, 1, 1)
    assert cell["causes"] == {"collided in seed 1: bar": 1, "aborted: depth_stale": 1}
    assert lines[-1] == "variable: 1 x aborted: depth_stale"


def test_baselines_are_compared_by_the_flights_of_the_same_seed() -> None:
    rows = [
        {
            **FLOWN,
            "baseline_mode": mode,
            "seed": seed,
            "outcome": outcome,
            "reason": "goal_reached" if outcome == "reached" else "blind",
            "mean_speed_m_s": speed,
        }
        for mode, seed, outcome, speed in [
            ("variable", 0, "reached", 3.0), ("variable", 1, "reached", 2.0), ("variable", 2, "timeout", 1.0),
            ("0.1", 0, "reached", 1.5), ("0.1", 1, "reached", 1.0), ("0.1", 2, "reached", 3.0),
            ("0.3", 0, "timeout", 0.1),
        ]
    ]  # fmt: skip
    lines = flight_table(flight_cells(rows, 5.0)).splitlines()
    assert lines[0].endswith("| variable faster (95 %) |")
    assert [line.split("|")[-2].strip() for line in lines[2:5]] == ["–", "2.00× (2.00 to 2.00)", "–"]
    assert "variable faster" not in flight_table(flight_cells(rows[:3], 5.0))


@pytest.mark.parametrize(
    ("world", "trees_per_ha"), [("forest_sparse", 100.0), ("forest", 400.0), ("forest_dense", 1000.0), ("mixed", 250.0)]
)
def test_a_table_of_flights_among_trees_says_how_many_and_the_speed_that_was_set(
    world: str, trees_per_ha: float, tmp_path: Path
) -> None:
    if world == "mixed":
        world = str(tmp_path / "mixed.yaml")
        Path(world).write_text("world: {kind: mixed, forest: {kind: forest, trees_per_ha: 250}, gap: {kind: gap}}\n")
    plan = make_plan("forest", size="160x120", calibration="exact", world=world)
    slow = plan.config.safety.model_copy(update={"max_speed_m_s": 3.5})
    results = results_of(replace(plan, config=plan.config.model_copy(update={"safety": slow})), [FLOWN])
    (cell,) = results.cells
    assert (cell["trees_per_ha"], cell["set_speed_m_s"]) == (trees_per_ha, 3.5)
    shown = columns(results.table.splitlines())
    assert (shown["trees/ha"], shown["set m/s"], shown["flights"]) == (f"{trees_per_ha:g}", "3.5", "1")


def test_a_table_of_flights_where_no_tree_stands_has_no_column_for_trees() -> None:
    (cell,), lines = tabled("forest", [FLOWN], world="room")
    assert (cell["trees_per_ha"], cell["set_speed_m_s"]) == (None, 5.0)
    assert "trees/ha" not in lines[0]
    assert columns(lines)["flights"] == "1"


def test_where_no_opening_is_large_enough_success_is_to_refuse() -> None:
    refused = {**THROUGH, "outcome": "refused", "reason": "mission_refused", "crossing_speed_m_s": None}
    rows = [{**refused, "seed": seed} for seed in range(9)] + [{**THROUGH, "seed": 9}]
    (cell,), lines = tabled("gap", rows, world="gap_small")
    assert (cell["wanted"], cell["success_rate"], cell["refused"], cell["reached"]) == ("refused", 0.9, 9, 1)
    assert columns(lines)["success (95 %)"] == "refused: 90% (60% to 98%)"
    assert lines[3:] == ["", "variable, motion none: 1 x reached: goal_reached"]


@pytest.mark.parametrize("world", ["gap", "gap_several"])
def test_where_an_opening_is_large_enough_a_refusal_is_no_success(world: str) -> None:
    refused = {**THROUGH, "seed": 1, "outcome": "refused", "reason": "mission_refused"}
    (cell,), lines = tabled("gap", [THROUGH, refused], world=world)
    assert (cell["wanted"], cell["success_rate"]) == ("reached", 0.5)
    assert columns(lines)["success (95 %)"].startswith("50% (")
    assert lines[3:] == ["", "variable, motion none: 1 x refused: mission_refused"]


def test_a_gap_s_table_tells_in_one_line_which_flights_touched_and_how_deep() -> None:
    touched = {**THROUGH, "outcome": "collided", "reason": "hull or bar 6 mm into an obstacle at 2.9 m/s, engaged"}
    rows = [
        THROUGH,
        {**touched, "seed": 713, "min_clearance_m": -0.0062},
        {**touched, "seed": 755, "min_clearance_m": -0.0101, "shape": "goku"},
        {**touched, "seed": 760, "reason": "the ground touched in flight"},
        {**THROUGH, "seed": 770, "outcome": "timeout", "reason": "not there after 180 s"},
    ]
    cells, lines = tabled("gap", rows)
    assert [cell["shape"] for cell in cells] == ["all", "blob", "goku"]
    assert lines[5:] == [
        "",
        "variable, motion none: touched in seed 713 by 6 mm, 755 by 10 mm, 760: the ground touched in flight",
        "",
        "variable, motion none: 1 x timeout: not there after 180 s",
    ]


def test_a_moving_object_s_table_tells_which_flights_did_not_end_well() -> None:
    rows = [
        WATCHED,
        {**WATCHED, "seed": 1, "outcome": "aborted", "reason": "depth_stale"},
        {**WATCHED, "seed": 2, "outcome": "aborted", "reason": "depth_stale"},
        {**WATCHED, "seed": 0, "baseline_mode": "0.1", "outcome": "collided", "reason": "bar"},
    ]
    (cell, _), lines = tabled("imo", rows)
    assert cell["outcomes"] == {"reached": 1, "aborted": 2}
    assert lines[-4:] == ["", "variable: 2 x aborted: depth_stale", "", "0.1: 1 x collided in seed 0: bar"]
    _, good = tabled("imo", rows[:1])
    assert good[-1].startswith("| 2 to 3 |")
