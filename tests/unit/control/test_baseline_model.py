"""The baseline model's interval contains the Teensy twin's baseline for any commands, and widens when uncertain."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.config.vehicle import NoServoConfig, SerialServoConfig, ServoMotion, SimCameraConfig, VehicleConfig
from morpheyes_daemon.control.baseline import HISTORY_NS, BaselineModel, FixedBaseline, baseline_law, baseline_model
from morpheyes_daemon.simulation.servo.teensy import ServoFault, ServoTruth, TeensyTwin
from morpheyes_daemon.wire.servo import SetTarget, encode
from tests.support.hand_clock import HandClock

MOTION = ServoMotion()
REPEATABILITY_M = MOTION.repeatability_sigma_mm / 1e3


def twin_on(clock: HandClock, seed: int = 0, truth: ServoTruth | None = None) -> TeensyTwin:
    return TeensyTwin(truth or ServoTruth.from_config(MOTION), clock, seed)


def send(twin: TeensyTwin, target_m: float) -> None:
    twin.receive(encode(SetTarget(0, target_m)))


waits_ms = st.integers(0, 6000)
targets_m = st.integers(100, 300).map(lambda mm: mm / 1e3)


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 1000),
    start_mm=st.integers(100, 300),
    commands=st.lists(st.tuples(waits_ms, targets_m), min_size=1, max_size=12),
)
def test_the_true_baseline_is_within_three_sigma_for_any_commands(
    seed: int, start_mm: int, commands: list[tuple[int, float]]
) -> None:
    clock = HandClock()
    twin = twin_on(clock, seed, ServoTruth(start_m=start_mm / 1e3))
    model = BaselineModel(MOTION)
    for wait_ms, target_m in commands:
        clock.t_ns += wait_ms * MS
        send(twin, target_m)
        model.on_acknowledged(target_m, clock.t_ns)
    for t_ns in range(clock.t_ns - HISTORY_NS, clock.t_ns + 6 * S, 97 * MS):
        estimate = model.at(t_ns)
        assert abs(twin.baseline_at(t_ns) - estimate.baseline_m) <= 3 * estimate.sigma_m


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 1000),
    commands=st.lists(st.tuples(waits_ms, targets_m, st.booleans()), min_size=1, max_size=10),
    stops_after=st.integers(0, 12),
)
def test_the_true_baseline_is_within_three_sigma_with_unconfirmed_commands(
    seed: int, commands: list[tuple[int, float, bool]], stops_after: int
) -> None:
    clock = HandClock()
    twin, model = twin_on(clock, seed), BaselineModel(MOTION)
    for number, (wait_ms, target_m, arrives) in enumerate(commands):
        clock.t_ns += wait_ms * MS
        if number == stops_after:
            twin.inject(ServoFault.STUCK)
        if arrives:
            send(twin, target_m)
        certain = arrives and number < stops_after
        (model.on_acknowledged if certain else model.on_unconfirmed)(target_m, clock.t_ns)
    for t_ns in range(clock.t_ns - HISTORY_NS, clock.t_ns + 6 * S, 97 * MS):
        estimate = model.at(t_ns)
        assert abs(twin.baseline_at(t_ns) - estimate.baseline_m) <= 3 * estimate.sigma_m


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 1000),
    commands=st.lists(st.tuples(waits_ms, targets_m, st.integers(0, 300)), min_size=1, max_size=8),
)
def test_an_acknowledgement_may_come_late_when_the_command_was_recorded(
    seed: int, commands: list[tuple[int, float, int]]
) -> None:
    clock = HandClock()
    twin, model = twin_on(clock, seed), BaselineModel(MOTION)
    for wait_ms, target_m, answer_ms in commands:
        clock.t_ns += wait_ms * MS
        model.on_sent(target_m, clock.t_ns)
        send(twin, target_m)
        clock.t_ns += answer_ms * MS
        model.on_acknowledged(target_m, clock.t_ns)
    for t_ns in range(clock.t_ns - HISTORY_NS, clock.t_ns + 6 * S, 97 * MS):
        estimate = model.at(t_ns)
        assert abs(twin.baseline_at(t_ns) - estimate.baseline_m) <= 3 * estimate.sigma_m


def test_before_the_first_command_only_the_range_is_known() -> None:
    estimate = BaselineModel(MOTION).at(5 * S)
    assert estimate.baseline_m == pytest.approx(0.2, abs=0.5e-3)  # half the play
    assert estimate.sigma_m == pytest.approx(0.2 / math.sqrt(12), rel=0.01)


def test_after_settling_sigma_is_the_repeatability() -> None:
    model = BaselineModel(MOTION)
    model.on_acknowledged(0.1, 10 * S)
    assert model.at(12 * S).moving
    rested = model.at(15 * S)
    assert not rested.moving
    assert rested.target_m == 0.1
    assert rested.baseline_m == pytest.approx(0.1, abs=0.3e-3)


def test_backlash_adds_to_sigma_after_growing_only() -> None:
    model = BaselineModel(MOTION)
    model.on_acknowledged(0.25, 10 * S)
    model.on_acknowledged(0.2, 20 * S)
    assert model.at(30 * S).sigma_m == pytest.approx(REPEATABILITY_M, rel=1e-6)
    model.on_acknowledged(0.25, 30 * S)
    play_m = 2 * MOTION.backlash_mm / 1e3
    assert model.at(40 * S).sigma_m == pytest.approx(math.hypot(play_m / math.sqrt(12), REPEATABILITY_M))


def test_the_past_does_not_change_with_a_new_command() -> None:
    model = BaselineModel(MOTION)
    model.on_acknowledged(0.25, 10 * S)
    before = [model.at(t) for t in range(9 * S, 20 * S, 100 * MS)]
    model.on_acknowledged(0.12, 20 * S)
    assert [model.at(t) for t in range(9 * S, 20 * S, 100 * MS)] == before
    assert model.at(21 * S).target_m == 0.12


def test_a_full_stroke_takes_four_seconds() -> None:
    model = BaselineModel(MOTION)
    model.on_acknowledged(0.3, 10 * S)
    model.on_acknowledged(0.1, 20 * S)
    assert model.at(22 * S).baseline_m == pytest.approx(0.2, abs=0.004)  # latency, 2 s of 50 mm/s
    assert model.at(23 * S).moving
    assert not model.at(25 * S).moving


def test_an_unconfirmed_command_is_uncertain_until_the_next_one() -> None:
    model = BaselineModel(MOTION)
    model.on_acknowledged(0.2, 10 * S)
    model.on_unconfirmed(0.3, 20 * S)
    assert model.at(30 * S).sigma_m > 0.02
    model.on_acknowledged(0.1, 30 * S)
    assert model.at(40 * S).sigma_m == pytest.approx(REPEATABILITY_M, rel=0.01)


def test_unconfirmed_commands_for_an_hour_cost_no_memory() -> None:
    model = BaselineModel(MOTION)
    for second in range(3600):
        model.on_unconfirmed(0.1 + 0.2 * (second % 2), second * S)
    assert len(model._commands) < 100
    assert model.at(3600 * S).sigma_m > 0.05


def test_before_the_history_the_baseline_is_unknown() -> None:
    model = BaselineModel(MOTION)
    for second in range(10, 100, 5):
        model.on_acknowledged(0.1 + 0.001 * second, second * S)
    assert model.at(90 * S).sigma_m < 0.001
    assert model.at(20 * S).sigma_m > 0.05


def test_commands_out_of_order_are_refused() -> None:
    model = BaselineModel(MOTION)
    model.on_acknowledged(0.2, 10 * S)
    with pytest.raises(ValueError, match="order"):
        model.on_acknowledged(0.2, 9 * S)


def test_the_fixed_rig_is_certain() -> None:
    fixed = VehicleConfig(camera=SimCameraConfig(), servo=NoServoConfig(backend="none", baseline_mm=120))
    model = baseline_model(fixed)
    model.on_acknowledged(0.3, 0)
    assert model.at(S).baseline_m == 0.12
    assert model.at(S).sigma_m == 0
    assert isinstance(model, FixedBaseline)
    assert isinstance(
        baseline_model(VehicleConfig(camera=SimCameraConfig(), servo=SerialServoConfig(backend="serial"))), BaselineModel
    )


@pytest.mark.parametrize(
    ("depth_m", "expected_m"), [(5, 0.2), (1, 0.1), (100, 0.3), (math.inf, 0.3), (math.nan, 0.1), (0, 0.1)]
)
def test_the_baseline_law_is_clamped(depth_m: float, expected_m: float) -> None:
    assert baseline_law(depth_m, 0.04, (0.1, 0.3)) == pytest.approx(expected_m)
