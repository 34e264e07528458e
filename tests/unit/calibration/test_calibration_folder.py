"""Which pictures belong together, and what is said of those that cannot be used."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.calibration.targets.detection import CornerCache, observe
from morpheyes_daemon.calibration.targets.image_pairs import read_folder
from morpheyes_daemon.errors import InputError

BOARD = Board(9, 6, 0.025)


def board_picture(shift: int = 0, size: tuple[int, int] = (320, 240)) -> np.ndarray:
    picture = np.full((size[1], size[0]), 200, np.uint8)
    drawn, _ = BOARD.picture(18, margin_squares=0.5)
    picture[20 : 20 + drawn.shape[0], 40 + shift : 40 + shift + drawn.shape[1]] = drawn
    return cv2.GaussianBlur(picture, (0, 0), 0.7)


def write_pairs(folder: Path, count: int = 3, **size: tuple[int, int]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(1, count + 1):
        cv2.imwrite(str(folder / f"left{number:02d}.png"), board_picture(4 * number, **size))
        cv2.imwrite(str(folder / f"right{number:02d}.png"), board_picture(4 * number - 3, **size))


def test_folders_are_sorted_by_length_not_by_name(tmp_path: Path) -> None:
    for name in ("100mm", "90mm", "122.2mm", "1000 MM"):
        write_pairs(tmp_path / name, 1)
    folders, problems = read_folder(tmp_path)
    assert [folder.nominal_m for folder in folders] == pytest.approx([0.09, 0.1, 0.1222, 1.0])
    assert not problems


def test_one_folder_alone_is_a_fixed_rig(tmp_path: Path) -> None:
    write_pairs(tmp_path / "rig")
    folders, _ = read_folder(tmp_path / "rig")
    assert len(folders) == 1
    assert folders[0].nominal_m is None
    assert len(folders[0].pairs) == 3


def test_names_share_their_number_however_they_are_written_and_other_files_are_ignored(tmp_path: Path) -> None:
    write_pairs(tmp_path, 1)
    cv2.imwrite(str(tmp_path / "left_7.png"), board_picture())
    cv2.imwrite(str(tmp_path / "Right-007.jpg"), board_picture())
    cv2.imwrite(str(tmp_path / "pattern.png"), board_picture())
    (tmp_path / "left_intrinsics.yml").write_text("fx: 1")
    (tmp_path / "SOURCE.md").write_text("where from")
    folders, problems = read_folder(tmp_path)
    names = [(pair.left.name, pair.right.name) for pair in folders[0].pairs if pair.left and pair.right]
    assert names == [("left01.png", "right01.png"), ("left_7.png", "Right-007.jpg")]
    assert not problems


def test_side_by_side_pictures_are_split(tmp_path: Path) -> None:
    folder = tmp_path / "60mm"
    folder.mkdir()
    for number in range(3):
        both = np.hstack([board_picture(5 * number), board_picture(3 * number)])
        cv2.imwrite(str(folder / f"scene_640x240_{number}.png"), both)
    folders, problems = read_folder(tmp_path)
    seen = observe(folders, BOARD, problems=problems)
    assert seen.size == (320, 240)
    assert seen.view_count == 3
    assert seen.names[0][1].endswith("(right half)")


def test_a_missing_right_picture_is_named_and_the_rest_kept(tmp_path: Path) -> None:
    write_pairs(tmp_path, 4)
    (tmp_path / "right02.png").unlink()
    folders, problems = read_folder(tmp_path)
    seen = observe(folders, BOARD, problems=problems)
    assert seen.view_count == 4, "the left picture alone still tells about the left lens"
    assert len(problems) == 1
    assert "left02.png" in problems[0]
    assert "retake" in problems[0]


def test_a_folder_without_any_right_picture_is_an_error(tmp_path: Path) -> None:
    write_pairs(tmp_path / "100mm")
    for path in (tmp_path / "100mm").glob("right*"):
        path.unlink()
    with pytest.raises(InputError, match=r"100mm: has no right picture"):
        read_folder(tmp_path)


def test_two_folders_of_one_length_are_refused(tmp_path: Path) -> None:
    write_pairs(tmp_path / "100mm", 1)
    write_pairs(tmp_path / "100.0mm", 1)
    with pytest.raises(InputError, match=r"same baseline as .*keep one"):
        read_folder(tmp_path)


def test_a_number_used_twice_is_named(tmp_path: Path) -> None:
    write_pairs(tmp_path, 3)
    cv2.imwrite(str(tmp_path / "left_3.png"), board_picture())
    _, problems = read_folder(tmp_path)
    assert any("same number" in problem and "left_3.png" in problem for problem in problems)


def test_pictures_of_another_size_are_named_and_left_out(tmp_path: Path) -> None:
    write_pairs(tmp_path, 4)
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{side}05.png"), board_picture(size=(640, 480)))
    cv2.imwrite(str(tmp_path / "right04.png"), board_picture(size=(640, 480)))
    folders, problems = read_folder(tmp_path)
    seen = observe(folders, BOARD, problems=problems)
    assert seen.view_count == 3
    assert any("left05.png: is 640x480" in problem for problem in problems)
    assert any("right04.png" in problem and "one size" in problem for problem in problems)


def test_unreadable_and_empty_pictures_are_named(tmp_path: Path) -> None:
    write_pairs(tmp_path, 5)
    (tmp_path / "left02.png").write_bytes(b"not a picture")
    (tmp_path / "right03.png").write_bytes(b"")
    folders, problems = read_folder(tmp_path)
    assert observe(folders, BOARD, problems=problems).view_count == 3
    for name in ("left02.png", "right03.png"):
        assert any(name in problem and "cannot be read as a picture" in problem for problem in problems)


def test_pictures_without_a_board_are_named_and_a_baseline_without_any_is_lost(tmp_path: Path) -> None:
    write_pairs(tmp_path / "100mm", 3)
    write_pairs(tmp_path / "200mm", 3)
    for path in (tmp_path / "200mm").glob("*.png"):
        cv2.imwrite(str(path), np.full((240, 320), 120, np.uint8))
    folders, problems = read_folder(tmp_path)
    seen = observe(folders, BOARD, problems=problems)
    assert list(seen.nominal_m) == [0.1]
    assert len(seen.lost) == 1
    assert "200mm" in seen.lost[0]
    assert any("no 9x6 board is found" in problem for problem in problems)


def test_boards_found_nowhere_are_an_error_that_names_the_option(tmp_path: Path) -> None:
    write_pairs(tmp_path, 3)
    folders, _ = read_folder(tmp_path)
    with pytest.raises(InputError, match="--board"):
        observe(folders, Board(7, 5, 0.025))


def test_nothing_to_calibrate_from_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="left01.png"):
        read_folder(tmp_path)
    with pytest.raises(InputError, match="not a folder"):
        read_folder(tmp_path / "absent")


def test_corners_found_once_are_remembered_and_forgotten_with_the_picture(tmp_path: Path) -> None:
    write_pairs(tmp_path, 3)
    folders, _ = read_folder(tmp_path)
    cache = CornerCache(tmp_path / "rig.corners.npz")
    first = observe(folders, BOARD, cache)
    again = CornerCache(tmp_path / "rig.corners.npz")
    assert len(again.found) == 6
    assert observe(folders, BOARD, again).left == pytest.approx(first.left)
    cv2.imwrite(str(tmp_path / "left01.png"), board_picture(30))
    moved = observe(folders, BOARD, CornerCache(tmp_path / "rig.corners.npz"))
    assert not np.allclose(moved.left[0], first.left[0])


def test_a_damaged_memory_of_corners_is_only_slower(tmp_path: Path) -> None:
    write_pairs(tmp_path, 3)
    memory = tmp_path / "rig.corners.npz"
    memory.write_bytes(b"PK\x03\x04 cut short")
    folders, _ = read_folder(tmp_path)
    assert observe(folders, BOARD, CornerCache(memory)).view_count == 3
