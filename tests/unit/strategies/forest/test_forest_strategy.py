"""Heading and speed of the forest mission: turns within the braking distance, open headings, unknown bins."""

import math
from dataclasses import replace

import pytest

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Intent, MissionCommand, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.strategies.forest.parameters import ForestParameters, Goal
from morpheyes_daemon.strategies.forest.strategy import Forest
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile
from tests.support.seen_from_above import CRAFT, SUMMARY, blind, empty_profile, with_points

FLYING = VehicleState(t_ns=S, position_t_ns=S, p_ned_m=(0.0, 0.0, -1.5), v_ned_m_s=(3.0, 0.0, 0.0), height_m=1.5)

NORTH = Goal(forward_m=80.0)


def engaged(
    profiles: list[ObstacleProfile], vehicle: VehicleState = FLYING, braking_m: float = 3.3, goal: Goal = NORTH
) -> MissionCommand:
    """Return the last command of a mission that engaged on a free view and got profiles at 5 Hz."""
    forest = Forest(ForestParameters(goal=goal), CRAFT)
    still = replace(vehicle, v_ned_m_s=(0.0, 0.0, 0.0))
    command = forest.decide(Observation(S, empty_profile(), SUMMARY, still, still, 0.1, 0.0, 0.5, False))
    for k, profile in enumerate(profiles, 1):
        t_ns = S + k * S // 5
        shown = replace(profile, t_ns=t_ns)
        command = forest.decide(
            Observation(t_ns, shown, SUMMARY, vehicle, vehicle, 0.1, braking_m, 2.0 * braking_m, True)
        )
    return command


def wanted_m_s(course_rad: float, trees: list[tuple[float, float]], braking_m: float) -> float:
    """Return the speed wanted on a course beside the goal; trees north and east of the vehicle."""
    vehicle = replace(FLYING, v_ned_m_s=(3.0 * math.cos(course_rad), 3.0 * math.sin(course_rad), 0.0))
    command = engaged([with_points(empty_profile(), trees)], vehicle, braking_m)
    return math.hypot(command.v_ned_m_s[0], command.v_ned_m_s[1])


def test_a_turn_whose_braking_distance_sweeps_over_a_tree_is_slower() -> None:
    between_course_and_goal = [(3.1, 1.3)]
    assert wanted_m_s(0.8, between_course_and_goal, braking_m=3.3) < 0.8 * wanted_m_s(
        0.8, between_course_and_goal, braking_m=0.0
    )


def test_a_turn_through_free_space_is_not_slowed() -> None:
    assert wanted_m_s(0.8, [], braking_m=3.3) == wanted_m_s(0.8, [], braking_m=0.0) > 3.5


@pytest.mark.parametrize("speed_m_s", [0.3, 3.0])
def test_it_turns_to_an_open_heading_at_any_speed(speed_m_s: float) -> None:
    vehicle = replace(FLYING, v_ned_m_s=(speed_m_s, 0.0, 0.0))
    trees = with_points(empty_profile(), [(5.0, 0.1 * k) for k in range(-30, 6)])
    command = engaged([trees], vehicle, braking_m=1.1 * speed_m_s)
    assert command.detail["heading_rad"] > 0.15
    assert command.z_close_m > 10.0


def test_obstacles_behind_the_goal_do_not_matter() -> None:
    before = with_points(empty_profile(), [(1.4, 0.42)])
    behind = with_points(empty_profile(), [(3.5, 0.1 * k) for k in range(7, 20)])
    goal = Goal(forward_m=2.0, right_m=0.6)
    slow = replace(FLYING, v_ned_m_s=(0.3, 0.0, 0.0))
    assert engaged([before], slow, 0.1, goal).detail["heading_rad"] < 0.1
    assert engaged([before, behind], slow, 0.1, goal).detail["heading_rad"] == pytest.approx(math.atan2(0.6, 2.0))


def test_unknown_bins_remembered_as_free_are_flown_into() -> None:
    strip = blind(empty_profile(), -0.02, 0.02)
    command = engaged([strip] * 10)
    assert command.z_close_m > 8.0
    assert abs(command.detail["heading_rad"]) < 0.05


def test_unknown_bins_never_seen_free_are_flown_around() -> None:
    forest = Forest(ForestParameters(), CRAFT)
    strip = blind(empty_profile(), -0.02, 0.02)
    for k in range(2):
        t_ns = S + k * S // 5
        shown = replace(strip, t_ns=t_ns)
        command = forest.decide(Observation(t_ns, shown, SUMMARY, FLYING, FLYING, 0.1, 3.3, 0.5, k > 0))
    assert abs(command.detail["heading_rad"]) > 0.1, "around it"


def turned_back_after_m(goal: Goal) -> float:
    """Return how far north a vehicle flies that does not turn, until it stops to turn back to its goal."""
    forest = Forest(ForestParameters(goal=goal), CRAFT)
    for k in range(200):
        t_ns, north_m = S + k * S // 5, 0.6 * k
        vehicle = replace(FLYING, t_ns=t_ns, position_t_ns=t_ns, p_ned_m=(north_m, 0.0, -1.5))
        shown = empty_profile(t_ns / S, north_m=north_m)
        command = forest.decide(Observation(t_ns, shown, SUMMARY, vehicle, vehicle, 0.1, 3.3, 6.6, k > 0))
        if command.intent is Intent.STOP:
            return north_m
    return math.inf


def test_turning_back_to_a_near_goal_takes_a_shorter_detour() -> None:
    assert turned_back_after_m(Goal(forward_m=3.0, right_m=1.8)) == pytest.approx(3.6, abs=0.5)
    assert turned_back_after_m(Goal(forward_m=3.0, right_m=20.0)) == pytest.approx(4.0, abs=0.5)
