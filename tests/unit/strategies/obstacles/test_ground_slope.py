"""The ground slope is fitted past trunks and bushes, and level ground is level."""

from __future__ import annotations

import math

import numpy as np
import pytest

from morpheyes_daemon.strategies.obstacles.ground_slope import ground_slope

HEIGHT_M = 1.5


def seen(rise_north: float, rise_east: float, offset_m: float = 0.0, seed: int = 0) -> np.ndarray:
    """Points (3, N) of a plane 1.5 m below as a camera sees it, with trunks before a fifth of it."""
    rng = np.random.default_rng(seed)
    azimuth, reach = rng.uniform(-0.55, 0.55, 6000), rng.uniform(2.5, 12.0, 6000)
    north, east = reach * np.cos(azimuth), reach * np.sin(azimuth)
    down = HEIGHT_M + offset_m - rise_north * north - rise_east * east
    # depth error of half a pixel at 5 m and 0.2 m of baseline
    down += rng.normal(0.0, 0.004, 6000) * reach
    trunk = np.abs((azimuth * 5) % 1.0 - 0.5) < 0.1
    down[trunk] -= rng.uniform(0.0, 2.5, int(trunk.sum()))
    return np.stack([north, east, down])


@pytest.mark.parametrize(("north", "east"), [(0.12, 0.0), (-0.15, 0.05), (0.0, 0.2), (0.25, -0.1)])
def test_a_slope_is_found_behind_trunks(north: float, east: float) -> None:
    found = ground_slope(seen(north, east), HEIGHT_M)
    assert found == pytest.approx((north, east), abs=0.03)


def test_a_rangefinder_over_a_bush_does_not_tilt_the_ground() -> None:
    assert ground_slope(seen(0.0, 0.0), HEIGHT_M - 0.8) == (0.0, 0.0)
    assert ground_slope(seen(0.15, 0.0), HEIGHT_M - 0.8) == pytest.approx((0.15, 0.0), abs=0.03)


def test_level_ground_and_too_few_points_give_no_slope() -> None:
    assert ground_slope(seen(0.0, 0.0), HEIGHT_M) == (0.0, 0.0)
    assert ground_slope(seen(0.2, 0.0)[:, :20], HEIGHT_M) == (0.0, 0.0)
    assert ground_slope(np.empty((3, 0)), HEIGHT_M) == (0.0, 0.0)


def test_a_wall_is_no_ground() -> None:
    rng = np.random.default_rng(1)
    azimuth, down = rng.uniform(-0.5, 0.5, 4000), rng.uniform(-1.5, 1.5, 4000)
    wall = np.stack([np.full(4000, 5.0), 5.0 * np.tan(azimuth), down])
    assert math.hypot(*ground_slope(wall, HEIGHT_M)) < 0.1
