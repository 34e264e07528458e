"""Which baseline to command when: few, useful motions that a small linear servo survives.

The servo slews by itself at its own speed, so a plan is a target, not a ramp. The planner ignores changes that would
not pay, keeps the share of time in motion under the servo's duty limit in every window, and lets every motion end
by shrinking, which takes the backlash out. It never spends on growing what coming back would cost: a large
baseline that cannot shrink is blind to what is near. Each turn on the way adds to the doubt where the eyes are, and
only rest takes it away: once in doubt, a motion inwards is finished before the next one outwards.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import ServoMotion
from morpheyes_daemon.control.baseline import SPEED_TOLERANCE
from morpheyes_daemon.messages.core import BaselineEstimate

DEADBAND_M = 0.002
"""Smaller changes than this are never worth a motion; the only deadband towards the smallest baseline."""
RESTED_DEADBAND, TIRED_DEADBAND = 0.03, 0.15
"""Relative change of baseline, and so of depth error, worth a motion with a full and with a spent duty budget."""
OVERSHOOT_M = 0.001
"""Beyond the play (twice 0.25 mm), so that the last piece of a growing motion is a shrinking one."""
LOST_M = 0.001
"""Doubt beyond backlash and repeatability, at rest, that is worth commanding the place again."""
TURN_SIGMA_M = 0.003
"""Doubt with which a shrinking baseline is not turned outwards again; one turn adds about as much."""
WINDOW_NS = 300 * S
"""Duty of small actuators is rated over minutes, commonly 2 in 10 (motor heat); half of that to be careful."""


@dataclass(slots=True)
class _Motion:
    """A stretch of time in which the servos run."""

    start_ns: int
    end_ns: int


class BaselinePlanner:
    """Turns wanted baselines into commands; call `plan` as often as wanted."""

    def __init__(self, motion: ServoMotion) -> None:
        self._range_m = motion.min_baseline_mm / 1e3, motion.max_baseline_mm / 1e3
        self._rate_m_s = 2 * motion.speed_mm_s / 1e3 * (1 - SPEED_TOLERANCE)
        self._overshoot_m = OVERSHOOT_M if motion.backlash_mm > 0 else 0.0
        self._lost_sigma_m = LOST_M + (motion.repeatability_sigma_mm + motion.backlash_mm) / 1e3
        self._budget_ns = round(WINDOW_NS * motion.max_duty_pct / 100)
        self._motions: deque[_Motion] = deque()
        self._target_m: float | None = None
        self._final_m: float | None = None

    def plan(self, wanted_m: float, estimate: BaselineEstimate) -> float | None:
        """Return the target to command at `estimate.t_ns`, or None to leave the servo alone.

        The result is meant to be commanded at once; planning goes on as if it had been. A wanted baseline that is
        not a number leaves the servo alone.
        """
        if not math.isfinite(wanted_m):
            return None
        wanted_m = min(max(wanted_m, self._range_m[0]), self._range_m[1])
        if self._target_m is None or self._is_lost(estimate):
            return self._go(wanted_m, estimate)
        deadband_m = self._deadband_m(wanted_m, estimate.t_ns)
        for to_m in (wanted_m, self._affordable(wanted_m, estimate)):
            if abs(to_m - self._aim_m()) < deadband_m:
                return self._come_back(estimate)
        if to_m > self._aim_m() and self._is_shrinking(estimate) and estimate.sigma_m > TURN_SIGMA_M:
            return None
        return self._go(to_m, estimate)

    def duty(self, t_ns: int) -> float:
        """Return the share of the last window in which the servos ran."""
        return self._used_ns(t_ns) / WINDOW_NS

    def _aim_m(self) -> float:
        """Return where the motion under way will end."""
        aim_m = self._target_m if self._final_m is None else self._final_m
        assert aim_m is not None
        return aim_m

    def _is_lost(self, estimate: BaselineEstimate) -> bool:
        return self._at_rest(estimate) and estimate.sigma_m > self._lost_sigma_m

    def _is_shrinking(self, estimate: BaselineEstimate) -> bool:
        assert self._target_m is not None
        return not self._at_rest(estimate) and self._target_m < estimate.baseline_m

    def _at_rest(self, estimate: BaselineEstimate) -> bool:
        """Return whether the last motion is over, by plan and by model (which knows of it only after a latency)."""
        return not estimate.moving and estimate.t_ns >= self._motions[-1].end_ns

    def _go(self, to_m: float, estimate: BaselineEstimate) -> float:
        """Command `to_m`, from above when it lies above and there is room."""
        if to_m > estimate.baseline_m and to_m + self._overshoot_m <= self._range_m[1]:
            return self._command(to_m + self._overshoot_m, estimate, final_m=to_m)
        return self._command(to_m, estimate, final_m=None)

    def _come_back(self, estimate: BaselineEstimate) -> float | None:
        """End a growing motion that has passed its target by the overshoot."""
        if self._final_m is None or not self._at_rest(estimate):
            return None
        return self._command(self._final_m, estimate, final_m=None)

    def _command(self, to_m: float, estimate: BaselineEstimate, final_m: float | None) -> float:
        t_ns, unsure_m = estimate.t_ns, math.sqrt(3) * estimate.sigma_m
        if self._motions:
            self._motions[-1].end_ns = min(self._motions[-1].end_ns, t_ns)
        duration_ns = self._duration_ns(abs(to_m - estimate.baseline_m) + unsure_m)
        self._motions.append(_Motion(t_ns, t_ns + duration_ns))
        self._target_m, self._final_m = to_m, final_m
        return to_m

    def _affordable(self, wanted_m: float, estimate: BaselineEstimate) -> float:
        """Return `wanted_m`, or as near to it as the duty budget lets the servos go."""
        here_m = estimate.baseline_m
        left_ns = self._budget_ns - self._used_ns(estimate.t_ns) - self._duration_ns(2 * self._overshoot_m)
        far_m = max(0, left_ns) / S * self._rate_m_s
        if wanted_m < here_m:
            return max(wanted_m, here_m - far_m)
        there_and_back_m = (far_m - (here_m - self._range_m[0])) / 2
        return min(wanted_m, here_m + max(0.0, there_and_back_m))

    def _deadband_m(self, wanted_m: float, t_ns: int) -> float:
        if wanted_m == self._range_m[0]:
            return DEADBAND_M
        tiredness = self._used_ns(t_ns) / self._budget_ns
        relative = RESTED_DEADBAND + (TIRED_DEADBAND - RESTED_DEADBAND) * tiredness
        return max(DEADBAND_M, relative * self._aim_m())

    def _used_ns(self, t_ns: int) -> int:
        """Return the time in motion within the window that ends at `t_ns`."""
        begin_ns = t_ns - WINDOW_NS
        while len(self._motions) > 1 and self._motions[0].end_ns <= begin_ns:
            self._motions.popleft()
        return sum(max(0, min(m.end_ns, t_ns) - max(m.start_ns, begin_ns)) for m in self._motions)

    def _duration_ns(self, distance_m: float) -> int:
        return round(distance_m / self._rate_m_s * S)
