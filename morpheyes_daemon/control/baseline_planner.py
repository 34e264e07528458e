"""Baseline planner: which baseline to command when, as few motions that a small linear servo survives.

The servo slews at its own speed, so a plan is a target, not a ramp. The planner ignores changes smaller than a
dead band, keeps the duty of the servo below its limit in every window, and ends every motion by shrinking, which
removes the backlash. Growing is limited to what leaves enough duty to shrink back: a large baseline that cannot shrink
has a far near limit. Each reversal during a motion adds uncertainty, which only rest removes: above a limit a shrinking
motion is finished before the next growing one.
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
"""Smallest change worth a motion, and the only dead band towards the smallest baseline.

Chosen: duty against depth error; 2 mm is 2 % of the smallest baseline."""

DEADBAND_FULL_BUDGET, DEADBAND_SPENT_BUDGET = 0.03, 0.15
"""Relative change of baseline, and so of depth error, worth a motion with a full and with a spent duty budget.

Unit: none. Chosen: as DEADBAND_M; linear in between."""

OVERSHOOT_M = 0.001
"""Overshoot of a growing motion, so that its last part shrinks.

Chosen: more than the backlash (twice 0.25 mm by default), less than a motion that costs duty."""

UNCERTAIN_M = 0.001
"""Sigma beyond backlash and repeatability, at rest, from which the same target is commanded again.

Chosen: ten times the servo's repeatability; lower repeats commands that change nothing."""

REVERSAL_SIGMA_M = 0.003
"""Sigma above which a shrinking motion is not reversed; one reversal adds about as much.

Chosen: certainty of the scale against following the wanted baseline."""

DUTY_WINDOW_NS = 300 * S
"""Window over which the duty is counted.

Chosen: small actuators are commonly rated at 2 minutes in 10 (motor heating); half of those 10 minutes."""


@dataclass(slots=True)
class _Motion:
    """An interval of time in which the servos run."""

    start_ns: int
    end_ns: int


class BaselinePlanner:
    """Turns wanted baselines into commands; `plan` may be called at any rate."""

    def __init__(self, motion: ServoMotion) -> None:
        self._range_m = motion.min_baseline_mm / 1e3, motion.max_baseline_mm / 1e3
        self._rate_m_s = 2 * motion.speed_mm_s / 1e3 * (1 - SPEED_TOLERANCE)
        self._overshoot_m = OVERSHOOT_M if motion.backlash_mm > 0 else 0.0
        self._uncertain_sigma_m = UNCERTAIN_M + (motion.repeatability_sigma_mm + motion.backlash_mm) / 1e3
        self._budget_ns = round(DUTY_WINDOW_NS * motion.max_duty_pct / 100)
        self._motions: deque[_Motion] = deque()
        self._target_m: float | None = None
        self._after_overshoot_m: float | None = None

    def plan(self, wanted_m: float, estimate: BaselineEstimate) -> float | None:
        """Return the target to command at `estimate.t_ns`, or None for no command.

        The result is to be commanded at once; the planner takes it as commanded. A wanted baseline that is not finite
        gives None.
        """
        if not math.isfinite(wanted_m):
            return None
        wanted_m = min(max(wanted_m, self._range_m[0]), self._range_m[1])
        if self._target_m is None or self._is_uncertain(estimate):
            return self._move(wanted_m, estimate)
        deadband_m = self._deadband_m(wanted_m, estimate.t_ns)
        for to_m in (wanted_m, self._within_budget(wanted_m, estimate)):
            if abs(to_m - self._final_m()) < deadband_m:
                return self._return_from_overshoot(estimate)
        if to_m > self._final_m() and self._is_shrinking(estimate) and estimate.sigma_m > REVERSAL_SIGMA_M:
            return None
        return self._move(to_m, estimate)

    def duty(self, t_ns: int) -> float:
        """Return the share of the last window in which the servos ran, 0 to 1."""
        return self._used_ns(t_ns) / DUTY_WINDOW_NS

    def _final_m(self) -> float:
        """Return the baseline at which the present motion will end, its overshoot taken back."""
        final_m = self._target_m if self._after_overshoot_m is None else self._after_overshoot_m
        assert final_m is not None
        return final_m

    def _is_uncertain(self, estimate: BaselineEstimate) -> bool:
        return self._at_rest(estimate) and estimate.sigma_m > self._uncertain_sigma_m

    def _is_shrinking(self, estimate: BaselineEstimate) -> bool:
        assert self._target_m is not None
        return not self._at_rest(estimate) and self._target_m < estimate.baseline_m

    def _at_rest(self, estimate: BaselineEstimate) -> bool:
        """Return whether the last motion is over by plan and by model (which shows it only after a latency)."""
        return not estimate.moving and estimate.t_ns >= self._motions[-1].end_ns

    def _move(self, to_m: float, estimate: BaselineEstimate) -> float:
        """Command `to_m`; a growing motion overshoots first where the range allows."""
        if to_m > estimate.baseline_m and to_m + self._overshoot_m <= self._range_m[1]:
            return self._command(to_m + self._overshoot_m, estimate, after_overshoot_m=to_m)
        return self._command(to_m, estimate, after_overshoot_m=None)

    def _return_from_overshoot(self, estimate: BaselineEstimate) -> float | None:
        """End a growing motion that has passed its target by the overshoot."""
        if self._after_overshoot_m is None or not self._at_rest(estimate):
            return None
        return self._command(self._after_overshoot_m, estimate, after_overshoot_m=None)

    def _command(self, to_m: float, estimate: BaselineEstimate, after_overshoot_m: float | None) -> float:
        t_ns, uncertainty_m = estimate.t_ns, math.sqrt(3) * estimate.sigma_m
        if self._motions:
            self._motions[-1].end_ns = min(self._motions[-1].end_ns, t_ns)
        duration_ns = self._duration_ns(abs(to_m - estimate.baseline_m) + uncertainty_m)
        self._motions.append(_Motion(t_ns, t_ns + duration_ns))
        self._target_m, self._after_overshoot_m = to_m, after_overshoot_m
        return to_m

    def _within_budget(self, wanted_m: float, estimate: BaselineEstimate) -> float:
        """Return `wanted_m`, or as near to it as the duty budget allows, the way back to the smallest included."""
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
        spent_share = self._used_ns(t_ns) / self._budget_ns
        relative = DEADBAND_FULL_BUDGET + (DEADBAND_SPENT_BUDGET - DEADBAND_FULL_BUDGET) * spent_share
        return max(DEADBAND_M, relative * self._final_m())

    def _used_ns(self, t_ns: int) -> int:
        """Return the time in motion within the window that ends at `t_ns`."""
        begin_ns = t_ns - DUTY_WINDOW_NS
        while len(self._motions) > 1 and self._motions[0].end_ns <= begin_ns:
            self._motions.popleft()
        return sum(max(0, min(m.end_ns, t_ns) - max(m.start_ns, begin_ns)) for m in self._motions)

    def _duration_ns(self, distance_m: float) -> int:
        return round(distance_m / self._rate_m_s * S)
