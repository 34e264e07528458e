"""The moving object is found, tracked and measured; a static scene has none."""

import numpy as np
import pytest

from morpheyes_daemon.messages.core import Track
from morpheyes_daemon.strategies.imo.tracker import ObjectTracker
from tests.support.moving_square import Square, moved, view


def along(start: Square, step: tuple[float, float, float], frames: int) -> list[Square]:
    return [moved(start, (k * step[0], k * step[1], k * step[2])) for k in range(frames)]


def test_a_crossing_object_is_confirmed_within_a_second_with_one_percent_depth_error() -> None:
    tracker = ObjectTracker()
    squares = along(Square((2.5, -0.5, 0.0)), (0.0, 0.06, 0.0), 14)
    tracks = [tracker.step(view(k, square)) for k, square in enumerate(squares)]
    assert all(track is not None and track.seen for track in tracks[5:])
    for track, square in list(zip(tracks, squares, strict=True))[5:]:
        assert isinstance(track, Track)
        # rows and columns are sampled at whole pixels, the face's middle to about one: 7 mm here
        assert np.allclose(track.p_ned_m[1:], square.p_ned_m[1:], atol=0.05)
        assert track.p_rect_m[2] == pytest.approx(2.5, rel=0.01)
    last = tracks[-1]
    assert last is not None
    assert last.v_ned_m_s[1] == pytest.approx(0.3, abs=0.1)


def test_it_is_tracked_down_to_a_dozen_pixels() -> None:
    tracker = ObjectTracker()
    squares = along(Square((1.6, -0.2, 0.0), 0.16), (0.2, 0.02, 0.005), 18)
    tracks = [tracker.step(view(k, square, baseline_m=0.3)) for k, square in enumerate(squares)]
    for track, square in list(zip(tracks, squares, strict=True))[5:]:
        assert track is not None
        assert track.seen
        # 12 px wide at 5 m: two hundredths of a pixel of disparity are 1 mm per m
        assert track.p_rect_m[2] == pytest.approx(square.p_ned_m[0], rel=0.015)


def test_an_object_that_fills_most_of_the_image_does_not_become_the_frame_of_reference() -> None:
    tracker = ObjectTracker()
    squares = along(Square((0.6, -0.05, 0.0), 0.35), (0.0, 0.015, 0.0), 10)
    tracks = [tracker.step(view(k, square, baseline_m=0.1)) for k, square in enumerate(squares)]
    last = tracks[-1]
    assert last is not None
    assert last.p_rect_m[2] == pytest.approx(0.6, rel=0.01)
    assert last.v_ned_m_s[1] > 0.03


def test_a_static_scene_has_no_object_in_spite_of_pose_errors() -> None:
    tracker = ObjectTracker()
    rng = np.random.default_rng(5)
    for k in range(25):
        eye = (0.0, 0.4 * np.sin(0.5 * k), 0.1 * np.sin(0.3 * k))
        track = tracker.step(view(k, Square((2.0, 0.2, 0.0)), eye, told_error_m=float(rng.normal(0.0, 0.01))))
        assert track is None


def test_a_moving_object_is_found_from_a_moving_vehicle() -> None:
    tracker = ObjectTracker()
    squares = along(Square((2.5, -0.4, 0.0)), (0.03, 0.05, 0.0), 14)
    tracks = [
        tracker.step(view(k, square, (0.0, 0.2 * np.sin(0.5 * k), 0.0), told_error_m=0.01 * (-1) ** k))
        for k, square in enumerate(squares)
    ]
    assert sum(track is not None and track.seen for track in tracks[5:]) >= 8


def test_it_is_found_again_after_a_second_of_occlusion() -> None:
    tracker = ObjectTracker(coast_s=2.0)
    squares = along(Square((2.5, -0.6, 0.0)), (0.0, 0.06, 0.0), 24)
    tracks = [tracker.step(view(k, square, hidden=10 <= k < 15)) for k, square in enumerate(squares)]
    before, behind, after = tracks[9], tracks[13], tracks[16]
    assert before is not None
    assert behind is not None
    assert after is not None
    assert not behind.seen
    assert after.seen
    assert after.id == before.id
    assert np.trace(behind.covariance) > np.trace(before.covariance)


def test_an_occluder_is_not_taken_for_the_object() -> None:
    tracker = ObjectTracker(coast_s=2.0)
    cover = Square((1.8, 0.1, 0.0), 0.3)  # hides 0.42 m at the object's depth
    squares = along(Square((2.5, -0.6, 0.0)), (0.0, 0.06, 0.0), 26)
    tracks = [tracker.step(view(k, square, cover=cover)) for k, square in enumerate(squares)]
    for track, square in list(zip(tracks, squares, strict=True))[6:]:
        assert track is not None
        if track.seen:
            assert track.p_rect_m[2] == pytest.approx(2.5, rel=0.02)
            # the centre of the visible part is off by less than what is hidden
            assert track.p_ned_m[1] == pytest.approx(square.p_ned_m[1], abs=0.16)
    last = tracks[-1]
    assert last is not None
    assert last.seen
    assert last.id == tracks[6].id
    assert last.v_ned_m_s[1] == pytest.approx(0.3, abs=0.1)


def test_an_object_that_stops_is_dropped() -> None:
    tracker = ObjectTracker()
    squares = along(Square((2.5, -0.4, 0.0)), (0.0, 0.06, 0.0), 10)
    squares += [squares[-1]] * 45
    tracks = [tracker.step(view(k, square)) for k, square in enumerate(squares)]
    assert tracks[9] is not None
    assert tracks[-1] is None
