"""The forest mission on profiles written by hand: where it goes, when it stops, looks, turns, and what baseline it asks.

Figures are worked out beside each test; the vehicle is at 1.5 m and sees 12 m far over 69 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Intent, MissionCommand, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.forest.parameters import ForestParameters, Goal
from morpheyes_daemon.strategies.forest.strategy import Forest
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile
from tests.support.seen_from_above import BINS, CRAFT, SUMMARY, blind, empty_profile, with_points
from tests.support.walls import depth_map

STILL = VehicleState(t_ns=S, position_t_ns=S, p_ned_m=(0.0, 0.0, -1.5), height_m=1.5)
FAR = Goal(forward_m=80.0)
Places = list[tuple[float, float]]


class Mission:
    """Engaged on a free view at the first second, then shown a profile every 0.2 s."""

    def __init__(
        self, start: VehicleState = STILL, engage_on: ObstacleProfile | None = None, **parameters: object
    ) -> None:
        self.forest = Forest(ForestParameters(**{"goal": FAR, **parameters}), CRAFT)
        self.t_ns = S
        first = engage_on or profile_at(start)
        self.show(replace(first, t_ns=S), start, engaged=False)

    def show(
        self,
        profile: ObstacleProfile,
        vehicle: VehicleState = STILL,
        *,
        engaged: bool = True,
        baseline_m: float = 0.1,
        braking_m: float = 0.0,
        reserve_m: float = 0.5,
        dt_s: float = 0.2,
    ) -> MissionCommand:
        self.t_ns += round(dt_s * S)
        seen = replace(profile, t_ns=self.t_ns)
        return self.forest.decide(
            Observation(self.t_ns, seen, SUMMARY, vehicle, vehicle, baseline_m, braking_m, reserve_m, engaged)
        )


def profile_at(vehicle: VehicleState) -> ObstacleProfile:
    return empty_profile(1.0, vehicle.p_ned_m[0], vehicle.p_ned_m[1], vehicle.yaw_rad)


def wall(north_m: float, from_m: float = -12.0, to_m: float = 12.0) -> Places:
    return [(north_m, float(east)) for east in np.arange(from_m, to_m, 0.1)]


def arc(away_m: float, yaw_rad: float = 0.0) -> Places:
    """Posts all around, as far away in every direction that is seen."""
    return [(away_m * math.cos(yaw_rad + a), away_m * math.sin(yaw_rad + a)) for a in np.arange(-1.5, 1.5, 0.05)]


def seen(places: Places, yaw_rad: float = 0.0) -> ObstacleProfile:
    """A profile with these obstacles; only those in view are seen."""
    base = empty_profile(yaw_rad=yaw_rad)
    inside = [(n, e) for n, e in places if abs((math.atan2(e, n) - yaw_rad + math.pi) % (2 * math.pi) - math.pi) < 0.6]
    return with_points(base, inside)


def speed(command: MissionCommand) -> float:
    return math.hypot(*command.v_ned_m_s[:2])


def course(command: MissionCommand) -> float:
    return math.atan2(command.v_ned_m_s[1], command.v_ned_m_s[0])


# where to


@pytest.mark.parametrize("yaw", [0.0, 1.0, math.pi / 2, -2.0])
def test_the_goal_lies_ahead_and_to_the_right_of_where_and_how_it_engaged(yaw: float) -> None:
    start = replace(STILL, p_ned_m=(5.0, -3.0, -1.5), yaw_rad=yaw)
    mission = Mission(start, goal=Goal(forward_m=20.0, right_m=8.0))
    command = mission.show(profile_at(start), start)
    assert command.intent is Intent.FLY
    assert command.reason is None
    # atan2(8, 20) right of the nose, inside the view
    assert course(command) == pytest.approx((yaw + math.atan2(8.0, 20.0) + math.pi) % (2 * math.pi) - math.pi, abs=1e-6)
    assert command.yaw_rad == pytest.approx(yaw + math.atan2(8.0, 20.0))
    assert command.v_ned_m_s[2] == 0.0


def test_until_it_engages_the_goal_follows_the_vehicle_and_afterwards_it_stays() -> None:
    mission = Mission(goal=Goal(forward_m=10.0))
    moved = replace(STILL, p_ned_m=(0.0, 4.0, -1.5))
    mission.show(profile_at(moved), moved, engaged=False)
    assert course(mission.show(profile_at(moved), moved)) == pytest.approx(0.0)
    aside = replace(moved, p_ned_m=(0.0, 0.0, -1.5))
    assert course(mission.show(profile_at(aside), aside)) == pytest.approx(math.atan2(4.0, 10.0))


def test_near_the_goal_it_is_done_and_stays_done() -> None:
    mission = Mission(goal=Goal(forward_m=10.0), goal_radius_m=1.5)
    before = replace(STILL, p_ned_m=(8.4, 0.0, -1.5))
    assert mission.show(profile_at(before), before).intent is Intent.FLY
    there = replace(STILL, p_ned_m=(8.6, 0.0, -1.5))
    for vehicle in (there, before):
        command = mission.show(profile_at(vehicle), vehicle)
        assert (command.intent, command.reason) == (Intent.DONE, Reason.GOAL_REACHED)
        assert command.v_ned_m_s == (0.0, 0.0, 0.0)
        assert command.yaw_rad is None
        assert command.clear_m == 0.0


def test_a_new_engagement_begins_anew() -> None:
    mission = Mission(goal=Goal(forward_m=10.0))
    there = replace(STILL, p_ned_m=(9.5, 0.0, -1.5))
    assert mission.show(profile_at(there), there).intent is Intent.DONE
    mission.show(profile_at(there), there, engaged=False)
    assert mission.show(profile_at(there), there).intent is Intent.FLY


def test_a_goal_aside_beyond_the_view_is_turned_to_along_the_edge_of_the_view() -> None:
    for right_m, side in [(10.0, 1.0), (-10.0, -1.0)]:
        command = Mission(goal=Goal(forward_m=8.0, right_m=right_m)).show(empty_profile())
        # three bins of 0.01 rad are kept off the edge
        assert command.yaw_rad == pytest.approx(side * 0.57, abs=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_around_a_tree_ahead_it_goes_and_keeps_its_width_clear(side: float) -> None:
    tree: Places = [(5.0, -side * 0.1)]
    command = Mission().show(seen(tree))
    heading = command.detail["heading_rad"]
    assert heading * side > 0.0, "around the nearer side"
    across = abs(-side * 0.1 * math.cos(heading) - 5.0 * math.sin(heading))
    # half a hull of 0.337 m and 0.30 m of margin
    assert across >= 0.337 / 2 + 0.30 - 0.01
    assert command.detail["half_width_m"] == pytest.approx(0.337 / 2 + 0.30)


def test_a_gap_is_flown_through_with_the_tight_margin_and_not_with_the_bar_open() -> None:
    # 0.8 m open: 0.337 + 2 * 0.15 = 0.64 fits, with the margin of 0.3 it is 0.94; a bar of 0.3 m and a camera are 0.33
    gap = [(0.1 * k, side * 0.40) for k in range(4, 100) for side in (1, -1)] + [
        (0.4, side * 0.1 * k) for k in range(4, 30) for side in (1, -1)
    ]
    narrow = Mission(engage_on=blind(empty_profile())).show(seen(gap))
    assert narrow.intent is Intent.FLY
    assert narrow.detail["half_width_m"] == pytest.approx(0.337 / 2 + 0.15)
    assert abs(course(narrow)) < 0.05
    assert Mission(tight_margin_m=0.25).show(seen(gap)).intent is Intent.STOP
    wide = Mission().show(seen(gap), baseline_m=0.6)
    assert wide.intent is Intent.STOP, "the bar is wider than the hull then"


# stopping and looking


@pytest.mark.parametrize(("away_m", "intent"), [(1.25, Intent.STOP), (1.4, Intent.FLY)])
def test_where_the_corridor_is_closed_it_stops_and_says_so(away_m: float, intent: Intent) -> None:
    """0.4 m and 0.6 m beyond must be free, before them half the hull and the tight margin, 0.3185 m."""
    command = Mission().show(seen(arc(away_m)))
    assert command.intent is intent
    if intent is Intent.STOP:
        assert command.reason is Reason.NO_FREE_PATH
        assert command.v_ned_m_s == (0.0, 0.0, 0.0)
        assert command.clear_m == 0.0


def closed_around(yaw_rad: float, freer: float) -> ObstacleProfile:
    """Closed all over; the ranges of one half (1 right, -1 left) are the longer ones."""
    profile = with_points(empty_profile(yaw_rad=yaw_rad), arc(1.0, yaw_rad))
    right = np.arange(BINS) > BINS // 2
    return replace(profile, range_m=np.where(right == (freer > 0), 1.1, 0.9))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_looks_to_the_freer_side_and_keeps_turning_there(side: float) -> None:
    mission = Mission(look_rate_deg_s=30.0)
    first = mission.show(closed_around(0.0, side))
    assert first.intent is Intent.STOP
    assert first.yaw_rad == pytest.approx(side * math.radians(30.0))
    turned = replace(STILL, yaw_rad=0.2 * side)
    again = mission.show(closed_around(0.2 * side, -side), turned)
    assert again.intent is Intent.STOP
    assert again.yaw_rad == pytest.approx(side * (0.2 + math.radians(30.0))), "though the other side is freer now"


def test_when_looking_has_found_a_way_it_goes_on() -> None:
    mission = Mission()
    assert mission.show(seen(wall(1.0, -0.8, 2.0))).intent is Intent.STOP
    turned = replace(STILL, yaw_rad=-1.2)
    command = mission.show(seen([], yaw_rad=-1.2), turned)
    assert command.intent is Intent.FLY
    assert -1.8 < command.detail["heading_rad"] < -0.6


def test_what_was_too_near_to_be_matched_ahead_stops_it() -> None:
    near = np.ones(BINS, bool)
    base = empty_profile()
    points = np.stack([0.5 * np.cos(base.azimuth_rad), 0.5 * np.sin(base.azimuth_rad)], axis=1)
    close = replace(base, near=near, range_m=np.full(BINS, 0.5), points_ned_m=points)
    assert Mission().show(close).intent is Intent.STOP


def test_where_nothing_is_known_it_is_slow_to_go_and_what_is_known_free_is_gone_through() -> None:
    """Never seen: something may stand at 2 m. Seen to be free: as good as seen now."""
    dark = blind(empty_profile())
    never = Mission(engage_on=dark).show(dark)
    # 2 m less half width and margin, 0.4685 m
    assert never.clear_m == pytest.approx(2.0 - 0.4685, abs=0.02)
    once = Mission().show(dark)
    assert once.clear_m > 9.0
    assert Mission(engage_on=dark).show(empty_profile()).clear_m > 9.0, "what is seen to be free is not unknown"


def test_a_shadow_is_taken_to_begin_behind_what_casts_it() -> None:
    dark = blind(empty_profile())
    behind = replace(dark, behind_m=np.full(BINS, 7.0))
    command = Mission(engage_on=dark).show(behind)
    assert command.clear_m == pytest.approx(7.0 - 0.4685, abs=0.02)


@pytest.mark.parametrize(("width", "flown_at"), [(2, True), (3, False)])
def test_two_blind_bins_are_no_obstacle_and_three_are(width: int, flown_at: bool) -> None:
    unknown = np.zeros(BINS, bool)
    unknown[60 : 60 + width] = True
    strip = replace(empty_profile(), unknown=unknown)
    heading = Mission(engage_on=strip).show(strip).detail["heading_rad"]
    assert (abs(heading) < 0.02) == flown_at


# how far and how fast


def test_the_clear_distance_counts_what_it_drifts_towards_as_well() -> None:
    """Flying north-east at 2 m/s while the way to the goal is free: the tree on its course counts."""
    drifting = replace(STILL, v_ned_m_s=(1.0, 1.0, 0.0))
    tree = (3.0 / math.sqrt(2.0), 3.0 / math.sqrt(2.0))
    mission = Mission()
    base = with_points(empty_profile(), [tree])
    command = mission.show(base, drifting)
    assert command.z_close_m > 9.0
    # slim margin 0.15 * 0.5
    assert command.clear_m == pytest.approx(3.0 - (0.337 / 2 + 0.075), abs=0.01)
    assert command.detail["drift_m"] == pytest.approx(command.clear_m)
    assert Mission().show(base, replace(STILL, v_ned_m_s=(0.3, 0.3, 0.0))).clear_m > 9.0, "slow it can still turn"


@pytest.mark.parametrize(("distance_m", "wanted_m_s"), [(5.0, 4.3), (3.0, 2.7), (60.0, 5.0)])
def test_it_wants_its_speed_far_from_the_goal_and_less_near_it(distance_m: float, wanted_m_s: float) -> None:
    command = Mission(goal=Goal(forward_m=distance_m), goal_radius_m=0.5).show(empty_profile())
    assert speed(command) == pytest.approx(wanted_m_s)


def test_it_wants_no_more_than_its_parameter_says() -> None:
    assert speed(Mission(speed_m_s=1.7).show(empty_profile())) == pytest.approx(1.7)


def test_off_its_nose_it_flies_slower_since_it_sees_less_there() -> None:
    command = Mission(goal=Goal(forward_m=80.0, right_m=40.0), speed_m_s=2.0).show(empty_profile())
    # cos(1.5 * atan(0.5))
    assert speed(command) == pytest.approx(2.0 * math.cos(1.5 * math.atan(0.5)))
    edge = Mission(goal=Goal(forward_m=8.0, right_m=40.0), speed_m_s=2.0).show(empty_profile(yaw_rad=0.0))
    assert speed(edge) == pytest.approx(2.0 * math.cos(1.5 * 0.57), rel=0.01)


def test_a_moving_vehicle_turns_its_course_by_the_gain_and_by_no_more_than_it_can() -> None:
    east = replace(STILL, v_ned_m_s=(0.0, 2.0, 0.0))
    command = Mission().show(empty_profile(), east)
    assert course(command) == pytest.approx(math.pi / 2 - 0.9)
    slightly = replace(STILL, v_ned_m_s=(2.0, 0.2, 0.0))
    command = Mission(turn_gains=(1.5, 0.0, 0.0)).show(empty_profile(), slightly)
    assert course(command) == pytest.approx(-0.5 * math.atan(0.1))


# the baseline


def times_s(commands: Sequence[float], over: float) -> float:
    return next((0.2 * (k + 1) for k, value in enumerate(commands) if value > over), math.inf)


def test_in_the_open_the_baseline_opens_and_before_trees_it_closes_with_its_time_constant() -> None:
    mission = Mission(baseline_gain=0.02, baseline_smoothing_s=0.5)
    for _ in range(20):
        closed = mission.show(seen(wall(5.0)))
    # Z_close is 5 m less the corridor's half width over the wall's nearest point: 4.53 m, b = 0.0906 -> 0.1 m
    assert closed.baseline_m == pytest.approx(0.1)
    mission.forest._memory.clear()
    # 12 m are trusted: b goes from 0.1 (0.0906) to 0.24 with 1 - e^(-t/0.5)
    opening = [mission.show(empty_profile()).baseline_m for _ in range(20)]
    assert opening[-1] == pytest.approx(0.24, abs=0.001)
    half = 0.0906 + (0.24 - 0.0906) * (1.0 - math.exp(-0.4 / 0.5))
    assert opening[1] == pytest.approx(half, abs=0.003)
    closing = [mission.show(seen(wall(6.0))).baseline_m for _ in range(20)]
    assert closing[-1] == pytest.approx(0.02 * (6.0 - 0.4685), abs=0.003)
    assert closing[2] < 0.16


def test_without_smoothing_the_baseline_is_at_once_the_gain_times_z_close() -> None:
    mission = Mission(baseline_gain=0.03, baseline_smoothing_s=0.0)
    mission.show(empty_profile())
    command = mission.show(seen(wall(6.0)))
    assert command.baseline_m == pytest.approx(0.03 * command.z_close_m)
    assert command.z_close_m == pytest.approx(6.0 - 0.4685, abs=0.1)


def test_while_it_looks_around_the_baseline_closes() -> None:
    mission = Mission(baseline_smoothing_s=0.0)
    assert mission.show(empty_profile()).baseline_m > 0.2
    assert mission.show(seen(wall(1.0))).baseline_m == pytest.approx(0.1)


# the weight of the free direction


def test_the_heading_is_blended_by_the_weight_of_each_rule() -> None:
    tree: Places = [(11.0, 0.05)]

    def blended(weight: object, reserve_m: float = 0.5) -> float:
        return Mission(weight=weight).show(seen(tree), reserve_m=reserve_m).detail["heading_rad"]

    free = blended(1000.0)
    assert free < -0.03, "the free direction itself"
    z = 11.0 - math.sqrt(0.4685**2 - 0.05**2)
    assert blended(3.0) == pytest.approx(math.tanh(3.0 / (2.0 * z)) * free, rel=1e-6)
    assert blended("stopping", 5.0) == pytest.approx(math.tanh(10.0 / (2.0 * z)) * free, rel=1e-6)
    assert blended("stopping", 0.5) == pytest.approx(math.tanh(4.0 / (2.0 * z)) * free, rel=1e-6)
    assert blended("paper") == pytest.approx(free / (1.0 + math.exp(-1.0 / z)), rel=1e-6)


# what goes with a command


def test_a_command_says_what_it_rests_on_and_when_it_ends() -> None:
    mission = Mission()
    moving = replace(STILL, position_t_ns=1234, p_ned_m=(1.0, 2.0, -1.5))
    first = mission.show(profile_at(moving), moving)
    second = mission.show(profile_at(moving), moving)
    assert second.seq == first.seq + 1
    assert (second.t_ns, second.expires_ns) == (mission.t_ns, mission.t_ns + 3 * S // 5)
    assert second.p_measured_ned_m == (1.0, 2.0, -1.5)


def test_the_height_is_the_parameters_or_that_at_which_it_engaged() -> None:
    assert Mission(height_m=2.5).show(empty_profile()).height_m == 2.5
    assert Mission(replace(STILL, height_m=1.1)).show(empty_profile()).height_m == 1.1
    assert Mission(replace(STILL, height_m=math.nan)).show(empty_profile()).height_m == 1.5
    mission = Mission(replace(STILL, height_m=1.1))
    assert mission.show(empty_profile(), replace(STILL, height_m=3.0)).height_m == 1.1


def test_a_tree_out_of_view_is_not_turned_into() -> None:
    """Seen on the right, then the nose turns left: the goal is gone to around the tree beside the view's edge."""
    tree = (3.0 * math.cos(0.2), 3.0 * math.sin(0.2))
    goal = Goal(forward_m=27.0, right_m=9.0)
    turned = replace(STILL, yaw_rad=-0.5)

    def passed_m(*first: ObstacleProfile) -> float:
        mission = Mission(goal=goal)
        for profile in first:
            mission.show(profile)
        heading = mission.show(seen([], yaw_rad=-0.5), turned).detail["heading_rad"]
        return abs(tree[1] * math.cos(heading) - tree[0] * math.sin(heading))

    assert passed_m() < 0.42
    assert passed_m(seen([tree])) > 0.337 / 2 + 0.30 - 0.01


