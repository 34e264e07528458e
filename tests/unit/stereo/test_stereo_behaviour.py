"""The calibration file's hash and mount, and the colours of baselines and depths at the ends of their scales."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.calibration_file import calibration_hash, read_calibration, write_calibration
from morpheyes_daemon.stereo.colours import baseline_bgr, colour_depth
from morpheyes_daemon.stereo.depth import default_settings
from morpheyes_daemon.stereo.rig import CameraMount
from tests.support.panels import crooked_rig

MOUNT = CameraMount((0.01, -0.14, 0.003), (1e-3, 2e-3, 3e-3))


def test_the_hash_is_a_sha_of_what_the_rig_is_and_of_nothing_else() -> None:
    rig = crooked_rig()
    assert len(calibration_hash(rig)) == 64
    assert int(calibration_hash(rig), 16) > 0
    assert calibration_hash(rig) == calibration_hash(crooked_rig())
    others = [replace(rig, mount=MOUNT), replace(rig, method="solved"), replace(rig, details={"date": "today"})]
    assert len({calibration_hash(one) for one in [rig, *others]}) == 4


def test_the_mount_comes_back_in_degrees_and_its_file_without_it_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    write_calibration(replace(crooked_rig(), mount=MOUNT), path)
    back = read_calibration(path).mount
    assert back is not None
    assert back.rotation_rad == pytest.approx(MOUNT.rotation_rad)
    assert back.sigma_rad == pytest.approx(MOUNT.sigma_rad)
    written = yaml.safe_load(path.read_text())
    assert written["mount"]["rotation_deg"] == pytest.approx([math.degrees(a) for a in MOUNT.rotation_rad])
    del written["mount"]["rotation_deg"]
    path.write_text(yaml.safe_dump(written))
    with pytest.raises(CalibrationError):
        read_calibration(path)


def test_a_rig_without_a_mount_has_none(tmp_path: Path) -> None:
    write_calibration(crooked_rig(), tmp_path / "rig.yaml")
    assert read_calibration(tmp_path / "rig.yaml").mount is None


def test_small_baselines_are_blue_large_ones_red_and_all_are_told_apart() -> None:
    assert baseline_bgr(0.1) == baseline_bgr(0.02) == baseline_bgr(math.nan) == (128, 0, 0)
    assert baseline_bgr(0.3) == baseline_bgr(0.9) == (0, 0, 128)
    b, g, r = baseline_bgr(0.2)
    assert g > 250 > max(b, r)
    assert len({baseline_bgr(0.1 + 0.02 * k) for k in range(11)}) == 11


def test_depth_goes_from_warm_to_cold_by_equal_ratios_and_unknown_is_grey() -> None:
    picture = colour_depth(np.array([[0.5, 3.87, 30.0, np.nan], [0.1, 3.9, 100.0, 0.0]], np.float32))
    assert picture.shape == (2, 4, 3)
    near, middle, far, unknown = picture[0].astype(int)
    assert near[2] > 100 > near[0], "red"
    assert far[0] > 100 > far[1] - 50, "blue"
    assert unknown.tolist() == picture[1, 3].tolist() == [38, 34, 32]
    assert picture[1, 0].tolist() == near.tolist(), "nearer than the scale is as near"
    assert picture[1, 2].tolist() == far.tolist()
    assert middle[1] > 200, "half way in ratios is green"


def test_from_four_hundred_rows_on_they_are_taken_two_by_two() -> None:
    assert [default_settings(height).row_step for height in (120, 399, 400, 480)] == [1, 1, 2, 2]
