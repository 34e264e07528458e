"""The state machine's table: written down a second time as a matrix, and checked for what any such table must be."""

from __future__ import annotations

import itertools

import pytest

from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, State
from morpheyes_daemon.safety.generate_docs import PAGE, renewed, sections
from morpheyes_daemon.safety.states import (
    CAUSE,
    EFFECTS,
    HOLDING,
    MEANING,
    TRANSITIONS,
    Machine,
    Transition,
    Trigger,
    mermaid,
)

MATRIX = """
              boot      preflight standby   engaged   braking   hold      pilot     released  fault
booted        preflight .         .         .         .         .         .         .         .
ready         .         standby   .         .         .         .         .         .         .
not_ready     .         preflight preflight .         .         .         .         .         .
engage        .         .         engaged   .         .         .         .         .         .
switch_off    .         .         .         released  released  released  preflight preflight .
mode_left     .         .         .         pilot     pilot     pilot     .         .         .
disarmed      .         .         .         released  released  released  .         .         .
found_flying  pilot     pilot     pilot     .         .         .         .         .         .
stale         .         .         .         braking   braking   .         .         .         .
fresh         .         .         .         .         engaged   .         .         .         .
fault         fault     fault     fault     braking   braking   .         .         .         fault
cleared       .         .         .         .         .         .         .         .         preflight
mission_over  .         .         .         braking   braking   .         .         .         .
stop_requested . .        .         braking   braking   .         .         .         .
stopped       .         .         .         .         hold      .         .         .         .
let_go        .         .         .         released  released  released  .         .         .
shutdown      released  released  released  braking   braking   braking   released  .         released
"""

HEAD, *ROWS = (line.split() for line in MATRIX.strip().splitlines())
EXPECTED = {
    (State(state), Trigger(row[0])): State(after)
    for row in ROWS
    for state, after in zip(HEAD, row[1:], strict=True)
    if after != "."
}
PAIRS = [(state, trigger) for state in State for trigger in Trigger]


def in_state(state: State) -> Machine:
    machine = Machine()
    machine.state, machine.reason, machine.since_ns = state, Reason.READY, 5
    return machine


def test_the_matrix_names_every_state_and_trigger() -> None:
    assert list(State) == HEAD
    assert [row[0] for row in ROWS] == list(Trigger)


@pytest.mark.parametrize(("state", "trigger"), PAIRS)
def test_each_pair_leads_where_the_matrix_says(state: State, trigger: Trigger) -> None:
    machine = in_state(state)
    step = machine.handle(trigger, Reason.DISARMED, 9)
    after = EXPECTED.get((state, trigger))
    if after is None:
        assert step is None
        assert (machine.state, machine.reason, machine.since_ns) == (state, Reason.READY, 5)
    else:
        assert step == Transition(9, state, trigger, after, Reason.DISARMED)
        assert (machine.state, machine.reason) == (after, Reason.DISARMED)
        assert machine.since_ns == (9 if after is not state else 5)


def test_the_same_state_for_the_same_reason_is_no_step() -> None:
    machine = in_state(State.FAULT)
    assert machine.handle(Trigger.FAULT, Reason.READY, 9) is None
    assert machine.handle(Trigger.FAULT, Reason.TASK_DIED, 9) is not None


def test_a_machine_starts_in_boot() -> None:
    machine = Machine()
    assert (machine.state, machine.reason, machine.since_ns) == (State.BOOT, Reason.STARTED, 0)


@pytest.mark.parametrize("table", [EFFECTS, MEANING], ids=["EFFECTS", "MEANING"])
def test_each_state_has_its_row(table: dict[State, str]) -> None:
    assert list(table) == list(State)
    assert all(table.values())


def test_each_trigger_has_its_cause_and_does_something() -> None:
    assert list(CAUSE) == list(Trigger)
    assert all(CAUSE.values())
    assert {trigger for _, trigger in TRANSITIONS} == set(Trigger)


def test_what_each_state_sends_at_most() -> None:
    sends = {action: {state for state in State if EFFECTS[state] is action} for action in Action}
    assert sends[Action.STICKS] == {State.ENGAGED}
    assert sends[Action.NEUTRAL] == {State.BRAKING, State.HOLD}
    assert sends[Action.RELEASE] == {State.PILOT, State.RELEASED}
    assert sends[Action.SILENT] == {State.BOOT, State.PREFLIGHT, State.STANDBY, State.FAULT}
    assert set(HOLDING) == {State.ENGAGED, State.BRAKING, State.HOLD}


def test_every_state_is_reached_and_left() -> None:
    reached = {State.BOOT}
    for _ in State:
        reached |= {after for (before, _), after in TRANSITIONS.items() if before in reached}
    assert reached == set(State)
    assert {before for (before, _), after in TRANSITIONS.items() if after is not before} == set(State)


def test_sticks_are_never_dropped_in_silence() -> None:
    """From a state that holds the sticks every way leads to another that does, or to one that releases."""
    for (before, _), after in TRANSITIONS.items():
        if before in HOLDING:
            assert EFFECTS[after] is not Action.SILENT


def test_flying_begins_in_standby_and_resumes_from_braking_alone() -> None:
    into = {before for (before, _), after in TRANSITIONS.items() if after is State.ENGAGED}
    assert into == {State.STANDBY, State.BRAKING}


def test_reasons_have_numbers_of_their_own() -> None:
    """Reason numbers stand in old logs and must never be shared."""
    for one, other in itertools.combinations(Reason, 2):
        assert one.number != other.number


def test_the_diagram_shows_every_way() -> None:
    lines = mermaid().splitlines()
    assert lines[:2] == ["stateDiagram-v2", "    [*] --> boot"]
    shown = set()
    for line in lines[2:]:
        ends, triggers = line.strip().split(": ")
        shown |= {(*ends.split(" --> "), trigger) for trigger in triggers.split(", ")}
    assert shown == {(b, a, t) for (b, t), a in TRANSITIONS.items() if a is not b}


def test_the_page_is_up_to_date() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert renewed(page) == page, "run: python -m morpheyes_daemon.safety.generate_docs"


def test_the_page_explains_every_state_trigger_and_lease() -> None:
    text = sections()
    assert set(text) == {"diagram", "states", "triggers", "leases"}
    assert "| hold | neutral | neutral sticks at a standstill; waits for the pilot |" in text["states"]
    assert "engaged, braking, hold → released; pilot, released → preflight |" in text["triggers"]
    assert "| link | link_lost | the autopilot link is silent | no |" in text["leases"]
    assert "| frame | frame_stale | no fresh camera frame | yes, within the time |" in text["leases"]


@pytest.mark.parametrize("page", ["", "<!-- generated: diagram -->", "<!-- generated: diagram -->\n<!-- end -->"])
def test_a_page_without_a_place_for_a_section_is_refused(page: str) -> None:
    with pytest.raises(ValueError, match="has no place for"):
        renewed(page)
