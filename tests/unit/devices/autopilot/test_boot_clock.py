"""The autopilot's stamps on our clock, with delay, jitter, drift, reboots and lies."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.devices.autopilot.boot_clock import MAX_AGE_NS, BootClock

BOOTED_NS = 777 * S


def errors_ms(clock: BootClock, jitter_ms: float, drift: float, timesync: bool, seconds: int = 60) -> list[float]:
    """Error of each stamp of a 50 Hz stream whose delay is 5 ms and more."""
    chance = random.Random(4)
    errors = []
    for i in range(50 * seconds):
        measured_ns = BOOTED_NS + i * 20 * MS
        boot_ns = round((measured_ns - BOOTED_NS) * (1.0 + drift))
        now_ns = measured_ns + round((5.0 + chance.expovariate(1.0 / jitter_ms)) * MS)
        if timesync and i % 50 == 0:
            there, back = (round((5.0 + chance.expovariate(1.0 / jitter_ms)) * MS) for _ in range(2))
            clock.add_round_trip(measured_ns - there, boot_ns, measured_ns + back)
        errors.append((clock.stamp_ns(boot_ns // MS, now_ns) - measured_ns) / MS)
    return errors[50 * 10 :]


def test_without_timesync_the_shortest_delay_remains() -> None:
    errors = errors_ms(BootClock(), jitter_ms=4.0, drift=0.0, timesync=False)
    # 5 ms of shortest delay, 1 ms of the stamps' own resolution
    assert all(3.5 < error < 6.0 for error in errors)


def test_timesync_takes_the_delay_off() -> None:
    errors = errors_ms(BootClock(), jitter_ms=4.0, drift=0.0, timesync=True)
    # half of the fastest round trip's jitter, 1 ms of resolution
    assert all(abs(error) < 3.0 for error in errors)


def test_drifting_clocks_are_followed() -> None:
    for drift in (-50e-6, 50e-6):
        errors = errors_ms(BootClock(), jitter_ms=2.0, drift=drift, timesync=True, seconds=600)
        assert all(abs(error) < 4.0 for error in errors)


@given(st.integers(0, 2**32 - 1), st.integers(0, 10**15), st.lists(st.integers(0, 10**15), max_size=3))
def test_a_stamp_is_never_in_the_future_nor_long_past(boot_ms: int, now_ns: int, exchange: list[int]) -> None:
    clock = BootClock()
    if len(exchange) == 3:
        clock.add_round_trip(*sorted(exchange))
    for later in (0, 20 * MS, 40 * S):
        stamp = clock.stamp_ns(boot_ms, now_ns + later)
        assert now_ns + later - MAX_AGE_NS <= stamp <= now_ns + later


def test_slower_than_real_time_is_no_reboot_and_no_stale_stamps() -> None:
    clock = BootClock()
    for i in range(50 * 60):
        measured_ns = BOOTED_NS + i * 20 * MS
        boot_ms = round(i * 20 * 0.95)
        assert not clock.rebooted(boot_ms)
        # 5 % of the two seconds that the filter remembers
        assert measured_ns - clock.stamp_ns(boot_ms, measured_ns) <= 101 * MS


def test_reboot_is_time_that_went_back_and_reordering_is_not() -> None:
    clock = BootClock()
    assert not clock.rebooted(5)
    for boot_s in range(100, 160):
        clock.stamp_ns(boot_s * 1000, BOOTED_NS + boot_s * S)
    assert not clock.rebooted(158_900)
    assert clock.rebooted(3_000)
    clock.reset()
    assert not clock.rebooted(3_000)
