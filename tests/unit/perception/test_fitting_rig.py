"""A calibration that lacks a baseline the vehicle may be asked for is refused before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.flights.flight_plan import make_plan
from tests.support.fixed_rig import fixed_rig


def test_a_fixed_rig_does_not_fly_a_variable_baseline(tmp_path: Path) -> None:
    rig = fixed_rig(tmp_path / "rig.yaml", 320, 240, 200.0, 0.15)
    with pytest.raises(CalibrationError, match=r"rig\.yaml: .*150 mm.* not 100 mm"):
        make_plan("forest", size="320x240", calibration=str(rig))


def test_it_flies_at_its_own(tmp_path: Path) -> None:
    rig = fixed_rig(tmp_path / "rig.yaml", 320, 240, 200.0, 0.15)
    assert make_plan("forest", size="320x240", calibration=str(rig), baseline="0.15").calibration == rig
