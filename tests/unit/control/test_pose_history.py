"""The pose history gives an image the attitude and position of its own moment."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.messages.core import VehicleState


def state(t_s: float, turn: float, **more: object) -> VehicleState:
    """A state whose values follow `turn`, attitude a tenth of a second before position."""
    return VehicleState(
        attitude_t_ns=round((t_s - 0.1) * S), roll_rad=0.1 * turn, pitch_rad=-0.2 * turn, yaw_rad=0.3 * turn,
        rates_frd_rad_s=(turn, 2 * turn, 3 * turn), position_t_ns=round(t_s * S),
        p_ned_m=(turn, -turn, 5 * turn), v_ned_m_s=(4 * turn, turn, -turn), **more,  # type: ignore[arg-type]
    )  # fmt: skip


def test_between_two_states_each_group_is_interpolated_by_its_own_stamp() -> None:
    history = PoseHistory()
    history.add(state(1.0, 0.0))
    history.add(state(2.0, 2.0))
    between = history.at(round(1.25 * S))
    # positions a quarter of the way, attitudes 0.35 of it
    assert between.p_ned_m == pytest.approx((0.5, -0.5, 2.5))
    assert between.v_ned_m_s == pytest.approx((2.0, 0.5, -0.5))
    assert (between.roll_rad, between.pitch_rad, between.yaw_rad) == pytest.approx((0.07, -0.14, 0.21))
    assert between.rates_frd_rad_s == pytest.approx((0.7, 1.4, 2.1))


def test_yaw_roll_and_pitch_take_the_short_way_round() -> None:
    history = PoseHistory()
    history.add(replace(state(1.0, 0.0), yaw_rad=3.0, roll_rad=-3.0))
    history.add(replace(state(2.0, 0.0), yaw_rad=-3.0, roll_rad=3.0))
    between = history.at(round(1.4 * S))
    assert abs(between.yaw_rad) == pytest.approx(math.pi)
    assert abs(between.roll_rad) == pytest.approx(math.pi)


def test_outside_of_what_is_known_the_nearest_end_counts() -> None:
    history = PoseHistory()
    for k in range(3):
        history.add(state(1.0 + k, float(k)))
    assert history.at(0).p_ned_m == (0.0, 0.0, 0.0)
    assert history.at(0).yaw_rad == 0.0
    late = history.at(9 * S)
    assert late.p_ned_m == (2.0, -2.0, 10.0)
    assert late.yaw_rad == pytest.approx(0.6)
    assert history.at(2 * S).p_ned_m == pytest.approx((1.0, -1.0, 5.0)), "a known moment as it was"


def test_what_is_no_pose_is_that_of_the_latest_state() -> None:
    history = PoseHistory()
    history.add(state(1.0, 0.0, armed=False, battery_v=11.0))
    history.add(state(2.0, 1.0, armed=True, battery_v=12.0))
    between = history.at(round(1.5 * S))
    assert between.armed
    assert between.battery_v == 12.0


def test_a_group_that_is_no_newer_is_not_stored_again_but_its_state_is_the_latest() -> None:
    history = PoseHistory()
    history.add(state(1.0, 0.0))
    history.add(state(2.0, 2.0))
    again = replace(state(2.0, 50.0), height_m=3.0)
    history.add(again)
    assert history.at(round(1.5 * S)).p_ned_m == pytest.approx((1.0, -1.0, 5.0))
    assert history.at(3 * S).yaw_rad == pytest.approx(0.6)
    assert history.latest is again
    # a newer position with an old attitude is stored as a position alone
    history.add(replace(state(3.0, 4.0), attitude_t_ns=0, yaw_rad=9.0))
    assert history.at(3 * S).p_ned_m == pytest.approx((4.0, -4.0, 20.0))
    assert history.at(3 * S).yaw_rad == pytest.approx(0.6)


def test_before_anything_is_known_the_state_is_empty() -> None:
    history = PoseHistory()
    assert history.at(5 * S) is history.latest
    assert history.now(5 * S).p_ned_m == (0.0, 0.0, 0.0)
    assert history.latest.t_ns == 0


def test_now_carries_the_position_on_by_its_velocity_for_half_a_second_at_most() -> None:
    history = PoseHistory()
    moving = VehicleState(position_t_ns=S, p_ned_m=(1.0, 2.0, -3.0), v_ned_m_s=(2.0, -4.0, 1.0))
    history.add(moving)
    assert history.now(S + 200 * MS).p_ned_m == pytest.approx((1.4, 1.2, -2.8))
    assert history.now(5 * S).p_ned_m == pytest.approx((2.0, 0.0, -2.5))
    assert history.now(S - 100 * MS).p_ned_m == (1.0, 2.0, -3.0)
    history = PoseHistory()
    history.add(replace(moving, position_t_ns=0))
    assert history.now(S).p_ned_m == (1.0, 2.0, -3.0), "a position that never came is not carried on"


def test_what_is_older_than_four_hundred_states_is_forgotten() -> None:
    history = PoseHistory()
    for k in range(500):
        history.add(state(1.0 + 0.01 * k, float(k)))
    assert history.at(0).p_ned_m[0] == 100.0
