"""The obstacle profile over scenes of cylinders, walls and ground, computed ray by ray and held against plain geometry.

The scene is known in ned metres, so what a bin must show is known without the profile's own arithmetic. Cells are 5 %
wide and bins 0.6 degrees; an obstacle's range may be a cell off either way.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.messages.core import DepthMap, Pinhole, VehicleState
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.obstacles.polar_profile import ObstacleProfile, obstacle_profile, wide_runs
from morpheyes_daemon.transforms import R_FRD_CAM, R_from_rpy, pose

PINHOLE = Pinhole(160, 120, 185.0, 79.5, 59.5)
HALF_FOV_RAD = math.atan(80.0 / 185.0)
FORWARD_M, DOWN_M = 0.1, -0.05
"""Where the camera sits on the body."""
Tree = tuple[float, float, float]
"""North, east, radius."""


def view(
    trees: tuple[Tree, ...] = (),
    *,
    p: tuple[float, float, float] = (0.0, 0.0, -1.5),
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
    tilt: float = 0.0,
    slope: float = 0.0,
    tops_m: float = 4.0,
    bottoms_m: float = 0.0,
    far_m: float = 40.0,
) -> View:
    """What a camera sees of upright cylinders between `bottoms_m` and `tops_m` over a ground that rises to the north.

    Far away there is a wall all around, so that every ray has a depth.
    """
    T_frd_rig = pose(R_from_rpy(0.0, tilt, 0.0) @ R_FRD_CAM, np.array([FORWARD_M, 0.0, DOWN_M]))
    T = pose(R_from_rpy(roll, pitch, yaw), np.array(p)) @ T_frd_rig
    v, u = np.mgrid[0 : PINHOLE.height, 0 : PINHOLE.width].astype(float)
    rays = np.stack([(u - PINHOLE.cx_px) / PINHOLE.f_px, (v - PINHOLE.cy_px) / PINHOLE.f_px, np.ones_like(u)], -1)
    d = rays @ T[:3, :3].T
    o = T[:3, 3]
    z = far_m / np.hypot(d[..., 0], d[..., 1])
    sink = d[..., 2] + slope * d[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -(o[2] + slope * o[0]) / sink
        z = np.where((sink > 0) & (ground > 0), np.minimum(z, ground), z)
        for north, east, radius in trees:
            a = d[..., 0] ** 2 + d[..., 1] ** 2
            b = d[..., 0] * (o[0] - north) + d[..., 1] * (o[1] - east)
            c = (o[0] - north) ** 2 + (o[1] - east) ** 2 - radius**2
            hit = (-b - np.sqrt(b * b - a * c)) / a
            height = -(o[2] + hit * d[..., 2]) - slope * north
            z = np.where((hit > 0) & (height < tops_m) & (height > bottoms_m), np.fmin(z, hit), z)
    none = np.zeros(z.shape, bool)
    depth = DepthMap(
        seq=1, t_ns=77, depth_m=z.astype(np.float32), near=none, half_occluded=none, pinhole=PINHOLE,
        T_rig_rect=np.eye(4), baseline_m=0.2, baseline_sigma_m=1e-4, sigma_disparity_px=0.25, near_limit_m=0.7,
        valid_fraction=1.0, ceiling_fraction=0.0, calibration_hash="none",
    )  # fmt: skip
    vehicle = VehicleState(p_ned_m=p, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, height_m=-p[2] - slope * p[0])
    grey = np.zeros(z.shape, np.uint8)
    return View(depth, grey, grey, vehicle, T_frd_rig)


def profile(seen: View, band_m: float = 0.4, trust_m: float = 15.0) -> ObstacleProfile:
    return obstacle_profile(seen, band_m, trust_m)


def with_depth(seen: View, columns: slice, rows: slice = slice(None), **changes: object) -> View:
    """The same with other values in a part of the depth map: depth_m, near, half_occluded."""
    maps = {}
    for name, value in changes.items():
        maps[name] = getattr(seen.depth, name).copy()
        maps[name][rows, columns] = value
    return replace(seen, depth=replace(seen.depth, **maps))


def at(found: ObstacleProfile, heading_rad: float) -> int:
    return int(np.argmin(np.abs((found.azimuth_rad - heading_rad + math.pi) % (2 * math.pi) - math.pi)))


def expected_m(found: ObstacleProfile, trees: tuple[Tree, ...], trust_m: float = 15.0) -> tuple[np.ndarray, np.ndarray]:
    """Nearest range of the cylinders by bin; and whether the bin lies off every edge by more than its own width."""
    ranges, clear = np.full(len(found.azimuth_rad), np.inf), np.ones(len(found.azimuth_rad), bool)
    for north, east, radius in trees:
        n, e = north - found.origin_ned_m[0], east - found.origin_ned_m[1]
        distance, heading = math.hypot(n, e), math.atan2(e, n)
        off = (found.azimuth_rad - heading + math.pi) % (2 * math.pi) - math.pi
        half = math.asin(radius / distance)
        across = distance * np.sin(off)
        inside = np.abs(off) < half
        surface = distance * np.cos(off) - np.sqrt(np.maximum(0.0, radius**2 - across**2))
        ranges = np.where(inside & (surface < trust_m), np.minimum(ranges, surface), ranges)
        clear &= np.abs(np.abs(off) - half) > 0.016
    return ranges, clear


SCENES: dict[str, tuple[tuple[Tree, ...], dict[str, float]]] = {
    "one tree": (((5.0, 0.5, 0.2),), {}),
    "near and far": (((2.0, -0.5, 0.15), (6.0, 1.2, 0.3), (9.0, -2.0, 0.4)), {}),
    "one behind another": (((4.0, 0.0, 0.2), (8.0, 0.3, 0.8)), {}),
    "camera tilted up": (((3.0, 0.4, 0.2), (7.0, -1.0, 0.3)), {"tilt": 0.14}),
    "nose down": (((3.0, 0.4, 0.2), (7.0, -1.0, 0.3)), {"pitch": -0.15}),
    "nose up": (((4.0, 0.4, 0.2), (7.0, -1.0, 0.3)), {"pitch": 0.2}),
    "rolled": (((4.0, 0.4, 0.2), (7.0, -1.0, 0.3)), {"roll": 0.2}),
    "facing east": (((0.5, 5.0, 0.2), (-2.0, 7.0, 0.3)), {"yaw": math.pi / 2}),
    "facing south": (((-5.0, 0.8, 0.2),), {"yaw": math.pi}),
    "uphill": (((4.0, 0.4, 0.2), (7.0, -1.0, 0.3)), {"slope": 0.15}),
    "downhill": (((4.0, 0.4, 0.2), (7.0, -1.0, 0.3)), {"slope": -0.12}),
}


@pytest.mark.parametrize("scene", SCENES)
def test_every_bin_shows_the_nearest_trunk_of_its_heading_and_free_is_free(scene: str) -> None:
    trees, how = SCENES[scene]
    found = profile(view(trees, **how))  # type: ignore[arg-type]
    wanted, clear = expected_m(found, trees)
    # at the borders a rolled or tilted image has columns that do not reach the band
    inner = clear & (np.arange(len(clear)) >= 6) & (np.arange(len(clear)) < len(clear) - 6)
    hit = inner & np.isfinite(wanted)
    assert hit.sum() >= 4
    # a cell of 5 %, sums over its neighbours: the first that counts may begin up to two cells before the surface
    assert np.all(np.abs(np.log(found.range_m[hit] / wanted[hit])) < math.log(1.05) * 2.3)
    free = inner & ~np.isfinite(wanted)
    assert np.all(np.isinf(found.range_m[free]))
    assert not found.unknown.any()
    assert not found.near.any()


def test_stamp_place_and_limits_of_the_image_are_told_with_it() -> None:
    found = profile(view(p=(3.0, 4.0, -2.0), yaw=1.0), trust_m=9.0)
    assert (found.t_ns, found.trust_m, found.near_limit_m) == (77, 9.0, 0.7)
    assert found.p_ned_m == (3.0, 4.0, -2.0)
    assert found.origin_ned_m == pytest.approx((3.0 + 0.1 * math.cos(1.0), 4.0 + 0.1 * math.sin(1.0)))


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5, 3.1])
def test_the_bins_go_from_left_to_right_over_the_field_of_view_around_where_the_camera_looks(yaw: float) -> None:
    found = profile(view(yaw=yaw))
    half = PINHOLE.h_fov_rad / 2
    assert found.azimuth_rad.mean() == pytest.approx(yaw)
    width = np.diff(found.azimuth_rad)
    assert width == pytest.approx(np.full(len(width), math.radians(0.6)), rel=0.02)
    assert found.azimuth_rad[0] == pytest.approx(yaw - half + width[0] / 2)
    assert len(found.azimuth_rad) == len(found.range_m) == round(2 * half / math.radians(0.6))


def test_a_bin_width_that_is_asked_for_is_used_and_there_are_eight_at_least() -> None:
    assert len(obstacle_profile(view(), 0.4, 9.0, 0.05).range_m) == round(PINHOLE.h_fov_rad / 0.05)
    assert len(obstacle_profile(view(), 0.4, 9.0, 1.0).range_m) == 8


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_the_points_lie_on_the_trunks_in_ned(yaw: float) -> None:
    trees = tuple(
        (10.0 + d * math.cos(yaw + a), 20.0 + d * math.sin(yaw + a), 0.2) for d, a in [(4.0, 0.2), (6.0, -0.25)]
    )
    found = profile(view(trees, p=(10.0, 20.0, -1.5), yaw=yaw))
    assert len(found.points_ned_m) > 8
    off = np.min([np.hypot(*(found.points_ned_m - (n, e)).T) - r for n, e, r in trees], axis=0)
    # the surface less the middle of a 5 % cell, and half a bin across
    assert np.all(np.abs(off) < 0.35)
    for n, e, _ in trees:
        assert np.hypot(*(found.points_ned_m - (n, e)).T).min() < 0.35


def test_what_is_beyond_the_trusted_range_is_kept_out() -> None:
    trees = ((6.0, 0.0, 0.4),)
    assert np.isfinite(profile(view(trees), trust_m=7.0).range_m).any()
    found = profile(view(trees), trust_m=5.0)
    assert np.isinf(found.range_m).all()
    assert len(found.points_ned_m) == 0
    assert not found.unknown.any(), "it was matched"


@pytest.mark.parametrize(
    ("bottoms_m", "tops_m", "counts"), [(0.0, 0.9, False), (2.1, 9.0, False), (0.0, 1.6, True), (1.4, 9.0, True)]
)
def test_only_what_reaches_into_the_band_at_the_vehicles_height_counts(
    bottoms_m: float, tops_m: float, counts: bool
) -> None:
    found = profile(view(((4.0, 0.0, 0.3),), bottoms_m=bottoms_m, tops_m=tops_m))
    assert bool(np.isfinite(found.range_m[at(found, 0.0)])) == counts


@pytest.mark.parametrize("height_m", [1.0, 3.0, 6.0])
def test_the_band_is_about_the_vehicle_and_not_about_the_camera_or_the_ground(height_m: float) -> None:
    for off_m, counts in [(-0.6, False), (0.0, True), (0.6, False)]:
        level = height_m + off_m
        found = profile(view(((5.0, 0.0, 0.3),), p=(0.0, 0.0, -height_m), bottoms_m=level - 0.1, tops_m=level + 0.1))
        assert bool(np.isfinite(found.range_m[at(found, 0.0)])) == counts


@pytest.mark.parametrize(
    ("band_m", "below_m", "counts"), [(0.2, 0.05, 1), (0.2, 0.35, 0), (0.8, 0.4, 1), (0.8, 0.95, 0)]
)
def test_the_band_is_as_wide_as_asked(band_m: float, below_m: float, counts: int) -> None:
    """A stump whose top is so far below the vehicle; less than a fifth of the band is not enough to count."""
    found = profile(view(((4.0, 0.0, 0.3),), tops_m=1.5 - below_m), band_m=band_m)
    assert np.isfinite(found.range_m[at(found, 0.0)]) == counts


def test_the_ground_of_a_slope_is_flown_over_and_no_obstacle() -> None:
    for slope in (0.12, 0.2):
        found = profile(view(slope=slope))
        assert np.isinf(found.range_m).all()


def test_without_a_rangefinder_the_height_is_that_over_the_start() -> None:
    seen = view(((4.0, 0.4, 0.2),), slope=0.15)
    blind = replace(seen, vehicle=replace(seen.vehicle, height_m=math.nan))
    assert np.array_equal(profile(seen).range_m, profile(blind).range_m)


def test_a_single_wrong_match_is_no_obstacle_and_a_thin_trunk_is() -> None:
    speck = with_depth(view(), slice(80, 81), slice(58, 62), depth_m=2.0)
    assert np.isinf(profile(speck).range_m).all()
    thin = profile(view(((3.0, 0.0, 0.04),)))
    assert np.isfinite(thin.range_m[at(thin, 0.0)])


def test_columns_without_depth_are_unknown_and_neither_free_nor_occupied() -> None:
    seen = with_depth(view(((4.0, 0.9, 0.2),)), slice(60, 80), depth_m=np.nan)
    found = profile(seen)
    left, right = (math.atan((u - PINHOLE.cx_px) / PINHOLE.f_px) for u in (60, 79))
    inside = (found.azimuth_rad > left + 0.01) & (found.azimuth_rad < right - 0.01)
    outside = (found.azimuth_rad < left - 0.015) | (found.azimuth_rad > right + 0.015)
    assert found.unknown[inside].all()
    assert not found.unknown[outside].any()
    assert np.isinf(found.range_m[inside]).all()
    assert np.isnan(found.behind_m).all(), "nothing tells what is there"
    whole = profile(with_depth(view(), slice(0, 160), depth_m=np.nan))
    assert whole.unknown.all()


def test_a_third_of_the_rows_matched_is_enough_to_know_a_direction() -> None:
    """Rows without depth in the band, as in a strip of sky between branches."""
    some = profile(with_depth(view(), slice(0, 160), slice(0, 60), depth_m=np.nan))
    assert not some.unknown[5:-5].any()


def test_what_is_too_near_to_be_matched_is_an_obstacle_at_the_near_limit() -> None:
    seen = with_depth(view(), slice(70, 90), depth_m=np.nan, near=True)
    found = profile(seen)
    ahead = at(found, 0.0)
    assert found.near[ahead]
    assert found.range_m[ahead] == 0.7
    assert not found.unknown[ahead]
    close = np.hypot(*(found.points_ned_m - found.origin_ned_m).T)
    assert close == pytest.approx(np.full(len(close), 0.7))
    assert len(close) == found.near.sum() >= 8


def test_a_run_of_too_near_narrower_than_any_trunk_is_a_mismatch() -> None:
    found = profile(with_depth(view(), slice(79, 81), depth_m=np.nan, near=True))
    assert not found.near.any()
    assert np.isinf(found.range_m).all()


def test_something_nearer_yet_counts_before_the_near_limit() -> None:
    seen = with_depth(view(((0.75, 0.0, 0.2),)), slice(0, 30), depth_m=np.nan, near=True)
    found = profile(seen)
    assert found.range_m[at(found, 0.0)] < 0.55 < 0.7 == found.range_m[5]


def test_what_one_camera_alone_sees_lies_behind_the_trunk_to_its_right() -> None:
    seen = with_depth(view(((4.0, 0.0, 0.3),)), slice(55, 67), depth_m=np.nan, half_occluded=True)
    found = profile(seen)
    shadow = at(found, math.atan((60 - PINHOLE.cx_px) / PINHOLE.f_px))
    trunk = at(found, 0.0)
    assert found.unknown[shadow]
    assert found.range_m[trunk] == pytest.approx(3.6, rel=0.12)
    assert found.behind_m[shadow] == found.range_m[at(found, math.atan((69 - PINHOLE.cx_px) / PINHOLE.f_px))]
    assert np.isnan(found.behind_m[trunk])
    assert np.isnan(found.behind_m[at(found, 0.2)])


def test_without_a_trunk_to_its_right_nothing_tells_what_the_shadow_lies_behind() -> None:
    found = profile(with_depth(view(), slice(55, 67), depth_m=np.nan, half_occluded=True))
    assert found.unknown.any()
    assert np.isnan(found.behind_m).all()


def test_the_strip_that_only_the_left_camera_sees_at_the_border_is_no_shadow() -> None:
    seen = with_depth(view(((4.0, -1.0, 0.3),)), slice(0, 14), depth_m=np.nan, half_occluded=True)
    found = profile(seen)
    assert found.unknown[2]
    assert np.isnan(found.behind_m).all()


def test_runs_are_kept_from_their_least_length_on() -> None:
    flags = np.array([1, 1, 1, 0, 1, 1, 1, 1, 0, 0, 1, 1, 1, 1, 1], bool)
    assert np.flatnonzero(wide_runs(flags, 4)).tolist() == [4, 5, 6, 7, 10, 11, 12, 13, 14]
    assert wide_runs(flags, 1).sum() == 12
    assert not wide_runs(np.zeros(5, bool), 1).any()


def test_a_larger_image_gives_the_same_profile() -> None:
    """Every second pixel of one twice as large; the rays differ by a quarter of a pixel."""
    small = view(((3.0, 0.4, 0.2), (7.0, -1.0, 0.3)))
    depth = small.depth
    large = Pinhole(320, 240, 370.0, 159.0, 119.0)
    twice = {name: getattr(depth, name).repeat(2, 0).repeat(2, 1) for name in ("depth_m", "near", "half_occluded")}
    found = profile(replace(small, depth=replace(depth, pinhole=large, **twice)))
    wanted = profile(small)
    assert (np.isfinite(found.range_m) == np.isfinite(wanted.range_m)).mean() > 0.95


def test_a_shadow_beside_a_trunk_at_the_right_border_lies_behind_it_as_well() -> None:
    seen = with_depth(view(), slice(158, 160), depth_m=4.0)
    found = profile(with_depth(seen, slice(140, 158), depth_m=np.nan, half_occluded=True))
    assert found.behind_m[-4] == found.range_m[-1] < 5.0


def test_at_the_right_border_nothing_tells_what_a_shadow_lies_behind() -> None:
    trees = ((3.0, -0.2, 0.3), (3.0, -1.25, 0.3))
    found = profile(with_depth(view(trees), slice(140, 160), depth_m=np.nan, half_occluded=True))
    assert found.unknown[-1]
    assert np.isfinite(found.range_m[0])
    assert np.isnan(found.behind_m).all()
