"""Baseline model: the baseline at any time from the commands alone, since the servos give no feedback.

`BaselineModel` propagates an interval that contains the true baseline: its lower bound assumes the combination of
speed, latency and backlash that gives the smallest baseline, its upper bound the one that gives the largest. The
dynamics are monotone, so the true baseline stays between the bounds for every sequence of commands. Lengths are as
commanded: what a commanded baseline really is, non-linearity of the servo included, is the calibration's business.
Which baseline to command is `baseline_planner`'s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.config.vehicle import NoServoConfig, ServoMotion, VehicleConfig
from morpheyes_daemon.messages.core import BaselineEstimate

SPEED_TOLERANCE = 0.08
"""Relative tolerance of the servo's speed about its nominal value; load and supply voltage change it. Unit: none.

Chosen: a wider one makes sigma larger while the servo moves, a narrower one may exclude the true baseline."""

LATENCY_FACTORS = (0.5, 2.0)
"""Earliest and latest first motion, as multiples of the nominal latency. Unit: none.

Chosen: as SPEED_TOLERANCE, certainty against a narrow interval."""

SETTLE_LAG = 0.4
"""Lag of a settling servo, as a share of its settling time T. Unit: none.

Source: equation, a first-order lag settles to 1 % in five time constants, tau = T/5; two of them are 0.4 T."""

HISTORY_NS = 20 * S
"""How far back `BaselineModel.at` can look.

Chosen: frames and depth maps are seconds old at most; a longer history costs memory and time."""


def baseline_law(depth_m: float, gain: float, range_m: tuple[float, float]) -> float:
    """Return b = K·Z clamped to the rig's range (paper, section V); the smallest when Z is unknown (NaN).

    The smallest baseline has the nearest near limit, so it is the safe one when no depth is known.
    """
    if math.isnan(depth_m):
        return range_m[0]
    return min(max(gain * depth_m, range_m[0]), range_m[1])


class FixedBaseline:
    """The baseline of a rig without servos: the interface of `BaselineModel`, with commands ignored."""

    def __init__(self, baseline_m: float) -> None:
        self._baseline_m = baseline_m

    def on_sent(self, target_m: float, t_ns: int) -> None:
        """Do nothing: the rig cannot move."""

    def on_acknowledged(self, target_m: float, t_ns: int) -> None:
        """Do nothing: the rig cannot move."""

    def on_unconfirmed(self, target_m: float, t_ns: int) -> None:
        """Do nothing: the rig cannot move."""

    def at(self, t_ns: int) -> BaselineEstimate:
        """Return the rig's one baseline, with a sigma of zero."""
        return BaselineEstimate(t_ns, self._baseline_m, self._baseline_m, 0.0, False)


class BaselineModel:
    """The baseline over time, as commanded, with its uncertainty; unknown within the rig's range at the start."""

    def __init__(self, motion: ServoMotion) -> None:
        self._range_m = motion.min_baseline_mm / 1e3, motion.max_baseline_mm / 1e3
        self._repeatability_m = motion.repeatability_sigma_mm / 1e3
        self._settle_ns = round(motion.settle_ms * MS)
        earliest, latest = (round(factor * motion.latency_ms * MS) for factor in LATENCY_FACTORS)
        self._earliest_ns = earliest
        self._latest_ns = latest + round(SETTLE_LAG * self._settle_ns)
        rate_m_s = 2 * motion.speed_mm_s / 1e3
        fast, slow = rate_m_s * (1 + SPEED_TOLERANCE), rate_m_s * (1 - SPEED_TOLERANCE)
        backlash_m = 2 * motion.backlash_mm / 1e3
        self._commands: list[_Command] = []
        self._low = _Bound(self._range_m[0], grow_m_s=slow, shrink_m_s=fast, backlash_m=backlash_m)
        self._high = _Bound(self._range_m[1], grow_m_s=fast, shrink_m_s=slow, backlash_m=0.0)

    def on_acknowledged(self, target_m: float, t_ns: int) -> None:
        """Record that the servo acknowledged `target_m` at `t_ns`; raises ValueError when times go back."""
        interval = target_m, target_m
        self._add(_Command(target_m, t_ns, t_ns + self._earliest_ns, t_ns + self._latest_ns, interval))

    def on_sent(self, target_m: float, t_ns: int) -> None:
        """Record that `target_m` was sent at `t_ns`; until it is acknowledged the old target may still hold.

        Raises ValueError when times go back.
        """
        interval = target_m, target_m
        self._add(_Command(target_m, t_ns, t_ns + self._earliest_ns, None, interval))

    def on_unconfirmed(self, target_m: float, t_ns: int) -> None:
        """Record that `target_m` was sent at `t_ns` but may have been lost, or the servo may have stopped.

        From then on, until the next command, the baseline may be anywhere between its present interval, the old and
        the new target. Raises ValueError when times go back.
        """
        present = self._low.at(t_ns), self._high.at(t_ns)
        interval = min(target_m, *present), max(target_m, *present)
        self._add(_Command(target_m, t_ns, t_ns + self._earliest_ns, None, interval))

    def at(self, t_ns: int) -> BaselineEstimate:
        """Return the baseline at a past, present or future time, given the commands recorded so far.

        Sigma is that of a uniform distribution over the interval, with the repeatability added in squares.
        """
        low, high = self._low.at(t_ns), self._high.at(t_ns)
        sigma_m = math.hypot((high - low) / math.sqrt(12), self._repeatability_m)
        settled_ns = max(self._low.arrival_ns(t_ns), self._high.arrival_ns(t_ns)) + self._settle_ns
        return BaselineEstimate(t_ns, self._target_at(t_ns), (low + high) / 2, sigma_m, t_ns < settled_ns)

    def _add(self, command: _Command) -> None:
        if self._commands and command.earliest_ns < self._commands[-1].earliest_ns:
            raise ValueError("commands must be given in the order of their times")
        self._commands.append(command)
        self._prune(command.earliest_ns - HISTORY_NS)
        for t_ns in sorted(self._changes_from(command.earliest_ns)):
            low_m, high_m = self._possible_targets(t_ns)
            self._low.set_target(low_m, t_ns)
            self._high.set_target(high_m, t_ns)

    def _prune(self, t_ns: int) -> None:
        """Drop commands that a certain one has replaced before `t_ns`, and merge old unconfirmed ones into one."""
        while len(self._commands) > 1 and self._commands[1].earliest_ns < t_ns:
            old, new = self._commands[:2]
            self._commands[:2] = [new if new.certain_by(t_ns) else old.merged(new)]

    def _changes_from(self, t_ns: int) -> set[int]:
        """Return the times from `t_ns` on at which the set of possible targets changes."""
        certain = {command.certain_ns for command in self._commands if command.certain_ns is not None}
        return {t_ns} | {change_ns for change_ns in certain if change_ns > t_ns}

    def _possible_targets(self, t_ns: int) -> tuple[float, float]:
        """Return the smallest and largest baseline that the servo may be moving to at `t_ns`."""
        possible: list[float] = list(self._range_m)
        for command in self._commands:
            if command.certain_by(t_ns):
                possible = []
            if command.earliest_ns <= t_ns:
                possible += command.interval_m
        return min(possible), max(possible)

    def _target_at(self, t_ns: int) -> float:
        sent = (command.target_m for command in reversed(self._commands) if command.sent_ns <= t_ns)
        return next(sent, sum(self._range_m) / 2)


