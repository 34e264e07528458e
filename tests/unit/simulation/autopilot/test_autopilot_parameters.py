"""The twin's parameter table: defaults, wire types, names of old and new."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.simulation.autopilot.parameters import (
    FLOW_SETUP,
    INT16,
    REAL32,
    RECOMMENDED,
    ParameterTable,
)


def test_the_defaults_are_arducopters() -> None:
    table = ParameterTable()
    expected = {
        "LOIT_SPEED": 1250,
        "LOIT_BRK_DELAY": 1.0,
        "LOIT_BRK_ACCEL": 250,
        "LOIT_BRK_JERK": 500,
        "LOIT_ANG_MAX": 0,
        "ANGLE_MAX": 3000,
        "PILOT_Y_RATE": 202.5,
        "RC_OVERRIDE_TIME": 3.0,
        "FS_THR_ENABLE": 1,
        "FS_OPTIONS": 16,
        "EK3_MAX_FLOW": 2.5,
        "RTL_ALT": 1500,
        "AVOID_MARGIN": 2.0,
        "MAV_GCS_SYSID": 255,
        "RC1_DZ": 20,
        "RC3_DZ": 30,
    }
    assert {name: table[name] for name in expected} == expected


def test_the_recommended_and_the_flow_sets_are_known_names() -> None:
    table = ParameterTable({**RECOMMENDED, **FLOW_SETUP})
    assert table["LOIT_SPEED"] == 500
    assert table.flow_only


def test_the_table_before_4_7_has_the_old_names() -> None:
    table = ParameterTable({"SYSID_MYGCS": 42}, old_names=True)
    assert list(table.gcs_sysids()) == [42]
    assert "MAV_GCS_SYSID" not in table
    with pytest.raises(KeyError, match="MAV_GCS_SYSID"):
        ParameterTable({"MAV_GCS_SYSID": 42}, old_names=True)


@pytest.mark.parametrize(("low", "high", "ids"), [(255, 0, [255]), (10, 12, [10, 11, 12]), (10, 5, [10])])
def test_the_accepted_ids_are_a_range(low: int, high: int, ids: list[int]) -> None:
    assert list(ParameterTable({"MAV_GCS_SYSID": low, "MAV_GCS_SYSID_HI": high}).gcs_sysids()) == ids


def test_names_fit_the_wire_and_indices_agree() -> None:
    table = ParameterTable()
    for index, name in enumerate(table):
        assert len(name) <= 16
        assert table.index_of(name) == index
        assert table.name_at(index) == name
    assert table.name_at(len(table)) is None
    assert table.name_at(-1) is None


@given(st.floats(-1e4, 1e4))
def test_integers_are_rounded_and_floats_are_not(value: float) -> None:
    table = ParameterTable()
    assert table.set("ANGLE_MAX", value)
    assert table.set("LOIT_SPEED", value)
    assert table.type_of("ANGLE_MAX") == INT16
    assert table["ANGLE_MAX"] == round(value)
    assert table.type_of("LOIT_SPEED") == REAL32
    assert table["LOIT_SPEED"] == value


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_is_refused(value: float) -> None:
    table = ParameterTable()
    assert not table.set("LOIT_SPEED", value)
    assert not table.set("NO_SUCH_NAME", 1.0)
    assert table["LOIT_SPEED"] == 1250
