"""Status telemetry: what ground stations and the autopilot's own log are told over MAVLink.

It only reports. Messages that the autopilot would act on (LANDING_TARGET, FOLLOW_TARGET) are not used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.messages.core import Event, MissionCommand, Track
from morpheyes_daemon.messages.safety import Health, State
from morpheyes_daemon.safety.states import Transition

STATE_NUMBERS: dict[State, int] = {state: number for number, state in enumerate(State)}
"""NAMED_VALUE_INT `me_state` of each state."""
WARNING, INFO = 4, 6
"""MAV_SEVERITY of a transition: to a state that needs the pilot, and to any other."""


class StatusLink(Protocol):
    """The part of the autopilot connection that only informs."""

    def send_statustext(self, severity: int, text: str) -> None:
        """Show a text on ground stations."""

    def send_named_int(self, name: str, value: int) -> None:
        """Log a whole number under a name."""

    def send_named_float(self, name: str, value: float) -> None:
        """Log a value under a name."""

    def send_debug_vector(self, name: str, x: float, y: float, z: float) -> None:
        """Show three values under a name."""


@dataclass(slots=True)
class StatusTelemetry:
    """Transitions, mission texts, health and the tracked object, each sent when it changes or arrives."""

    link: StatusLink
    topics: Topics
    events: EventLog
    last_text: str = ""

    def on_transition(self, step: Transition) -> None:
        """Report one step of the state machine as event and STATUSTEXT."""
        text = f"{step.before} to {step.after}: {step.reason.text}"
        self.events.publish(Event(step.t_ns, "monitor", step.reason, text))
        severity = WARNING if step.after in (State.BRAKING, State.HOLD, State.FAULT) else INFO
        self.link.send_statustext(severity, f"MorphEyes {step.after}: {step.reason}")

    def on_command(self, command: MissionCommand) -> None:
        """Report once what a mission says beside its reason, such as the size of the gap it refuses."""
        if command.text and command.reason and command.text != self.last_text:
            self.events.publish(Event(command.t_ns, "mission", command.reason, command.text))
        self.last_text = command.text

    def on_track(self, track: Track) -> None:
        """Send the tracked object: position and velocity in ned, its depth and one sigma for the log."""
        self.link.send_debug_vector("me_obj_p", *track.p_ned_m)
        self.link.send_debug_vector("me_obj_v", *track.v_ned_m_s)
        self.link.send_named_float("me_obj_z", track.p_rect_m[2] if track.seen else math.nan)
        self.link.send_named_float("me_obj_sd", math.sqrt(float(track.covariance[:3, :3].trace())))

    def on_health(self, report: Health) -> None:
        """Log state, reason, baseline, nearest depth and frame age."""
        self.link.send_named_int("me_state", STATE_NUMBERS[report.state])
        self.link.send_named_int("me_reason", report.reason.number)
        estimate, seen = self.topics.baseline.get(), self.topics.perception.get()
        if estimate is not None:
            self.link.send_named_float("me_base", estimate.baseline_m)
        if seen is not None:
            self.link.send_named_float("me_near", seen.summary.nearest_m)
        self.link.send_named_float("me_age", report.ages_s["frame"])
