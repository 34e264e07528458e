"""Matching on scenes whose disparity is known exactly: accuracy, padding, what is too near, hidden or unseen."""

import cv2
import numpy as np
import pytest

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.stereo.matching import (
    MatchSettings,
    _half_occluded,
    _remove_islands,
    _runs,
    disparity_range,
    match,
)
from tests.support.panels import Panel, ideal_pair

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
B = 0.2
NOISE = 1.5


def truth_of(depth_m):
    return B * PINHOLE.f_px / depth_m


@pytest.fixture(scope="module")
def slanted():
    """A wall that recedes to the right: every fraction of a pixel occurs."""
    left, right, depth = ideal_pair([Panel(4.0, slope_x=0.9, slope_y=-0.2)], PINHOLE, B, NOISE)
    return left, right, truth_of(depth)


@pytest.fixture(scope="module")
def panel_before_wall():
    """A panel at 2 m (37 px) in front of a wall at 6 m (12.3 px)."""
    panels = [Panel(6.0), Panel(2.0, x_m=(-0.3, 0.25), seed=5)]
    left, right, depth = ideal_pair(panels, PINHOLE, B, NOISE)
    return left, right, truth_of(depth)


def test_disparities_are_right_to_a_tenth_of_a_pixel(slanted):
    left, right, truth = slanted
    found = match(left, right, 64)
    error = (found.disparity_px - truth)[:, 45:]
    known = np.isfinite(error)
    assert known.mean() > 0.97
    assert np.median(np.abs(error[known])) < 0.08
    assert np.mean(np.abs(error[known]) > 0.75) < 0.01


def test_whole_pixels_do_not_attract_disparities(slanted):
    """The parabola that OpenCV fits is biased by up to 0.1 px and more; straightened, by less than 0.05."""
    left, right, truth = slanted
    found = match(left, right, 64)
    error = found.disparity_px - truth
    ours = np.isfinite(error) & (np.abs(error) < 0.75)
    fraction = truth % 1.0
    bias = [np.median(error[ours & (fraction >= low) & (fraction < low + 0.1)]) for low in np.arange(0, 1, 0.1)]
    assert np.max(np.abs(bias)) < 0.06
    assert abs(np.median(error[ours])) < 0.02


def test_it_beats_the_plain_matcher_and_loses_no_columns(slanted):
    left, right, truth = slanted
    plain = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=64, blockSize=3, P1=8 * 9, P2=32 * 9, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    ).compute(left, right) / 16.0  # fmt: skip
    ours = match(left, right, 64).disparity_px
    plain_known = plain >= 0
    assert plain_known[:, :63].sum() == 0
    assert np.isfinite(ours[:, 40:63]).mean() > 0.9
    shared = plain_known & np.isfinite(ours)
    assert np.median(np.abs(ours - truth)[shared]) < 0.75 * np.median(np.abs(plain - truth)[shared])


def test_only_what_the_right_camera_cannot_see_is_lost_at_the_left_edge(panel_before_wall):
    left, right, truth = panel_before_wall
    found = match(left, right, 64)
    column = np.arange(320)
    outside = (column < truth - 1) & (column < 30)
    inside = (column > truth + 4) & (column < 60)
    assert np.isfinite(found.disparity_px[outside]).mean() < 0.02
    assert np.isfinite(found.disparity_px[inside]).mean() > 0.95
    assert found.half_occluded[outside].mean() > 0.9


def test_what_a_nearer_panel_hides_from_the_right_camera_is_told(panel_before_wall):
    left, right, truth = panel_before_wall
    found = match(left, right, 64)
    partner = np.arange(320) - truth
    hidden = np.zeros(truth.shape, bool)
    for row in range(240):
        for u in range(320):
            hidden[row, u] = (partner[row, u + 1 :] < partner[row, u] - 0.5).any() or partner[row, u] < -0.5
    assert found.half_occluded[hidden].mean() > 0.85
    grown = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 7), np.uint8)).astype(bool)
    assert (found.half_occluded & ~grown).mean() < 0.005
    assert not (found.half_occluded & found.near).any()
    assert not np.isfinite(found.disparity_px[found.half_occluded | found.near]).any()


