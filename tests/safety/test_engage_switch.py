"""What counts as the pilot asking to engage, and what does not."""

from __future__ import annotations

import math

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.safety.engage_switch import EngageSwitch

START_NS = 1000 * S
STEADY_NS, ASKING_NS = 200 * MS, S
OFF, ON = 1000, 1900
ABOVE = 1700


class Pilot:
    """A switch heard every 50 ms."""

    def __init__(self) -> None:
        self.switch = EngageSwitch(ABOVE, 500 * MS)
        self.now_ns = START_NS

    def puts(self, width: float, ms: int = 400, every_ms: int = 50) -> Pilot:
        for _ in range(ms // every_ms):
            self.now_ns += every_ms * MS
            self.switch.hear(self.now_ns, width)
        return self

    @property
    def asks(self) -> bool:
        return self.switch.asks(self.now_ns)


def test_a_flip_asks() -> None:
    pilot = Pilot().puts(OFF)
    assert not pilot.switch.on
    pilot.puts(ON)
    assert pilot.switch.on
    assert pilot.asks


def test_a_new_switch_knows_nothing() -> None:
    switch = EngageSwitch(ABOVE, S)
    assert not switch.on
    assert not switch.flipped(0)
    assert not switch.asks(0)


@pytest.mark.parametrize("first_ns", [0, 1, START_NS])
def test_a_switch_that_was_always_on_never_asks(first_ns: int) -> None:
    pilot = Pilot()
    pilot.switch.hear(first_ns, ON)
    pilot.puts(ON, 5000)
    assert pilot.switch.on
    assert not pilot.asks


@pytest.mark.parametrize(("gap_ns", "asks"), [(STEADY_NS - 1, False), (STEADY_NS, True)])
def test_off_must_have_been_steady(gap_ns: int, asks: bool) -> None:
    switch = EngageSwitch(ABOVE, 500 * MS)
    switch.hear(START_NS, OFF)
    switch.hear(START_NS + gap_ns, ON)
    switch.hear(START_NS + gap_ns + STEADY_NS, ON)
    assert switch.asks(START_NS + gap_ns + STEADY_NS) is asks


@pytest.mark.parametrize(("gap_ns", "asks"), [(STEADY_NS - 1, False), (STEADY_NS, True)])
def test_on_must_be_steady(gap_ns: int, asks: bool) -> None:
    pilot = Pilot().puts(OFF)
    flip_ns = pilot.now_ns + 50 * MS
    pilot.switch.hear(flip_ns, ON)
    assert pilot.switch.flipped(flip_ns)
    assert not pilot.switch.asks(flip_ns + STEADY_NS), "one message is not steady, however old"
    pilot.switch.hear(flip_ns + gap_ns, ON)
    assert pilot.switch.asks(flip_ns + gap_ns) is asks


@pytest.mark.parametrize(("age_ns", "asks"), [(ASKING_NS, True), (ASKING_NS + 1, False)])
def test_a_flip_counts_for_a_moment(age_ns: int, asks: bool) -> None:
    pilot = Pilot().puts(OFF)
    flip_ns = pilot.now_ns + 50 * MS
    pilot.puts(ON, 300)
    assert pilot.switch.asks(flip_ns + age_ns) is asks
    assert pilot.switch.flipped(flip_ns + age_ns) is asks


def test_a_flip_counts_once() -> None:
    pilot = Pilot().puts(OFF).puts(ON)
    pilot.switch.use()
    assert pilot.switch.on
    assert not pilot.asks
    assert not pilot.puts(ON).asks
    assert pilot.puts(OFF).puts(ON).asks


def test_off_takes_the_flip_back() -> None:
    pilot = Pilot().puts(OFF).puts(ON).puts(OFF, 50)
    assert not pilot.asks
    assert not pilot.switch.on
    assert not pilot.switch.flipped(pilot.now_ns)


@pytest.mark.parametrize(("gap_ns", "asks"), [(500 * MS, True), (500 * MS + 1, False)])
def test_a_gap_forgets_what_was_seen(gap_ns: int, asks: bool) -> None:
    pilot = Pilot().puts(OFF)
    pilot.now_ns += gap_ns - 50 * MS
    assert pilot.puts(ON).asks is asks


def test_a_gap_while_on_needs_a_new_flip() -> None:
    pilot = Pilot().puts(OFF).puts(ON, 100)
    pilot.now_ns += 600 * MS
    assert not pilot.puts(ON, 300).asks


@pytest.mark.parametrize("width", [0, 65535, 799, 2201, math.nan, math.inf, -1])
def test_a_pulse_that_is_none_forgets_what_was_seen(width: float) -> None:
    pilot = Pilot().puts(OFF)
    assert pilot.switch.hear(pilot.now_ns + 1, width) is None
    assert not pilot.switch.on
    assert not pilot.puts(ON).asks, "an absent channel is no off"


def test_a_pulse_that_is_none_takes_the_flip_back() -> None:
    pilot = Pilot().puts(OFF).puts(ON)
    assert pilot.switch.flipped(pilot.now_ns)
    pilot.switch.hear(pilot.now_ns + 1, 0)
    assert not pilot.switch.flipped(pilot.now_ns + 1)
    assert not pilot.asks


@pytest.mark.parametrize(
    ("width", "on"),
    [(800, False), (ABOVE, False), (ABOVE + 1, True), (ABOVE + 0.5, True), (2200, True)],
)
def test_what_is_on(width: float, on: bool) -> None:
    assert EngageSwitch(ABOVE, S).hear(START_NS, width) is on


def test_the_same_message_again_tells_nothing_new() -> None:
    switch = EngageSwitch(ABOVE, S)
    assert switch.hear(START_NS, OFF) is False
    assert switch.hear(START_NS, OFF) is None
    assert switch.hear(START_NS, ON) is True, "another position at the same instant is news"
    assert switch.hear(START_NS, OFF) is False
    assert switch.hear(START_NS + 1, OFF) is False, "and so is the same position later"


def test_off_is_believed_though_it_was_overtaken() -> None:
    pilot = Pilot().puts(OFF).puts(ON)
    assert pilot.switch.hear(pilot.now_ns - 300 * MS, OFF) is False
    assert not pilot.switch.on


def test_an_overtaken_off_does_not_make_the_next_on_a_flip() -> None:
    pilot = Pilot().puts(ON)
    pilot.switch.hear(pilot.now_ns - 350 * MS, OFF)
    assert not pilot.puts(ON).asks


def test_an_overtaken_on_is_ignored() -> None:
    pilot = Pilot().puts(ON).puts(OFF)
    assert pilot.switch.hear(pilot.now_ns - 1, ON) is None
    assert not pilot.switch.on
    assert pilot.puts(ON).asks, "and does not spoil the flip that follows"


def test_a_stray_on_asks_for_nothing() -> None:
    pilot = Pilot().puts(OFF).puts(ON, 50).puts(OFF, 50)
    assert not pilot.asks
    assert not pilot.puts(ON, 300).asks, "nor does it leave a steady off behind"


def test_a_worn_contact_asks_for_nothing() -> None:
    pilot = Pilot().puts(OFF)
    for _ in range(20):
        assert not pilot.puts(ON, 100).asks
        assert not pilot.puts(OFF, 100).asks


def test_forgetting_forgets_the_time_too() -> None:
    pilot = Pilot().puts(OFF).puts(ON)
    pilot.switch.forget()
    assert not pilot.switch.on
    assert not pilot.asks
    pilot.now_ns -= 900 * S
    assert not pilot.puts(ON).asks
    assert pilot.puts(OFF).puts(ON).asks
