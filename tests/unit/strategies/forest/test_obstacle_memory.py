"""Obstacle memory: obstacles that left the view, and space that was seen to be free."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.strategies.forest.obstacle_memory import RANGE_STEP_M, ObstacleMemory
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile
from tests.support.seen_from_above import BINS, blind, empty_profile, with_points

MIDDLE = np.array([BINS // 2])
LIMIT_M = 12.0 - RANGE_STEP_M
"""Profiles reach 12 m."""


def remembering(*profiles: ObstacleProfile) -> ObstacleMemory:
    memory = ObstacleMemory(6.0)
    for profile in profiles:
        memory.add(profile)
    return memory


def free_m(memory: ObstacleMemory, profile: ObstacleProfile, bins: np.ndarray = MIDDLE) -> float:
    return float(memory.seen_free_m(profile, bins, 2.0, 16.0)[0])


def test_a_tree_that_left_the_view_is_remembered_until_it_is_old() -> None:
    seen, away = with_points(empty_profile(1.0), [(5.0, 0.0)]), empty_profile(2.0, yaw_rad=2.0)
    memory = remembering(seen, away)
    assert memory.points_ned_m.tolist() == [[5.0, 0.0]]
    memory.add(empty_profile(7.5, yaw_rad=2.0))
    assert memory.points_ned_m.size == 0


def test_points_that_a_later_view_sees_through_are_dropped() -> None:
    mismatch = with_points(empty_profile(1.0), [(5.0, 0.0)])
    assert remembering(mismatch, empty_profile(1.2)).points_ned_m.size == 0
    # neither a missing depth nor a nearer obstacle contradicts it
    assert len(remembering(mismatch, blind(empty_profile(1.2))).points_ned_m) == 1
    assert len(remembering(mismatch, with_points(empty_profile(1.2), [(3.0, 0.0)])).points_ned_m) == 2


def test_space_never_seen_is_not_free() -> None:
    dark = blind(empty_profile(1.0))
    assert free_m(remembering(dark), dark) == 2.0


def test_without_depth_remembered_space_stays_free() -> None:
    dark = blind(empty_profile(2.0, north_m=4.0))
    memory = remembering(empty_profile(1.0), dark)
    assert free_m(memory, dark) == pytest.approx(LIMIT_M - 4.0, abs=RANGE_STEP_M)


def test_half_occluded_space_is_free_as_far_as_an_earlier_view_saw() -> None:
    before = with_points(empty_profile(1.0), [(9.0, 0.0)])
    shadow = blind(empty_profile(1.8, north_m=3.0), -0.02, 0.02)
    # short of the trunk, by the margin for depth errors
    assert free_m(remembering(before, shadow), shadow) == pytest.approx(0.9 * 9.0 - 0.3 - 3.0, abs=RANGE_STEP_M)


def test_free_space_of_two_views_is_combined() -> None:
    first = blind(empty_profile(1.0), -0.05, 0.2)
    aside = replace(empty_profile(1.5, east_m=1.0, yaw_rad=-0.2), trust_m=6.0)
    dark = blind(empty_profile(2.0))
    assert free_m(remembering(first, dark), dark) == 2.0
    assert free_m(remembering(first, aside, dark), dark) == pytest.approx(math.sqrt(36.0 - 1.0), abs=RANGE_STEP_M)


def test_free_space_is_dropped_with_the_points_of_its_view() -> None:
    dark, late = blind(empty_profile(1.2)), blind(empty_profile(7.5))
    memory = remembering(empty_profile(1.0), dark)
    assert free_m(memory, dark) > 10.0
    memory.add(late)
    assert free_m(memory, late) == 2.0
    memory = remembering(empty_profile(1.0))
    memory.clear()
    memory.add(dark)
    assert free_m(memory, dark) == 2.0


def test_free_space_behind_unknown_space_does_not_count() -> None:
    across = empty_profile(1.0, north_m=8.0, east_m=-5.0, yaw_rad=math.pi / 2)
    dark = blind(empty_profile(1.2))
    assert free_m(remembering(across, dark), dark) == 2.0


def test_an_obstacle_nearer_than_the_near_limit_hides_what_is_behind() -> None:
    near = empty_profile(1.0)
    near = replace(near, near=np.ones(BINS, dtype=np.bool_))
    dark = blind(empty_profile(1.2))
    assert free_m(remembering(near, dark), dark) == 2.0


def test_space_beyond_the_edge_of_a_view_is_not_free() -> None:
    turned = blind(empty_profile(1.2, yaw_rad=0.3))
    memory = remembering(empty_profile(1.0), turned)
    inside, outside = np.array([10]), np.array([BINS - 10])
    assert free_m(memory, turned, inside) == pytest.approx(LIMIT_M, abs=RANGE_STEP_M)
    assert free_m(memory, turned, outside) == 2.0


def test_at_most_ten_views_a_second_are_kept_and_the_newest() -> None:
    def with_one_good_view(good: int, views: int) -> ObstacleMemory:
        taken = [empty_profile(1.0 + 0.01 * k) for k in range(views)]
        return remembering(*(view if k == good else blind(view) for k, view in enumerate(taken)))

    dark = blind(empty_profile(1.5))
    assert free_m(with_one_good_view(good=0, views=40), dark) > 10.0
    assert free_m(with_one_good_view(good=5, views=40), dark) == 2.0, "dropped for its neighbours"
    assert free_m(with_one_good_view(good=39, views=40), dark) > 10.0
