"""The fault matrix is complete, its page is up to date, and its rules notice what they are for."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from morpheyes_daemon.errors import UsageError
from morpheyes_daemon.fault_injection.expectations import Fault, FaultOutcome, complaints
from morpheyes_daemon.fault_injection.harness import Measured, Sent, TruePath
from morpheyes_daemon.fault_injection.matrix import FAULTS
from morpheyes_daemon.fault_injection.report import page
from morpheyes_daemon.fault_injection.runner import Row, choose, flights, load_rows, make_row, store_row
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode

PAGE = Path(__file__).parents[2] / "docs/faults.md"


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_page_has_the_rows_of_the_matrix_and_all_are_well() -> None:
    """Regenerate it with `morpheyes faults --out docs/faults.md` when this fails."""
    lines = [cells(line) for line in PAGE.read_text().splitlines() if line.startswith("| ")][2:]
    written = {(line[0].split(":")[0], line[1], line[2], line[3]) for line in lines}
    wanted = {(f.name, f.kind, state.value, end.value) for f in FAULTS for state, end in f.endings.items()}
    assert written == wanted
    assert {line[-1] for line in lines} == {"ok"}


def test_the_page_says_how_many_flights_and_that_all_ended_well() -> None:
    found = re.search(r"(\d+) faults in (\d+) rows, (\d+) flights", PAGE.read_text())
    assert found is not None
    assert int(found[1]) == len(FAULTS) >= 40
    assert int(found[2]) == flights(FAULTS)
    assert int(found[3]) == 3 * flights(FAULTS), "three seeds each"
    assert f"{found[3]} ended as the table says (100.0%)" in PAGE.read_text()


def test_names_are_unique_and_chosen_by_their_beginning() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(set(names)) == len(names)
    assert {fault.name for fault in choose("desync")} == {"desync-5ms", "desync-20ms", "desync-50ms"}
    assert choose(None) == FAULTS
    with pytest.raises(UsageError, match="there is no fault 'x'"):
        choose("x")


def fault(ending: FaultOutcome, state: State = State.ENGAGED, **more: object) -> Fault:
    return Fault("name", "what", 0.1, {state: ending}, **more)  # type: ignore[arg-type]


SEEN = Measured(
    state=State.ENGAGED, reason=Reason.ENGAGED, reaction_s=None, quiet_s=None, release_s=None, neutrals=0, left=False,
    sticks_after=0, last=Sent.STICKS, last_s=6.98, stop_m=3.0, stopped=True, reserved_m=4.0, clearance_m=0.5, events=(),
)  # fmt: skip
HELD = replace(
    SEEN, state=State.HOLD, reaction_s=0.2, quiet_s=0.2, neutrals=300, last=Sent.NEUTRAL, reason=Reason.FRAME_STALE
)
RELEASED = replace(HELD, state=State.RELEASED, release_s=0.12, last=Sent.RELEASE)
SILENT = replace(SEEN, state=State.STANDBY, last=None, last_s=None)
GOOD: dict[FaultOutcome, Measured] = {
    FaultOutcome.FLIES: SEEN,
    FaultOutcome.FLIES_WITH_PAUSES: replace(SEEN, state=State.BRAKING, last=Sent.NEUTRAL, neutrals=40),
    FaultOutcome.RESUMES: replace(SEEN, reaction_s=0.2, neutrals=20, sticks_after=100),
    FaultOutcome.HOLDS: HELD,
    FaultOutcome.HOLDS_IF_IT_MATTERS: HELD,
    FaultOutcome.RELEASES: RELEASED,
    FaultOutcome.LETS_GO: RELEASED,
    FaultOutcome.READY: SILENT,
    FaultOutcome.UNREADY: replace(SILENT, state=State.PREFLIGHT),
    FaultOutcome.STOPS: HELD,
}
BAD: list[tuple[FaultOutcome, dict[str, object]]] = [
    (FaultOutcome.FLIES, {"state": State.HOLD}),
    (FaultOutcome.FLIES, {"last": Sent.NEUTRAL}),
    (FaultOutcome.FLIES, {"left": True}),
    (FaultOutcome.FLIES_WITH_PAUSES, {"state": State.HOLD}),
    (FaultOutcome.FLIES_WITH_PAUSES, {"state": State.RELEASED}),
    (FaultOutcome.RESUMES, {"reaction_s": 0.4}),
    (FaultOutcome.RESUMES, {"reaction_s": None}),
    (FaultOutcome.RESUMES, {"sticks_after": 0}),
    (FaultOutcome.RESUMES, {"state": State.BRAKING}),
    (FaultOutcome.HOLDS, {"quiet_s": 0.36}),
    (FaultOutcome.HOLDS, {"quiet_s": None}),
    (FaultOutcome.HOLDS, {"state": State.BRAKING}),
    (FaultOutcome.HOLDS, {"last": Sent.RELEASE}),
    (FaultOutcome.HOLDS, {"last_s": 6.5}),
    (FaultOutcome.HOLDS, {"stopped": False}),
    (FaultOutcome.HOLDS_IF_IT_MATTERS, {"state": State.RELEASED}),
    (FaultOutcome.RELEASES, {"release_s": 0.16}),
    (FaultOutcome.RELEASES, {"release_s": None}),
    (FaultOutcome.RELEASES, {"state": State.HOLD}),
    (FaultOutcome.RELEASES, {"sticks_after": 1}),
    (FaultOutcome.RELEASES, {"last": Sent.NEUTRAL}),
    (FaultOutcome.LETS_GO, {"quiet_s": 0.4}),
    (FaultOutcome.LETS_GO, {"neutrals": 0}),
    (FaultOutcome.LETS_GO, {"state": State.HOLD}),
    (FaultOutcome.LETS_GO, {"last": Sent.STICKS}),
    (FaultOutcome.READY, {"state": State.PREFLIGHT}),
    (FaultOutcome.READY, {"neutrals": 1}),
    (FaultOutcome.READY, {"last": Sent.STICKS}),
    (FaultOutcome.UNREADY, {"state": State.STANDBY}),
    (FaultOutcome.UNREADY, {"state": State.ENGAGED}),
    (FaultOutcome.UNREADY, {"last": Sent.NEUTRAL}),
    (FaultOutcome.STOPS, {"stopped": False}),
    (FaultOutcome.STOPS, {"stop_m": 4.1}),
    (FaultOutcome.STOPS, {"sticks_after": 1}),
    (FaultOutcome.FLIES, {"clearance_m": -0.01}),
    (FaultOutcome.HOLDS, {"clearance_m": -0.01}),
    (FaultOutcome.LETS_GO, {"clearance_m": -0.01}),
    (FaultOutcome.STOPS, {"clearance_m": -0.01}),
]


@pytest.mark.parametrize("ending", GOOD)
def test_what_ends_as_it_must_is_not_complained_of(ending: FaultOutcome) -> None:
    assert complaints(fault(ending), State.ENGAGED, GOOD[ending]) == []


@pytest.mark.parametrize(("ending", "changes"), BAD, ids=str)
def test_each_rule_notices_what_it_is_for(ending: FaultOutcome, changes: dict[str, object]) -> None:
    assert complaints(fault(ending), State.ENGAGED, replace(GOOD[ending], **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("ending", [FaultOutcome.RELEASES, FaultOutcome.LETS_GO, FaultOutcome.STOPS])
def test_out_of_braking_it_may_fly_on_until_it_has_noticed_and_no_longer(ending: FaultOutcome) -> None:
    one = fault(ending, State.BRAKING)
    seen = replace(GOOD[ending], sticks_after=5, quiet_s=0.3)
    assert complaints(one, State.BRAKING, seen) == []
    assert complaints(one, State.BRAKING, replace(seen, last=Sent.STICKS))
    late = complaints(one, State.BRAKING, replace(seen, quiet_s=0.4))
    assert bool(late) is (one.kind == "A"), "a daemon that is cut off does not know"


def test_a_daemon_that_starts_where_it_must_refuse_is_complained_of() -> None:
    assert complaints(fault(FaultOutcome.REFUSES), State.ENGAGED, SEEN)


def test_what_falls_or_is_the_pilots_may_hit_the_ground() -> None:
    hit = replace(RELEASED, clearance_m=-0.5)
    assert complaints(fault(FaultOutcome.RELEASES), State.ENGAGED, hit) == []
    assert complaints(fault(FaultOutcome.LETS_GO, falls=True), State.ENGAGED, hit) == []


def test_rows_are_kept_and_the_page_shows_the_worst(tmp_path: Path) -> None:
    one = choose("camera-stall")[0]
    rows = [
        make_row(one, State.ENGAGED, seed, replace(HELD, quiet_s=0.5 + seed / 10, reserved_m=math.inf), ())
        for seed in (0, 1)
    ]
    for row in rows:
        store_row(tmp_path / "rows.jsonl", row)
    assert load_rows(tmp_path / "rows.jsonl") == rows
    assert load_rows(tmp_path / "none.jsonl") == []
    assert all(isinstance(row, Row) and row.passed for row in rows)
    text = page(rows, "--seeds 0-1", (one,))
    assert "1 faults in 4 rows, 2 flights (0 to 2 seeds each), 2 ended as the table says (100.0%)" in text
    assert "0.60 s" in text
    assert text.count("not flown") == 3
    rows.append(make_row(choose("camera-stall")[0], State.HOLD, 0, HELD, ("still moves",)))
    assert "3 flights (0 to 2 seeds each), 2 ended" in page(rows, "", (one,))
    assert "still moves" in page(rows, "", (one,))


class Drifting:
    """A stage whose vehicle comes 0.1 m nearer to a tree with each look, from 0.25 m on."""

    def __init__(self) -> None:
        self.autopilot = SimpleNamespace(autopilot=SimpleNamespace(mode=Mode.LOITER))
        self.looks = 0

    def truth(self, t_ns: int) -> SimpleNamespace:
        return SimpleNamespace(p_ned_m=(0.0, 0.0, 0.0), v_ned_m_s=(0.0, 0.0, 0.0))

    def clearance_m(self, t_ns: int) -> float:
        self.looks += 1
        return 0.35 - 0.1 * self.looks


@pytest.mark.parametrize(("mode", "clearance_m"), [(Mode.LOITER, -0.05), (Mode.LAND, 0.15), (Mode.RTL, 0.15)])
def test_what_comes_near_counts_in_loiter_alone(mode: Mode, clearance_m: float) -> None:
    stage = Drifting()
    path = TruePath(stage)  # type: ignore[arg-type]
    for moment in range(4):
        if moment == 2:
            stage.autopilot.autopilot.mode = mode
        path.sample(moment)
    assert path.clearance_m == pytest.approx(clearance_m)
