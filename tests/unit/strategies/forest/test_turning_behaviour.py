"""What counts as nearer, how long trees are remembered, and how far ahead a turn is checked: figures by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.forest.bug_algorithm import BugAlgorithm
from morpheyes_daemon.strategies.forest.parameters import ForestParameters
from morpheyes_daemon.strategies.forest.turn_feasibility import (
    Turn,
    feasible_speed_share,
    goal_approach_m_s,
    path_margin_m,
)


@pytest.mark.parametrize(("now_m", "side"), [(19.1, 1), (18.9, 0)])
def test_a_metre_nearer_than_ever_ends_following_what_is_in_the_way(now_m: float, side: int) -> None:
    around = BugAlgorithm()
    around.update(20.0, 0.3, 0)
    around.update(20.0, 0.3, 16 * S)
    around.update(now_m, 0.3, 17 * S)
    assert around.side == side


@pytest.mark.parametrize(("seconds", "follows"), [(14.9, False), (15.1, True)])
def test_fifteen_seconds_without_coming_nearer_are_a_stall(seconds: float, follows: bool) -> None:
    around = BugAlgorithm()
    around.update(20.0, -0.3, 0)
    assert around.update(20.0, -0.3, round(seconds * S)) == follows


@pytest.mark.parametrize(("seconds", "follows"), [(29.9, True), (30.1, False)])
def test_half_a_minute_that_leads_nowhere_is_enough(seconds: float, follows: bool) -> None:
    around = BugAlgorithm()
    around.update(20.0, 0.3, 0)
    assert around.update(20.0, 0.3, 16 * S)
    assert around.update(20.0, 0.3, round((16 + seconds) * S)) == follows


def test_wide_enough_are_three_metres_or_six_tenths_of_the_best() -> None:
    headings = np.linspace(-0.5, 0.5, 5)
    around = BugAlgorithm()
    around.update(20.0, 0.3, 0)
    around.update(20.0, 0.3, 16 * S)
    assert around.heading(headings, np.array([9.0, 9.0, 9.0, 3.1, 2.9])) == 3
    assert around.heading(headings, np.array([2.0, 2.0, 1.3, 1.1, 0.1])) == 2
    around.side = -1
    assert around.heading(headings, np.array([2.9, 3.1, 9.0, 9.0, 9.0])) == 1


def test_the_defaults_that_flights_are_measured_with() -> None:
    """Figures of docs/results.md hold for these; who changes one measures anew."""
    assert ForestParameters().model_dump(exclude={"goal"}) == {
        "goal_radius_m": 1.5, "height_m": None, "speed_m_s": 5.0, "baseline_gain": 0.02, "baseline_smoothing_s": 0.5,
        "margin_m": 0.30, "tight_margin_m": 0.15, "band_margin_m": 0.20, "safe_m": 0.4, "memory_s": 6.0,
        "reach_m": 16.0, "weight": "stopping", "turn_gains": (1.2, 0.0, 0.05), "look_rate_deg_s": 35.0,
    }  # fmt: skip
    assert ForestParameters().goal.forward_m == 80.0
    assert ForestParameters().goal.right_m == 0.0


def nearest_m(tree: np.ndarray, v0: np.ndarray, v1: np.ndarray, period_s: float, braking_s: float) -> float:
    """A slow reference: a velocity that follows a command in 0.7 s, for two periods; from each of twelve moments on
    a stop is tried, `braking_s` at the speed of the moment, but for the first four.
    """
    nearest, place, v, dt = math.inf, np.zeros(2), v0.copy(), 1e-3
    moments = [2.0 * period_s * k / 11 for k in range(12)]
    t = 0.0
    for k, moment in enumerate(moments):
        while t < moment - dt / 2:
            v = v + (v1 - v) / 0.7 * dt
            place = place + v * dt
            t += dt
        length = braking_s if k >= 4 else 0.0
        for share in np.linspace(0.0, 1.0, 100):
            nearest = min(nearest, float(np.linalg.norm(tree - place - share * length * v)))
    return nearest


@pytest.mark.parametrize("period_s", [0.2, 0.6])
@pytest.mark.parametrize("braking_s", [0.0, 0.8])
@pytest.mark.parametrize("seed", range(2))
def test_the_share_is_the_largest_that_keeps_clear_by_a_slow_reference(
    period_s: float, braking_s: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    v0, wanted = rng.uniform(-3, 3, 2), rng.uniform(-3, 3, 2)
    way = v0 + wanted
    tree = way / np.linalg.norm(way) * rng.uniform(0.6, 2.5) + rng.uniform(-0.3, 0.3, 2)
    share = feasible_speed_share(tree[None, :], Turn(v0, wanted, braking_s, period_s), 0.4)
    room = {s: nearest_m(tree, v0, s * wanted, period_s, braking_s) for s in (1.0, 0.7, 0.45, 0.25, 0.0)}
    # the reference's steps of a millisecond
    clear = [s for s, m in room.items() if m > 0.4 + 0.01]
    blocked = [s for s, m in room.items() if m < 0.4 - 0.01]
    if clear and not [s for s in room if s > max(clear) and s not in blocked]:
        assert share == max(clear)
    if len(blocked) == len(room):
        assert room[share] > max(room.values()) - 0.05


def test_the_speed_onto_a_goal_aside_is_that_of_the_circle_it_can_turn() -> None:
    # 0.9 rad in two periods and 0.7 s; a chord of d at an angle a to the course lies on a circle of d / (2 sin a)
    rate = 0.9 / (2 * 0.2 + 0.7)
    for off in (0.3, 1.0, math.pi / 2, -0.5):
        found = goal_approach_m_s((4.0 * math.cos(off), 4.0 * math.sin(off)), 0.0, 0.2)
        assert found == pytest.approx(rate * 4.0 / (2.0 * math.sin(abs(off))))
    assert goal_approach_m_s((-4.0, 0.1), 0.0, 0.2) == pytest.approx(rate * math.hypot(4.0, 0.1) / 2.0)
    assert goal_approach_m_s((4.0, 0.0), 0.0, 0.2) == pytest.approx(rate * 4.0 / 0.02)


def test_the_margin_of_the_way_that_is_flown_is_half_of_the_tight_one_to_all_of_it() -> None:
    assert [path_margin_m(0.2, period) for period in (0.05, 0.5, 0.75, 1.0, 3.0)] == pytest.approx(
        [0.1, 0.1, 0.15, 0.2, 0.2]
    )
