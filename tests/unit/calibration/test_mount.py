"""How the left camera sits on the vehicle, from attitudes and boards: found, refused when it cannot be, kept in the file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morpheyes_daemon.calibration.mount import ATTITUDES, MountViews, orientations, read_mount_folder, solve_mount
from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Mount
from morpheyes_daemon.errors import CalibrationError, InputError
from morpheyes_daemon.flights.sim_boards import render_mount_folder
from morpheyes_daemon.simulation.camera.true_rig import RANGE_M, RigTwin
from morpheyes_daemon.stereo.calibration_file import calibration_hash, read_calibration, write_calibration
from morpheyes_daemon.stereo.rectify import rectify
from morpheyes_daemon.stereo.rig import CameraMount, RigModel
from morpheyes_daemon.transforms import Array, R_from_rotvec, rotvec_from_R

R_FRD_RIG = T_frd_rig(Mount())[:3, :3]
TRUE = np.array([0.009, -0.006, 0.004])
BOARD = Board(9, 6, 0.025)


def turned(n: int, spread_rad: float, noise_rad: float, stray: int = 0) -> MountViews:
    """Attitudes about a level one, and the board that a camera with the TRUE rotation sees, some of them upside down."""
    rng = np.random.default_rng(5)
    R_ned_frd = np.array([R_from_rotvec(rng.normal(0.0, spread_rad, 3)) for _ in range(n)])
    wall = R_FRD_RIG @ R_from_rotvec(np.array([0.1, 0.2, 0.0]))
    upside_down = R_from_rotvec(np.array([0.0, 0.0, math.pi]))
    seen = []
    for k, attitude in enumerate(R_ned_frd):
        R = (attitude @ R_FRD_RIG @ R_from_rotvec(TRUE)).T @ wall
        seen.append(R @ upside_down if k % 3 == 1 else R)
    wrong = [R_from_rotvec(rng.normal(0.0, 0.1 if k < stray else noise_rad, 3)) for k in range(n)]
    noisy = np.array([R @ e for R, e in zip(R_ned_frd, wrong, strict=True)])
    return MountViews(tuple(str(k) for k in range(n)), noisy, np.array(seen))


def off_rad(mount: CameraMount, true: Array = TRUE) -> float:
    return float(np.linalg.norm(rotvec_from_R(R_from_rotvec(true).T @ R_from_rotvec(np.array(mount.rotation_rad)))))


def test_without_errors_the_rotation_is_found_exactly() -> None:
    found = solve_mount(turned(12, 0.5, 0.0), R_FRD_RIG, 2)
    assert off_rad(found.mount) < 1e-9
    assert found.rms_rad < 1e-9
    assert math.degrees(found.rotation_spread_rad) == pytest.approx(
        50.0, abs=10.0
    )  # half a radian about each of three axes


def test_what_is_left_of_an_attitudes_error_is_what_it_says() -> None:
    found = solve_mount(turned(60, 0.5, 3.5e-3), R_FRD_RIG, 2)
    assert found.rms_rad == pytest.approx(3.5e-3, rel=0.25)
    # the error is within three of its own sigmas in each axis, and well below a single attitude's
    error = np.abs(np.array(found.mount.rotation_rad) - TRUE)
    assert np.all(error < 3 * np.array(found.mount.sigma_rad))
    assert max(found.mount.sigma_rad) < 1.2e-3


def test_a_few_attitudes_that_are_quite_wrong_hardly_count() -> None:
    found = solve_mount(turned(60, 0.5, 2e-3, stray=4), R_FRD_RIG, 2)
    assert off_rad(found.mount) < 4e-3


def test_a_vehicle_that_was_hardly_turned_is_refused() -> None:
    with pytest.raises(CalibrationError, match="rotate the vehicle farther"):
        solve_mount(turned(30, 0.03, 3.5e-3), R_FRD_RIG, 2)


@pytest.mark.parametrize("axes", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_vehicle_that_was_turned_about_one_axis_or_none_is_refused(axes: tuple[float, float, float]) -> None:
    views = turned(12, 0.5, 0.0)
    attitudes = [R_from_rotvec(np.array(axes) * 0.1 * k) for k in range(12)]
    wall = R_FRD_RIG
    seen = [(attitude @ R_FRD_RIG @ R_from_rotvec(TRUE)).T @ wall for attitude in attitudes]
    with pytest.raises(CalibrationError, match="rotate the vehicle farther"):
        solve_mount(replace(views, R_ned_frd=np.array(attitudes), R_cam0_board=np.array(seen)), R_FRD_RIG, 2)


def test_too_few_pictures_are_refused() -> None:
    with pytest.raises(CalibrationError, match="9 pictures show the board, 10 are needed"):
        solve_mount(turned(9, 0.5, 0.0), R_FRD_RIG, 2)


def test_boards_look_the_same_in_one_two_or_four_ways_up() -> None:
    assert [
        orientations(Board(9, 6, 0.025)),
        orientations(Board(6, 6, 0.025)),
        orientations(Board(9, 6, 0.025, "charuco", "5X5_1000", 0.7)),
    ] == [2, 4, 1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mount") / "held"
    render_mount_folder(out, seed=1, views=24, board=BOARD, size=(640, 480))
    return out


def test_the_twins_camera_is_found_from_its_pictures(folder: Path) -> None:
    twin = RigTwin(640, 480, seed=1)
    views = read_mount_folder(folder, BOARD, twin.cam0)
    assert len(views.names) >= 20
    found = solve_mount(views, R_FRD_RIG, orientations(BOARD))
    true = rotvec_from_R(twin.T_rig_eye(0, twin.actual_m(RANGE_M[0]))[:3, :3])
    # the camera is 9 mrad off; 3.5 mrad of attitude error in each of two dozen pictures leave about one of each axis
    assert np.linalg.norm(true) > 8e-3
    assert off_rad(found.mount, true) < 4e-3


def test_pictures_that_cannot_be_used_are_named_and_left_out(folder: Path, tmp_path: Path) -> None:
    lines = (folder / ATTITUDES).read_text().splitlines()
    for name in ("left01.png", "left02.png"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "left03.png").write_bytes(b"no picture")
    (tmp_path / ATTITUDES).write_text("\n".join(lines[:4]) + "\nleft99.png,0,0,0\n")
    views = read_mount_folder(tmp_path, BOARD, RigTwin(640, 480, seed=1).cam0)
    assert [
        problem.partition(":")[0].rpartition("/")[2] for problem in views.problems if "delete its row" in problem
    ] == [
        "left03.png",
        "left99.png",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("picture,roll_deg,pitch_deg\n", "needs the columns picture, roll_deg, pitch_deg, yaw_deg"),
        ("picture,roll_deg,pitch_deg,yaw_deg\nleft01.png,1,2,x\n", "line 2: the angles are not numbers"),
        ("picture,roll_deg,pitch_deg,yaw_deg\nleft01.png,1,2,nan\n", "line 2: the angles are not numbers"),
        ("picture,roll_deg,pitch_deg,yaw_deg\nleft01.png,1\n", "line 2: the angles are not numbers"),
    ],
)
def test_a_bad_list_of_attitudes_is_refused_naming_the_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / ATTITUDES).write_text(text)
    with pytest.raises(InputError, match=said):
        read_mount_folder(tmp_path, BOARD, RigTwin(640, 480, seed=1).cam0)


def test_a_folder_without_attitudes_says_how_to_take_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="calibrate capture --mount"):
        read_mount_folder(tmp_path, BOARD, RigTwin(640, 480, seed=1).cam0)


def test_the_file_keeps_it_and_the_rectified_camera_points_there(tmp_path: Path) -> None:
    rig = RigTwin(640, 480, seed=1).exact_rig(3)
    mounted = replace(rig, mount=CameraMount((0.009, -0.006, 0.004), (1e-3, 1e-3, 1e-3)))
    write_calibration(mounted, tmp_path / "rig.yaml")
    read = read_calibration(tmp_path / "rig.yaml")
    assert read.mount is not None
    assert read.mount.rotation_rad == pytest.approx((0.009, -0.006, 0.004))
    assert calibration_hash(read) == calibration_hash(mounted) != calibration_hash(rig)
    assert read_calibration(_saved(rig, tmp_path)).mount is None
    plain, turned_eye = (rectify(one, 0.1).T_rig_rect[:3, :3] for one in (rig, mounted))
    assert turned_eye == pytest.approx(R_from_rotvec(np.array([0.009, -0.006, 0.004])) @ plain, abs=1e-9)


def _saved(rig: RigModel, folder: Path) -> Path:
    write_calibration(rig, folder / "plain.yaml")
    return folder / "plain.yaml"
