"""Findings that say "do not fly" keep the daemon from standing by; a flight that is under way is not ended by them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.doctor.parameter_rules import examine_parameters
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.safety.monitor import SafetyMonitor


class StopFindings:
    """Reports each new STOP finding once and tells the safety monitor whether any is left, by source."""

    def __init__(self, config: VehicleConfig, monitor: SafetyMonitor, events: EventLog, clock: Clock) -> None:
        self._config = config
        self._monitor = monitor
        self._events = events
        self._clock = clock
        self._known: dict[str, tuple[str, ...]] = {}

    def on_parameters(self, values: Mapping[str, float]) -> None:
        """Examine the autopilot's parameters, which have just changed."""
        self.take("doctor", examine_parameters(values, self._config))

    def take(self, source: str, findings: Sequence[Finding]) -> None:
        """Take the findings of one source, which replace its earlier ones."""
        stops = [finding for finding in findings if finding.severity is Severity.STOP]
        self._monitor.set_missing(Reason.DOCTOR_SAYS_NO if stops else None, source)
        for finding in stops:
            if finding.id not in self._known.get(source, ()):
                text = f"{finding.id}: {finding.evidence}; {finding.risk}; {finding.remedy}"
                self._events.publish(Event(self._clock.now_ns(), "doctor", Reason.DOCTOR_SAYS_NO, text))
        self._known[source] = tuple(finding.id for finding in stops)