@dataclass(frozen=True, slots=True)
class _Command:
    """A target that may act from `earliest_ns` on and certainly acts from `certain_ns` on (None: never certain).

    `interval_m` is the smallest and largest baseline it may lead to.
    """

    target_m: float
    sent_ns: int
    earliest_ns: int
    certain_ns: int | None
    interval_m: tuple[float, float]

    def certain_by(self, t_ns: int) -> bool:
        return self.certain_ns is not None and self.certain_ns <= t_ns

    def merged(self, later: _Command) -> _Command:
        """Return one command whose interval covers this one's and that of a later unconfirmed one."""
        interval = min(self.interval_m[0], later.interval_m[0]), max(self.interval_m[1], later.interval_m[1])
        return replace(self, target_m=later.target_m, sent_ns=later.sent_ns, interval_m=interval)


@dataclass(frozen=True, slots=True)
class _Motion:
    """Motion of the lead screw from `screw_m` to `target_m`; `camera_m` is the camera's place in the backlash before."""

    start_ns: int
    screw_m: float
    camera_m: float
    target_m: float
    arrival_ns: int


class _Bound:
    """One bound of the interval: a servo with assumed speeds and backlash.

    The camera lies between screw − backlash and screw. Shrinking pushes it to the screw itself, which is how the
    baseline is defined; growing leaves it behind by the backlash.
    """

    def __init__(self, start_m: float, *, grow_m_s: float, shrink_m_s: float, backlash_m: float) -> None:
        self._grow_m_s, self._shrink_m_s, self._backlash_m = grow_m_s, shrink_m_s, backlash_m
        self._start_m = start_m
        self._motions = [_Motion(0, start_m, start_m - backlash_m, start_m, 0)]

    def set_target(self, target_m: float, t_ns: int) -> None:
        """Move to `target_m` from `t_ns` on; motions that were to start later are dropped."""
        while self._motions[-1].start_ns >= t_ns and len(self._motions) > 1:
            self._motions.pop()
        motion = self._motions[-1]
        if target_m == motion.target_m:
            return
        screw_m, camera_m = self._screw(motion, t_ns), self.at(t_ns)
        arrival_ns = t_ns + math.ceil(abs(target_m - screw_m) / self._speed(screw_m, target_m) * S)
        self._motions.append(_Motion(t_ns, screw_m, camera_m, target_m, arrival_ns))
        if len(self._motions) > 2 and self._motions[1].start_ns < t_ns - HISTORY_NS:
            del self._motions[0]

    def at(self, t_ns: int) -> float:
        """Return the bound at `t_ns`; the start value for times before the history."""
        if t_ns < self._motions[0].start_ns:
            return self._start_m - self._backlash_m
        motion = self._motion_at(t_ns)
        screw_m = self._screw(motion, t_ns)
        return min(max(motion.camera_m, screw_m - self._backlash_m), screw_m)

    def arrival_ns(self, t_ns: int) -> int:
        """Return when the motion that is in force at `t_ns` ends."""
        return self._motion_at(t_ns).arrival_ns

    def _motion_at(self, t_ns: int) -> _Motion:
        index = bisect_right(self._motions, t_ns, key=lambda motion: motion.start_ns) - 1
        return self._motions[max(0, index)]

    def _screw(self, motion: _Motion, t_ns: int) -> float:
        if t_ns >= motion.arrival_ns:
            return motion.target_m
        step_m = self._speed(motion.screw_m, motion.target_m) * max(0, t_ns - motion.start_ns) / S
        way_m = motion.target_m - motion.screw_m
        return motion.screw_m + math.copysign(min(step_m, abs(way_m)), way_m)

    def _speed(self, from_m: float, to_m: float) -> float:
        return self._grow_m_s if to_m > from_m else self._shrink_m_s


def baseline_model(config: VehicleConfig) -> BaselineModel | FixedBaseline:
    """Return the baseline model of the configured servo; without a servo the one baseline of the rig."""
    if isinstance(config.servo, NoServoConfig):
        return FixedBaseline(config.baseline_range_m[0])
    return BaselineModel(config.servo.motion)
