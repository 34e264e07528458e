"""Decisions of the gap mission: it measures before the run, refuses small openings, and stops behind the wall."""

import math
from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.control.path_following import LEAN_LAG_S, PathFollower
from morpheyes_daemon.messages.core import DepthSummary, Intent, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.base import Craft
from morpheyes_daemon.strategies.gap.openings import CrossingPoint, Opening
from morpheyes_daemon.strategies.gap.parameters import GapParameters
from morpheyes_daemon.strategies.gap.perception import GapPercept
from morpheyes_daemon.strategies.gap.strategy import Gap, Phase

S = 1_000_000_000
CRAFT = Craft(Footprint(), np.eye(4), (0.1, 0.3), 0.2, 3.0, 0.2)
WALL_M, BEYOND_M = 7.0, 8.0


def opening(place=(WALL_M, 0.2, -1.4), room_m=0.04, z_m=4.0, cut=False):
    at = CrossingPoint(place, room_m)
    width, height = 0.337 + 2 * room_m, 0.187 + 2 * room_m
    return Opening(np.zeros((4, 2), np.float32), z_m, (at,), at, width, height, BEYOND_M, cut)


class Course:
    """A vehicle that follows its commands with the lag of a lean, and a strategy that gets the openings of `show`."""

    def __init__(self, show, **parameters):
        self.strategy = Gap(GapParameters(**parameters), CRAFT)
        self.show, self.now_ns = show, 10 * S
        self.vehicle = VehicleState(p_ned_m=(0.0, 0.0, -1.5))
        self.path = PathFollower()
        self.baseline_m = 0.3
        self.commands, self.phases, self.ranges = [], [], []
        self.step(engaged=False)

    def step(self, engaged=True):
        self.now_ns += S // 5
        range_m = WALL_M - self.vehicle.p_ned_m[0]
        percept = GapPercept(
            t_ns=self.now_ns - S // 10, bimodal=True, separation=9.0, range_m=range_m, yaw_rad=0.0, near_limit_m=0.5,
            scale_sigma=0.005, origin_ned_m=self.vehicle.p_ned_m, silhouette=self.strategy.silhouette,
            openings=tuple(self.show(range_m)),
        )  # fmt: skip
        summary = DepthSummary(
            1, self.now_ns, self.now_ns, self.baseline_m, 1e-4, 370.0, 0.8, 0.25, 0.5, 0.9, 0.0, 3.0, 0.01, "none"
        )
        speed = math.hypot(*self.vehicle.v_ned_m_s)
        command = self.strategy.decide(
            Observation(
                self.now_ns, percept, summary, self.vehicle, self.vehicle, self.baseline_m, speed, speed, engaged
            )
        )
        self.commands.append(command)
        self.phases.append(self.strategy._phase)
        self.ranges.append(range_m)
        self.baseline_m += max(-0.01, min(0.01, command.baseline_m - self.baseline_m))
        for k in range(10):
            self.move(command, self.now_ns + k * S // 50)
        return command

    def move(self, command, now_ns):
        """One stick period."""
        flies = command.intent is Intent.FLY
        wanted = self.path.wanted_velocity(command, self.vehicle, now_ns) if flies else (0.0, 0.0, 0.0)
        v = [u + 0.02 / LEAN_LAG_S * (w - u) for u, w in zip(self.vehicle.v_ned_m_s, wanted, strict=True)]
        north, east, down = (p + 0.02 * u for p, u in zip(self.vehicle.p_ned_m, v, strict=True))
        self.vehicle = replace(
            self.vehicle, p_ned_m=(north, east, down), v_ned_m_s=(float(v[0]), float(v[1]), float(v[2]))
        )

    def fly(self, seconds):
        for _ in range(round(5 * seconds)):
            command = self.step()
            if command.intent in (Intent.DONE, Intent.REFUSE):
                return command
        return command


def visible_until_near(range_m, **what):
    return [opening(z_m=range_m, **what)] if range_m > 0.7 else []


def test_the_phases_of_a_flight_through_follow_in_order():
    course = Course(visible_until_near)
    last = course.fly(30.0)
    assert (last.intent, last.reason) == (Intent.DONE, Reason.GOAL_REACHED)
    met = list(dict.fromkeys(course.phases))
    assert met == [Phase.APPROACH, Phase.CLOSE, Phase.RUN, Phase.BEHIND, Phase.OVER]
    through = min(zip(course.ranges, course.commands, strict=True), key=lambda pair: abs(pair[0]))[1]
    assert through.line.p_ned_m[1:] == pytest.approx((0.2, -1.4), abs=0.01)
    assert course.vehicle.p_ned_m[0] > WALL_M + 0.5


def test_before_the_run_free_space_ends_at_the_wall():
    course = Course(visible_until_near)
    course.fly(30.0)
    rows = zip(course.phases, course.ranges, course.commands, strict=True)
    for phase, range_m, command in rows:
        if phase in (Phase.APPROACH, Phase.CLOSE):
            assert command.clear_m < max(range_m, 0.0)
        if phase is Phase.RUN:
            assert command.clear_m <= range_m + BEYOND_M
            assert command.baseline_m == CRAFT.baseline_range_m[0]


def test_the_run_waits_for_the_smallest_baseline():
    course = Course(visible_until_near)
    course.fly(30.0)
    first = course.phases.index(Phase.RUN)
    closing = [command for command, phase in zip(course.commands, course.phases, strict=True) if phase is Phase.CLOSE]
    assert closing
    assert first - course.phases.index(Phase.CLOSE) >= 5


def test_a_refusal_names_the_sizes_of_opening_and_vehicle():
    course = Course(lambda range_m: visible_until_near(range_m, room_m=-0.03))
    last = course.fly(40.0)
    assert (last.intent, last.reason) == (Intent.REFUSE, Reason.MISSION_REFUSED)
    assert "0.28 x 0.13 m" in last.text
    assert "0.34 x 0.19 m" in last.text
    assert "baseline of 100 mm" in last.text
    assert WALL_M - course.vehicle.p_ned_m[0] > 3.0


def test_the_opening_with_the_largest_clearance_is_chosen():
    def two(range_m):
        place = (WALL_M, -0.6, -1.6)
        return [*visible_until_near(range_m, room_m=0.01), *visible_until_near(range_m, room_m=0.2, place=place)]

    course = Course(two)
    assert course.fly(30.0).reason is Reason.GOAL_REACHED
    assert course.vehicle.p_ned_m[1] == pytest.approx(-0.6, abs=0.05)


def test_an_opening_that_proves_larger_is_chosen_instead():
    def two(range_m):
        seems_m = 0.3 if range_m > 6.5 else 0.01
        place = (WALL_M, -0.6, -1.6)
        return [*visible_until_near(range_m, room_m=seems_m), *visible_until_near(range_m, room_m=0.1, place=place)]

    course = Course(two)
    assert course.fly(30.0).reason is Reason.GOAL_REACHED
    assert course.vehicle.p_ned_m[1] == pytest.approx(-0.6, abs=0.05)


def test_between_equal_openings_the_choice_does_not_change():
    flips = iter([0.05, 0.0] * 500)

    def two(range_m):
        more_m = next(flips)
        place = (WALL_M, -0.6, -1.6)
        return [*visible_until_near(range_m, room_m=0.1), *visible_until_near(range_m, room_m=0.1 + more_m, place=place)]

    course = Course(two)
    assert course.fly(30.0).reason is Reason.GOAL_REACHED
    assert len({round(command.line.p_ned_m[1], 1) for command in course.commands if command.line}) == 1


def test_without_an_opening_it_refuses_after_a_time():
    course = Course(lambda range_m: [], look_s=12.0)
    last = course.fly(20.0)
    assert (last.intent, last.text) == (Intent.REFUSE, "no opening in the wall")
    assert WALL_M - course.vehicle.p_ned_m[0] == pytest.approx(GapParameters().stand_off_m, abs=0.3)


def test_before_the_mission_engages_it_stays_in_the_approach():
    course = Course(visible_until_near)
    for _ in range(20):
        course.step(engaged=False)
    assert set(course.phases) == {Phase.APPROACH}


def test_an_opening_lost_at_the_start_of_the_run_aborts_it():
    course = Course(lambda range_m: visible_until_near(range_m) if range_m > 3.6 else [], speed_m_s=0.8)
    course.fly(14.0)
    assert Phase.RUN in course.phases
    after = course.phases[course.phases.index(Phase.RUN) :]
    assert Phase.APPROACH in after
    assert course.vehicle.p_ned_m[0] < WALL_M


def test_an_opening_lost_while_the_baseline_shrinks_is_measured_again():
    hidden = []

    def show(range_m):
        closing = bool(course.phases) and course.phases[-1] is Phase.CLOSE
        if (closing or hidden) and len(hidden) < 15:
            hidden.append(range_m)
            return []
        return visible_until_near(range_m)

    course = Course(lambda range_m: [])
    course.show = show
    last = course.fly(40.0)
    assert len(hidden) == 15
    after = course.phases[course.phases.index(Phase.CLOSE) :]
    assert after.index(Phase.APPROACH) < after.index(Phase.RUN)
    assert last.intent is Intent.DONE


def test_an_opening_cut_by_the_image_is_not_chosen():
    course = Course(lambda range_m: visible_until_near(range_m, cut=True), look_s=3.0)
    assert course.fly(10.0).intent is Intent.REFUSE


@pytest.mark.parametrize(("room_m", "intent"), [(0.04, Intent.DONE), (-0.02, Intent.REFUSE)])
def test_a_followed_opening_may_be_cut_while_the_vehicle_fits(room_m, intent):
    def show(range_m):
        near = range_m < 5.5
        return visible_until_near(range_m, cut=near, room_m=room_m if near else 0.04)

    assert Course(show, look_s=3.0).fly(30.0).intent is intent


def test_a_cut_opening_is_not_chosen_again_after_a_loss():
    def show(range_m):
        away = course.now_ns > 13 * S
        gone = away and course.now_ns < 16 * S
        return [] if gone else visible_until_near(range_m, cut=away)

    course = Course(lambda range_m: [], look_s=3.0)
    course.show = show
    assert course.fly(30.0).intent is Intent.REFUSE
