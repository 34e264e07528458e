"""`morpheyes calibrate` at a terminal: from rendered boards to a judged file, and what is said when it cannot be."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from morpheyes_daemon.cli import main
from morpheyes_daemon.flights.sim_boards import render_folder
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.stereo.calibration_file import read_calibration, write_calibration

NOMINAL_M = (0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards") / "twin"
    render_folder(folder, 0, NOMINAL_M, views=5)
    return folder


class Terminal:
    """Runs the command line and keeps what it prints."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._capsys, self._monkeypatch = capsys, monkeypatch

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        self._monkeypatch.setattr(sys, "argv", ["morpheyes", "calibrate", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = self._capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err


@pytest.fixture
def terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Terminal:
    return Terminal(capsys, monkeypatch)


def test_from_rendered_boards_to_a_judged_file_and_its_report(boards: Path, tmp_path: Path, terminal: Terminal) -> None:
    file = tmp_path / "rig.yaml"
    code, out, _ = terminal("solve", boards, "--out", file, "--json")
    solved = json.loads(out)
    assert code == 0
    assert {len(solved[key]) for key in ("nominal_mm", "baselines_mm", "rms_px")} == {3}
    assert [row["baseline_mm"] for row in solved["leave_one_out"]] == [200.0]
    assert solved["verdict"]

    code, out, _ = terminal("evaluate", file, "--json")
    truth = json.loads(out)
    assert code == 0
    # five views at three baselines only; ten baselines with twelve views are three times better
    assert truth["epipolar_median_px"] <= 0.10
    assert truth["baseline_error_max_mm"] <= 1.5, "three knots do not follow the servo's waves"
    assert truth["disparity_bias_max_px"] <= 0.25

    code, _, _ = terminal("report", file)
    page = (tmp_path / "rig.html").read_text(encoding="utf-8")
    assert code == 0
    assert 'src="http' not in page, "nothing is fetched"
    assert "@import" not in page
    code, _, _ = terminal("report", file, "--out", tmp_path / "rig.png")
    assert code == 0
    assert (tmp_path / "rig.png").read_bytes().startswith(b"\x89PNG")

    code, out, _ = terminal("repeatability", file, boards, "--out", tmp_path / "visits.png", "--json")
    assert code == 0
    positions = json.loads(out)["positions"]
    assert [row["target_mm"] for row in positions] == [100.0, 200.0, 300.0]
    # the pictures at one baseline are one visit: what scatters is the measurement
    assert max(row["sigma_mm"] for row in positions) < 0.05


def test_a_missing_square_size_is_an_error_and_nothing_is_asked(
    boards: Path, tmp_path: Path, terminal: Terminal
) -> None:
    folder = tmp_path / "unmeasured"
    shutil.copytree(boards, folder)
    (folder / "board.yaml").unlink()
    code, out, err = terminal("solve", folder, "--json")
    assert (code, out) == (2, "")
    assert "--square-mm" in err


def test_a_wrong_square_size_is_caught_by_the_folders_names(boards: Path, tmp_path: Path, terminal: Terminal) -> None:
    folder = tmp_path / "wrong"
    shutil.copytree(boards, folder)
    (folder / "board.yaml").unlink()
    code, _, err = terminal("solve", folder, "--square-mm", 30, "--out", tmp_path / "rig.yaml", "--json")
    assert code == 2
    assert "as if a square were 25" in err
    assert not (tmp_path / "rig.yaml").exists()
    assert (tmp_path / "rig.corners.npz").exists(), "the corners found are kept"


def test_two_square_sizes_that_disagree_are_refused(boards: Path, terminal: Terminal) -> None:
    code, _, err = terminal("solve", boards, "--square-mm", 30, "--json")
    assert code == 2
    assert "board.yaml (25 mm) disagree" in err


def test_a_cut_or_edited_file_is_refused_by_name(boards: Path, tmp_path: Path, terminal: Terminal) -> None:
    file = tmp_path / "rig.yaml"
    terminal("solve", boards, "--out", file, "--json")
    text = file.read_text(encoding="utf-8")
    for damaged in (text[: len(text) // 2], text.replace("nominal_mm: 200.0", "nominal_mm: 201.0")):
        file.write_text(damaged, encoding="utf-8")
        code, _, err = terminal("evaluate", file, "--json")
        assert code == 2
        assert str(file) in err
        assert "calibrate solve" in err


def test_a_file_of_another_rig_has_no_twin(boards: Path, tmp_path: Path, terminal: Terminal) -> None:
    folder = tmp_path / "own"
    shutil.copytree(boards, folder)
    content = yaml.safe_load((folder / "board.yaml").read_text())
    (folder / "board.yaml").write_text(yaml.safe_dump({**content, "rig": "my own"}))
    terminal("solve", folder, "--out", tmp_path / "own.yaml", "--json")
    code, _, err = terminal("evaluate", tmp_path / "own.yaml", "--json")
    assert code == 2
    assert "--seed" in err


def test_rendering_into_a_full_folder_is_refused(boards: Path, terminal: Terminal) -> None:
    before = sorted(boards.rglob("*.png"))
    code, _, err = terminal("render", boards)
    assert code == 2
    assert "not empty" in err
    assert sorted(boards.rglob("*.png")) == before


@pytest.mark.parametrize("text", ["abc", "50,100", "100,100", "0"])
def test_baselines_that_cannot_be_are_refused(text: str, tmp_path: Path, terminal: Terminal) -> None:
    code, _, err = terminal("render", tmp_path / "new", "--baselines", text)
    assert code == 2
    assert "--baselines" in err


def test_the_same_seed_renders_the_same_pictures(boards: Path, tmp_path: Path) -> None:
    import cv2

    again = tmp_path / "again"
    render_folder(again, 0, (0.2,), views=2)
    for name in ("left01.png", "right02.png"):
        picture = cv2.imread(str(again / "200mm" / name))
        assert picture.std() > 20
    render_folder(tmp_path / "third", 0, (0.2,), views=2)
    one, two = (cv2.imread(str(tmp_path / name / "200mm" / "left01.png")) for name in ("again", "third"))
    assert one is not None
    assert two is not None
    assert np.array_equal(one, two)


def test_the_cameras_mount_is_measured_and_written_into_the_file(tmp_path: Path, terminal: Terminal) -> None:
    file, held = tmp_path / "rig.yaml", tmp_path / "held"
    write_calibration(RigTwin(640, 480, seed=0).exact_rig(3), file)
    assert terminal("render", held, "--mount", "--views", 20)[0] == 0
    code, out, _ = terminal("mount", file, held, "--out", tmp_path / "mounted.yaml", "--json")
    found = json.loads(out)
    assert code == 0
    # the twin's left camera is turned by -0.52, 0.32 and 0.08 degrees
    assert found["rotation_deg"] == pytest.approx([-0.52, 0.32, 0.08], abs=0.25)
    assert max(found["sigma_deg"]) < 0.15
    assert read_calibration(tmp_path / "mounted.yaml").mount is not None
    assert read_calibration(file).mount is None
    before, after = (
        json.loads(terminal("evaluate", one, "--seed", 0, "--json")[1])["pointing_error_deg"][0]
        for one in (file, tmp_path / "mounted.yaml")
    )
    assert before == pytest.approx(0.61, abs=0.02)
    assert after < 0.25
    code, out, _ = terminal("mount", file, held)
    assert "the left camera is rotated up by -0." in out
    assert read_calibration(file).mount is not None


def test_without_attitudes_it_says_what_to_do(boards: Path, tmp_path: Path, terminal: Terminal) -> None:
    file = tmp_path / "rig.yaml"
    write_calibration(RigTwin(640, 480, seed=0).exact_rig(3), file)
    code, _, err = terminal("mount", file, boards)
    assert code != 0
    assert "calibrate capture --mount" in err
