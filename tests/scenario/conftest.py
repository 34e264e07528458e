"""A short forest flight for tests: the real daemon in lockstep over twelve metres, with small images."""

from collections.abc import Callable
from pathlib import Path

import pytest

from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.lockstep import FlightPlan

WORLD = """
world:
  {kind: forest, course_m: 12, half_width_m: 12, run_in_m: 6, run_out_m: 20, trees_per_ha: %d}
"""
MISSION = """
strategy: forest
parameters: {goal: {forward_m: 12.0}}
"""


@pytest.fixture
def short_forest(tmp_path: Path) -> Callable[..., FlightPlan]:
    """Return a maker of plans; keywords go to `make_plan`, `trees_per_ha` to the world."""

    def make(trees_per_ha: int = 400, **changes: object) -> FlightPlan:
        (tmp_path / "short.yaml").write_text(MISSION, encoding="utf-8")
        (tmp_path / "grove.yaml").write_text(WORLD % trees_per_ha, encoding="utf-8")
        options = {"size": "160x120", "calibration": "exact", "limit_s": 60.0, **changes}
        return make_plan(str(tmp_path / "short.yaml"), world=str(tmp_path / "grove.yaml"), **options)  # type: ignore[arg-type]

    return make
