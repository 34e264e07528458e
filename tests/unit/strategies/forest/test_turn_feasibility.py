"""Turn feasibility: slower where the curved path to a new heading meets an obstacle, and to turn onto the goal."""

from __future__ import annotations

import math

import numpy as np
import pytest

from morpheyes_daemon.strategies.forest.parameters import ForestParameters
from morpheyes_daemon.strategies.forest.turn_feasibility import (
    MAX_TURN_RAD,
    RESPONSE_S,
    Turn,
    feasible_speed_share,
    goal_approach_m_s,
    path_margin_m,
)
from morpheyes_daemon.transforms import wrap_rad

TREE = np.array([[1.65, 1.5]])
"""Off the straight paths along x and y, on the curve between them."""
AHEAD, ASIDE = np.array([3.0, 0.0]), np.array([0.0, 3.0])


def share(
    frame_period_s: float, obstacles: np.ndarray, before: np.ndarray, wanted: np.ndarray, braking_s: float = 0.0
) -> float:
    return feasible_speed_share(obstacles, Turn(before, wanted, braking_s, frame_period_s), 0.4)


def nearest_m(frame_period_s: float, course_rad: float, speed_m_s: float) -> float:
    """Return how near a point comes to its goal, 5 m to the north, at the turn rate of such a frame period."""
    rate_rad_s = MAX_TURN_RAD / (2.0 * frame_period_s + RESPONSE_S)
    place, nearest, dt_s = np.array([-5.0, 0.0]), math.inf, 0.02
    for _ in range(3000):
        distance_m = float(np.linalg.norm(place))
        nearest = min(nearest, distance_m)
        off_rad = wrap_rad(math.atan2(-place[1], -place[0]) - course_rad)
        course_rad += max(-rate_rad_s * dt_s, min(rate_rad_s * dt_s, off_rad))
        speed = min(speed_m_s, goal_approach_m_s((-place[0], -place[1]), course_rad, frame_period_s))
        place = place + dt_s * speed * np.array([math.cos(course_rad), math.sin(course_rad)])
    return nearest


def test_a_curved_path_through_a_tree_is_slower_at_long_frame_periods() -> None:
    assert share(1.0, TREE, AHEAD, ASIDE) < 1.0


def test_at_short_frame_periods_the_next_decision_is_in_time() -> None:
    assert share(0.2, TREE, AHEAD, ASIDE) == 1.0


@pytest.mark.parametrize(("away_m", "slower"), [(2.5, True), (6.0, False)])
def test_a_tree_between_two_courses_slows_the_turn_within_braking_distance(away_m: float, slower: bool) -> None:
    tree = away_m * np.array([[math.cos(0.4), math.sin(0.4)]])
    assert share(0.2, tree, AHEAD, ASIDE) == 1.0
    assert (share(0.2, tree, AHEAD, ASIDE, braking_s=1.1) < 1.0) == slower


def test_a_tree_ahead_does_not_slow_the_turn_away_from_it() -> None:
    ahead, aside = np.array([[3.1, 0.0]]), np.array([[2.6, 2.05]])
    assert share(0.4, ahead, AHEAD, ASIDE, braking_s=1.1) == 1.0
    assert share(0.4, np.concatenate([ahead, aside]), AHEAD, ASIDE, braking_s=1.1) == 0.45


def test_without_a_clear_share_the_one_with_most_clearance_is_taken() -> None:
    before_and_behind = np.array([[1.37, 0.03], [1.92, 3.31]])
    assert share(1.0, before_and_behind, AHEAD, ASIDE, braking_s=1.1) == 0.45


@pytest.mark.parametrize(("frame_period_s", "share_of_tight"), [(0.1, 0.5), (0.2, 0.5), (0.8, 0.8), (2.0, 1.0)])
def test_long_frame_periods_keep_a_larger_margin(frame_period_s: float, share_of_tight: float) -> None:
    assert path_margin_m(0.15, frame_period_s) == pytest.approx(share_of_tight * 0.15)


@pytest.mark.parametrize("obstacles", [np.empty((0, 2)), np.array([[9.0, -5.0]])], ids=["nothing", "far away"])
def test_a_free_path_is_not_slowed(obstacles: np.ndarray) -> None:
    assert share(1.0, obstacles, AHEAD, ASIDE, braking_s=1.1) == 1.0


@pytest.mark.parametrize("frame_period_s", [0.2, 1.0])
@pytest.mark.parametrize("off_deg", [0, 20, 45, 80, 120, 170])
def test_a_goal_to_the_side_is_reached_without_circling(frame_period_s: float, off_deg: int) -> None:
    assert nearest_m(frame_period_s, math.radians(off_deg), 4.0) < 0.5 * ForestParameters().goal_radius_m


def test_a_goal_straight_ahead_does_not_slow() -> None:
    assert goal_approach_m_s((5.0, 0.0), 0.0, 1.0) > 4.0
