"""The planner keeps the servo within its duty, ends motions by shrinking, and can always shrink back."""

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.config.vehicle import ServoMotion
from morpheyes_daemon.control.baseline import SPEED_TOLERANCE, BaselineModel
from morpheyes_daemon.control.baseline_planner import DUTY_WINDOW_NS, REVERSAL_SIGMA_M, BaselinePlanner
from morpheyes_daemon.simulation.servo.teensy import ServoTruth, TeensyTwin
from morpheyes_daemon.wire.servo import SetTarget, encode
from tests.support.hand_clock import HandClock

MOTION = ServoMotion()
DUTY = MOTION.max_duty_pct / 100
ACKNOWLEDGED_NS = 10 * MS


class Rig:
    """A planner that commands a model, five times a second, as the baseline task does."""

    def __init__(self) -> None:
        self.t_ns = 100 * S
        self.model = BaselineModel(MOTION)
        self.planner = BaselinePlanner(MOTION)
        self.commands: list[tuple[int, float]] = []

    def want(self, wanted_m: float, seconds: float = 0.2) -> None:
        for _ in range(round(seconds * 5)):
            target_m = self.planner.plan(wanted_m, self.model.at(self.t_ns))
            if target_m is not None:
                self.model.on_sent(target_m, self.t_ns)
                self.model.on_acknowledged(target_m, self.t_ns + ACKNOWLEDGED_NS)
                self.commands.append((self.t_ns, target_m))
            self.t_ns += 200 * MS

    @property
    def baseline_m(self) -> float:
        return self.model.at(self.t_ns).baseline_m

    def settled_at(self, baseline_m: float) -> "Rig":
        self.want(baseline_m, 70.0)
        assert self.baseline_m == pytest.approx(baseline_m, abs=1e-3)
        self.commands.clear()
        return self


def test_the_first_wanted_baseline_is_always_commanded() -> None:
    rig = Rig()
    rig.want(rig.baseline_m)
    assert len(rig.commands) == 1


def test_a_small_change_is_ignored() -> None:
    rig = Rig().settled_at(0.2)
    rig.want(0.205, 5.0)
    rig.want(0.195, 5.0)
    assert rig.commands == []


def test_the_smallest_baseline_has_the_smallest_dead_band() -> None:
    rig = Rig().settled_at(0.103)
    rig.want(0.1, 2.0)
    assert [target_m for _, target_m in rig.commands] == [0.1]


def test_growing_overshoots_and_returns_to_remove_the_backlash() -> None:
    rig = Rig().settled_at(0.15)
    rig.want(0.2, 5.0)
    assert [target_m for _, target_m in rig.commands] == pytest.approx([0.201, 0.2])
    estimate = rig.model.at(rig.t_ns)
    assert not estimate.moving
    assert estimate.sigma_m == pytest.approx(MOTION.repeatability_sigma_mm / 1e3)


def test_shrinking_does_not_overshoot() -> None:
    rig = Rig().settled_at(0.2)
    rig.want(0.12, 5.0)
    assert [target_m for _, target_m in rig.commands] == [0.12]


def test_at_the_end_of_the_stroke_there_is_no_overshoot() -> None:
    rig = Rig().settled_at(0.2)
    rig.want(0.3, 5.0)
    assert [target_m for _, target_m in rig.commands] == [0.3]


def test_a_motion_is_reversed_half_way() -> None:
    rig = Rig().settled_at(0.1)
    rig.want(0.3, 2.0)
    rig.want(0.1, 5.0)
    assert [target_m for _, target_m in rig.commands] == [0.3, 0.1]
    assert rig.baseline_m == pytest.approx(0.1, abs=1e-3)


def test_a_baseline_that_is_not_finite_is_ignored() -> None:
    rig = Rig().settled_at(0.2)
    rig.want(math.nan, 1.0)
    rig.want(math.inf, 1.0)
    assert rig.commands == []


@pytest.mark.parametrize("target_m", [0.1, 0.195])
def test_an_uncertain_servo_is_commanded_again(target_m: float) -> None:
    rig = Rig().settled_at(0.2)
    rig.model.on_unconfirmed(target_m, rig.t_ns)
    rig.t_ns += 10 * S
    rig.want(0.2, 8.0)
    assert rig.commands[0][1] == pytest.approx(0.201)
    assert rig.model.at(rig.t_ns).sigma_m < 0.5e-3


