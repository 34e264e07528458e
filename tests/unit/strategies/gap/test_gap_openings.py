"""Openings are found and measured in projection along the wall's normal; a wall without one has none."""

import math

import cv2
import numpy as np
import pytest

from morpheyes_daemon.strategies.gap.openings import Silhouette, crossing_frame, find_openings
from morpheyes_daemon.strategies.gap.wall_segmentation import median, segment_wall
from tests.support.walls import PINHOLE, T_ned_rect, depth_map, depth_of_wall, rectangle

VEHICLE = Silhouette(0.337, 0.187)
PX_M = 4.0 / PINHOLE.f_px
"""A pixel on the wall at four metres."""


def openings(depth, T):
    found = segment_wall(depth)
    assert found is not None
    way = crossing_frame(found.plane, depth.pinhole, T)
    assert way is not None
    return find_openings(depth, found, way, VEHICLE)


def test_the_crossing_point_of_a_rectangle_is_its_centre_with_its_clearance():
    T = T_ned_rect()
    depth, _ = depth_of_wall([rectangle(0.2, -1.4, 0.417, 0.267)], T)
    (opening,) = openings(depth, T)
    assert opening.crossing_points[0].p_ned_m == pytest.approx((4.0, 0.2, -1.4), abs=1.5 * PX_M)
    assert opening.crossing_points[0].clearance_m == pytest.approx(0.040, abs=1.5 * PX_M)
    assert (opening.width_m, opening.height_m) == pytest.approx((0.417, 0.267), abs=2 * PX_M)
    assert opening.z_m == pytest.approx(4.0, abs=0.05)
    assert not opening.cut


def test_the_contour_covers_the_hole():
    T = T_ned_rect()
    depth, hole = depth_of_wall([lambda y, z: np.hypot(y, z + 1.5) < 0.3], T)
    (opening,) = openings(depth, T)
    mask = np.zeros(hole.shape, np.uint8)
    cv2.fillPoly(mask, [opening.contour_px.astype(np.int32)], 1)
    seen = mask.astype(bool)
    assert (seen & hole).sum() / (seen | hole).sum() > 0.95


def test_an_oblique_wall_is_measured_along_its_normal():
    T, turn = T_ned_rect(), math.radians(12)
    depth, _ = depth_of_wall([rectangle(0.0, -1.5, 0.6, 0.4)], T, turn_rad=turn)
    found = segment_wall(depth)
    assert found is not None
    way = crossing_frame(found.plane, depth.pinhole, T)
    assert way is not None
    assert way.yaw_rad == pytest.approx(turn, abs=0.01)
    (opening,) = find_openings(depth, found, way, VEHICLE)
    assert opening.width_m == pytest.approx(0.6, abs=2 * PX_M)


def test_a_leaning_camera_does_not_move_the_opening():
    T = T_ned_rect(pitch=-0.15, roll=0.05, yaw=0.05)
    depth, _ = depth_of_wall([rectangle(0.1, -1.2, 0.417, 0.267)], T)
    (opening,) = openings(depth, T)
    assert opening.crossing_points[0].p_ned_m == pytest.approx((4.0, 0.1, -1.2), abs=1.5 * PX_M)


def test_clearance_is_negative_where_it_does_not_fit():
    T = T_ned_rect()
    depth, _ = depth_of_wall([rectangle(0.0, -1.5, 0.417, 0.147)], T)
    (opening,) = openings(depth, T)
    assert opening.crossing_points[0].clearance_m == pytest.approx(-0.020, abs=1.5 * PX_M)


def test_several_openings_are_all_found_and_the_largest_has_most_clearance():
    T = T_ned_rect()
    holes = [rectangle(-0.7, -1.5, 0.38, 0.24), rectangle(0.5, -1.6, 0.6, 0.5)]
    found = openings(depth_of_wall(holes, T)[0], T)
    assert len(found) == 2
    best = max(found, key=lambda opening: opening.crossing_points[0].clearance_m)
    assert best.crossing_points[0].p_ned_m[1] == pytest.approx(0.5, abs=0.05)


def test_the_half_occluded_rim_belongs_to_the_opening():
    """The half-occluded strip has no depth; counted as wall it would shift the centre."""
    T = T_ned_rect()
    depth, hole = depth_of_wall([rectangle(0.0, -1.5, 0.5, 0.4)], T)
    seen = depth.depth_m.copy()
    columns = np.flatnonzero(hole.any(axis=0))
    strip = hole.copy()
    strip[:, : columns[-1] - 8] = False
    seen[strip] = np.nan
    (opening,) = openings(depth_map(seen), T)
    assert opening.crossing_points[0].p_ned_m[1] == pytest.approx(0.0, abs=1.5 * PX_M)


def test_a_hole_at_the_edge_of_the_image_is_cut():
    T = T_ned_rect()
    (opening,) = openings(depth_of_wall([rectangle(1.6, -1.5, 0.6, 0.4)], T)[0], T)
    assert opening.cut


def test_the_nearest_obstacle_behind_the_wall_counts():
    T = T_ned_rect()
    (opening,) = openings(depth_of_wall([rectangle(0.0, -1.5, 0.6, 0.4)], T, back_m=3.0)[0], T)
    assert opening.beyond_m == pytest.approx(3.0, abs=0.5)


def test_a_plain_wall_is_not_bimodal():
    T = T_ned_rect()
    depth, _ = depth_of_wall([], T, turn_rad=0.2)
    found = segment_wall(depth)
    assert found is not None
    assert not found.bimodal
    way = crossing_frame(found.plane, PINHOLE, T)
    assert way is not None
    assert find_openings(depth, found, way, VEHICLE) == ()


def test_without_depth_there_is_no_wall():
    assert segment_wall(depth_map(np.full((240, 320), np.nan))) is None


def test_the_safe_point_of_a_symmetric_hole_is_its_centre():
    T = T_ned_rect()
    (opening,) = openings(depth_of_wall([rectangle(0.1, -1.5, 0.5, 0.4)], T)[0], T)
    assert opening.safe_point.p_ned_m[1:] == pytest.approx((0.1, -1.5), abs=3 * PX_M)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 101])
def test_the_median_is_the_usual_one(n, dtype):
    values = np.random.default_rng(n).normal(size=n).astype(dtype)
    assert median(values) == pytest.approx(float(np.median(values)), rel=1e-6)
