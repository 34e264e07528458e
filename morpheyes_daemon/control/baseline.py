"""Where the eyes are: the baseline at any moment from the commands alone, since the servos give no feedback.

`BaselineModel` propagates an interval that must hold the true baseline: one edge assumes the least favourable of
speed, latency and backlash, the other the most favourable. The dynamics are monotone, so the truth stays between
the edges whatever the commands were. Lengths are as commanded: what a commanded baseline really is, non-linearity
of the servo included, is the calibration's business. Which baseline to command is `baseline_planner`'s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.config.vehicle import NoServoConfig, ServoConfig, ServoMotion
from morpheyes_daemon.messages.core import BaselineEstimate

SPEED_TOLERANCE = 0.08
"""Relative; load and battery move a linear servo's speed by some percent about its data sheet's."""
LATENCY_SPREAD = (0.5, 2.0)
"""Earliest and latest first motion, as multiples of the nominal latency."""
SETTLE_LAG = 0.4
"""A servo that settles in T nears its target with a time constant of about T/5 and lags by two of them."""
HISTORY_NS = 20 * S
"""How far back `BaselineModel.at` can look; frames and depth maps are seconds old at most."""


def baseline_for(depth_m: float, gain: float, range_m: tuple[float, float]) -> float:
    """Return b = K·Z clamped to the rig's range (paper, section V); the smallest when Z is unknown (NaN).

    The smallest baseline has the shortest near blind zone, so it is the safe one when nothing is known.
    """
    if math.isnan(depth_m):
        return range_m[0]
    return min(max(gain * depth_m, range_m[0]), range_m[1])


class FixedBaseline:
    """The baseline of a rig without servos; takes the same verbs and moves nothing."""

    def __init__(self, baseline_m: float) -> None:
        self._baseline_m = baseline_m

    def command(self, target_m: float, t_ns: int) -> None:
        """Do nothing: the rig cannot move."""

    def send(self, target_m: float, t_ns: int) -> None:
        """Do nothing: the rig cannot move."""

    def doubt(self, target_m: float, t_ns: int) -> None:
        """Do nothing: the rig cannot move."""

    def at(self, t_ns: int) -> BaselineEstimate:
        """Return the rig's one baseline."""
        return BaselineEstimate(t_ns, self._baseline_m, self._baseline_m, 0.0, False)


class BaselineModel:
    """The baseline over time, as commanded, with its uncertainty; starts not knowing where the eyes are."""

    def __init__(self, motion: ServoMotion) -> None:
        self._range_m = motion.min_baseline_mm / 1e3, motion.max_baseline_mm / 1e3
        self._repeatability_m = motion.repeatability_sigma_mm / 1e3
        self._settle_ns = round(motion.settle_ms * MS)
        earliest, latest = (round(factor * motion.latency_ms * MS) for factor in LATENCY_SPREAD)
        self._earliest_ns = earliest
        self._latest_ns = latest + round(SETTLE_LAG * self._settle_ns)
        rate_m_s = 2 * motion.speed_mm_s / 1e3
        fast, slow = rate_m_s * (1 + SPEED_TOLERANCE), rate_m_s * (1 - SPEED_TOLERANCE)
        play_m = 2 * motion.backlash_mm / 1e3
        self._commands: list[_Command] = []
        self._low = _Edge(self._range_m[0], grow_m_s=slow, shrink_m_s=fast, play_m=play_m)
        self._high = _Edge(self._range_m[1], grow_m_s=fast, shrink_m_s=slow, play_m=0.0)

    def command(self, target_m: float, t_ns: int) -> None:
        """Take note that the servo acknowledged `target_m` at `t_ns`; times must not go back."""
        hull = target_m, target_m
        self._note(_Command(target_m, t_ns, t_ns + self._earliest_ns, t_ns + self._latest_ns, hull))

    def send(self, target_m: float, t_ns: int) -> None:
        """Take note that `target_m` was sent at `t_ns`; until it is acknowledged the old target may hold as well."""
        hull = target_m, target_m
        self._note(_Command(target_m, t_ns, t_ns + self._earliest_ns, None, hull))

    def doubt(self, target_m: float, t_ns: int) -> None:
        """Take note that `target_m` was sent at `t_ns` but may have been lost, or the servo may have stopped.

        From then on the eyes may be anywhere between here, the old and the new target, until the next command.
        """
        here = self._low.at(t_ns), self._high.at(t_ns)
        hull = min(target_m, *here), max(target_m, *here)
        self._note(_Command(target_m, t_ns, t_ns + self._earliest_ns, None, hull))

    def at(self, t_ns: int) -> BaselineEstimate:
        """Return the baseline at a past, present or future time, given the commands known now."""
        low, high = self._low.at(t_ns), self._high.at(t_ns)
        sigma_m = math.hypot((high - low) / math.sqrt(12), self._repeatability_m)
        rests_ns = max(self._low.arrival_ns(t_ns), self._high.arrival_ns(t_ns)) + self._settle_ns
        return BaselineEstimate(t_ns, self._target_at(t_ns), (low + high) / 2, sigma_m, t_ns < rests_ns)

    def _note(self, command: _Command) -> None:
        if self._commands and command.since_ns < self._commands[-1].since_ns:
            raise ValueError("commands must be given in the order of their times")
        self._commands.append(command)
        self._forget(command.since_ns - HISTORY_NS)
        for t_ns in sorted(self._changes_from(command.since_ns)):
            low_m, high_m = self._goals(t_ns)
            self._low.aim(low_m, t_ns)
            self._high.aim(high_m, t_ns)

    def _forget(self, t_ns: int) -> None:
        """Drop commands that a sure one has replaced before `t_ns`, and join old doubts into one."""
        while len(self._commands) > 1 and self._commands[1].since_ns < t_ns:
            old, new = self._commands[:2]
            self._commands[:2] = [new if new.sure_by(t_ns) else old.joined(new)]

    def _changes_from(self, t_ns: int) -> set[int]:
        sure = {command.sure_ns for command in self._commands if command.sure_ns is not None}
        return {t_ns} | {change_ns for change_ns in sure if change_ns > t_ns}

    def _goals(self, t_ns: int) -> tuple[float, float]:
        """Return the lowest and highest place that the servo may be going to at `t_ns`."""
        possible: list[float] = list(self._range_m)
        for command in self._commands:
            if command.sure_by(t_ns):
                possible = []
            if command.since_ns <= t_ns:
                possible += command.hull_m
        return min(possible), max(possible)

    def _target_at(self, t_ns: int) -> float:
        sent = (command.target_m for command in reversed(self._commands) if command.sent_ns <= t_ns)
        return next(sent, sum(self._range_m) / 2)