wanted_baselines = st.lists(st.tuples(st.integers(80, 320).map(lambda mm: mm / 1e3), st.floats(0.2, 20.0)), max_size=30)


@settings(max_examples=60, deadline=None)
@given(wanted_baselines)
def test_the_duty_limit_holds_and_leaves_enough_to_shrink(changes: list[tuple[float, float]]) -> None:
    rig = Rig().settled_at(0.1)
    for wanted_m, seconds in changes:
        rig.want(wanted_m, seconds)
        assert rig.planner.duty(rig.t_ns) <= DUTY + 1e-9
    rig.want(0.1, 8.0)
    assert rig.baseline_m <= 0.1 + 0.003  # the dead band, and the tolerance of the servo's speed
    assert rig.planner.duty(rig.t_ns) <= DUTY + 1e-9


def forest_wanted_baselines(seed: int, seconds: float) -> list[float]:
    """Wanted baselines of a flight among trees: nearest depth closes at 2 m/s, then jumps to the next tree, noisy."""
    noise, wanted_baselines_m, depth_m = random.Random(seed), [], 6.0
    for _ in range(round(seconds * 5)):
        depth_m -= 2.0 / 5
        if depth_m < 2.5:
            depth_m = noise.uniform(3.0, 8.0)
        wanted_baselines_m.append(0.04 * depth_m * noise.gauss(1.0, 0.03))
    return wanted_baselines_m


@pytest.mark.parametrize("seed", range(4))
def test_a_forest_flight_stays_within_the_duty_and_follows_the_baseline_law(seed: int) -> None:
    rig = Rig().settled_at(0.15)
    unlimited_m, errors_m, unlimited_errors_m = 0.15, [], []
    for wanted_m in forest_wanted_baselines(seed, 60):
        rig.want(wanted_m)
        law_m = min(max(wanted_m, 0.1), 0.3)
        unlimited_m += min(max(law_m - unlimited_m, -0.01), 0.01)  # 50 mm/s for a beat of 0.2 s
        errors_m.append(abs(rig.baseline_m - law_m))
        unlimited_errors_m.append(abs(unlimited_m - law_m))
    assert rig.planner.duty(rig.t_ns) <= DUTY
    assert sum(errors_m) < 1.5 * sum(unlimited_errors_m)  # the cost of dead band, duty and uncertainty


@pytest.mark.parametrize("beats", [1, 2, 5, 10])
@pytest.mark.parametrize("near_m", [0.1, 0.2])
def test_alternating_baselines_keep_sigma_small(near_m: float, beats: int) -> None:
    rig = Rig().settled_at(0.2)
    stroke_m, sigmas_m = 0.3 - near_m, []
    for _ in range(300 // beats):
        for wanted_m in beats * [0.3] + beats * [near_m]:
            rig.want(wanted_m)
            sigmas_m.append(rig.model.at(rig.t_ns).sigma_m)
    of_the_stroke_m = 2 * SPEED_TOLERANCE * stroke_m / math.sqrt(12)
    assert max(sigmas_m) < of_the_stroke_m + 3 * REVERSAL_SIGMA_M
    assert sum(sigmas_m) / len(sigmas_m) < 0.005


def test_changing_baselines_keep_the_true_servo_within_its_duty() -> None:
    rig, clock = Rig(), HandClock()
    clock.t_ns = rig.t_ns
    twin = TeensyTwin(ServoTruth(start_m=0.1), clock, seed=5)
    running, step_ns = [], 200 * MS
    for beat in range(900 * 5):
        clock.t_ns = rig.t_ns
        before = len(rig.commands)
        rig.want(0.3 if beat // 25 % 2 else 0.1)
        for _, target_m in rig.commands[before:]:
            twin.receive(encode(SetTarget(beat % 256, target_m)))
        clock.t_ns = rig.t_ns
        running.append(abs(twin.baseline_at(rig.t_ns) - twin.baseline_at(rig.t_ns - step_ns)) > 0.5e-3)
    window = DUTY_WINDOW_NS // step_ns
    assert max(sum(running[i : i + window]) / window for i in range(0, len(running) - window, 25)) <= DUTY
    assert sum(running) / len(running) > DUTY / 2  # the budget is used