def test_something_beyond_the_ceiling_is_near_and_never_far():
    panels = [Panel(6.0), Panel(0.8, x_m=(-0.08, 0.22), y_m=(-0.2, 0.2), seed=5)]
    left, right, depth = ideal_pair(panels, PINHOLE, B, NOISE)
    truth = truth_of(depth)
    found = match(left, right, 64)
    too_near = truth > 64
    assert 0.1 < too_near.mean() < 0.5
    assert found.near[too_near].mean() > 0.85
    assert np.isfinite(found.disparity_px[too_near]).mean() < 0.03
    wall = ~cv2.dilate(too_near.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    assert found.near[wall].mean() < 0.005
    assert np.isfinite(found.disparity_px[wall & (np.arange(320) > 110)]).mean() > 0.9


def test_nothing_is_near_in_a_scene_within_range(slanted, panel_before_wall):
    for left, right, _ in (slanted, panel_before_wall):
        assert match(left, right, 64).near.mean() < 0.002


def test_a_bare_wall_is_unknown_and_not_near():
    left, right, _ = ideal_pair([Panel(0.8, contrast=0.0)], PINHOLE, B, NOISE)
    found = match(left, right, 64)
    assert found.near.mean() < 0.05
    assert np.isfinite(found.disparity_px).mean() < 0.4


def test_a_smaller_range_reports_the_rest_as_near(panel_before_wall):
    left, right, truth = panel_before_wall
    found = match(left, right, 16)
    assert found.ceiling_px == 16
    assert found.near[(truth > 30) & (np.arange(320) > 60)].mean() > 0.8
    assert np.isfinite(found.disparity_px[(truth < 13) & (np.arange(320) > 200)]).mean() > 0.9


def test_pixels_that_the_cameras_do_not_cover_are_unknown(slanted):
    left, right, truth = slanted
    in_left, in_right = np.ones(left.shape, bool), np.ones(left.shape, bool)
    in_left[:20], in_right[:, :50], in_right[:, 300:] = False, False, False
    found = match(left, right, 64, covered=(in_left, in_right))
    partner = np.arange(320) - truth
    assert not np.isfinite(found.disparity_px[:20]).any()
    assert not found.near[:20].any()
    assert not np.isfinite(found.disparity_px[partner < 48]).any()
    assert np.isfinite(found.disparity_px[20:][(partner > 55)[20:] & (partner < 295)[20:]]).mean() > 0.95


def test_negative_disparities_are_found_where_asked_for(slanted):
    left, right, truth = slanted
    shift = 24
    # the right image moved to the right lowers every disparity by as much
    moved = np.roll(right, shift, axis=1)
    found = match(left, moved, 64, min_disparity=-32)
    sure = np.zeros(truth.shape, bool)
    sure[:, 60:280] = True
    error = (found.disparity_px - (truth - shift))[sure]
    assert np.isfinite(error).mean() > 0.95
    assert np.nanmedian(np.abs(error)) < 0.08
    assert (found.disparity_px[sure] < 0).any()


def test_rows_taken_two_by_two_cost_little(slanted):
    left, right, truth = slanted
    found = match(left, right, 64, MatchSettings(row_step=2))
    error = (found.disparity_px - truth)[:, 45:]
    assert found.disparity_px.shape == truth.shape
    assert np.isfinite(error).mean() > 0.95
    assert np.nanmedian(np.abs(error)) < 0.1


def test_sizes_that_do_not_divide_are_filled_to_the_edge(slanted):
    left, right, _ = (image[:239, :317] for image in slanted)
    found = match(left, right, 64, MatchSettings(row_step=2))
    assert found.disparity_px.shape == found.near.shape == found.half_occluded.shape == (239, 317)
    assert np.isfinite(found.disparity_px[-1, 60:]).mean() > 0.8


@pytest.fixture
def threads():
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("threads")
def test_the_number_of_threads_changes_not_a_bit(panel_before_wall):
    left, right, _ = panel_before_wall
    results = []
    for count in (1, 2, 3, 8):
        cv2.setNumThreads(count)
        results.append(match(left, right, 64))
    for other in results[1:]:
        assert np.array_equal(results[0].disparity_px, other.disparity_px, equal_nan=True)
        assert np.array_equal(results[0].near, other.near)
        assert np.array_equal(results[0].half_occluded, other.half_occluded)


def test_small_patches_in_the_unknown_are_forgotten_and_branches_are_not():
    disparity = np.full((60, 80), np.nan, np.float32)
    disparity[:, 50:] = 10.0
    disparity[20:24, 20:26] = 30.0
    disparity[:, 47:50] = 25.0
    disparity[40:43, 60:66] = 40.0
    _remove_islands(disparity, 200, 0.8)
    assert np.isnan(disparity[20:24, 20:26]).all()
    # the branch has unknown on its left only, the patch on the wall nowhere
    assert (disparity[:, 47:50] == 25.0).all()
    assert (disparity[40:43, 60:66] == 40.0).all()
    large = np.full((60, 80), np.nan, np.float32)
    large[10:40, 10:40] = 5.0
    _remove_islands(large, 200, 0.8)
    assert (large[10:40, 10:40] == 5.0).all()


def slow_one_eyed(disparity, near, ceiling):
    """The rule of `_half_occluded`, pixel by pixel."""
    height, width = disparity.shape
    mask = np.zeros((height, width), bool)
    for row in range(height):
        known = np.isfinite(disparity[row]) | near[row]
        for u in np.flatnonzero(~known):
            right = next((k for k in range(u, width) if known[k]), None)
            left = next((k for k in range(u, -1, -1) if known[k]), None)
            if right is None or near[row, right]:
                continue
            d_right = disparity[row, right]
            if left is None:
                mask[row, u] = u <= d_right
            else:
                d_left = ceiling if near[row, left] else disparity[row, left]
                mask[row, u] = right - u <= np.floor(d_right - d_left + 1.0)
    return mask


@pytest.mark.parametrize("seed", range(5))
def test_hidden_pixels_by_runs_are_those_found_one_by_one(seed):
    rng = np.random.default_rng(seed)
    disparity = np.round(rng.uniform(0, 20, (12, 40)), 2).astype(np.float32)
    disparity[rng.random((12, 40)) < 0.5] = np.nan
    near = np.isnan(disparity) & (rng.random((12, 40)) < 0.2)
    disparity[0], near[0] = np.nan, False
    assert np.array_equal(_half_occluded(disparity, near, 24.0), slow_one_eyed(disparity, near, 24.0))


def test_runs_are_found_to_the_edges():
    mask = np.array([[1, 1, 0, 1], [0, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 1]], bool)
    row, first, end = _runs(mask)
    expected = [(0, 0, 2), (0, 3, 4), (2, 0, 4), (3, 1, 2), (3, 3, 4)]
    assert list(zip(row.tolist(), first.tolist(), end.tolist(), strict=True)) == expected


@pytest.mark.parametrize(
    ("largest", "width", "count"), [(0, 320, 16), (15, 320, 16), (15.5, 320, 32), (79, 320, 80), (1e6, 320, 304)]
)
def test_the_search_range_covers_what_is_asked_within_the_width(largest, width, count):
    assert disparity_range(largest, width) == count


@pytest.mark.parametrize(
    ("left", "right", "count", "words"),
    [
        ((240, 320), (240, 318), 64, "same size"),
        ((240, 320, 3), (240, 320, 3), 64, "grey"),
        ((240, 320), (240, 320), 60, "multiple of 16"),
        ((240, 320), (240, 320), 320, "too narrow"),
    ],
)
def test_pairs_that_cannot_be_matched_are_refused(left, right, count, words):
    with pytest.raises(InputError, match=words):
        match(np.zeros(left, np.uint8), np.zeros(right, np.uint8), count)


def test_a_narrow_pair_can_still_be_matched():
    left, right, depth = ideal_pair([Panel(4.0)], Pinhole(100, 80, 370.0, 49.5, 39.5), B, NOISE)
    found = match(left, right, 32)
    assert np.nanmedian(np.abs(found.disparity_px - truth_of(depth))) < 0.1
