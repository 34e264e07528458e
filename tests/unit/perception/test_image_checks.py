"""Bad images are told from good ones, and good ones are let through."""

from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.messages.core import Image, Pinhole
from morpheyes_daemon.perception.image_checks import (
    FrozenCheck,
    ImageFault,
    PairCheck,
    exposure_faults,
    matching_faults,
    row_shift,
)
from morpheyes_daemon.stereo.epipolar import RowOffsets, row_offsets
from morpheyes_daemon.stereo.matching import match
from tests.support.panels import Panel, ideal_pair

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
PANELS = [Panel(5.0, slope_x=0.3), Panel(2.5, x_m=(-0.3, 0.6), y_m=(-0.5, 0.3), seed=3)]


Pair = tuple[Image, Image]


@pytest.fixture(scope="module")
def pair() -> Pair:
    left, right, _ = ideal_pair(PANELS, PINHOLE, 0.2, 1.5)
    return left, right


def valid_fraction(left, right):
    return float(np.isfinite(match(left, right, 80).disparity_px).mean())


def test_a_good_pair_has_no_fault(pair: Pair):
    assert exposure_faults(*pair) == set()
    assert matching_faults(*pair, valid_fraction(*pair)) == set()
    # not even when something else says that depth is scarce
    assert matching_faults(*pair, 0.0) == set()


def test_the_same_image_again_is_frozen_in_either_camera(pair):
    left, right = pair
    noisy = left ^ np.uint8(1)
    check = FrozenCheck()
    assert not check.check(left, right)
    assert not check.check(noisy, right[::-1])
    assert check.check(left, right[::-1])
    assert check.check(left, right)
    assert not check.check(left[:100], right[:100])


def test_one_changed_pixel_is_not_frozen(pair: Pair):
    left, right = pair
    check = FrozenCheck()
    check.check(left, right)
    other_left, other_right = left.copy(), right.copy()
    other_left[5, 7] ^= 1
    other_right[9, 9] ^= 1
    assert not check.check(other_left, other_right)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda image: image // 32, ImageFault.DARK),
        (lambda image: np.zeros_like(image), ImageFault.DARK),
        (lambda image: np.where(image > 90, 255, image), ImageFault.BURNT),
        (lambda image: np.full_like(image, 120), ImageFault.BLANK),
    ],
)
def test_a_camera_that_sees_nothing_is_told(pair, side, spoil, fault):
    images = list(pair)
    images[side] = spoil(images[side]).astype(np.uint8)
    assert exposure_faults(*images) == {fault}


