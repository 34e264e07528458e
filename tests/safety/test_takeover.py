"""The pilot takes over: from every state that holds the sticks, in every way, at any moment."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.states import HOLDING
from tests.support.cockpit import OFF_US, ON_US, Cockpit

WAYS: dict[str, tuple[Callable[[Cockpit], None], State, Reason]] = {
    "switch": (lambda cockpit: cockpit.rc(OFF_US), State.RELEASED, Reason.SWITCH_OFF),
    "switch to its middle": (lambda cockpit: cockpit.rc(1500), State.RELEASED, Reason.SWITCH_OFF),
    "stabilize": (lambda cockpit: cockpit.heartbeat(custom_mode=0), State.PILOT, Reason.MODE_NOT_LOITER),
    "alt hold": (lambda cockpit: cockpit.heartbeat(custom_mode=2), State.PILOT, Reason.MODE_NOT_LOITER),
    "rtl by failsafe": (
        lambda cockpit: cockpit.heartbeat(custom_mode=6, system_status=5),
        State.PILOT,
        Reason.MODE_NOT_LOITER,
    ),
    "disarm": (lambda cockpit: cockpit.heartbeat(armed=False), State.RELEASED, Reason.DISARMED),
}


def take_over(cockpit: Cockpit, way: str) -> None:
    """Let the pilot act; asserts the release in the same call, as the only thing sent."""
    act, state, reason = WAYS[way]
    count = len(cockpit.sent)
    act(cockpit)
    assert [(out.action, out.reason) for out in cockpit.sent[count:]] == [(Action.RELEASE, reason)]
    assert (cockpit.state, cockpit.monitor.reason) == (state, reason)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("state", HOLDING)
def test_each_way_releases_on_reception(state: State, way: str) -> None:
    take_over(Cockpit().into(state), way)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("state", [state for state in State if state not in HOLDING])
def test_who_holds_nothing_sends_nothing_new(state: State, way: str) -> None:
    cockpit = Cockpit().into(state)
    count = len(cockpit.sent)
    WAYS[way][0](cockpit)
    assert cockpit.sent[count:] == []


@pytest.mark.parametrize("silent", Lease)
@pytest.mark.parametrize("way", ["switch", "stabilize", "disarm"])
def test_a_stale_lease_does_not_stand_in_the_pilots_way(way: str, silent: Lease) -> None:
    """Disarming while RC_CHANNELS is silent, the switch while heartbeats are, and so on."""
    cockpit = Cockpit().engage()
    cockpit.silent.add(silent)
    cockpit.run(1.0)
    assert cockpit.state in HOLDING
    take_over(cockpit, way)


def test_a_flick_of_the_mode_between_two_periods_is_seen() -> None:
    cockpit = Cockpit().engage()
    take_over(cockpit, "stabilize")
    cockpit.heartbeat(custom_mode=5)
    assert all(out.action is not Action.STICKS for out in cockpit.run(10.0))
    assert cockpit.state is State.PILOT


def test_a_flick_of_the_switch_between_two_periods_is_seen() -> None:
    cockpit = Cockpit().engage()
    take_over(cockpit, "switch")
    cockpit.rc(ON_US)
    assert all(out.action in (Action.RELEASE, Action.SILENT) for out in cockpit.run(10.0))


def test_both_positions_at_the_same_instant_release() -> None:
    """On a virtual clock two messages can carry the same stamp."""
    cockpit = Cockpit().engage()
    cockpit.rc(ON_US)
    take_over(cockpit, "switch")


def test_after_the_take_over_only_a_steady_flip_engages_again() -> None:
    cockpit = Cockpit().engage()
    take_over(cockpit, "switch")
    cockpit.switch_us = ON_US
    cockpit.run(2.0)
    assert cockpit.state is not State.ENGAGED, "off was too short"
    cockpit.switch_us = OFF_US
    cockpit.run(0.4)
    assert cockpit.state is State.STANDBY
    cockpit.engage()


def test_a_mode_change_needs_the_switch_off_before_on() -> None:
    cockpit = Cockpit().engage()
    take_over(cockpit, "alt hold")
    cockpit.heartbeat(custom_mode=5)
    cockpit.run(3.0)
    assert cockpit.state is State.PILOT
    cockpit.switch_us = OFF_US
    cockpit.run(0.4)
    cockpit.engage()


def test_a_thousand_take_overs_at_random_times() -> None:
    """Released by the call that hears the pilot, whatever the moment; the witness sees to what comes after."""
    rng = random.Random(5)
    ways = list(WAYS)
    cockpit = Cockpit()
    for _ in range(1000):
        cockpit.said.update(custom_mode=5, armed=True, system_status=4)
        cockpit.switch_us = OFF_US
        cockpit.run(0.28)
        cockpit.engage()
        for _ in range(rng.randrange(20)):
            a, b, c, d = (rng.uniform(1000, 2000) for _ in range(4))
            cockpit.wanted = a, b, c, d
            if rng.random() < 0.05:
                cockpit.silent = set(rng.sample(list(Lease), rng.randrange(3)))
            cockpit.period()
        cockpit.wait(rng.randrange(20 * MS))
        take_over(cockpit, rng.choice(ways))
        cockpit.silent.clear()
        after = cockpit.run(rng.uniform(0.02, 0.5))
        assert all(out.action in (Action.RELEASE, Action.SILENT) for out in after)
    assert cockpit.witness.counts["engagements"] == 1000


def test_reception_to_release_takes_no_time_of_the_gate() -> None:
    cockpit = Cockpit().engage()
    take_over(cockpit, "switch")
    assert cockpit.sent[-1].t_ns == cockpit.now_ns
    assert cockpit.now_ns > 1000 * S
