"""What a finished campaign leaves beside its flights: settings, results and table, which belong together.

A reader of the folder must never find the settings of one campaign beside the table of another, so all of them are
written at the end, and nothing of an earlier table is touched before.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from morpheyes_daemon.campaigns.forest_table import Row, flight_cells, flight_table
from morpheyes_daemon.campaigns.gap_table import gap_cells, gap_table
from morpheyes_daemon.campaigns.imo_table import draw_trajectories, imo_cells, imo_table
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.simulation.worlds.forest_world import ForestWorld
from morpheyes_daemon.simulation.worlds.gap_world import GapWorld
from morpheyes_daemon.simulation.worlds.loader import MixedWorld, load_world

SETTINGS, RESULTS, TABLE = "campaign.json", "results.json", "table.md"


@dataclass(frozen=True, slots=True)
class Results:
    """All flights of a campaign, the cells that sum them up, and the cells as a table in Markdown."""

    flights: list[Row]
    cells: list[Row]
    table: str

    def as_json(self) -> Row:
        """Return flights and cells as plain values."""
        return {"flights": self.flights, "cells": self.cells}

    def write(self, folder: Path, settings: Row) -> None:
        """Replace settings, results and table in `folder`, once all three are written beside the old ones."""
        texts = {
            SETTINGS: json.dumps(settings, indent=2),
            RESULTS: json.dumps(self.as_json(), indent=2),
            TABLE: self.table,
        }
        for name, text in texts.items():
            (folder / f"{name}.part").write_text(f"{text}\n", encoding="utf-8")
        for name in texts:
            (folder / f"{name}.part").replace(folder / name)


def results_of(plan: FlightPlan, rows: list[Row]) -> Results:
    """Return the flights of a campaign with the cells and the table that its field reports them in."""
    world = load_world(plan.scenario.world).world
    if plan.mission.strategy == "gap":
        wall = world.gap if isinstance(world, MixedWorld) else world
        cells = gap_cells(rows, to_refuse=isinstance(wall, GapWorld) and not wall.passable)
        return Results(rows, cells, gap_table(cells))
    if plan.mission.strategy == "imo":
        cells = imo_cells(rows)
        return Results(rows, cells, imo_table(cells))
    forest = world.forest if isinstance(world, MixedWorld) else world
    trees_per_ha = forest.trees_per_ha if isinstance(forest, ForestWorld) else None
    cells = flight_cells(rows, plan.config.safety.max_speed_m_s, trees_per_ha)
    return Results(rows, cells, flight_table(cells))


def draw_figures(plan: FlightPlan, rows: Sequence[Row], folder: Path) -> None:
    """Draw into `folder` the figures that the field of a campaign shows beside its table, if any."""
    if plan.mission.strategy == "gap":
        from morpheyes_daemon.campaigns.gap_figure import draw_sequences

        draw_sequences(folder / "sequences.png", plan, rows)
    if plan.mission.strategy == "imo":
        draw_trajectories(rows, folder / "trajectories.png")
