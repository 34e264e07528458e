"""systemd is told what changed, and pinged only while the daemon really works."""

from dataclasses import replace

import pytest

from morpheyes_daemon.reasons import Reason
from morpheyes_daemon.safety.states import State
from morpheyes_daemon.supervisor.service_manager import INPUTS, STALE_S, ServiceManager, chain_is_fresh
from morpheyes_daemon.tasks.health import Health

FRESH = {name: 0.1 for name in ("gate", *INPUTS)}


def report(state: State = State.ENGAGED, **ages: float) -> Health:
    return Health(1, state, Reason.ENGAGED, None, {**FRESH, **ages}, {}, {}, 0.0, 0.0)


def test_ready_once_status_on_change_ping_every_time() -> None:
    sent: list[str] = []
    manager = ServiceManager(sent.append)
    manager.tell(report(State.STANDBY))
    manager.tell(report(State.STANDBY))
    manager.tell(report())
    manager.stopping()
    assert sent == [
        f"READY=1\nSTATUS=standby: {Reason.ENGAGED.text}\nWATCHDOG=1",
        "WATCHDOG=1",
        f"STATUS=engaged: {Reason.ENGAGED.text}\nWATCHDOG=1",
        "STOPPING=1\nSTATUS=stopping: neutral, then release",
    ]


def test_preflight_says_what_is_missing() -> None:
    sent: list[str] = []
    waiting = replace(report(State.PREFLIGHT), missing=Reason.CAMERA_LOST)
    ServiceManager(sent.append).tell(waiting)
    assert f"STATUS=preflight: {Reason.CAMERA_LOST.text}" in sent[0]


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("age_s", [STALE_S, 100.0, float("nan")])
def test_engaged_on_stale_inputs_is_not_pinged(name: str, age_s: float) -> None:
    assert not chain_is_fresh(report(**{name: age_s}))
    assert chain_is_fresh(report(**{name: STALE_S - 0.01}))


@pytest.mark.parametrize("state", [state for state in State if state is not State.ENGAGED])
def test_a_missing_device_is_no_reason_for_a_restart(state: State) -> None:
    assert chain_is_fresh(report(state, frame=float("nan"), vehicle=99.0))


@pytest.mark.parametrize("state", State)
def test_a_stick_period_that_stands_still_is_never_pinged(state: State) -> None:
    assert not chain_is_fresh(report(state, gate=STALE_S))
    assert not chain_is_fresh(report(state, gate=float("nan")))