@dataclass(frozen=True, slots=True)
class _Command:
    """A target that may act since `since_ns` and surely acts from `sure_ns` (None: never sure)."""

    target_m: float
    sent_ns: int
    since_ns: int
    sure_ns: int | None
    hull_m: tuple[float, float]

    def sure_by(self, t_ns: int) -> bool:
        return self.sure_ns is not None and self.sure_ns <= t_ns

    def joined(self, later: _Command) -> _Command:
        """Return one command that allows what this one and a later doubt allow."""
        hull = min(self.hull_m[0], later.hull_m[0]), max(self.hull_m[1], later.hull_m[1])
        return replace(self, target_m=later.target_m, sent_ns=later.sent_ns, hull_m=hull)


@dataclass(frozen=True, slots=True)
class _Leg:
    """Motion of the screw from `screw_m` towards `goal_m`; `eye_m` is where the eye hung in its play before."""

    start_ns: int
    screw_m: float
    eye_m: float
    goal_m: float
    arrival_ns: int


class _Edge:
    """One edge of the interval: a servo with assumed speeds and play.

    The eye lies between screw − play and screw. Shrinking pushes it to the screw itself, which is how the baseline
    is meant; growing leaves it behind by the play.
    """

    def __init__(self, start_m: float, *, grow_m_s: float, shrink_m_s: float, play_m: float) -> None:
        self._grow_m_s, self._shrink_m_s, self._play_m = grow_m_s, shrink_m_s, play_m
        self._start_m = start_m
        self._legs = [_Leg(0, start_m, start_m - play_m, start_m, 0)]

    def aim(self, goal_m: float, t_ns: int) -> None:
        """Head for `goal_m` from `t_ns` on; legs that were to start later are dropped."""
        while self._legs[-1].start_ns >= t_ns and len(self._legs) > 1:
            self._legs.pop()
        leg = self._legs[-1]
        if goal_m == leg.goal_m:
            return
        screw_m, eye_m = self._screw(leg, t_ns), self.at(t_ns)
        arrival_ns = t_ns + math.ceil(abs(goal_m - screw_m) / self._speed(screw_m, goal_m) * S)
        self._legs.append(_Leg(t_ns, screw_m, eye_m, goal_m, arrival_ns))
        if len(self._legs) > 2 and self._legs[1].start_ns < t_ns - HISTORY_NS:
            del self._legs[0]

    def at(self, t_ns: int) -> float:
        """Return where the eye is; the start again for times that are forgotten."""
        if t_ns < self._legs[0].start_ns:
            return self._start_m - self._play_m
        leg = self._leg(t_ns)
        screw_m = self._screw(leg, t_ns)
        return min(max(leg.eye_m, screw_m - self._play_m), screw_m)

    def arrival_ns(self, t_ns: int) -> int:
        """Return when the leg of time `t_ns` ends."""
        return self._leg(t_ns).arrival_ns

    def _leg(self, t_ns: int) -> _Leg:
        return self._legs[max(0, bisect_right(self._legs, t_ns, key=lambda leg: leg.start_ns) - 1)]

    def _screw(self, leg: _Leg, t_ns: int) -> float:
        if t_ns >= leg.arrival_ns:
            return leg.goal_m
        step_m = self._speed(leg.screw_m, leg.goal_m) * max(0, t_ns - leg.start_ns) / S
        return leg.screw_m + math.copysign(min(step_m, abs(leg.goal_m - leg.screw_m)), leg.goal_m - leg.screw_m)

    def _speed(self, from_m: float, to_m: float) -> float:
        return self._grow_m_s if to_m > from_m else self._shrink_m_s


def baseline_model(servo: ServoConfig) -> BaselineModel | FixedBaseline:
    """Return the model that fits the configured servo."""
    if isinstance(servo, NoServoConfig):
        return FixedBaseline(servo.baseline_mm / 1e3)
    return BaselineModel(servo.motion)
