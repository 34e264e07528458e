"""Writes the generated parts of docs/safety.md: the diagram, the states, the triggers and the ways between them.

`python -m morpheyes_daemon.safety.generate_docs` brings the file up to date; a test fails while it is not.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import LEASE_REASONS, Lease
from morpheyes_daemon.safety.monitor import RESUMED
from morpheyes_daemon.safety.states import CAUSE, EFFECTS, MEANING, TRANSITIONS, Trigger, mermaid

PAGE = Path("docs/safety.md")
BEGIN, END = "<!-- generated: {} -->", "<!-- end -->"


def sections() -> dict[str, str]:
    """Return the generated text of each section by its name."""
    return {
        "diagram": f"```mermaid\n{mermaid()}\n```",
        "states": _table(("state", "sends at most", "meaning"), ((s, EFFECTS[s], MEANING[s]) for s in State)),
        "triggers": _table(("trigger", "when", "from → to"), ((t, CAUSE[t], _ways(t)) for t in Trigger)),
        "leases": _table(
            ("lease", "reason when it runs out", "text", "flies on when it returns"),
            ((x, LEASE_REASONS[x], LEASE_REASONS[x].text, _yes(LEASE_REASONS[x] in RESUMED)) for x in Lease),
        ),
    }


def renewed(page: str) -> str:
    """Return `page` with every generated section brought up to date; raises ValueError when one has no place."""
    for name, text in sections().items():
        begin = BEGIN.format(name)
        before, found, rest = page.partition(begin)
        _, closed, after = rest.partition(END)
        if not found or not closed:
            raise ValueError(f"{PAGE} has no place for '{name}': put {begin} and {END} where it belongs")
        page = f"{before}{begin}\n{text}\n{END}{after}"
    return page


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _ways(trigger: Trigger) -> str:
    by_target: dict[State, list[str]] = {}
    for (before, fired), after in TRANSITIONS.items():
        if fired is trigger:
            by_target.setdefault(after, []).append(before)
    return "; ".join(f"{', '.join(sources)} → {after}" for after, sources in by_target.items())


def _yes(flag: bool) -> str:
    return "yes, within the time" if flag else "no"


if __name__ == "__main__":
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
