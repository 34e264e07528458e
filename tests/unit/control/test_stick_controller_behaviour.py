"""Mission to sticks on the Loiter plant: the governor alone keeps a mission that never slows off a wall."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.control.governor import Governor, GovernorLimits
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.control.velocity import VelocityTuning
from morpheyes_daemon.messages.core import DepthSummary, Governed, Intent, Line, MissionCommand, Sticks, VehicleState
from tests.support.copter_parameters import copter_parameters
from tests.support.loiter_plant import LoiterPlant

MODEL = LoiterModel.from_parameters(copter_parameters())
LIMITS = GovernorLimits(
    dead_daemon_s=1.0, depth_sigmas=3.0, max_relative_depth_error=0.2, max_speed_m_s=4.5,
    sync_error_s=0.0, image_width_px=320,
)  # fmt: skip
SEEN = DepthSummary(1, 0, 0, 0.2, 0.0005, 740.0, 0.8, 0.25, 0.9, 0.9, 0.0, 2.0, 0.02, "hash")
COURSES = {"north": 0.0, "east": math.pi / 2, "north-west": -math.pi / 4, "south": math.pi}
FRAME_MS = 200


def configured(limits: GovernorLimits) -> StickController:
    """A stick controller that knows the vehicle."""
    controller = StickController(Governor(limits), lambda model: VelocityTuning())
    controller.configure(MODEL)
    return controller


def stepped(
    controller: StickController, order: MissionCommand, seen: DepthSummary, state: VehicleState, now_ns: int
) -> tuple[Sticks, Governed]:
    """One stick period of a controller that is configured."""
    found = controller.step(order, seen, state, now_ns)
    assert found is not None
    return found


def test_before_the_vehicle_is_known_no_stick_is_offered_and_no_stop_is_promised() -> None:
    controller = StickController(Governor(LIMITS), lambda model: VelocityTuning())
    assert controller.step(order(), SEEN, VehicleState(), 9 * S) is None
    assert controller.stopping_distance_m(1.0, 2.0) == float("inf")


class Flight:
    """A mission that always wants 5 m/s along a course, frames at 5 Hz, against a plant stepped every millisecond."""

    def __init__(
        self,
        course_rad: float,
        wall_m: float = math.inf,
        yaw_rad: float | None = None,
        limits: GovernorLimits = LIMITS,
        seen: DepthSummary = SEEN,
        speed_m_s: float = 5.0,
    ) -> None:
        self.controller = configured(limits)
        self.plant = LoiterPlant(5.0, MODEL.lean_max_rad, 0.2)
        self.plant.yaw = course_rad if yaw_rad is None else yaw_rad
        self.way = (math.cos(course_rad), math.sin(course_rad))
        self.wall_m, self.seen, self.speed_m_s = wall_m, seen, speed_m_s
        self.speeds: list[float] = []
        self.told: list[tuple[Sticks, Governed]] = []

    def along(self, of: list[float]) -> float:
        return of[0] * self.way[0] + of[1] * self.way[1]

    def vehicle(self, now_ns: int) -> VehicleState:
        plant = self.plant
        return VehicleState(
            position_t_ns=now_ns, yaw_rad=plant.yaw, p_ned_m=(plant.p[0], plant.p[1], -1.5),
            v_ned_m_s=(plant.v[0], plant.v[1], 0.0), height_m=1.5, height_t_ns=now_ns,
        )  # fmt: skip

    def fly(self, seconds: float, dies_s: float = math.inf) -> Flight:
        """Fly; after `dies_s` the last sticks are held for a second, then they are neutral."""
        for ms in range(round(seconds * 1000)):
            now_ns = 100 * S + ms * MS
            state = self.vehicle(now_ns)
            if ms % FRAME_MS == 0:
                v = (self.speed_m_s * self.way[0], self.speed_m_s * self.way[1], 0.0)
                order = MissionCommand(
                    seq=1, t_ns=now_ns, expires_ns=now_ns + S, intent=Intent.FLY, reason=None, v_ned_m_s=v,
                    yaw_rad=None, height_m=None, baseline_m=0.2,
                    clear_m=min(30.0, self.wall_m - self.along(self.plant.p)),
                    p_measured_ned_m=state.p_ned_m,
                )  # fmt: skip
            if ms % 20 == 0 and ms < dies_s * 1000:
                self.told.append(stepped(self.controller, order, self.seen, state, now_ns))
            sticks = self.told[-1][0]
            if ms < (dies_s + 1.0) * 1000:
                n = -MODEL.pitch.deflection(sticks.pitch_us), MODEL.roll.deflection(sticks.roll_us)
            else:
                n = 0.0, 0.0
            self.plant.step_ms(*n)
            self.speeds.append(self.along(self.plant.v))
        return self

    @property
    def left_m(self) -> float:
        return self.wall_m - self.along(self.plant.p)


@pytest.mark.parametrize("course", COURSES)
def test_before_a_wall_that_nothing_else_slows_for_it_slows_and_stops(course: str) -> None:
    flight = Flight(COURSES[course], wall_m=9.0).fly(10.0)
    assert max(flight.speeds) > 1.5, "it flies"
    assert 0.1 < flight.left_m < 1.0, "and stops before the wall, not far from it"
    assert abs(flight.speeds[-1]) < 0.1


def test_flying_backwards_it_stops_as_well() -> None:
    flight = Flight(0.0, wall_m=7.0, yaw_rad=math.pi).fly(9.0)
    assert 0.1 < flight.left_m < 1.0
    assert abs(flight.speeds[-1]) < 0.1


@pytest.mark.parametrize("dies_s", [1.0, 1.7, 2.4, 4.0])
def test_a_daemon_that_dies_at_any_moment_leaves_a_vehicle_that_stops_before_the_wall(dies_s: float) -> None:
    flight = Flight(0.7, wall_m=9.0).fly(dies_s + 5.0, dies_s)
    assert flight.left_m > 0.0
    assert abs(flight.speeds[-1]) < 0.1


def test_from_a_stand_beside_something_near_the_first_sticks_are_small() -> None:
    flight = Flight(0.3, wall_m=1.5).fly(0.4)
    for sticks, found in flight.told:
        held = math.hypot(*MODEL.speed_for_sticks(sticks.roll_us, sticks.pitch_us, 1.5))
        # a microsecond of stick is less than 0.02 m/s
        assert held <= found.stick_limit_m_s + 0.03
    # full lean would settle at 5 m/s
    assert 0.1 < max(found.stick_limit_m_s for _, found in flight.told) < 1.6


@pytest.mark.parametrize(
    ("limits", "seen", "bound"),
    [
        (replace(LIMITS, max_speed_m_s=1.2), SEEN, "cap"),
        (LIMITS, replace(SEEN, baseline_m=0.02, baseline_sigma_m=0.0), "trust"),
        (replace(LIMITS, sync_error_s=0.002), replace(SEEN, nearest_m=1.5), "sync"),
    ],
)
def test_in_free_space_it_settles_at_the_speed_of_each_bound(
    limits: GovernorLimits, seen: DepthSummary, bound: str
) -> None:
    flight = Flight(1.0, limits=limits, seen=seen).fly(6.0)
    found = flight.told[-1][1]
    assert found.bound == bound
    assert 0.5 < found.limit_m_s < 2.5
    # between two frames the way flown takes up to 0.3 m off what is trusted
    assert flight.speeds[-1] == pytest.approx(found.limit_m_s, rel=0.12)


def test_a_speed_within_the_limit_is_flown_as_wanted() -> None:
    flight = Flight(2.0, speed_m_s=1.0).fly(6.0)
    assert flight.speeds[-1] == pytest.approx(1.0, abs=0.05)
    assert flight.told[-1][1].wanted_m_s == pytest.approx(1.0)


STEADY = VehicleState(
    position_t_ns=9 * S, p_ned_m=(0.0, 0.0, -1.5), v_ned_m_s=(2.0, 0.0, 0.0), height_m=1.5, height_t_ns=9 * S
)


def order(**changes: object) -> MissionCommand:
    base = MissionCommand(
        seq=1, t_ns=9 * S, expires_ns=10 * S, intent=Intent.FLY, reason=None, v_ned_m_s=(2.0, 0.0, 0.0), yaw_rad=None,
        height_m=None, baseline_m=0.2, clear_m=30.0, p_measured_ned_m=(0.0, 0.0, -1.5),
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


def sticks(changed: MissionCommand, state: VehicleState = STEADY) -> Sticks:
    controller = configured(LIMITS)
    return stepped(controller, changed, SEEN, state, 9 * S)[0]


def test_height_heading_climb_and_line_of_the_command_reach_the_sticks() -> None:
    plain = sticks(order())
    assert sticks(order(height_m=2.5)).throttle_us > plain.throttle_us == 1500
    assert sticks(order(v_ned_m_s=(2.0, 0.0, -0.4))).throttle_us > 1500
    assert sticks(order(yaw_rad=0.5)).yaw_us > plain.yaw_us == 1500
    assert sticks(order(line=Line(9 * S, (5.0, 1.0, -1.5), gain_1_s=1.0))).roll_us > plain.roll_us
    coasting = sticks(order(coast=True))
    assert (coasting.roll_us, coasting.pitch_us) == (1500, 1500)


def test_the_governor_slows_the_way_over_the_ground_and_not_the_climb() -> None:
    before_a_wall = sticks(order(clear_m=0.1, v_ned_m_s=(2.0, 0.0, -0.4)))
    assert before_a_wall.throttle_us > 1500
    assert before_a_wall.pitch_us >= 1500


@pytest.mark.parametrize("turned_rad", [0.0, 1.0, math.pi])
def test_of_a_stick_only_what_pushes_along_the_motion_is_taken(turned_rad: float) -> None:
    """Slow enough already, but wanting more along the motion and sideways: the way sideways stays."""
    state = replace(STEADY, yaw_rad=turned_rad, v_ned_m_s=(0.4, 0.0, 0.0))
    controller = configured(LIMITS)
    found, told = stepped(controller, order(clear_m=1.8, v_ned_m_s=(0.2, 0.9, 0.0)), SEEN, state, 9 * S)
    forward, right = MODEL.speed_for_sticks(found.roll_us, found.pitch_us, 1.5)
    cos, sin = math.cos(turned_rad), math.sin(turned_rad)
    north, east = cos * forward - sin * right, sin * forward + cos * right
    assert north <= told.stick_limit_m_s + 0.03
    assert east > 0.3


def test_what_the_loop_has_learned_is_forgotten_when_the_sticks_were_not_ours() -> None:
    def last(controller: StickController, steps: int, before: Callable[[int], None]) -> Sticks:
        for k in range(steps):
            before(k)
            now_ns = 9 * S + k * 20 * MS
            state = replace(STEADY, position_t_ns=now_ns, v_ned_m_s=(1.0, -0.5, 0.0))
            held, _ = stepped(controller,
                order(t_ns=now_ns, line=Line(now_ns, (5.0, 1.0, -1.5), gain_1_s=0.5, integral_1_s2=1.0)),
                SEEN, state, now_ns,
            )  # fmt: skip
        return held

    def controller() -> StickController:
        return configured(LIMITS)

    worn = controller()
    fresh = replace(last(controller(), 1, lambda k: None), t_ns=0, expires_ns=0)
    tired = last(worn, 60, lambda k: None)
    assert (tired.roll_us, tired.pitch_us) != (fresh.roll_us, fresh.pitch_us)
    worn.reset()
    assert replace(last(worn, 1, lambda k: None), t_ns=0, expires_ns=0) == fresh


def test_a_command_to_stand_still_is_neutral_sticks() -> None:
    held = sticks(order(v_ned_m_s=(0.0, 0.0, 0.0)))
    assert (held.roll_us, held.pitch_us) == (1500, 1500)


def test_a_stick_against_the_motion_is_left_as_strong_as_it_is() -> None:
    """Flying north near something and asked to go south: the stick that brakes is not turned into one that pushes."""
    controller = configured(LIMITS)
    state = replace(STEADY, v_ned_m_s=(0.6, 0.0, 0.0))
    held, told = stepped(controller, order(clear_m=1.2, v_ned_m_s=(-3.0, 0.0, 0.0)), SEEN, state, 9 * S)
    forward, _ = MODEL.speed_for_sticks(held.roll_us, held.pitch_us, 1.5)
    assert forward < -told.stick_limit_m_s
    assert forward < -0.1