@pytest.mark.parametrize("yaw", [0.0, 3.0, -3.1])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_when_it_comes_no_nearer_it_follows_what_is_in_the_way_on_the_goals_side(side: float, yaw: float) -> None:
    start = replace(STILL, yaw_rad=yaw)
    mission = Mission(start, goal=Goal(forward_m=10.0, right_m=10.0 * math.tan(side * 0.1)))
    goal_rad = yaw + side * 0.1
    tree = seen([(5.0 * math.cos(goal_rad), 5.0 * math.sin(goal_rad))], yaw)

    def off_rad(profile: ObstacleProfile) -> float:
        heading = mission.show(profile, start, dt_s=1.0).detail["heading_rad"]
        return (heading - yaw + math.pi) % (2 * math.pi) - math.pi

    assert abs([off_rad(tree) for _ in range(15)][-1]) < 0.3
    assert off_rad(tree) == pytest.approx(side * 0.57)
    # the goal is in sight and the way is free: it makes for it at once
    assert off_rad(empty_profile(yaw_rad=yaw)) == pytest.approx(side * 0.1)


def test_depth_is_trusted_as_far_as_its_sigmas_allow_and_the_band_is_hull_and_margin() -> None:
    far = depth_map(np.full((240, 320), 6.0))
    grey = np.zeros((240, 320), np.uint8)
    found = Forest(ForestParameters(), CRAFT).perceive(View(far, grey, grey, STILL, CRAFT.T_frd_rig))
    # 0.15 m * 370 px / 0.25 px * (0.2 / 3)
    assert found.trust_m == pytest.approx(14.8)
    assert np.isfinite(found.range_m).all()
    assert found.range_m.min() == pytest.approx(6.0, rel=0.1)
    # 0.12 / 2 + 0.2 = 0.26 m above and below: a board 0.3 m below the vehicle's height is flown over
    v = np.arange(240)[:, None] - 119.5
    low = np.where(v * 4.0 / 370.0 > 0.34, 4.0, 30.0) * np.ones((1, 320))
    over = Forest(ForestParameters(), CRAFT).perceive(View(depth_map(low), grey, grey, STILL, CRAFT.T_frd_rig))
    assert np.isinf(over.range_m).all()
    wide = Forest(ForestParameters(band_margin_m=0.6), CRAFT)
    assert np.isfinite(wide.perceive(View(depth_map(low), grey, grey, STILL, CRAFT.T_frd_rig)).range_m).any()


