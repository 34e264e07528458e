"""Keeping to a line between two commands of the mission, at the stick period: the mission sees five times a second.

Only turns a command into the velocity wanted now; the governor bounds it afterwards.
"""

from __future__ import annotations

import math

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Line, MissionCommand, VehicleState

Vector3 = tuple[float, float, float]

CLIMB_MOST_M_S = 0.5
"""As the velocity loop's own bound on climbing."""

LEAN_LAG_S = 0.15
"""A wanted velocity takes hold so much later (VelocityTuning.lean_lag_s)."""

CLIMB_GAIN_1_S = 4.0
"""Climbing answers later than a lean does: a quicker way back overshoots."""

ANSWER_S = 0.25
"""Where the vehicle will be after this is what is held against the line: without it the way back overshoots."""

MISSED_MOST_M_S = 0.4
"""A lateral wind of 3 m/s takes less from Loiter's speed than this."""

AHEAD_MOST_S = 2.0
"""A moving line is not carried on for longer than this."""


class PathFollower:
    """Holds what is missing to the line over time; one per flight."""

    def __init__(self) -> None:
        self._missed = (0.0, 0.0, 0.0)
        self._last_ns = 0

    def reset(self) -> None:
        """Forget what was missing."""
        self._missed = (0.0, 0.0, 0.0)
        self._last_ns = 0

    def wanted_velocity(self, command: MissionCommand, vehicle: VehicleState, now_ns: int) -> Vector3:
        """Return the velocity (ned) that the command asks for at `now_ns`, with the way back to its line."""
        line = command.line
        if line is None:
            self.reset()
            return command.v_ned_m_s
        place, moving = _line_at(line, now_ns)
        north, east, down = (there - here for there, here in zip(place, vehicle.p_ned_m, strict=True))
        missed = self._gathered(line, (north, east, down), now_ns)
        vn, ve, vd = command.v_ned_m_s
        gain = line.gain_1_s
        north += ANSWER_S * (moving[0] - vehicle.v_ned_m_s[0])
        east += ANSWER_S * (moving[1] - vehicle.v_ned_m_s[1])
        back = _across(
            (gain * north + missed[0] + moving[0], gain * east + missed[1] + moving[1]), (vn, ve), line.most_m_s
        )
        climb = min(gain, CLIMB_GAIN_1_S) * down + missed[2] + moving[2]
        return vn + back[0], ve + back[1], vd + max(-CLIMB_MOST_M_S, min(CLIMB_MOST_M_S, climb))

    def _gathered(self, line: Line, off: Vector3, now_ns: int) -> Vector3:
        """Return the integral of what is missing, each axis bounded."""
        if line.integral_1_s2 == 0.0:
            self.reset()
            return self._missed
        dt_s = min(0.1, (now_ns - self._last_ns) / S) if self._last_ns else 0.0
        self._last_ns = now_ns
        grown = (m + line.integral_1_s2 * o * dt_s for m, o in zip(self._missed, off, strict=True))
        north, east, down = (max(-MISSED_MOST_M_S, min(MISSED_MOST_M_S, value)) for value in grown)
        self._missed = (north, east, down)
        return self._missed


def _across(back: tuple[float, float], v: tuple[float, float], most_m_s: float) -> tuple[float, float]:
    """Return the part of `back` across a velocity, all of it when that is zero, shortened to `most_m_s`."""
    speed = math.hypot(*v)
    along = (v[0] / speed, v[1] / speed) if speed > 0.0 else (0.0, 0.0)
    forward = back[0] * along[0] + back[1] * along[1]
    across = (back[0] - forward * along[0], back[1] - forward * along[1])
    size = math.hypot(*across)
    scale = min(1.0, most_m_s / size) if size > 0.0 else 0.0
    return scale * across[0], scale * across[1]


def _line_at(line: Line, now_ns: int) -> tuple[Vector3, Vector3]:
    """Return where the line's point is, and how it moves when the lean takes hold."""
    t = max(0.0, min(AHEAD_MOST_S, (now_ns - line.t_ns) / S))
    p, v, a = line.p_ned_m, line.v_ned_m_s, line.a_ned_m_s2
    place = (
        p[0] + (v[0] + 0.5 * a[0] * t) * t,
        p[1] + (v[1] + 0.5 * a[1] * t) * t,
        p[2] + (v[2] + 0.5 * a[2] * t) * t,
    )
    t += LEAN_LAG_S
    return place, (v[0] + a[0] * t, v[1] + a[1] * t, v[2] + a[2] * t)
