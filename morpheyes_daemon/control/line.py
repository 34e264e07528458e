"""Keeping to a line between two commands of the mission, at the stick period: the mission sees five times a second.

Only turns a command into the velocity wanted now; the governor bounds it afterwards.
"""

from __future__ import annotations

import math

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages import Line, MissionCommand, VehicleState

Vector3 = tuple[float, float, float]

CLIMB_MOST_M_S = 0.5
"""As the velocity loop's own bound on climbing."""

LEAN_LAG_S = 0.15
"""A wanted velocity takes hold so much later (VelocityTuning.lean_lag_s)."""

AHEAD_MOST_S = 2.0
"""A moving line is not carried on for longer than this."""


def wanted_velocity(command: MissionCommand, vehicle: VehicleState, now_ns: int) -> Vector3:
    """Return the velocity (ned) that the command asks for at `now_ns`, with the way back to its line."""
    line = command.line
    if line is None:
        return command.v_ned_m_s
    place, moving = _line_at(line, now_ns)
    north, east, down = (there - here for there, here in zip(place, vehicle.p_ned_m, strict=True))
    vn, ve, vd = command.v_ned_m_s
    speed = math.hypot(vn, ve)
    back, along = (line.gain_1_s * north + moving[0], line.gain_1_s * east + moving[1]), (0.0, 0.0)
    if speed > 0.0:
        along = (vn / speed, ve / speed)
    forward = back[0] * along[0] + back[1] * along[1]
    across = (back[0] - forward * along[0], back[1] - forward * along[1])
    size = math.hypot(*across)
    scale = min(1.0, line.most_m_s / size) if size > 0.0 else 0.0
    climb = vd + max(-CLIMB_MOST_M_S, min(CLIMB_MOST_M_S, line.gain_1_s * down + moving[2]))
    return vn + scale * across[0], ve + scale * across[1], climb


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