@pytest.mark.parametrize("changes", [{"tight_margin_m": 0.4}, {"reach_m": 1.05, "safe_m": 0.5}], ids=str)
def test_parameters_that_contradict_each_other_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"tight_margin_m must not|reach_m must be at least 0\.6 m more"):
        ForestParameters(**changes)
    assert ForestParameters(tight_margin_m=0.3, margin_m=0.3, reach_m=1.1, safe_m=0.5)


def away_and_back(mission: Mission, flown_m: float, start_m: float = 0.0) -> tuple[float, float, float]:
    """Fly north at 3 m/s past a goal that lies east: way until it stops, the turn it makes, and its rate."""
    north_m = start_m
    while True:
        vehicle = replace(STILL, p_ned_m=(north_m, 0.0, -1.5), v_ned_m_s=(3.0, 0.0, 0.0))
        command = mission.show(profile_at(vehicle), vehicle)
        if command.intent is Intent.STOP:
            break
        north_m += 0.6
        assert north_m < start_m + flown_m
    yaw = 0.0
    while command.intent is Intent.STOP:
        assert command.yaw_rad is not None
        rate = (command.yaw_rad - yaw + math.pi) % (2 * math.pi) - math.pi
        yaw += rate * 0.2
        vehicle = replace(STILL, p_ned_m=(north_m, 0.0, -1.5), yaw_rad=yaw)
        command = mission.show(profile_at(vehicle), vehicle)
    return north_m - start_m, yaw, rate


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_turning_back_it_stops_turning_when_the_goal_is_well_in_view(side: float) -> None:
    mission = Mission(goal=Goal(forward_m=0.1, right_m=side * 20.0))
    flown_m, turned_rad, rate = away_and_back(mission, 30.0)
    # the goal is abeam at once, and a first detour of 4 m is allowed
    assert flown_m == pytest.approx(4.0, abs=0.7)
    assert rate == pytest.approx(side * math.radians(35.0))
    # from where it stands the goal is 90 degrees and atan(3.9 / 20) off; within half of 75 degrees it has turned enough
    off_deg = 90.0 + math.degrees(math.atan((flown_m - 0.1) / 20.0))
    assert math.degrees(abs(turned_rad)) == pytest.approx(off_deg - 37.5, abs=7.1)


