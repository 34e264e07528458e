"""Observe, pursue, dodge: velocity, heading and baseline that the moving-object mission commands."""

import math
from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Intent, MissionCommand, Track, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.strategies.imo.behaviours import (
    Dodge,
    ObjectState,
    Pursue,
    closest_approach,
    evasion_direction,
    pursuit_velocity,
)
from morpheyes_daemon.strategies.imo.strategy import Imo, ImoParameters, ImoPercept
from tests.support.seen_from_above import CRAFT, SUMMARY, empty_profile


def moving(p: tuple[float, float, float], v: tuple[float, float, float], sigma: float = 0.0) -> ObjectState:
    return ObjectState(np.array(p), np.array(v), np.eye(6) * sigma**2, 0.2)


def test_pursuit_keeps_the_distance_and_matches_the_objects_speed() -> None:
    pursue = Pursue(kind="pursue", distance_m=3.0)
    origin = np.zeros(3)
    assert np.allclose(pursuit_velocity(moving((3.0, 0, 0), (0, 0, 0)), origin, pursue), 0.0)
    assert np.allclose(pursuit_velocity(moving((3.0, 0, 0), (0.7, 0, 0)), origin, pursue), (0.7, 0.0))
    assert pursuit_velocity(moving((5.0, 0, 0), (0, 0, 0)), origin, pursue)[0] == pytest.approx(0.8 * 2.0)
    assert pursuit_velocity(moving((2.0, 0, 0), (0, 0, 0)), origin, pursue)[0] < 0.0
    # across the line of sight the vehicle yaws and does not move
    assert np.allclose(pursuit_velocity(moving((3.0, 0, 0), (0, 1.0, 0)), origin, pursue), 0.0)


def test_the_closest_approach_has_its_time_and_distance() -> None:
    approach = closest_approach(moving((4.0, 0.3, 0), (-1.0, 0.0, 0)), np.zeros(3), 10.0)
    assert approach is not None
    assert approach.in_s == pytest.approx(4.0)
    assert approach.distance_m == pytest.approx(0.3)
    assert closest_approach(moving((4.0, 0.0, 0), (1.0, 0, 0)), np.zeros(3), 10.0) is None


def test_the_spread_of_a_predicted_path_grows_with_time() -> None:
    sure = moving((4.0, 0.0, 0), (-1.0, 0, 0), sigma=0.1)
    # position and velocity, 0.1 each, four seconds ahead
    assert sure.spread_m(4.0) == pytest.approx(math.hypot(0.1, 0.4))


def test_evasion_is_across_the_path_and_away_from_it() -> None:
    approaching = moving((4.0, 0.2, 0), (-1.0, 0.0, 0))
    approach = closest_approach(approaching, np.zeros(3), 10.0)
    assert approach is not None
    out = evasion_direction(approach, approaching)
    assert np.allclose(out, (0.0, -1.0))  # it passes east of us, so west


def track(p: tuple[float, float, float], v: tuple[float, float, float], depth_m: float) -> Track:
    return Track(1, 10 * S, 1, True, p, v, np.eye(6) * 1e-4, (0.0, 0.0, depth_m), 0.2, 500, 0.1)


def decide(imo: Imo, found: Track | None, at_s: float = 10.0, engaged: bool = True) -> MissionCommand:
    vehicle = VehicleState(t_ns=round(at_s * S), position_t_ns=round(at_s * S), p_ned_m=(0.0, 0.0, -1.5), height_m=1.5)
    percept = ImoPercept(found, 100, 10, empty_profile(0.0))
    return imo.decide(Observation(round(at_s * S), percept, SUMMARY, vehicle, vehicle, 0.1, 0.5, 0.5, engaged))


def mission(**parameters: object) -> Imo:
    return Imo(ImoParameters.model_validate(parameters), CRAFT)


def test_the_baseline_follows_the_median_depth_and_stays_when_the_object_is_lost() -> None:
    imo = mission(baseline_gain=0.04)
    assert decide(imo, None).baseline_m == 0.1
    assert decide(imo, track((6.0, 0, -1.5), (0, 0, 0), 5.9)).baseline_m == pytest.approx(0.04 * 5.9)
    assert decide(imo, None).baseline_m == pytest.approx(0.04 * 5.9)
    assert decide(imo, track((16.0, 0, -1.5), (0, 0, 0), 15.0)).baseline_m == 0.3


def test_it_yaws_only_when_the_object_is_off_the_centre() -> None:
    imo = mission()
    decide(imo, None, engaged=False)
    assert decide(imo, track((5.0, 0.2, -1.5), (0, 0, 0), 5.0)).yaw_rad == pytest.approx(0.0)
    assert decide(imo, track((5.0, 1.5, -1.5), (0, 0, 0), 5.0)).yaw_rad == pytest.approx(math.atan2(1.5, 4.91), abs=0.01)


def test_observing_stays_and_ends_after_its_duration() -> None:
    imo = mission(duration_s=5.0)
    decide(imo, None, 9.0, engaged=False)
    watching = decide(imo, track((5.0, 0, -1.5), (1.0, 0, 0), 5.0), 10.0)
    assert watching.intent is Intent.FLY
    assert watching.v_ned_m_s == (0.0, 0.0, 0.0)
    assert decide(imo, None, 14.5).intent is Intent.DONE


def test_pursuit_is_bounded_by_visible_free_space() -> None:
    imo = mission(behaviour={"kind": "pursue", "distance_m": 2.0})
    decide(imo, None, 9.0, engaged=False)
    seen = decide(imo, track((6.0, 0, -1.5), (0, 0, 0), 5.9))
    assert seen.v_ned_m_s[0] > 0.5
    assert seen.clear_m > 5.0
    # the camera does not see backwards
    assert decide(imo, track((1.2, 0, -1.5), (-0.5, 0, 0), 1.1)).clear_m == 0.0


def test_dodging_stays_within_the_declared_free_radius() -> None:
    imo = mission(behaviour=Dodge(kind="dodge").model_dump(), free_radius_m=2.0)
    decide(imo, None, 9.0, engaged=False)
    coming = track((3.0, 0.05, -1.5), (-1.0, 0.0, 0.0), 2.9)
    aside = decide(imo, coming)
    assert aside.v_ned_m_s[1] < -0.5
    assert abs(aside.v_ned_m_s[0]) < 0.1
    assert 1.5 < aside.clear_m <= 2.0
    passing_by = decide(imo, replace(coming, v_ned_m_s=(0.0, 1.0, 0.0)))
    assert passing_by.v_ned_m_s == (0.0, 0.0, 0.0)
