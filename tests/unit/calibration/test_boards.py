"""Boards: told apart, found, and their corners exact; what a person types is checked."""

import numpy as np
import pytest

from morpheyes_daemon.calibration.targets.boards import Board, aligned, find_corners, parse_board
from morpheyes_daemon.calibration.targets.subpixel import saddle_points
from morpheyes_daemon.errors import UsageError
from morpheyes_daemon.simulation.camera.calibration_boards import BoardTwin, draw_poses
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.transforms import inverse

CHESS = Board(9, 6, 0.025)
CHARUCO = Board(9, 6, 0.03, "charuco", "5X5_1000")


@pytest.mark.parametrize("board", [CHESS, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_of_the_camera_twin_are_found_to_a_few_hundredths_of_a_pixel(board: Board) -> None:
    rig = RigTwin(seed=3)
    b, views = rig.actual_m(0.2), 4
    poses = draw_poses(rig, board, b, views, np.random.default_rng([3, 510, round(b * 1e9)]))
    errors = []
    for pair, T_rig_board in zip(BoardTwin(rig, board, seed=3).pairs([b] * views), poses, strict=True):
        T_eye_board = inverse(rig.T_rig_eye(0, b)) @ T_rig_board
        true = rig.cam0.project(board.points_m @ T_eye_board[:3, :3].T + T_eye_board[:3, 3])
        found = find_corners(pair.left, board)
        assert found is not None
        turned = np.nanmedian(np.abs(found - true)) > 1.0
        errors.append((found[::-1] if turned else found) - true)
    size = np.linalg.norm(np.concatenate(errors), axis=1)
    # photon noise and a spot of 0.6 px leave 0.02 px per coordinate; twice that at the farthest boards
    assert np.nanmedian(size) < 0.04
    assert np.nanpercentile(size, 95) < 0.12


def test_a_partly_hidden_charuco_board_gives_the_corners_that_are_seen() -> None:
    picture, corners = CHARUCO.picture(48)
    picture[:, : picture.shape[1] // 2] = 128
    found = find_corners(picture, CHARUCO)
    assert found is not None
    seen = np.isfinite(found[:, 0])
    assert 15 < seen.sum() < 40
    assert np.abs(found[seen] - corners[seen]).max() < 0.1


def test_there_is_no_board_in_a_blank_picture() -> None:
    blank = np.full((240, 320), 90, dtype=np.uint8)
    assert find_corners(blank, CHESS) is None
    assert find_corners(blank, CHARUCO) is None


def test_the_right_camera_gets_the_left_cameras_order_whatever_the_detector_gave() -> None:
    _, corners = CHESS.picture(20)
    shifted = corners - [31.0, 0.5]
    assert aligned(corners, shifted[::-1], CHESS) == pytest.approx(shifted)
    assert aligned(corners, shifted, CHESS) == pytest.approx(shifted)


def test_a_square_board_is_aligned_over_quarter_turns() -> None:
    board = Board(7, 7, 0.02)
    _, corners = board.picture(20)
    quarter = np.rot90(corners.reshape(7, 7, 2), 1, axes=(0, 1)).reshape(-1, 2)
    assert aligned(corners, quarter, board) == pytest.approx(corners)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (-0.49, 0.25)])
def test_the_saddle_of_a_soft_corner_is_found_at_any_pixel_phase(shift: tuple[float, float]) -> None:
    v, u = np.mgrid[0:41, 0:41].astype(np.float64)
    x, y = u - 20 - shift[0], v - 20 - shift[1]
    image = (127 + 100 * np.tanh(0.7 * (x + 0.2 * y)) * np.tanh(0.7 * (y - 0.1 * x))).astype(np.uint8)
    found, good = saddle_points(image, np.array([[20.6, 19.7]]), 5)
    assert good.all()
    assert found[0] == pytest.approx([20 + shift[0], 20 + shift[1]], abs=0.02), "rounding to grey levels"


def test_where_there_is_no_saddle_the_start_is_kept() -> None:
    found, good = saddle_points(np.full((40, 40), 77, np.uint8), np.array([[20.0, 20.0]]), 5)
    assert not good.any()
    assert found[0] == pytest.approx([20.0, 20.0])


def test_what_a_board_option_means() -> None:
    assert parse_board("9x6", 0.025) == CHESS
    charuco = parse_board("charuco:10x7:5x5_1000", 0.025)
    assert (charuco.columns, charuco.rows, charuco.dictionary) == (9, 6, "5X5_1000")
    assert parse_board("charuco:10x7", 0.02, marker_m=0.014).marker_share == pytest.approx(0.7)
    assert parse_board(charuco.label, 0.025) == charuco


@pytest.mark.parametrize("text", ["9 by 6", "9x", "x6", "2x6", "9x6:5X5_50", "charuco:10x7:NOPE", "100x6"])
def test_a_board_that_cannot_be_is_refused_with_a_remedy(text: str) -> None:
    with pytest.raises(UsageError, match=r"give|use"):
        parse_board(text, 0.025)


@pytest.mark.parametrize("square_m", [0.0, -0.02, 5.0, float("nan")])
def test_a_square_of_an_unbelievable_size_is_refused(square_m: float) -> None:
    with pytest.raises(UsageError, match="measure one"):
        parse_board("9x6", square_m)