def test_each_turn_back_that_brings_it_no_nearer_allows_a_detour_twice_as_long() -> None:
    mission = Mission(goal=Goal(forward_m=0.1, right_m=20.0))
    first, _, _ = away_and_back(mission, 30.0)
    second, _, _ = away_and_back(mission, 30.0)
    assert second == pytest.approx(2.0 * first, abs=1.3)
    # 1.5 m nearer than ever is not nearer, 3 m are
    for nearer_m, wanted_m in [(1.5, 16.0), (3.0, 4.0)]:
        near = replace(STILL, p_ned_m=(0.0, nearer_m, -1.5))
        again = Mission(goal=Goal(forward_m=0.1, right_m=20.0))
        away_and_back(again, 30.0)
        away_and_back(again, 30.0)
        again.show(profile_at(near), near)
        assert away_and_back(again, 30.0)[0] == pytest.approx(wanted_m, abs=1.3)


def test_exactly_the_detour_is_enough_to_turn_back() -> None:
    """A metre a step: after four steps it has flown the four metres."""
    mission = Mission(goal=Goal(forward_m=-20.0))
    steps = 0
    while mission.show(empty_profile(), replace(STILL, v_ned_m_s=(2.0, 0.0, 0.0)), dt_s=0.5).intent is Intent.FLY:
        steps += 1
    assert steps == 3
