"""The autopilot's parameters in SI units, in the names and units of each generation of the firmware."""

from __future__ import annotations

import math

import pytest

from morpheyes_daemon.control import parameters as p
from morpheyes_daemon.errors import DeviceError

BOTH = [
    (p.LOIT_SPEED, "LOIT_SPEED", 500.0, "LOIT_SPEED_MS", 5.0, 5.0),
    (p.ANGLE_MAX, "ANGLE_MAX", 4500.0, "ATC_ANGLE_MAX", 45.0, math.pi / 4),
    (p.LOIT_BRK_ACCEL, "LOIT_BRK_ACCEL", 250.0, "LOIT_BRK_ACC_M", 2.5, 2.5),
    (p.LOIT_BRK_JERK, "LOIT_BRK_JERK", 500.0, "LOIT_BRK_JRK_M", 5.0, 5.0),
    (p.VELOCITY_P, "PSC_VELXY_P", 1.5, "PSC_NE_VEL_P", 1.5, 1.5),
    (p.PILOT_SPEED_UP, "PILOT_SPEED_UP", 250.0, "PILOT_SPD_UP", 2.5, 2.5),
    (p.PILOT_SPEED_DN, "PILOT_SPEED_DN", 150.0, "PILOT_SPD_DN", 1.5, 1.5),
    (p.THR_DZ, "THR_DZ", 80.0, "PILOT_THR_DZ", 80.0, 0.08),
    (p.FLOW_RATE, "EK3_MAX_FLOW", 3.0, "EK3_FLOW_MAX", 3.0, 3.0),
    (p.RTL_ALTITUDE, "RTL_ALT", 20.0, "RTL_ALT_M", 20.0, 20.0),
    (p.GCS_SYSID, "MAV_GCS_SYSID", 255.0, "SYSID_MYGCS", 255.0, 255.0),
]
DEFAULTS = [
    (p.LOIT_ANG_MAX, 0.0), (p.ANGLE_MAX, math.radians(30.0)), (p.VELOCITY_P, 2.0),
    (p.PILOT_Y_RATE, math.radians(202.5)), (p.PILOT_SPEED_DN, 0.0), (p.THR_DZ, 0.1), (p.FLOW_RATE, 2.5),
    (p.VELOCITY_SOURCE, 3.0), (p.RTL_ALTITUDE, 15.0),
]  # fmt: skip


@pytest.mark.parametrize(("quantity", "old", "old_value", "new", "new_value", "si"), BOTH, ids=lambda x: str(x)[:20])
def test_each_generation_gives_the_same_si_value(
    quantity: p.Quantity, old: str, old_value: float, new: str, new_value: float, si: float
) -> None:
    if old != "RTL_ALT":
        assert quantity.read({old: old_value}) == pytest.approx(si)
    assert quantity.read({new: new_value}) == pytest.approx(si)
    assert quantity.find({new: new_value}) == (new, pytest.approx(si))
    assert quantity.change({new: 1.0}, si) == {new: pytest.approx(new_value)}


def test_centimetres_and_degrees_of_the_older_ones() -> None:
    assert p.RTL_ALTITUDE.read({"RTL_ALT": 1500.0}) == pytest.approx(15.0)
    assert p.LOIT_ANG_MAX.read({"LOIT_ANG_MAX": 20.0}) == pytest.approx(math.radians(20.0))
    assert p.PILOT_Y_RATE.read({"PILOT_Y_RATE": 90.0}) == pytest.approx(math.pi / 2)
    assert p.LOIT_BRK_DELAY.read({"LOIT_BRK_DELAY": 0.3}) == 0.3
    assert p.VELOCITY_SOURCE.read({"EK3_SRC1_VELXY": 5.0}) == 5.0 == p.OPTICAL_FLOW


@pytest.mark.parametrize(("quantity", "default"), DEFAULTS, ids=lambda x: str(x)[:20])
def test_what_an_older_firmware_lacks_has_the_value_that_it_flies_with(quantity: p.Quantity, default: float) -> None:
    assert quantity.find({}) is None
    assert quantity.read({}) == pytest.approx(default)


def test_what_is_missing_is_named_in_every_generation() -> None:
    with pytest.raises(DeviceError, match="no parameter LOIT_SPEED nor LOIT_SPEED_MS:"):
        p.LOIT_SPEED.read({})


def test_the_first_generation_counts_where_both_are_and_is_written_where_none_is() -> None:
    assert p.LOIT_SPEED.read({"LOIT_SPEED_MS": 9.0, "LOIT_SPEED": 300.0}) == pytest.approx(3.0)
    assert p.LOIT_SPEED.change({}, 3.0) == {"LOIT_SPEED": 300.0}
    assert p.LOIT_SPEED.change({"LOIT_SPEED_MS": 9.0, "LOIT_SPEED": 9.0}, 3.0) == {"LOIT_SPEED": 300.0}


def test_a_written_value_has_no_noise_of_its_conversion() -> None:
    assert p.LOIT_BRK_ACCEL.change({}, 2.5) == {"LOIT_BRK_ACCEL": 250.0}
    assert p.PILOT_Y_RATE.change({}, math.radians(90.0)) == {"PILOT_Y_RATE": 90.0}
