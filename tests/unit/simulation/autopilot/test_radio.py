"""Receiver and overrides merged by ArduCopter's rules, without a vehicle."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.simulation.autopilot.parameters import ParameterTable
from morpheyes_daemon.simulation.autopilot.rc_input import KEEP, RELEASE_HIGH, Radio, RcInput

TICK = 10 * MS


class Inputs:
    """RcInput on a hand-set time."""

    def __init__(self, *, receiver: bool = True, **changes: float) -> None:
        self.radio = Radio(present=receiver)
        self.table = ParameterTable(changes)
        self.rc = RcInput(self.table, self.radio)
        self.t_ns = 5 * S

    def run(self, seconds: float, *, armed: bool = True) -> list[bool]:
        """Update at 100 Hz and return the failsafe's edges."""
        edges = []
        for _ in range(round(seconds * S / TICK)):
            self.t_ns += TICK
            edge = self.rc.update(self.t_ns, armed=armed)
            if edge is not None:
                edges.append(edge)
        return edges


pulses = st.integers(900, 2100)


@given(st.lists(pulses, min_size=4, max_size=4), st.lists(pulses, min_size=4, max_size=4))
def test_an_override_wins_until_it_expires(sticks: list[int], override: list[int]) -> None:
    inputs = Inputs(RC_OVERRIDE_TIME=0.5, FS_THR_ENABLE=0)
    inputs.radio.channels_us[:4] = sticks
    inputs.run(0.1)
    inputs.rc.override(inputs.t_ns, [*override, *[KEEP] * 4])
    inputs.run(0.4)
    assert inputs.rc.channels_us[:4] == override
    inputs.run(0.15)
    assert inputs.rc.channels_us[:4] == sticks


@given(st.lists(st.sampled_from([0, KEEP, RELEASE_HIGH, 1000, 1500, 2000]), min_size=16, max_size=16))
def test_every_value_on_every_channel_means_what_the_rules_say(values: list[int]) -> None:
    inputs = Inputs(FS_THR_ENABLE=0)
    inputs.run(0.1)
    before = list(inputs.radio.channels_us)
    inputs.rc.override(inputs.t_ns, values)
    inputs.run(0.03)
    for index, value in enumerate(values):
        released = value == KEEP or value == 0 or (index >= 8 and value == RELEASE_HIGH)
        assert inputs.rc.channels_us[index] == (before[index] if released else value)


@given(pulses, st.integers(0, 60), st.booleans())
def test_a_stick_is_scaled_to_one_with_its_dead_zone_and_direction(pulse: int, dead: int, reverse: bool) -> None:
    inputs = Inputs(RC2_DZ=dead, RC2_REVERSED=float(reverse), RC2_MIN=1100, RC2_MAX=1900, RC2_TRIM=1520)
    inputs.radio.sticks(pitch_us=pulse, throttle_us=1500)
    inputs.run(0.1)
    pitch = inputs.rc.pilot().pitch
    assert -1.0 <= pitch <= 1.0
    off = pulse - 1520
    if abs(off) <= dead:
        assert pitch == 0.0
    else:
        assert (pitch > 0) is ((off > 0) is not reverse)
    if pulse in (1100, 1900):
        assert abs(pitch) == 1.0


def test_rcmap_moves_the_sticks() -> None:
    inputs = Inputs(RCMAP_PITCH=3, RCMAP_THROTTLE=2)
    inputs.radio.sticks(pitch_us=1000, throttle_us=2000)
    inputs.run(0.1)
    pilot = inputs.rc.pilot()
    assert pilot.pitch == 1.0
    assert pilot.throttle == 0.0


def test_the_middle_of_the_throttle_is_that_of_its_range() -> None:
    inputs = Inputs(RC3_MIN=1100, RC3_MAX=1900, RC3_TRIM=1100)
    inputs.radio.sticks(throttle_us=1500)
    inputs.run(0.1)
    pilot = inputs.rc.pilot()
    assert pilot.throttle == pilot.throttle_middle


@pytest.mark.parametrize(("silence_s", "edges"), [(0.9, []), (1.1, [True])])
def test_silence_of_a_second_is_a_failsafe(silence_s: float, edges: list[bool]) -> None:
    inputs = Inputs(FS_THR_ENABLE=3)
    inputs.run(1.0)
    inputs.radio.heard = False
    assert inputs.run(silence_s) == edges
    assert inputs.rc.pilot().valid is (not edges)


def test_a_throttle_below_the_failsafe_value_is_a_failsafe_after_three_frames() -> None:
    inputs = Inputs(FS_THR_ENABLE=3)
    inputs.run(1.0)
    inputs.radio.sticks(throttle_us=950)
    assert inputs.run(0.03) == []
    assert not inputs.rc.pilot().valid, "a doubtful throttle is not flown on"
    assert inputs.run(0.04) == [True]
    inputs.radio.sticks(throttle_us=1500)
    assert inputs.run(0.1) == [False]


def test_without_any_input_there_is_no_failsafe_on_the_ground() -> None:
    inputs = Inputs(receiver=False, FS_THR_ENABLE=3)
    assert inputs.run(5.0, armed=False) == []
    assert not inputs.rc.pilot().valid


def test_a_setting_of_zero_never_fails() -> None:
    inputs = Inputs(FS_THR_ENABLE=0)
    inputs.run(1.0)
    inputs.radio.heard = False
    assert inputs.run(20.0) == []
    assert inputs.rc.pilot().valid


def test_overrides_can_be_switched_off_by_rc_override_time_zero_and_last_for_ever_below() -> None:
    never, always = Inputs(RC_OVERRIDE_TIME=0), Inputs(RC_OVERRIDE_TIME=-1)
    for inputs in (never, always):
        inputs.run(0.1)
        inputs.rc.override(inputs.t_ns, [1700] * 4)
        inputs.run(30.0)
    assert never.rc.channels_us[0] == 1500
    assert always.rc.channels_us[0] == 1700


@pytest.mark.parametrize("position", [1, 2, 3, 4, 5, 6])
def test_the_mode_switch_reports_each_position_once(position: int) -> None:
    inputs = Inputs()
    inputs.radio.mode_switch(position)
    seen = []
    for _ in range(100):
        inputs.run(0.01)
        seen.append(inputs.rc.new_mode_position(inputs.t_ns))
    assert [value for value in seen if value is not None] == [position]


def test_a_flicker_of_the_mode_switch_is_no_change() -> None:
    inputs = Inputs()
    seen = []
    for step in range(200):
        inputs.radio.mode_switch(4 if step % 15 == 14 else 1)
        inputs.run(0.01)
        seen.append(inputs.rc.new_mode_position(inputs.t_ns))
    assert {value for value in seen if value is not None} == {1}
