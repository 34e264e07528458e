"""The crossing of an oscillating opening is planned where it moves little, and waited for where the run begins."""

import math

import numpy as np
import pytest

from morpheyes_daemon.strategies.gap.crossing import MAX_OPENING_M_S, MAX_PLAN_OFFSET_S, MAX_WALL_TURN_RAD, Crossing
from morpheyes_daemon.strategies.gap.opening_tracker import PointTracker
from morpheyes_daemon.strategies.gap.parameters import GapParameters

S = 1_000_000_000
WATCHED_S, NOW_NS = 18.0, 18 * S
SIGMA = np.full(3, 0.01)


def tracks():
    """Return trackers of an opening that oscillates by 0.5 m and of its wall that turns, after eighteen seconds."""
    place, yaw = PointTracker(), PointTracker(walk_sqrt_s=0.002)
    for track in (place, yaw):
        track.set_moving()
    for k in range(91):
        t_s = k / 5
        place.update(k * S // 5, np.array([4.0, 0.5 * math.sin(t_s), -1.4 + 0.15 * math.cos(t_s)]), SIGMA, 4.0)
        yaw.update(k * S // 5, np.array([0.0, math.radians(15) * math.sin(math.pi / 4 * t_s + 1.0), 0.0]), SIGMA)
    return place, yaw


def test_the_crossing_is_planned_where_opening_and_wall_move_little():
    place, yaw = tracks()
    crossing = Crossing(GapParameters())
    crossing.plan(place, yaw, WATCHED_S, NOW_NS)
    t_s = crossing.t_ns / S
    # fitted to eighteen seconds: speed to a few cm/s, heading to a degree
    assert math.hypot(0.5 * math.cos(t_s), 0.15 * math.sin(t_s)) < MAX_OPENING_M_S + 0.05
    assert abs(math.radians(15) * math.sin(math.pi / 4 * t_s + 1.0)) < MAX_WALL_TURN_RAD + 0.02
    assert crossing.t_ns >= NOW_NS + crossing.run_ns


def test_a_planned_crossing_is_kept_until_its_run_is_due():
    place, yaw = tracks()
    crossing = Crossing(GapParameters())
    crossing.plan(place, yaw, WATCHED_S, NOW_NS)
    planned_ns = crossing.t_ns
    begins_ns = planned_ns - crossing.run_ns
    assert not crossing.is_due(place, yaw, WATCHED_S, begins_ns - S // 2)
    crossing.plan(place, yaw, WATCHED_S, begins_ns - S // 2)
    assert crossing.t_ns == planned_ns
    assert crossing.is_due(place, yaw, WATCHED_S, begins_ns)
    assert not crossing.is_due(place, yaw, 2.0, begins_ns)


def test_the_limits_on_motion_widen_with_waiting():
    place, yaw = tracks()
    crossing = Crossing(GapParameters())
    middle_ns = round(6 * math.pi * S)
    assert crossing.motion_cost(middle_ns, place, yaw, WATCHED_S) > 2.0
    assert crossing.motion_cost(middle_ns, place, yaw, 60.0) < 1.0


def test_the_waiting_point_leads_straight_to_the_crossing():
    place, yaw = tracks()
    crossing = Crossing(GapParameters())
    crossing.plan(place, yaw, WATCHED_S, NOW_NS)
    assert crossing.waiting_point(place, 2.0)[1] == pytest.approx(0.0, abs=0.05)
    begin, meeting = crossing.waiting_point(place, WATCHED_S), place.at(crossing.t_ns)
    assert begin + crossing.run_ns / S * meeting.v_m_s == pytest.approx(meeting.p_m)


def test_accelerating_to_the_set_speed_costs_time():
    crossing = Crossing(GapParameters(speed_m_s=2.0))
    assert crossing.run_time_s(4.0, 2.0) == pytest.approx(2.0)
    assert crossing.run_time_s(4.0, 0.0) == pytest.approx(2.75)
    assert crossing.run_time_s(-0.1, 2.0) == 0.0


def test_the_arrival_is_as_planned_until_the_speed_shows():
    crossing = Crossing(GapParameters(speed_m_s=3.0, stand_off_m=4.0))
    crossing.begin(NOW_NS)
    run_s = crossing.run_ns / S
    assert crossing.time_to_arrival_s(4.0, 0.0, NOW_NS) == pytest.approx(run_s)
    assert crossing.time_to_arrival_s(4.0, 0.1, NOW_NS + S // 2) == pytest.approx(run_s - 0.5)
    assert crossing.time_to_arrival_s(0.9, 3.0, NOW_NS + 3 * S) == pytest.approx(
        0.3
    )  # late: not before the set speed allows


@pytest.mark.parametrize(
    ("planned_s", "left_s"),
    [(0.35, 0.35), (0.25, 0.25), (2.0, 0.3 + MAX_PLAN_OFFSET_S), (-1.0, 0.3 - MAX_PLAN_OFFSET_S)],
)
def test_the_time_to_the_crossing_is_as_planned_within_a_bound(planned_s, left_s):
    crossing = Crossing(GapParameters(speed_m_s=3.0), t_ns=NOW_NS + round(planned_s * S), begun_ns=NOW_NS - 3 * S)
    assert crossing.time_to_crossing_s(0.9, 3.0, NOW_NS) == pytest.approx(left_s)
    assert crossing.time_to_crossing_s(-1.0, 3.0, NOW_NS + 9 * S) == 0.0
