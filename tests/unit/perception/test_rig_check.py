"""`calibrate check` without a board: rows at every baseline, the yaw from two, and nothing claimed without evidence."""

import math

import numpy as np
import pytest

from morpheyes_daemon.errors import CalibrationError, InputError
from morpheyes_daemon.perception.calibration_check import CalibrationCheck, CalibrationCheckResult
from morpheyes_daemon.perception.extrinsics_monitor import turned_rig
from tests.support.panels import Panel, crooked_rig, raw_pair

PANELS = [Panel(5.0, slope_x=0.3), Panel(2.5, x_m=(-0.3, 0.6), y_m=(-0.5, 0.3), seed=3), Panel(9.0, seed=5)]
RIG = crooked_rig(320, 240)
F_PX = 370.0


def checked(pitch_deg: float, yaw_deg: float, panels_at: dict[float, list[Panel]]) -> CalibrationCheckResult:
    """What the check says when the right camera has turned since the calibration, by so much."""
    believed = turned_rig(RIG, -np.radians([pitch_deg, yaw_deg, 0.0]), 0.2)
    check = CalibrationCheck(believed, (320, 240))
    for baseline_m, panels in panels_at.items():
        check.add(baseline_m, *raw_pair(panels, RIG, baseline_m, noise=1.5))
    return check.result()


def test_a_good_calibration_is_fit_to_fly() -> None:
    result = checked(0.0, 0.0, {0.1: PANELS, 0.3: PANELS})
    assert result.acceptance.startswith("fit to fly")
    assert result.passed
    assert result.findings == ()
    # the yaw's own sigma is about a tenth of a pixel
    assert result.bias_px == pytest.approx(0.0, abs=0.2)


def test_a_bent_rig_is_told_with_its_pitch_and_its_yaw() -> None:
    result = checked(0.15, 0.15, {0.1: PANELS, 0.3: PANELS})
    assert not result.acceptance.startswith("fit to fly")
    for one in result.baselines:
        assert one.fit is not None
        assert math.degrees(one.fit.pitch_rad) == pytest.approx(0.15, abs=0.02)
    assert result.bias_px == pytest.approx(F_PX * math.radians(0.15), abs=0.3)
    assert any("yaw" in finding for finding in result.findings)


def test_a_scene_that_moves_tells_nothing_of_the_yaw() -> None:
    elsewhere = [Panel(4.0, slope_x=0.3), Panel(1.8, x_m=(-0.5, 0.4), y_m=(-0.4, 0.4), seed=3)]
    result = checked(0.0, 0.15, {0.1: PANELS, 0.3: elsewhere})
    assert result.bias_px is None
    assert result.passed


def test_a_bare_wall_is_said_to_tell_nothing() -> None:
    result = checked(0.15, 0.15, {0.1: [Panel(3.0, contrast=0.01)], 0.3: [Panel(3.0, contrast=0.01)]})
    assert all(one.figures()["epipolar_median_px"] is None for one in result.baselines)
    assert "point the cameras at another scene" in result.findings[0]


def test_no_pictures_and_baselines_outside_are_errors() -> None:
    check = CalibrationCheck(RIG, (320, 240))
    with pytest.raises(InputError, match="no pictures"):
        check.result()
    with pytest.raises(CalibrationError, match="covers"):
        check.add(0.5, *raw_pair(PANELS, RIG, 0.3))
