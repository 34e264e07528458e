"""Messages survive the way into the log and back."""

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.errors import RecordingError
from morpheyes_daemon.messages.core import DepthSummary, Event, Governed, Perception, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.recorder.encoding import find_type, from_plain, to_plain, type_name
from morpheyes_daemon.recorder.schemas import dataclass_schema


@dataclass(frozen=True)
class Finding:
    """A percept that no module of the package knows."""

    points: np.ndarray
    weight: float
    inner: Any = None


def through_json(value: Any, hint: Any) -> Any:
    return from_plain(json.loads(json.dumps(to_plain(value), allow_nan=False)), hint)


numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(numbers, numbers, numbers, st.integers(0, 2**62))
def test_every_float_comes_back_bit_for_bit(limit: float, clear: float, trust: float, t_ns: int) -> None:
    value = Governed(t_ns, limit, "stopping", clear, trust, 1.0, 2.0)
    back = through_json(value, Governed)
    assert back.t_ns == t_ns
    for name in ("limit_m_s", "clear_m", "trust_m"):
        was, now = getattr(value, name), getattr(back, name)
        assert now == was or (math.isnan(was) and math.isnan(now))


def test_enums_tuples_and_optional_fields_come_back_typed() -> None:
    output = GateOutput(5, State.BRAKING, Action.NEUTRAL, None, 1500, 1500, 1500, 1500)
    assert through_json(output, GateOutput) == output
    event = Event(7, "gate", Reason.LINK_LOST, "0.6 s")
    assert through_json(event, Event) == event
    vehicle = VehicleState(t_ns=3, rc_us=(1500, 1400), p_ned_m=(1.0, 2.0, -3.0))
    back = through_json(vehicle, VehicleState)
    assert back.rc_us == (1500, 1400)
    assert back.p_ned_m == (1.0, 2.0, -3.0)


@pytest.mark.parametrize("shape", [(3,), (40, 3), (0,), (0, 2), (2, 2)])
def test_arrays_come_back_whether_listed_or_packed(shape: tuple[int, ...]) -> None:
    points = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    back = through_json(Finding(points, 0.5), Finding)
    assert back.points.shape == shape
    np.testing.assert_array_equal(back.points.astype(np.float32), points)


def test_a_value_whose_field_says_nothing_carries_its_own_type() -> None:
    back = through_json(Finding(np.zeros(2), 1.0, inner=Finding(np.ones(2), 2.0)), Finding)
    assert isinstance(back.inner, Finding)
    assert back.inner.weight == 2.0


def test_a_log_cannot_make_us_import_foreign_modules() -> None:
    assert find_type("antigravity.Finding") is None
    assert find_type(type_name(Finding)) is Finding
    assert find_type("morpheyes_daemon.messages.core.Governed") is Governed


def test_full_images_are_left_out() -> None:
    summary = DepthSummary(3, 1, 2, 0.2, 0.001, 370.0, 0.8, 0.25, 0.5, 0.9, 0.01, 1.2, 0.05, "5f1e")
    image, depth = np.zeros((4, 4), np.uint8), np.ones((4, 4), np.float32)
    plain = to_plain(Perception(summary, None, np.zeros(72, np.float32), (), image, depth))
    assert "left_rect" not in plain
    assert "depth_m" not in plain
    assert plain["summary"]["seq"] == 3


def test_something_unknown_becomes_its_text_and_never_an_error() -> None:
    assert to_plain({"a": object}) == {"a": repr(object)}
    assert to_plain({1: {2, 1}}) == {"1": [1, 2]}


def test_nonsense_is_a_sentence() -> None:
    with pytest.raises(RecordingError, match="cannot be read back"):
        from_plain({"t_ns": "soon", "source": "x", "reason": "no_such_reason"}, Event)


def test_a_message_of_another_version_is_refused_unless_the_new_field_has_a_default() -> None:
    plain = to_plain(Event(7, "gate", Reason.LINK_LOST, "0.6 s"))
    assert from_plain({k: v for k, v in plain.items() if k != "text"} | {"old": 1}, Event).text == ""
    with pytest.raises(RecordingError, match="source is missing"):
        from_plain({k: v for k, v in plain.items() if k != "source"}, Event)


def test_schema_names_every_field_with_its_kind() -> None:
    properties = json.loads(dataclass_schema(GateOutput))["properties"]
    assert properties["pitch_us"] == {"type": "integer"}
    assert properties["state"] == {"type": "string"}
    vehicle = json.loads(dataclass_schema(VehicleState))["properties"]
    assert vehicle["p_ned_m"] == {"type": "array", "items": {"type": "number"}}
