"""The governor: for any command the vehicle can stop within free space and trusted range."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.control.governor import Governor, GovernorLimits, trust_range_m
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.messages.core import DepthSummary, Intent, MissionCommand, VehicleState
from morpheyes_daemon.simulation.autopilot.parameters import RECOMMENDED, ParameterTable

MODEL = LoiterModel.from_parameters(dict(ParameterTable(RECOMMENDED)))
LIMITS = GovernorLimits(
    dead_daemon_s=1.0,
    depth_sigmas=3.0,
    max_relative_depth_error=0.2,
    max_speed_m_s=4.0,
    sync_error_s=0.002,
    image_width_px=320,
)
SEEN = DepthSummary(1, 0, 0, 0.2, 0.0005, 370.0, 0.8, 0.25, 0.9, 0.9, 0.0, 2.0, 0.02, "hash")


def command(clear_m: float, speed: float = 4.0) -> MissionCommand:
    return MissionCommand(
        1, 0, 10**9, Intent.FLY, None, (speed, 0.0, 0.0), 0.0, 1.5, 0.2, clear_m, (0.0, 0.0, -1.5), clear_m
    )


def flying(speed: float, flown_m: float = 0.0) -> VehicleState:
    return VehicleState(p_ned_m=(flown_m, 0.0, -1.5), v_ned_m_s=(speed, 0.0, 0.0), height_m=1.5)


@given(st.floats(0.0, 40.0), st.floats(0.0, 5.0), st.floats(0.0, 6.0))
def test_it_always_leaves_room_to_stop_after_the_daemons_death(clear: float, speed: float, flown: float) -> None:
    governed = Governor(LIMITS).limit(command(clear), SEEN, flying(speed, flown), MODEL, 0)
    room_m = min(clear, governed.trust_m) - flown - 0.15
    needed = MODEL.stopping_distance_m(governed.limit_m_s, 1.5, 1.0)
    assert needed <= max(0.0, room_m) + 1e-6
    # and it wastes none of it: the fastest that fits, up to the cap and the time between the cameras
    faster = min(governed.limit_m_s + 0.01, MODEL.speed_for_distance_m(100.0, 1.5, 1.0))
    spends_all = MODEL.stopping_distance_m(faster, 1.5, 1.0) > room_m
    assert spends_all or governed.bound in ("cap", "sync")


@given(st.floats(0.0, 12.0), st.floats(0.0, 4.0))
def test_a_stick_held_by_a_dead_daemon_still_leaves_room_to_stop(clear: float, speed: float) -> None:
    governed = Governor(LIMITS).limit(command(clear), SEEN, flying(speed), MODEL, 0)
    stick, tau = governed.stick_limit_m_s, MODEL.time_constant_s(1.5)

    def way_to_a_stop_m(stick_m_s: float) -> float:
        """Held for a second, in steps of 2 ms, then neutral."""
        v, way = speed, 0.0
        for _ in range(500):
            v += (stick_m_s - v) / tau * 0.002
            way += v * 0.002
        return way + MODEL.stopping_distance_m(v, 1.5)

    # the steps' own error is half of one of them at the fastest change, 4 m/s in 1.2 s; ten halvings leave 0.01 m/s
    if stick > 0.0:
        assert way_to_a_stop_m(stick) <= clear - 0.15 + 0.02
    else:
        assert way_to_a_stop_m(0.02) > clear - 0.15 - 0.02


@given(st.floats(0.0, 30.0), st.floats(0.0, 5.0))
def test_more_free_distance_never_means_slower(clear: float, more: float) -> None:
    governor = Governor(LIMITS)
    less = governor.limit(command(clear), SEEN, flying(1.0), MODEL, 0).limit_m_s
    assert governor.limit(command(clear + more), SEEN, flying(1.0), MODEL, 0).limit_m_s >= less - 1e-9


@pytest.mark.parametrize("clear", [math.nan, -math.inf, -1.0, 0.0])
def test_invalid_or_no_free_distance_means_standing_still(clear: float) -> None:
    governed = Governor(LIMITS).limit(command(clear), SEEN, flying(1.0), MODEL, 0)
    assert governed.limit_m_s == 0.0
    assert governed.stick_limit_m_s < 0.01


def test_trusted_range_ends_where_three_sigmas_are_a_fifth_of_the_depth() -> None:
    z = trust_range_m(SEEN, 3.0, 0.2)
    sigma = math.hypot(z * z * 0.25 / (0.2 * 370.0), z * 0.0005 / 0.2)
    assert 3.0 * sigma / z == pytest.approx(0.2, rel=1e-9)


def test_an_unknown_baseline_has_no_trusted_range() -> None:
    assert trust_range_m(replace(SEEN, baseline_sigma_m=0.05), 3.0, 0.2) == 0.0


def test_a_time_offset_of_the_cameras_slows_down_near_obstacles() -> None:
    slow = Governor(replace(LIMITS, sync_error_s=0.02))
    governed = slow.limit(replace(command(40.0), z_close_m=2.0), SEEN, flying(1.0), MODEL, 0)
    assert governed.bound == "sync"
    speed, found = governed.limit_m_s, []
    for x_m, forward in [(0.0, 0.0), (-0.86, 1.0), (0.86, 1.0)]:
        # a point 2 m ahead, in the middle or at an edge; the right camera exposes 20 ms later from where it is then
        along, across = 0.02 * speed * forward, 0.02 * speed * (1.0 - forward)
        u_left, u_right = 370.0 * x_m / 2.0, 370.0 * (x_m - 0.2 - across) / (2.0 - along)
        found.append(abs(u_left - u_right - 370.0 * 0.2 / 2.0))
    # the worst is a pixel off: sideways, exactly
    assert max(found) == pytest.approx(1.0, abs=1e-6)
