"""The forest mission asks for less speed where a turn could not be stopped in before what stands in it."""

import math
from dataclasses import replace

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.config import Footprint
from morpheyes_daemon.messages import DepthSummary, VehicleState
from morpheyes_daemon.strategies.base import Craft, Observation
from morpheyes_daemon.strategies.forest import Forest, ForestParameters
from morpheyes_daemon.strategies.profile import ObstacleProfile
from morpheyes_daemon.transforms import R_FRD_CAM, pose

CRAFT = Craft(Footprint(), pose(R_FRD_CAM, np.array([0.09, 0.0, -0.02])), (0.1, 0.3), 0.2, 3.0, 0.2)
SUMMARY = DepthSummary(1, 0, 0, 0.1, 0.0, 740.0, 0.8, 0.25, 0.5, 1.0, 0.0, 2.0, 0.1, "")


def wanted_m_s(course_rad: float, trees: list[tuple[float, float]], braking_m: float) -> float:
    """Speed asked for on a course beside the goal, which lies north; trees north and east of the vehicle."""
    forest = Forest(ForestParameters(), CRAFT)
    bins = np.linspace(-0.6, 0.6, 121)
    free, no = np.full(121, np.inf), np.zeros(121, dtype=np.bool_)
    points = np.array(trees, dtype=np.float64).reshape(-1, 2)
    profile = ObstacleProfile(S, (0.0, 0.0, -1.5), (0.0, 0.0), bins, free, no, free * np.nan, no, points, 12.0, 0.5)
    still = VehicleState(t_ns=S, position_t_ns=S, p_ned_m=(0.0, 0.0, -1.5), height_m=1.5)
    velocity = (3.0 * math.cos(course_rad), 3.0 * math.sin(course_rad), 0.0)
    flying = replace(still, v_ned_m_s=velocity)
    before = Observation(S, profile, SUMMARY, still, still, 0.1, 0.0, 0.5, False)
    forest.decide(before)
    command = forest.decide(replace(before, now_ns=S + S // 5, vehicle=flying, braking_m=braking_m, engaged=True))
    return math.hypot(command.v_ned_m_s[0], command.v_ned_m_s[1])


def test_a_turn_that_sweeps_over_a_tree_within_braking_is_taken_slower() -> None:
    between_course_and_goal = [(3.1, 1.3)]
    assert wanted_m_s(0.8, between_course_and_goal, braking_m=3.3) < 0.8 * wanted_m_s(
        0.8, between_course_and_goal, braking_m=0.0
    )


def test_a_turn_through_free_space_is_not_slowed() -> None:
    assert wanted_m_s(0.8, [], braking_m=3.3) == wanted_m_s(0.8, [], braking_m=0.0) > 3.5