def test_dusk_and_bright_sky_are_no_faults(pair: Pair):
    left, right = (image // 8 for image in pair)
    assert exposure_faults(left, right) == set()
    left, right = (np.where(np.arange(240)[:, None] < 90, 255, image).astype(np.uint8) for image in pair)
    assert exposure_faults(left, right) == set()


def test_swapped_cameras_are_told(pair):
    left, right = pair
    assert matching_faults(right, left, valid_fraction(right, left)) == {ImageFault.SWAPPED}


@pytest.mark.parametrize("rows", [-14, 8, 20])
def test_rows_far_off_are_told(pair: Pair, rows):
    left, right = pair
    off = np.roll(right, rows, axis=0)
    assert matching_faults(left, off, valid_fraction(left, off)) == {ImageFault.MISALIGNED}


@pytest.mark.parametrize("rows", [-7, 0, 5])
def test_the_row_shift_is_found_in_spite_of_parallax(pair: Pair, rows):
    left, right = pair
    assert abs(row_shift(left, np.roll(right, rows, axis=0)) - rows) <= 1


def test_scarce_depth_alone_is_no_fault():
    bare = ideal_pair([Panel(3.0, contrast=0.02)], PINHOLE, 0.2, 1.5)[:2]
    too_near = ideal_pair([Panel(0.25)], PINHOLE, 0.3, 1.5)[:2]
    for left, right in (bare, too_near):
        assert matching_faults(left, right, valid_fraction(left, right)) == set()


def test_every_fault_says_what_it_is():
    assert all(fault.text and fault.value for fault in ImageFault)


F_PX = 372.0
"""Of the simulator's cameras at 320 pixels: two rows are 5.4 mrad."""


def disparity(left, right):
    return match(left, right, 80).disparity_px


def ask(check, left, right, disparity_px):
    return check.check(left, row_offsets(left, right, disparity_px), F_PX)


def test_cameras_that_see_the_same_are_alike(pair):
    check = PairCheck()
    left, right = pair
    assert [ask(check, left, right, disparity(left, right)) for _ in range(6)] == [set()] * 6


def test_cameras_that_see_different_things_are_told_after_three_frames(pair):
    left, right = pair
    wrong = disparity(left, right) + 12
    check = PairCheck()
    assert [ask(check, left, right, wrong) for _ in range(4)] == [set(), set()] + [{ImageFault.SCENE_MISMATCH}] * 2
    assert ask(check, left, right, disparity(left, right)) == {ImageFault.SCENE_MISMATCH}
    assert ask(check, left, right, disparity(left, right)) == set(), "two good frames clear it"


def test_a_row_apart_is_no_fault(pair: Pair):
    left, right = pair
    apart = np.roll(right, 1, axis=0)
    check = PairCheck()
    assert [ask(check, left, apart, disparity(left, apart)) for _ in range(9)] == [set()] * 9


def test_rows_that_stay_apart_are_told_after_five_frames(pair: Pair):
    left, right = pair
    apart, wrong, good = np.roll(right, 2, axis=0), disparity(left, right), (left, right, disparity(left, right))
    check = PairCheck()
    found = [ask(check, left, apart, wrong) for _ in range(6)]
    assert found == [set()] * 4 + [{ImageFault.ROW_MISMATCH}] * 2
    assert [ask(check, *good) for _ in range(4)] == [{ImageFault.ROW_MISMATCH}] * 3 + [set()], "four bad frames of eight"


def test_few_places_of_which_none_is_found_again_are_told(pair):
    """Swapped cameras in a dense view: hardly a place has a depth at all."""
    nothing = RowOffsets(np.empty((0, 2)), np.empty(0), np.empty(0), tried=45)
    check = PairCheck()
    assert [check.check(pair[0], nothing, F_PX) for _ in range(3)] == [set(), set(), {ImageFault.SCENE_MISMATCH}]
    check, fewer = PairCheck(), replace(nothing, tried=20)
    assert [check.check(pair[0], fewer, F_PX) for _ in range(4)] == [set()] * 4, "too few to say"


@pytest.mark.parametrize(("rows_px", "told"), [(0.0005 * F_PX, False), (0.002 * F_PX, True)])
def test_few_places_that_are_found_again_vouch_for_the_cameras_when_their_rows_agree(pair, rows_px, told):
    """All that is seen is far and hazy, or the few partners are false."""
    few = RowOffsets(np.zeros((20, 2)), np.full(20, 3.0), np.full(20, rows_px), tried=90)
    check = PairCheck()
    assert [bool(check.check(pair[0], few, F_PX)) for _ in range(4)] == [False, False, told, told]


def test_rows_far_apart_are_told_after_three_frames_like_cameras_that_see_different_things(pair):
    """Swapped cameras find false partners far off their rows."""
    left, right = pair
    apart, wrong = np.roll(right, 5, axis=0), disparity(left, right)
    assert row_offsets(left, apart, wrong).count > 0.3 * row_offsets(left, apart, wrong).tried
    check = PairCheck()
    assert [ask(check, left, apart, wrong) for _ in range(4)] == [set(), set()] + [{ImageFault.SCENE_MISMATCH}] * 2


def test_rows_no_farther_apart_than_the_doubt_in_where_the_cameras_point_are_no_fault(pair):
    left, right = pair
    apart = np.roll(right, 2, axis=0)
    offsets = row_offsets(left, apart, disparity(left, apart))
    kept = {row_uncertainty_rad: PairCheck() for row_uncertainty_rad in (0.0, 1e-3, 4e-3)}
    found = {
        row_uncertainty_rad: [check.check(left, offsets, F_PX, row_uncertainty_rad) for _ in range(6)][-1]
        for row_uncertainty_rad, check in kept.items()
    }
    assert found == {0.0: {ImageFault.ROW_MISMATCH}, 1e-3: {ImageFault.ROW_MISMATCH}, 4e-3: set()}


def test_rows_apart_for_a_moment_are_no_fault(pair):
    """As in a quick pitch, where 2 ms between the cameras show."""
    left, right = pair
    apart, depth = np.roll(right, 2, axis=0), disparity(left, right)
    check = PairCheck()
    for _ in range(3):
        assert [ask(check, left, apart, depth) for _ in range(4)] == [set()] * 4
        assert [ask(check, left, right, depth) for _ in range(8)] == [set()] * 8


def test_a_bare_wall_is_no_fault():
    rng = np.random.default_rng(1)
    left, right = (rng.normal(120, 1.0, (240, 320)).round().astype(np.uint8) for _ in range(2))
    assert ask(PairCheck(), left, right, np.full((240, 320), 5.0, np.float32)) == set()
