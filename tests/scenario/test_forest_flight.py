"""The daemon flies the forest: whole flights in lockstep, judged by the truth."""

from collections.abc import Callable

import numpy as np
import pytest

from morpheyes_daemon.flights.lockstep import FlightPlan, Watchers, fly
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.simulation.worlds.collision import VehicleShape
from morpheyes_daemon.simulation.worlds.loader import build_world, load_world

Maker = Callable[..., FlightPlan]


def test_it_reaches_the_goal_and_the_same_seed_gives_the_same_sticks(short_forest: Maker) -> None:
    plan = short_forest(seed=3)
    first, second = fly(plan), fly(plan)
    assert first.outcome == "reached"
    assert first.min_clearance_m > 0.0
    assert first.sticks_sha256 == second.sticks_sha256
    assert first.time_s == second.time_s


def test_another_seed_gives_other_sticks(short_forest: Maker) -> None:
    assert fly(short_forest(seed=4)).sticks_sha256 != fly(short_forest(seed=5)).sticks_sha256


def test_a_held_baseline_is_held(short_forest: Maker) -> None:
    summary = fly(short_forest(seed=3, baseline="0.2"))
    assert summary.baseline_mode == "0.2"
    # the servo's own non-linearity and repeatability
    assert abs(summary.baseline_min_m - 0.2) < 0.003
    assert abs(summary.baseline_max_m - 0.2) < 0.003


def test_nothing_is_sent_before_the_pilot_engages_and_neutral_comes_before_the_release(short_forest: Maker) -> None:
    out: list[GateOutput] = []
    watchers = Watchers(attach=[lambda daemon, stage: daemon.topics.gate.tap(out.append)])
    fly(short_forest(seed=3), watchers)
    first = next(k for k, sent in enumerate(out) if sent.action is Action.STICKS)
    assert {sent.action for sent in out[: first - 1]} <= {Action.SILENT, Action.NEUTRAL}
    assert all(sent.state is State.ENGAGED for sent in out if sent.action is Action.STICKS)
    last = max(k for k, sent in enumerate(out) if sent.action is Action.STICKS)
    after = [sent.action for sent in out[last + 1 :]]
    assert after[0] is Action.NEUTRAL
    assert Action.RELEASE in after


@pytest.mark.slow
def test_a_straight_line_through_the_default_forest_mostly_collides() -> None:
    """The control run: the forest leaves no path open along the course."""
    shape, hits = VehicleShape(), 0
    for seed in range(40):
        world = build_world(load_world("forest"), seed)
        places = (np.array([x, 0.0, -1.5]) for x in np.arange(0.0, 80.0, 0.1))
        hits += any(world.clearance_m(place, np.eye(3), shape, 0.3) < 0.0 for place in places)
    assert hits >= 30
