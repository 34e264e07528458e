"""`morpheyes depth` and `morpheyes analyze`: what they print, leave behind, and say about what they cannot use."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from morpheyes_daemon.cli import main
from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.stereo.calibration_file import write_calibration
from tests.support.panels import Panel, crooked_rig, ideal_pair, raw_pair

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
PNG = b"\x89PNG\r\n\x1a\n"


class Terminal:
    """Runs the command line and keeps what it prints."""

    def __init__(self, capsys, monkeypatch):
        self._capsys, self._monkeypatch = capsys, monkeypatch

    def __call__(self, *arguments):
        self._monkeypatch.setattr(sys, "argv", ["morpheyes", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = self._capsys.readouterr()
        return ended.value.code or 0, said.out, said.err


@pytest.fixture
def terminal(capsys, monkeypatch):
    return Terminal(capsys, monkeypatch)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    left, right, depth = ideal_pair([Panel(4.0, slope_x=0.3)], PINHOLE, 0.2, 1.5)
    cv2.imwrite(str(folder / "left.png"), left)
    cv2.imwrite(str(folder / "right.png"), right)
    cv2.imwrite(str(folder / "both.png"), np.hstack([left, right]))
    cv2.imwrite(str(folder / "small.png"), right[:, :-2])
    np.save(folder / "truth.npy", depth)
    raw = raw_pair([Panel(3.0)], crooked_rig(320, 240), 0.25, 1.5)
    for name, image in zip(("raw_left.png", "raw_right.png"), raw, strict=True):
        cv2.imwrite(str(folder / name), image)
    write_calibration(crooked_rig(), folder / "rig.yaml")
    (folder / "torn.png").write_bytes(PNG + b"torn")
    return folder


OPTIONS = ("--focal-px", 370, "--baseline-m", 0.2)


@pytest.mark.parametrize("form", [("left.png", "right.png"), ("both.png",)])
def test_depth_of_a_rectified_pair(terminal, pictures, tmp_path, form):
    code, out, _ = terminal("depth", *(pictures / name for name in form), *OPTIONS, "--out", tmp_path, "--json")
    assert code == 0
    statistics = json.loads(out)
    assert {"valid_fraction", "median_depth_m", "near_limit_m", "ceiling_fraction", "time_s"} <= set(statistics)
    depth, truth = np.load(tmp_path / "depth.npy"), np.load(pictures / "truth.npy")
    assert depth.shape == (240, 320)
    assert depth.dtype == np.float32
    assert statistics["valid_fraction"] == pytest.approx(np.isfinite(depth).mean())
    assert statistics["valid_fraction"] > 0.85
    assert np.nanmedian(np.abs(depth - truth) / truth) < 0.006
    assert statistics["near_limit_m"] == pytest.approx(0.2 * 370 / 80)
    picture = cv2.imread(str(tmp_path / "depth.png"))
    assert picture is not None
    assert picture.shape[1] > 1000


def test_depth_of_raw_pictures_of_a_rig(terminal, pictures, tmp_path):
    raw = (pictures / "raw_left.png", pictures / "raw_right.png")
    code, out, _ = terminal(
        "depth", *raw, "--calibration", pictures / "rig.yaml", "--baseline-m", 0.25, "--out", tmp_path, "--json"
    )
    assert code == 0
    statistics = json.loads(out)
    assert statistics["median_depth_m"] == pytest.approx(3.0, rel=0.01)
    assert statistics["baseline_m"] == pytest.approx(crooked_rig().length_m(0.25))


def test_a_person_is_told_in_words(terminal, pictures, tmp_path):
    code, out, _ = terminal("depth", pictures / "both.png", *OPTIONS, "--out", tmp_path)
    assert code == 0
    assert "% of the pixels, median 4." in out
    assert str(tmp_path / "depth.png") in out


def test_nearer_is_searched_when_asked(terminal, pictures, tmp_path):
    files = (pictures / "left.png", pictures / "right.png")
    _, out, _ = terminal("depth", *files, *OPTIONS, "--near-m", 0.5, "--out", tmp_path, "--json")
    assert json.loads(out)["near_limit_m"] <= 0.5
    _, out, _ = terminal("depth", *files, *OPTIONS, "--near-m", 5.0, "--out", tmp_path, "--json")
    statistics = json.loads(out)
    assert 4.0 < statistics["near_limit_m"] <= 5.0
    assert statistics["ceiling_fraction"] > 0.2


def test_pictures_without_any_match_have_no_median(terminal, tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((240, 640), 128, np.uint8))
    code, out, _ = terminal("depth", tmp_path / "grey.png", *OPTIONS, "--out", tmp_path, "--json")
    statistics = json.loads(out)
    assert code == 0
    assert statistics["valid_fraction"] == 0.0
    assert statistics["median_depth_m"] is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("left.png", "small.png", *OPTIONS), "The left picture is 320x240 px, the right one 318x240 px"),
        (("left.png", "torn.png", *OPTIONS), "torn.png: cannot be read as a picture"),
        (("left.png", "rig.yaml", *OPTIONS), "rig.yaml: cannot be read as a picture"),
        (("left.png", "nowhere.png", *OPTIONS), "nowhere.png: there is no such file"),
        (("left.png", "right.png"), "Give --focal-px and --baseline-m"),
        (("left.png", "right.png", "--focal-px", 370), "Give --focal-px and --baseline-m"),
        (("left.png", "right.png", "--focal-px", -1, "--baseline-m", 0.2), "--focal-px must be greater than zero"),
        (("left.png", "right.png", *OPTIONS, "--near-m", 0.01), "have no depth nearer than"),
        (("left.png", "right.png", "--calibration", "rig.yaml"), "name the baseline with --baseline-m"),
        (("left.png", "right.png", "--calibration", "rig.yaml", "--baseline-m", 0.4), "covers a baseline of 100 to"),
        (("left.png", "right.png", "--calibration", "rig.yaml", *OPTIONS), "leave out --focal-px"),
        (("left.png", "right.png", "--calibration", "left.png", "--baseline-m", 0.2), "left.png: cannot be read"),
        (("both.png", "both.png", "--calibration", "rig.yaml", "--baseline-m", 0.2), "cannot serve 640x240 px"),
    ],
)
def test_what_cannot_be_used_gets_one_sentence_and_exit_2(terminal, pictures, tmp_path, arguments, words):
    named = [pictures / a if str(a).endswith((".png", ".yaml")) else a for a in arguments]
    code, out, err = terminal("depth", *named, "--out", tmp_path / "out")
    assert code == 2
    assert out == ""
    assert words in err
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_a_side_by_side_picture_of_odd_width_is_refused(terminal, tmp_path):
    cv2.imwrite(str(tmp_path / "odd.png"), np.zeros((240, 641), np.uint8))
    code, _, err = terminal("depth", tmp_path / "odd.png", *OPTIONS)
    assert code == 2
    assert "even width" in err


def test_a_folder_that_cannot_be_written_is_named(terminal, pictures, tmp_path):
    (tmp_path / "file").write_text("")
    code, _, err = terminal("depth", pictures / "both.png", *OPTIONS, "--out", tmp_path / "file" / "x")
    assert code == 2
    assert "cannot be written" in err


def test_analyze_draws_the_figures_and_prints_the_numbers(terminal, tmp_path):
    code, out, _ = terminal("analyze", "--out", tmp_path, "--json")
    assert code == 0
    numbers = json.loads(out)
    assert numbers["table_1"]["intrinsic"]["k3"] == 2.0
    assert json.loads((tmp_path / "analysis.json").read_text()) == numbers
    for name in ("depth_error", "intrinsic_errors", "extrinsic_errors", "table_1", "sync_bounds"):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture is not None, name
        assert picture.std() > 5, name


def test_analyze_takes_a_rig(terminal, pictures, tmp_path):
    code, out, _ = terminal("analyze", "--rig", pictures / "rig.yaml", "--out", tmp_path)
    assert code == 0
    assert "Table I" in out
    code, _, err = terminal("analyze", "--rig", pictures / "left.png", "--out", tmp_path)
    assert code == 2
    assert "left.png" in err
