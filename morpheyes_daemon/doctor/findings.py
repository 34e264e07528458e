"""What an examination finds: risk, evidence and remedy, and the verdict over all of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding weighs."""

    STOP = "stop"
    CARE = "care"
    NOTE = "note"


class Verdict(StrEnum):
    """May it fly?"""

    FLY = "fly"
    CARE = "fly with care"
    STOP = "do not fly"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found. `parameters` are the autopilot parameters that remedy it, as the autopilot names them."""

    id: str
    severity: Severity
    evidence: str
    risk: str
    remedy: str
    parameters: dict[str, float] = field(default_factory=dict)


def verdict(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that the gravest finding asks for."""
    found = {finding.severity for finding in findings}
    if Severity.STOP in found:
        return Verdict.STOP
    return Verdict.CARE if Severity.CARE in found else Verdict.FLY


def by_weight(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings, gravest first, else in their order."""
    order = list(Severity)
    return sorted(findings, key=lambda finding: order.index(finding.severity))


def remedies(findings: Iterable[Finding]) -> dict[str, float]:
    """Return all parameters to be set; where two findings name the same one, the graver finding's value stands."""
    changes: dict[str, float] = {}
    for finding in by_weight(findings):
        for name, value in finding.parameters.items():
            changes.setdefault(name, value)
    return changes
