"""The Teensy twin's servos do what the data sheet and field-facts say of the real ones."""

import asyncio

import numpy as np
import pytest

from morpheyes_daemon.clock import MS, S, run_virtual, running_clock
from morpheyes_daemon.simulation.servo.teensy import ServoFault, ServoTruth, TeensyTwin
from morpheyes_daemon.wire.servo import Ack, Decoder, Hello, SetTarget, Status, StatusFlag, Verdict, encode
from tests.support.hand_clock import HandClock

EXACT = ServoTruth(speed_spread=0.0, repeatability_sigma_m=0.0, start_m=0.3)


def bench(truth: ServoTruth = EXACT, seed: int = 0) -> tuple[TeensyTwin, HandClock]:
    clock = HandClock()
    return TeensyTwin(truth, clock, seed), clock


def go(twin: TeensyTwin, clock: HandClock, target_m: float, then_s: float) -> float:
    """Send a target, let time pass, return where the eyes are."""
    twin.receive(encode(SetTarget(1, target_m)))
    clock.t_ns += round(then_s * S)
    return twin.baseline_at(clock.t_ns)


def test_the_full_stroke_takes_four_seconds_at_twice_25_mm_per_second() -> None:
    twin, clock = bench()
    began_ns = clock.t_ns
    go(twin, clock, 0.1, 6.0)
    places_m = [twin.baseline_at(began_ns + t * 100 * MS) for t in range(5, 35)]
    assert np.diff(places_m).tolist() == pytest.approx([-0.005] * 29, rel=1e-6)
    assert twin.baseline_at(began_ns + 4 * S) == pytest.approx(0.1, abs=2.5e-3)
    assert twin.baseline_at(began_ns + round(4.2 * S)) == pytest.approx(0.1, abs=0.1e-3)


def test_nothing_moves_before_the_latency() -> None:
    twin, clock = bench()
    began_ns = clock.t_ns
    go(twin, clock, 0.1, 1.0)
    assert twin.baseline_at(began_ns + 14 * MS) == 0.3
    assert twin.baseline_at(began_ns + 35 * MS) < 0.3


def test_growing_falls_short_by_the_backlash_of_both_servos_and_shrinking_does_not() -> None:
    twin, clock = bench()
    assert go(twin, clock, 0.15, 6.0) == pytest.approx(0.15, abs=1e-6)
    assert go(twin, clock, 0.2, 6.0) == pytest.approx(0.2 - 0.5e-3, abs=1e-6)
    assert go(twin, clock, 0.1999, 6.0) == pytest.approx(0.2 - 0.5e-3, abs=1e-6)  # within the play
    assert go(twin, clock, 0.199, 6.0) == pytest.approx(0.199, abs=1e-6)


def test_targets_are_met_to_the_repeatability() -> None:
    truth = ServoTruth(backlash_m=0.0, repeatability_sigma_m=0.18e-3)
    errors_m = []
    for seed in range(40):
        twin, clock = bench(truth, seed)
        errors_m += [go(twin, clock, target_m, 6.0) - target_m for target_m in (0.12, 0.2, 0.28)]
    assert np.std(errors_m) == pytest.approx(0.18e-3, rel=0.25)  # 120 samples: 3 sigma of a standard deviation
    assert abs(np.mean(errors_m)) < 0.06e-3


def test_the_past_stays_as_it_was() -> None:
    twin, clock = bench()
    began_ns = clock.t_ns
    go(twin, clock, 0.1, 2.0)
    before = [twin.baseline_at(t) for t in range(began_ns, clock.t_ns, 50 * MS)]
    go(twin, clock, 0.3, 2.0)
    assert [twin.baseline_at(t) for t in range(began_ns, began_ns + 2 * S, 50 * MS)] == before


def test_targets_beyond_the_stroke_are_clamped_and_said() -> None:
    twin, clock = bench()
    sent: list[bytes] = []
    twin.connect(sent.append)
    assert go(twin, clock, 0.05, 6.0) == pytest.approx(0.1, abs=1e-6)
    assert Decoder().feed(b"".join(sent)) == [Ack(1, Verdict.CLAMPED, 0.1)]


def test_a_reboot_stops_the_servos_where_they_are_and_forgets() -> None:
    twin, clock = bench()
    go(twin, clock, 0.1, 1.0)
    twin.reboot()
    here_m = twin.baseline_at(clock.t_ns)
    assert go(twin, clock, 0.2, 0.4) == here_m  # still booting: not heard
    assert go(twin, clock, 0.2, 6.0) == here_m
    assert go(twin, clock, 0.2, 6.0) == pytest.approx(0.2, abs=0.6e-3)


def test_status_is_told_five_times_a_second_with_its_flags() -> None:
    async def scene() -> list[bytes]:
        twin = TeensyTwin(EXACT, running_clock(), 0)
        sent: list[bytes] = []
        twin.connect(sent.append)
        running = asyncio.create_task(twin.run())
        await asyncio.sleep(1.1)
        twin.receive(b"\x01\x02" + encode(Hello()) + encode(SetTarget(4, 0.2)))
        await asyncio.sleep(0.2)
        running.cancel()
        return sent

    messages = Decoder().feed(b"".join(run_virtual(scene())))
    told = [message for message in messages if isinstance(message, Status)]
    assert len(told) == 6
    assert told[0].flags == StatusFlag.COLD
    assert told[0].target_m is None
    assert told[-1].flags == StatusFlag(0)
    assert told[-1].target_m == 0.2
    assert told[-1].dropped_frames == 1
    assert told[-1].uptime_ms - told[0].uptime_ms == pytest.approx(1000, abs=1)


def test_garbage_is_seeded_too() -> None:
    def noise(seed: int) -> bytes:
        twin, _ = bench(seed=seed)
        sent: list[bytes] = []
        twin.connect(sent.append)
        twin.inject(ServoFault.GARBAGE)
        twin.receive(encode(Hello()))
        return b"".join(sent)

    assert noise(1) == noise(1) != noise(2)
