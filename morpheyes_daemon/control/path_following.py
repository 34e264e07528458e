"""Path following: keeps the vehicle to the command's line at every stick period, between two mission commands.

Only turns a command into the velocity wanted now; the governor bounds it afterwards.
"""

from __future__ import annotations

import math

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Line, MissionCommand, VehicleState

Vector3 = tuple[float, float, float]

MAX_CLIMB_M_S = 0.5
"""Largest vertical correction.

Chosen: the velocity loop's own bound on climbing (VelocityTuning.climb_max_m_s)."""

LEAN_LAG_S = 0.15
"""Delay after which a wanted velocity takes effect.

Chosen: that of the velocity loop (VelocityTuning.lean_lag_s), dead time and lean response of the identified plant."""

CLIMB_GAIN_1_S = 4.0
"""Largest gain of the vertical correction.

Chosen: climbing responds later than leaning does; a higher gain overshoots."""

LOOKAHEAD_S = 0.25
"""The horizontal error is taken at the position predicted for this time.

Chosen: damping; without it the correction of a gap's run swings by 80 mm, a longer one converges later."""

MAX_INTEGRAL_M_S = 0.4
"""Bound of the integral on each axis.

Chosen: a lateral wind of 3 m/s takes less from Loiter's speed; a larger bound overshoots more after an error."""

MAX_EXTRAPOLATION_S = 2.0
"""Longest time for which a moving line is extrapolated from its stamp.

Chosen: longer than a command is valid; a longer one would follow a wrong acceleration further."""

MAX_STEP_S = 0.1
"""Longest step of the integral, for delayed stick periods.

Chosen: five stick periods; a longer one lets one delay step the velocity."""


class PathFollower:
    """Keeps the integral of the error to the line; one per flight."""

    def __init__(self) -> None:
        self._integral_m_s = (0.0, 0.0, 0.0)
        self._last_ns = 0

    def reset(self) -> None:
        """Clear the integral."""
        self._integral_m_s = (0.0, 0.0, 0.0)
        self._last_ns = 0

    def wanted_velocity(self, command: MissionCommand, vehicle: VehicleState, now_ns: int) -> Vector3:
        """Return the velocity (ned, m/s) of the command at `now_ns` plus the correction towards its line."""
        line = command.line
        if line is None:
            self.reset()
            return command.v_ned_m_s
        point, line_v = _line_at(line, now_ns)
        north, east, down = (there - here for there, here in zip(point, vehicle.p_ned_m, strict=True))
        integral = self._integrated(line, (north, east, down), now_ns)
        vn, ve, vd = command.v_ned_m_s
        gain = line.gain_1_s
        north += LOOKAHEAD_S * (line_v[0] - vehicle.v_ned_m_s[0])
        east += LOOKAHEAD_S * (line_v[1] - vehicle.v_ned_m_s[1])
        correction = _across(
            (gain * north + integral[0] + line_v[0], gain * east + integral[1] + line_v[1]), (vn, ve), line.max_m_s
        )
        climb = min(gain, CLIMB_GAIN_1_S) * down + integral[2] + line_v[2]
        return vn + correction[0], ve + correction[1], vd + max(-MAX_CLIMB_M_S, min(MAX_CLIMB_M_S, climb))

    def _integrated(self, line: Line, error_m: Vector3, now_ns: int) -> Vector3:
        """Return the integral of the error (m/s), each axis bounded."""
        if line.integral_1_s2 == 0.0:
            self.reset()
            return self._integral_m_s
        dt_s = min(MAX_STEP_S, (now_ns - self._last_ns) / S) if self._last_ns else 0.0
        self._last_ns = now_ns
        grown = (m + line.integral_1_s2 * o * dt_s for m, o in zip(self._integral_m_s, error_m, strict=True))
        north, east, down = (max(-MAX_INTEGRAL_M_S, min(MAX_INTEGRAL_M_S, value)) for value in grown)
        self._integral_m_s = (north, east, down)
        return self._integral_m_s


def _across(correction: tuple[float, float], v: tuple[float, float], max_m_s: float) -> tuple[float, float]:
    """Return the part of `correction` across a velocity, all of it when that is zero, shortened to `max_m_s`."""
    speed = math.hypot(*v)
    along = (v[0] / speed, v[1] / speed) if speed > 0.0 else (0.0, 0.0)
    forward = correction[0] * along[0] + correction[1] * along[1]
    across = (correction[0] - forward * along[0], correction[1] - forward * along[1])
    size = math.hypot(*across)
    scale = min(1.0, max_m_s / size) if size > 0.0 else 0.0
    return scale * across[0], scale * across[1]


def _line_at(line: Line, now_ns: int) -> tuple[Vector3, Vector3]:
    """Return the line's point (ned, m) now, and its velocity (ned, m/s) when the lean takes effect."""
    t = max(0.0, min(MAX_EXTRAPOLATION_S, (now_ns - line.t_ns) / S))
    p, v, a = line.p_ned_m, line.v_ned_m_s, line.a_ned_m_s2
    point = (
        p[0] + (v[0] + 0.5 * a[0] * t) * t,
        p[1] + (v[1] + 0.5 * a[1] * t) * t,
        p[2] + (v[2] + 0.5 * a[2] * t) * t,
    )
    t += LEAN_LAG_S
    return point, (v[0] + a[0] * t, v[1] + a[1] * t, v[2] + a[2] * t)
