"""What systemd hears, and what it takes for the watchdog to stop."""

import math
from typing import Any

import pytest

from morpheyes_daemon.daemon.systemd import SystemdReport, chain_turns
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Health, State
from morpheyes_daemon.observer.process import event_line


def report(state: State = State.STANDBY, reason: Reason = Reason.READY, **ages_s: float) -> Health:
    ages = {"gate": 0.02, "frame": 0.1, "perception": 0.2, **ages_s}
    return Health(0, state, reason, None, ages, {}, {}, 0.0, 0.0)


class Manager:
    def __init__(self) -> None:
        self.heard: list[list[str]] = []

    def send(self, text: str) -> bool:
        self.heard.append(text.split("\n"))
        return True


def test_ready_once_status_at_every_change_watchdog_always() -> None:
    manager = Manager()
    systemd = SystemdReport(manager.send)
    systemd.tell(report(State.PREFLIGHT, Reason.LINK_LOST))
    systemd.tell(report(State.PREFLIGHT, Reason.LINK_LOST))
    systemd.tell(report())
    assert manager.heard == [
        ["READY=1", "STATUS=preflight: the autopilot link is silent", "WATCHDOG=1"],
        ["WATCHDOG=1"],
        ["STATUS=standby: everything needed is present and fresh", "WATCHDOG=1"],
    ]


@pytest.mark.parametrize(
    ("ages_s", "turns"),
    [
        ({}, True),
        ({"gate": 1.5}, False),
        ({"gate": math.nan}, False),
        ({"frame": math.nan, "perception": math.nan}, True),
        ({"frame": 60.0, "perception": 60.0}, True),
        ({"perception": 10.0}, True),
        ({"perception": 31.0}, False),
    ],
)
def test_only_what_a_restart_could_mend_stops_the_watchdog(ages_s: dict[str, Any], turns: bool) -> None:
    assert chain_turns(report(**ages_s)) is turns
    manager = Manager()
    SystemdReport(manager.send).tell(report(**ages_s))
    assert ("WATCHDOG=1" in manager.heard[0]) is turns


def test_an_event_is_one_line_that_says_its_reason_once() -> None:
    second = 1_000_000_000
    detail = Event(3 * second, "camera", Reason.CAMERA_LOST, "/dev/video0: unplugged")
    assert event_line(detail, second) == "     2.00 s  camera     the camera went away; /dev/video0: unplugged"
    same = Event(3 * second, "monitor", Reason.READY, f"preflight to standby: {Reason.READY.text}")
    assert event_line(same, second).count(Reason.READY.text) == 1
