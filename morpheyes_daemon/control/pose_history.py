"""Pose history of the vehicle, so that a frame can be given attitude and position at its own mid-exposure."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.transforms import wrap_rad

HISTORY_LENGTH = 400
"""States kept, about four seconds at the requested message rates. Unit: states.

Chosen: longer than any frame's latency; more would only cost memory."""

MAX_EXTRAPOLATION_S = 0.5
"""Longest time for which the position is extrapolated by its velocity.

Chosen: longer gaps stop the flight by VEHICLE_STALE; a longer extrapolation would move a stale position further."""


class PoseHistory:
    """States in order of arrival; `at` interpolates attitude and position between their own stamps."""

    def __init__(self) -> None:
        self._attitudes: deque[VehicleState] = deque(maxlen=HISTORY_LENGTH)
        self._positions: deque[VehicleState] = deque(maxlen=HISTORY_LENGTH)
        self.latest = VehicleState()

    def add(self, state: VehicleState) -> None:
        """Append a state; an attitude or position that is no newer than the last one is not stored again."""
        if not self._attitudes or state.attitude_t_ns > self._attitudes[-1].attitude_t_ns:
            self._attitudes.append(state)
        if not self._positions or state.position_t_ns > self._positions[-1].position_t_ns:
            self._positions.append(state)
        self.latest = state

    def at(self, t_ns: int) -> VehicleState:
        """Return the state at `t_ns`: interpolated within the history, its nearest end outside it."""
        a0, a1, wa = _neighbours(self._attitudes, t_ns, lambda state: state.attitude_t_ns)
        p0, p1, wp = _neighbours(self._positions, t_ns, lambda state: state.position_t_ns)
        if a0 is None or a1 is None or p0 is None or p1 is None:
            return self.latest
        return replace(
            self.latest,
            roll_rad=a0.roll_rad + wa * wrap_rad(a1.roll_rad - a0.roll_rad),
            pitch_rad=a0.pitch_rad + wa * wrap_rad(a1.pitch_rad - a0.pitch_rad),
            yaw_rad=wrap_rad(a0.yaw_rad + wa * wrap_rad(a1.yaw_rad - a0.yaw_rad)),
            rates_frd_rad_s=_interpolated(a0.rates_frd_rad_s, a1.rates_frd_rad_s, wa),
            p_ned_m=_interpolated(p0.p_ned_m, p1.p_ned_m, wp),
            v_ned_m_s=_interpolated(p0.v_ned_m_s, p1.v_ned_m_s, wp),
        )

    def now(self, now_ns: int) -> VehicleState:
        """Return the latest state with its position extrapolated to `now_ns`, for MAX_EXTRAPOLATION_S at most."""
        latest = self.latest
        elapsed_s = (now_ns - latest.position_t_ns) / 1e9
        ahead_s = min(MAX_EXTRAPOLATION_S, max(0.0, elapsed_s)) if latest.position_t_ns else 0.0
        p, v = latest.p_ned_m, latest.v_ned_m_s
        return replace(latest, p_ned_m=(p[0] + v[0] * ahead_s, p[1] + v[1] * ahead_s, p[2] + v[2] * ahead_s))


def _neighbours(
    states: deque[VehicleState], t_ns: int, stamp: Callable[[VehicleState], int]
) -> tuple[VehicleState | None, VehicleState | None, float]:
    """Return the states before and after `t_ns` and the weight of the later one, 0 to 1."""
    if not states:
        return None, None, 0.0
    index = bisect_right(states, t_ns, key=stamp)
    if index == 0:
        return states[0], states[0], 0.0
    if index == len(states):
        return states[-1], states[-1], 0.0
    before, after = states[index - 1], states[index]
    return before, after, (t_ns - stamp(before)) / (stamp(after) - stamp(before))


def _interpolated(
    a: tuple[float, float, float], b: tuple[float, float, float], weight: float
) -> tuple[float, float, float]:
    return (
        a[0] + weight * (b[0] - a[0]),
        a[1] + weight * (b[1] - a[1]),
        a[2] + weight * (b[2] - a[2]),
    )
