"""The wall's plane and the two clusters, against a depth image whose wall and holes are known pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest

from morpheyes_daemon.strategies.gap.wall_segmentation import Plane, median, segment_wall
from tests.support.walls import PINHOLE, T_ned_rect, depth_map, depth_of_wall, rectangle


@pytest.mark.parametrize("turn_deg", [0.0, 15.0, -20.0])
@pytest.mark.parametrize("pitch", [0.0, 0.12])
def test_the_plane_has_the_inverse_depth_of_the_wall_at_every_pixel(turn_deg: float, pitch: float) -> None:
    T, turn = T_ned_rect(pitch=pitch), math.radians(turn_deg)
    exact, _ = depth_of_wall([], T, turn_rad=turn, noise_px=0.0)
    seen, _ = depth_of_wall([rectangle(0.0, -1.5, 0.8, 0.6)], T, turn_rad=turn)
    found = segment_wall(seen)
    assert found is not None
    rows, columns = range(0, 240, 7), range(3, 320, 11)
    wanted = 1.0 / exact.depth_m[::7, 3::11]
    assert found.plane.inverse_depth(rows, columns) == pytest.approx(wanted, rel=0.01)
    uv = np.array([[10.0, 20.0], [300.0, 200.0]])
    assert found.plane.at(uv) == pytest.approx([1.0 / exact.depth_m[20, 10], 1.0 / exact.depth_m[200, 300]], rel=0.01)


def test_a_plane_is_affine_in_the_pixel() -> None:
    plane = Plane(0.001, -0.002, 0.5)
    assert plane.at(np.array([[10.0, 20.0]])) == pytest.approx([0.47])
    assert plane.inverse_depth(range(20, 41, 20), range(10, 11)) == pytest.approx(np.array([[0.47], [0.43]]))


@pytest.mark.parametrize("back_m", [0.8, 2.0, 8.0])
def test_the_far_cluster_is_what_is_seen_through_the_holes(back_m: float) -> None:
    seen, hole = depth_of_wall([rectangle(0.3, -1.6, 0.7, 0.5)], T_ned_rect(), back_m=back_m)
    found = segment_wall(seen)
    assert found is not None
    assert found.bimodal
    far, near = found.clusters()
    # four sigmas of noise apart: single pixels err
    assert (far == hole).mean() > 0.995
    assert (near == ~hole).mean() > 0.995
    box = (slice(60, 200), slice(100, 290))
    boxed = found.clusters(box)
    assert np.array_equal(boxed[0], far[box])
    assert np.array_equal(boxed[1], near[box])


def test_a_background_nearer_than_a_bulge_is_no_second_cluster() -> None:
    for back_m, bimodal in [(0.1, False), (1.0, True)]:
        seen, _ = depth_of_wall([rectangle(0.0, -1.5, 0.8, 0.6)], T_ned_rect(), back_m=back_m, noise_px=0.02)
        found = segment_wall(seen)
        assert found is not None
        assert found.bimodal == bimodal


def test_a_wall_without_a_hole_has_one_cluster() -> None:
    found = segment_wall(depth_of_wall([], T_ned_rect())[0])
    assert found is not None
    assert not found.bimodal
    assert found.separation == 0.0


def test_the_separation_is_that_of_ashman_and_more_noise_makes_it_less() -> None:
    """sqrt(2) * jump / hypot(sigma, sigma), both clusters as noisy: jump / sigma."""
    f_b = 0.15 * PINHOLE.f_px
    for noise_px in (0.3, 0.6):
        seen, _ = depth_of_wall([rectangle(0.0, -1.5, 1.2, 0.9)], T_ned_rect(), noise_px=noise_px, back_m=8.0)
        found = segment_wall(seen)
        assert found is not None
        jump = 1.0 / 4.0 - 1.0 / 12.0
        assert found.separation == pytest.approx(jump / (noise_px / f_b), rel=0.25)
        assert found.threshold_1_m == pytest.approx(jump / 2, rel=0.05)


def test_what_is_too_near_to_be_known_is_near_and_what_is_unknown_is_neither() -> None:
    seen, hole = depth_of_wall([rectangle(0.0, -1.5, 0.8, 0.6)], T_ned_rect())
    depth = seen.depth_m.copy()
    depth[0:30, 0:40] = np.nan
    depth[200:240, 0:40] = np.nan
    close = np.zeros(depth.shape, bool)
    close[0:30, 0:40] = True
    found = segment_wall(depth_map(depth, close))
    assert found is not None
    far, near = found.clusters()
    assert near[0:30, 0:40].all()
    assert not (near | far)[200:240, 0:40].any()
    assert (far == hole).mean() > 0.99


def test_too_little_that_is_known_is_no_wall() -> None:
    nothing = np.full((240, 320), np.nan)
    assert segment_wall(depth_map(nothing)) is None
    few = nothing.copy()
    few[0:30, 0:30] = 4.0
    assert segment_wall(depth_map(few)) is None
    some = nothing.copy()
    some[0:120, 0:160] = 4.0
    assert segment_wall(depth_map(some)) is not None


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 10, 11])
def test_the_median_is_numpys(n: int) -> None:
    values = np.random.default_rng(n).normal(size=n)
    assert median(values) == pytest.approx(float(np.median(values)))
