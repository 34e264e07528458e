"""The row of a flight tells why it ended in the words of whoever knew, and so does the page of `morpheyes sim`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.cli.sim import _page
from morpheyes_daemon.flights.lockstep import FlightCounter, Summary
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason

SIZE = (
    "the opening is 0.41 x 0.30 m with -12 mm of room; the vehicle needs 0.34 x 0.19 m and 0 mm at a baseline of 100 mm"
)


def summary(**changes: Any) -> Summary:
    """Ones and empty texts, with changes."""
    kinds: dict[str, Any] = {"str": "", "int": 1, "float": 1.0}
    return Summary(**{**{field.name: kinds[str(field.type)] for field in fields(Summary)}, **changes})


def test_what_was_last_said_of_a_reason_is_kept_but_not_the_monitor_s_own_words() -> None:
    events = EventLog()
    tally = FlightCounter(Topics.create(), events)
    for source, reason, text in (
        ("camera", Reason.CAMERA_LOST, "camera: unplugged"),
        ("camera", Reason.RECOVERED, "camera: works again"),
        ("mission", Reason.MISSION_REFUSED, SIZE),
        ("monitor", Reason.MISSION_REFUSED, "ENGAGED to BRAKING: refused"),
        ("camera", Reason.CAMERA_LOST, "camera: unplugged again"),
    ):
        events.publish(Event(1, source, reason, text))
    assert tally.said("mission_refused") == SIZE
    assert tally.said("camera_lost") == "camera: unplugged again"
    assert tally.said("goal_reached") == tally.said("hull or bar 3 mm into an obstacle") == ""


def test_the_page_says_why_where_there_is_a_text() -> None:
    refused = summary(outcome="refused", reason="mission_refused", text=SIZE)
    lines = _page(refused, Path("out")).splitlines()
    assert lines[0] == "             outcome  refused (mission_refused)"
    assert lines[1].startswith("                 why  the opening is 0.41 x 0.30 m with -12 mm of room; the vehicle")
    assert lines[2].startswith(" " * 22)
    assert " ".join(line.strip() for line in lines[1:3]).removeprefix("why  ") == SIZE
    assert max(map(len, lines)) <= 115
    assert "why" not in _page(summary(outcome="reached"), Path("out"))
    assert refused.as_json()["text"] == SIZE
