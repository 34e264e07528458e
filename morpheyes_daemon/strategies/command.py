"""Mission commands: the fields that every strategy fills in alike, from what it observed and decided."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Intent, Line, MissionCommand
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.messages.reasons import Reason

EXPIRY_FRAMES = 3
"""Frame periods for which a command is valid. Unit: frames.

Chosen: one lost frame and its latency do not brake the vehicle; a longer validity flies further without depth."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What a strategy decides on one percept; see MissionCommand for the fields."""

    intent: Intent
    reason: Reason | None = None
    v_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None
    height_m: float | None = None
    baseline_m: float = math.nan
    clear_m: float = 0.0
    z_close_m: float = math.nan
    line: Line | None = None
    detail: dict[str, float] = field(default_factory=dict)
    text: str = ""


class CommandBuilder:
    """Numbers a strategy's commands and stamps them with their validity and the state they were decided on."""

    def __init__(self, frame_period_s: float) -> None:
        self._valid_ns = round(EXPIRY_FRAMES * frame_period_s * S)
        self._seq = 0

    def build(self, observation: Observation, decision: Decision) -> MissionCommand:
        """Return the mission command of a decision."""
        self._seq += 1
        return MissionCommand(
            seq=self._seq,
            t_ns=observation.now_ns,
            expires_ns=observation.now_ns + self._valid_ns,
            intent=decision.intent,
            reason=decision.reason,
            v_ned_m_s=decision.v_ned_m_s,
            yaw_rad=decision.yaw_rad,
            height_m=decision.height_m,
            baseline_m=decision.baseline_m,
            clear_m=decision.clear_m,
            p_measured_ned_m=observation.vehicle.p_ned_m,
            z_close_m=decision.z_close_m,
            detail=decision.detail,
            line=decision.line,
            text=decision.text,
        )
