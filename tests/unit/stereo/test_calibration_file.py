"""The calibration file: readable, the same rig and hash after a round trip, and noticed when damaged."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.calibration_file import calibration_hash, read_calibration, write_calibration
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel
from tests.support.panels import crooked_rig

DETAILS = {
    "made": "2025-03-01",
    "board": {"kind": "chessboard", "columns": 9, "rows": 6, "square_mm": 25.0},
    "rms_px": np.float64(0.21),
    "coverage": np.array([[0.5, 1.0], [0.25, 0.0]]),
    "outliers": ["right15.png"],
}


@pytest.fixture
def rig():
    plain = crooked_rig()
    baselines = tuple(
        CalibratedBaseline(b.nominal_m, b.q_cam0_cam1, b.t_cam0_cam1_m, 0.2, 1e-4, 1e-4) for b in plain.baselines
    )
    return RigModel(plain.cam0, plain.cam1, baselines, "solved", DETAILS)


@pytest.fixture
def path(rig, tmp_path):
    write_calibration(rig, tmp_path / "rig.yaml")
    return tmp_path / "rig.yaml"


def test_a_rig_comes_back_as_it_went(rig, path):
    back = read_calibration(path)
    assert calibration_hash(back) == calibration_hash(rig)
    assert back.method == "solved"
    # twelve digits are kept
    assert np.allclose(back.T_cam0_cam1(0.177), rig.T_cam0_cam1(0.177), atol=1e-11)
    assert back.cam0 == rig.cam0
    assert back.sigma_yaw_rad(0.2) == pytest.approx(1e-4, rel=1e-9)
    assert back.details["board"] == DETAILS["board"]
    assert back.details["coverage"] == [[0.5, 1.0], [0.25, 0.0]]


def test_saving_again_gives_the_same_bytes(path, tmp_path):
    write_calibration(read_calibration(path), tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_bytes() == path.read_bytes()


def test_frames_and_units_stand_in_the_keys(path):
    data = yaml.safe_load(path.read_text())
    first = data["baselines"][0]
    assert first["nominal_mm"] == 100.0
    assert len(first["T_cam0_cam1"]["rotation_quaternion_wxyz"]) == 4
    assert first["T_cam0_cam1"]["translation_mm"][0] == pytest.approx(100.1)
    assert data["cameras"]["cam1"]["k1"] == -0.17
    assert re.fullmatch(r"[0-9a-f]{64}", data["sha256"])


def test_comments_and_layout_are_free(rig, path):
    text = path.read_text()
    path.write_text("# my own rig\n" + yaml.safe_dump(yaml.safe_load(text), default_flow_style=False))
    assert calibration_hash(read_calibration(path)) == calibration_hash(rig)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.97])
def test_a_file_cut_short_is_noticed(path, share):
    text = path.read_text()
    path.write_text(text[: int(share * len(text))])
    with pytest.raises(CalibrationError, match=r"rig\.yaml.*calibrate solve"):
        read_calibration(path)


def test_every_cut_is_noticed(path):
    text = path.read_text()
    whole = len(text.rstrip())
    for length in range(0, whole, 97):
        path.write_text(text[:length])
        with pytest.raises(CalibrationError, match=re.escape(str(path))):
            read_calibration(path)


@pytest.mark.parametrize(("old", "new"), [("fx_px: 741.0", "fx_px: 742.0"), ("solved", "exact"), ("25.0", "30.0")])
def test_an_edited_number_is_noticed(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match="does not match its own hash"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not a MorphEyes calibration"),
        (b"camera: {backend: sim}\n", "is not a MorphEyes calibration"),
        (b"- 1\n- 2\n", "is not a MorphEyes calibration"),
        (b"\xff\xfe\x00", "cannot be read as text"),
        (b"format: [\n", "not valid YAML"),
        (b"format: morpheyes-calibration-99\n", "has the format"),
        (b"format: morpheyes-calibration-1\nmethod: solved\n", "truncated"),
    ],
)
def test_other_files_are_refused_by_name(path, content, words):
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=words) as error:
        read_calibration(path)
    assert str(path) in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"nowhere\.yaml: there is no such file"):
        read_calibration(tmp_path / "nowhere.yaml")


def test_a_place_that_cannot_be_written_is_named(rig, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_calibration(rig, tmp_path / "file" / "rig.yaml")


def test_nothing_is_left_beside_the_file(path: Path):
    assert [entry.name for entry in path.parent.iterdir()] == ["rig.yaml"]
