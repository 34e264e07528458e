"""Goals that are not simply ahead, ground that is not level, and what else grows: whole flights, judged by the truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from morpheyes_daemon.daemon.composition import Daemon
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.lockstep import FlightPlan, Watchers, fly
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.core import Intent, MissionCommand
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import GateOutput, State

pytestmark = pytest.mark.slow


def plan_of(mission: str, **changes: object) -> FlightPlan:
    options = {"size": "160x120", "calibration": "exact", "limit_s": 150.0, **changes}
    return make_plan(mission, **options)  # type: ignore[arg-type]


def test_a_goal_behind_the_vehicle_is_reached_by_looking_around() -> None:
    summary = fly(plan_of("forest_behind"))
    assert summary.outcome == "reached"
    assert summary.min_clearance_m > 0.0
    # turned nearly on the spot: 40 m and half of it again
    assert summary.path_m < 60.0


def test_out_of_a_dead_end_by_stopping_looking_around_and_going_on() -> None:
    commands: list[MissionCommand] = []
    watchers = Watchers(attach=[lambda daemon, stage: daemon.topics.command.tap(commands.append)])
    summary = fly(plan_of("forest_dead_end"), watchers)
    assert summary.outcome == "reached"
    assert summary.min_clearance_m > 0.0
    stops = [command for command in commands if command.intent is Intent.STOP]
    assert any(command.reason is Reason.NO_FREE_PATH and command.yaw_rad is not None for command in stops)


def test_height_is_kept_over_rolling_ground(tmp_path: Path) -> None:
    relief = "{slope_deg: 6, rolling_m: 0.8, rolling_length_m: 30}"
    hill = f"{{kind: forest, course_m: 30, half_width_m: 20, run_in_m: 6, run_out_m: 25, relief: {relief}}}"
    (tmp_path / "hill.yaml").write_text(f"world: {hill}\n", encoding="utf-8")
    mission = "strategy: forest\nparameters: {goal: {forward_m: 30.0}}\n"
    (tmp_path / "uphill.yaml").write_text(mission, encoding="utf-8")
    heights: list[float] = []

    def attach(daemon: Daemon, stage: SimVehicle) -> None:
        def note(out: GateOutput) -> None:
            if out.state is State.ENGAGED:
                heights.append(stage.truth(out.t_ns).height_m)

        daemon.topics.gate.tap(note)

    plan = plan_of(str(tmp_path / "uphill.yaml"), world=str(tmp_path / "hill.yaml"))
    summary = fly(plan, Watchers(attach=[attach]))
    assert summary.outcome == "reached"
    # 10 degrees at 3 m/s are 0.5 m/s of climb, which surface tracking is behind by a second
    assert min(heights) > 0.9
    assert max(heights) < 2.1


@pytest.mark.parametrize("world", ["forest_light", "forest_bushes", "forest_branches"])
def test_the_goal_is_reached_against_the_sun_and_through_undergrowth(world: str) -> None:
    summary = fly(plan_of("forest", world=world))
    assert summary.outcome == "reached"
    assert summary.min_clearance_m > 0.0


def test_a_mixed_course_is_flown_around_its_wall() -> None:
    crossings_m: list[float] = []

    def attach(daemon: Daemon, stage: SimVehicle) -> None:
        def note(out: GateOutput) -> None:
            north_m, east_m, _ = stage.truth(out.t_ns).p_ned_m
            if abs(north_m - 45.0) < 0.1:
                crossings_m.append(abs(east_m))

        daemon.topics.gate.tap(note)

    summary = fly(plan_of("mixed"), Watchers(attach=[attach]))
    assert summary.outcome == "reached"
    assert summary.min_clearance_m > 0.0
    # the wall is 8 m wide, its opening in the middle
    assert min(crossings_m) > 4.0
