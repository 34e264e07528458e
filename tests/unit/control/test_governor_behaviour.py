"""Each bound of the governor by a vehicle whose braking has a closed form: figures by hand, in every direction."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from morpheyes_daemon.config.vehicle import NoServoConfig, SafetyConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.control.governor import Governor, GovernorLimits, trust_range_m
from morpheyes_daemon.control.limits import governor_limits
from morpheyes_daemon.messages.core import DepthSummary, Governed, Intent, MissionCommand, VehicleState

TAU_S = 0.5
DIRECTIONS = [(1.0, 0.0), (0.0, 1.0), (0.6, 0.8), (-1.0, 0.0), (0.0, -1.0), (-0.8, 0.6)]


class SteadyBrake:
    """Stops with 2 m/s2 from a metre above the ground on, with 1 m/s2 below."""

    def deceleration_m_s2(self, height_m: float) -> float:
        return 2.0 if height_m >= 1.0 else 1.0

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        return speed_m_s**2 / (2.0 * self.deceleration_m_s2(height_m)) + speed_m_s * reaction_s

    def speed_for_distance_m(self, distance_m: float, height_m: float, reaction_s: float = 0.0) -> float:
        a = self.deceleration_m_s2(height_m)
        return a * (math.sqrt(reaction_s**2 + 2.0 * distance_m / a) - reaction_s) if distance_m > 0.0 else 0.0

    def time_constant_s(self, height_m: float) -> float:
        return TAU_S


LIMITS = GovernorLimits(
    dead_daemon_s=1.0, depth_sigmas=3.0, max_relative_depth_error=0.3, max_speed_m_s=50.0,
    sync_error_s=0.0, image_width_px=320,
)  # fmt: skip
SEEN = DepthSummary(1, 0, 0, 0.2, 0.0, 500.0, 0.8, 0.1, 0.9, 0.9, 0.0, 2.0, 0.02, "hash")
"""Trusted to b f / sigma_d * 0.3 / 3 = 0.2 * 500 / 0.1 * 0.1 = 100 m."""


def command(clear_m: float, v: tuple[float, float] = (4.0, 0.0), z_close_m: float = math.nan) -> MissionCommand:
    return MissionCommand(
        seq=1, t_ns=0, expires_ns=10**9, intent=Intent.FLY, reason=None, v_ned_m_s=(*v, 0.0), yaw_rad=0.0,
        height_m=1.5, baseline_m=0.2, clear_m=clear_m, p_measured_ned_m=(10.0, 20.0, -1.5),
        z_close_m=z_close_m,
    )  # fmt: skip


def vehicle(v: tuple[float, float] = (0.0, 0.0), flown: tuple[float, float] = (0.0, 0.0)) -> VehicleState:
    return VehicleState(p_ned_m=(10.0 + flown[0], 20.0 + flown[1], -9.0), v_ned_m_s=(*v, 3.0), height_m=1.5)


def governed(
    order: MissionCommand,
    state: VehicleState | None = None,
    limits: GovernorLimits = LIMITS,
    seen: DepthSummary = SEEN,
    height_m: float = 1.5,
) -> Governed:
    return Governor(limits).limit(order, seen, replace(state or vehicle(), height_m=height_m), SteadyBrake(), 7)


def test_what_is_seen_to_be_free_bounds_the_speed_less_a_standoff_of_fifteen_centimetres() -> None:
    # 3.15 m clear leave 3 m: v + v^2/4 = 3 at v = 2
    found = governed(command(3.15))
    assert (found.bound, found.t_ns) == ("clear", 7)
    assert found.limit_m_s == pytest.approx(2.0)


def test_the_standoff_is_kept_even_where_nothing_else_is_left() -> None:
    assert governed(command(0.15)).limit_m_s == 0.0
    assert governed(command(0.16)).limit_m_s > 0.0


def test_depth_that_is_not_trusted_bounds_the_speed_however_much_is_free() -> None:
    # a tenth of the baseline is trusted to 10 m, 9.85 m of it less the standoff: v + v^2/4 = 9.85
    found = governed(command(60.0), seen=replace(SEEN, baseline_m=0.02))
    assert found.bound == "trust"
    assert found.trust_m == pytest.approx(10.0)
    assert found.limit_m_s == pytest.approx(2.0 * (math.sqrt(10.85) - 1.0))


def test_the_configured_speed_is_the_last_bound() -> None:
    found = governed(command(60.0), limits=replace(LIMITS, max_speed_m_s=1.25))
    assert (found.bound, found.limit_m_s) == ("cap", 1.25)


def test_the_time_between_the_cameras_bounds_the_speed_by_the_nearest_in_the_corridor_or_else_in_view() -> None:
    late = replace(LIMITS, sync_error_s=0.01)
    # forwards, at the image's edge: k Z / (W/2 + b f / Z + k) / dt = 4 / (160 + 25 + 1) / 0.01
    for order, seen in [
        (command(60.0, z_close_m=4.0), SEEN),
        (command(60.0), replace(SEEN, nearest_m=4.0)),
    ]:
        found = governed(order, limits=late, seen=seen)
        assert found.bound == "sync"
        # sideways 4 / 500 / 0.01 is less than forwards 2.15
        assert found.limit_m_s == pytest.approx(0.8)
    wide = replace(late, image_width_px=2000)
    assert governed(command(60.0, z_close_m=4.0), limits=wide).limit_m_s == pytest.approx(4.0 / 1026.0 / 0.01)


@pytest.mark.parametrize("nearest_m", [math.inf, math.nan, 0.0, -1.0])
def test_with_nothing_near_the_time_between_the_cameras_bounds_nothing(nearest_m: float) -> None:
    late = replace(LIMITS, sync_error_s=0.01, max_speed_m_s=1.0)
    found = governed(command(60.0, z_close_m=nearest_m), limits=late, seen=replace(SEEN, nearest_m=nearest_m))
    assert found.limit_m_s == 1.0


def test_cameras_that_expose_together_bound_nothing() -> None:
    assert governed(command(60.0, z_close_m=0.1)).bound == "clear"


@pytest.mark.parametrize("way", DIRECTIONS)
def test_the_way_flown_since_the_image_is_taken_off_in_every_direction(way: tuple[float, float]) -> None:
    # 4.15 m clear then, 1 m flown
    found = governed(command(4.15), vehicle(flown=way))
    assert found.limit_m_s == pytest.approx(2.0)
    assert found.clear_m == pytest.approx(3.15)
    seen = replace(SEEN, baseline_m=0.02)
    assert governed(command(60.0), vehicle(flown=way), seen=seen).limit_m_s == pytest.approx(
        2.0 * (math.sqrt(9.85) - 1.0)
    )


@pytest.mark.parametrize("way", DIRECTIONS)
def test_speed_and_wish_are_told_in_every_direction_without_the_climb(way: tuple[float, float]) -> None:
    found = governed(command(9.0, (3.0 * way[0], 3.0 * way[1])), vehicle((2.0 * way[0], 2.0 * way[1])))
    assert found.wanted_m_s == pytest.approx(3.0)
    assert found.speed_m_s == pytest.approx(2.0)


def test_low_over_the_ground_where_it_brakes_worse_it_flies_slower() -> None:
    low = governed(command(3.15), height_m=0.5)
    assert low.limit_m_s == pytest.approx(math.sqrt(7.0) - 1.0)
    assert low.stick_limit_m_s < governed(command(3.15)).stick_limit_m_s


@pytest.mark.parametrize("bad", ["clear", "trust", "place", "cap"])
def test_an_input_that_is_no_number_stops_the_vehicle_whichever_it_is(bad: str) -> None:
    nan = math.nan
    order = command(nan if bad == "clear" else 9.0)
    seen = replace(SEEN, f_px=nan) if bad == "trust" else SEEN
    state = vehicle(flown=(nan, 0.0)) if bad == "place" else vehicle()
    limits = replace(LIMITS, max_speed_m_s=nan) if bad == "cap" else LIMITS
    assert governed(order, state, limits, seen).limit_m_s == 0.0


def after_a_held_stick(stick_m_s: float, speed_m_s: float) -> tuple[float, float]:
    """Speed after, and way to a stop, of a stick held for a second by a daemon that died: steps of 0.1 ms."""
    v, way, dt = speed_m_s, 0.0, 1e-4
    for _ in range(10_000):
        v += (stick_m_s - v) / TAU_S * dt
        way += v * dt
    return v, way + SteadyBrake().stopping_distance_m(v, 1.5)


@pytest.mark.parametrize(("clear_m", "speed_m_s"), [(3.15, 0.0), (3.15, 1.5), (8.0, 2.5), (1.2, 0.2)])
def test_the_stick_is_as_strong_as_a_dead_daemon_may_leave_it_and_no_stronger(clear_m: float, speed_m_s: float) -> None:
    found = governed(command(clear_m), vehicle((0.0, speed_m_s)))
    after, way = after_a_held_stick(found.stick_limit_m_s, speed_m_s)
    # the reference's steps, 1e-4 of the speed
    assert way <= clear_m - 0.15 + 1e-3
    assert after <= found.limit_m_s + 1e-3
    # ten halvings of at most 2.9 m/s, times the second it is held
    after, way = after_a_held_stick(found.stick_limit_m_s + 0.02, speed_m_s)
    assert way > clear_m - 0.15 or after > found.limit_m_s


def test_too_fast_already_the_stick_is_neutral() -> None:
    assert governed(command(3.15), vehicle((9.0, 0.0))).stick_limit_m_s == 0.0


def test_a_stick_may_not_lead_beyond_the_cap_either() -> None:
    limits = replace(LIMITS, max_speed_m_s=1.0)
    found = governed(command(60.0), vehicle((0.5, 0.0)), limits)
    after, _ = after_a_held_stick(found.stick_limit_m_s, 0.5)
    assert after == pytest.approx(1.0, abs=5e-3)


def test_trust_takes_disparity_and_baseline_into_account() -> None:
    # share 0.1, a sigma of the baseline of 6 % of it: sqrt(0.01 - 0.0036) = 0.08
    assert trust_range_m(replace(SEEN, baseline_sigma_m=0.012), 3.0, 0.3) == pytest.approx(80.0)
    assert trust_range_m(replace(SEEN, sigma_disparity_px=0.2), 3.0, 0.3) == pytest.approx(50.0)
    assert trust_range_m(replace(SEEN, baseline_sigma_m=0.02), 3.0, 0.3) == pytest.approx(0.0, abs=1e-4)
    assert trust_range_m(replace(SEEN, baseline_sigma_m=0.03), 3.0, 0.3) == 0.0


def test_the_bounds_are_those_of_the_configuration() -> None:
    config = VehicleConfig(
        camera=SimCameraConfig(width_px=480, sync_error_ms=3.0),
        servo=NoServoConfig(backend="none"),
        safety=SafetyConfig(dead_daemon_s=1.4, depth_sigmas=2.0, max_relative_depth_error=0.25, max_speed_m_s=3.5),
    )
    assert governor_limits(config) == GovernorLimits(
        dead_daemon_s=1.4, depth_sigmas=2.0, max_relative_depth_error=0.25, max_speed_m_s=3.5,
        sync_error_s=0.003, image_width_px=480, sync_tolerance_px=1.0, standoff_m=0.15,
    )  # fmt: skip


@pytest.mark.parametrize("dead_s", [0.5, 1.6])
def test_the_stick_is_held_as_long_as_a_dead_daemon_leaves_it(dead_s: float) -> None:
    limits = replace(LIMITS, dead_daemon_s=dead_s)
    found = governed(command(3.15), vehicle((1.0, 0.0)), limits)
    stick = found.stick_limit_m_s

    def way_and_speed(stick_m_s: float) -> tuple[float, float]:
        v, way, dt = 1.0, 0.0, 1e-4
        for _ in range(round(dead_s * 1e4)):
            v += (stick_m_s - v) / TAU_S * dt
            way += v * dt
        return way + v**2 / 4.0, v

    # the reference's steps; ten halvings
    way, after = way_and_speed(stick)
    assert way <= 3.0 + 1e-3
    assert after <= found.limit_m_s + 1e-3
    way, after = way_and_speed(stick + 0.03)
    assert way > 3.0 or after > found.limit_m_s


def test_the_time_between_the_cameras_counts_within_a_metre_as_well() -> None:
    late = replace(LIMITS, sync_error_s=0.01)
    found = governed(command(60.0, z_close_m=0.8), limits=late)
    # 0.8 / (160 + 0.2 * 500 / 0.8 + 1) / 0.01, less than sideways 0.16
    assert found.limit_m_s == pytest.approx(min(0.8 / 286.0, 0.8 / 500.0) / 0.01)
