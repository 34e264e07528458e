"""The Teensy and its two linear servos: answers the real bytes and knows where the servos truly are.

Each servo follows its target with a limited speed and a proportional end, after a latency, and carries its eye with
play: the eye lies between screw − play and screw. Targets are reached with a seeded repeatability error. The twin
speaks over any link (`connect`); it opens none itself. Only the simulator reads `baseline_at`, which is on the
servos' own scale: what length it is on the bar is the rig's (`RigTwin.actual_m`).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from morpheyes_daemon.clock import MS, Clock, S, Ticker
from morpheyes_daemon.config.vehicle import ServoMotion
from morpheyes_daemon.wire.servo import (
    VERSION,
    Ack,
    Decoder,
    Hello,
    Message,
    SetTarget,
    Status,
    StatusFlag,
    Verdict,
    Welcome,
    encode,
)

STATUS_RATE_HZ = 5.0
HOST_SILENT_NS = S
BOOT_NS = 500 * MS
"""A Teensy 3.2 answers on USB about half a second after a reset."""
FIRMWARE = 1
HISTORY_NS = 60 * S


@dataclass(frozen=True, slots=True)
class ServoTruth:
    """What the servos of a twin really do; lengths of the whole baseline, speed and backlash of one camera."""

    min_m: float = 0.100
    max_m: float = 0.300
    speed_m_s: float = 0.025
    speed_spread: float = 0.03
    backlash_m: float = 0.25e-3
    latency_s: float = 0.020
    settle_s: float = 0.150
    repeatability_sigma_m: float = 0.1e-3
    start_m: float = 0.200

    @classmethod
    def from_config(cls, motion: ServoMotion) -> ServoTruth:
        """Return servos that behave as the configuration says, apart from scatter."""
        low_m, high_m = motion.min_baseline_mm / 1e3, motion.max_baseline_mm / 1e3
        return cls(
            min_m=low_m,
            max_m=high_m,
            speed_m_s=motion.speed_mm_s / 1e3,
            backlash_m=motion.backlash_mm / 1e3,
            latency_s=motion.latency_ms / 1e3,
            settle_s=motion.settle_ms / 1e3,
            repeatability_sigma_m=motion.repeatability_sigma_mm / 1e3,
            start_m=(low_m + high_m) / 2,
        )


class ServoFault(Enum):
    """What can go wrong with the servos and their controller."""

    STUCK = "the servos hold where they are, targets are acknowledged"
    SILENT = "the Teensy neither listens nor answers"
    GARBAGE = "the Teensy sends random bytes instead of frames"
    RUNS_IN = "the servos run to their short end and stay there, targets are acknowledged"
    WRONG_POSITION = "the servos go 10 mm beyond every target, as far as the stroke goes"


WRONG_BY_M = 0.010
_DEAF = {ServoFault.STUCK, ServoFault.RUNS_IN}


class TeensyTwin:
    """The Teensy behind a link; the same seed and the same bytes at the same times give the same motion."""

    def __init__(self, truth: ServoTruth, clock: Clock, seed: int) -> None:
        self._truth, self._clock = truth, clock
        self._rng = np.random.default_rng(seed)
        scatter = self._rng.uniform(-truth.speed_spread, truth.speed_spread, 2)
        now_ns = clock.now_ns()
        self._eyes = [_Eye(truth, truth.speed_m_s * (1 + part), now_ns) for part in scatter]
        self._faults: set[ServoFault] = set()
        self._write: Callable[[bytes], None] = _discard
        self._decoder = Decoder()
        self._target_m: float | None = None
        self._boot(now_ns - BOOT_NS)

    def connect(self, write: Callable[[bytes], None]) -> None:
        """Send answers to `write` from now on; hand received bytes to `receive`."""
        self._write = write

    async def run(self) -> None:
        """Send STATUS at its rate until cancelled."""
        ticker = Ticker(self._clock, STATUS_RATE_HZ)
        while True:
            await ticker.wait()
            self._send(self._status())

    def receive(self, data: bytes) -> None:
        """Take bytes from the host and answer what they ask."""
        if ServoFault.SILENT in self._faults or self._clock.now_ns() < self._ready_ns:
            return
        for message in self._decoder.feed(data):
            self._heard_ns = self._clock.now_ns()
            self._answer(message)

    def baseline_at(self, t_ns: int) -> float:
        """Return where the servos hold the eyes apart, in metres on their own scale, now or up to a minute ago."""
        return sum(eye.at(t_ns) for eye in self._eyes)

    def inject(self, fault: ServoFault) -> None:
        """Let a fault begin now."""
        self._faults.add(fault)
        if fault is ServoFault.STUCK:
            self._halt()
        elif fault is ServoFault.RUNS_IN:
            for eye in self._eyes:
                eye.aim(self._truth.min_m / 2, self._clock.now_ns())

    def repair(self) -> None:
        """End all faults; servos that did not obey go on to their target."""
        was_stuck = bool(_DEAF & self._faults)
        self._faults.clear()
        if was_stuck and self._target_m is not None:
            self._drive(self._target_m)

    def reboot(self) -> None:
        """Restart the Teensy: no pulses, the servos stop where they are, the target is forgotten."""
        self._halt()
        self._boot(self._clock.now_ns())

    def _boot(self, t_ns: int) -> None:
        self._booted_ns = t_ns
        self._ready_ns = t_ns + BOOT_NS
        self._heard_ns = t_ns
        self._target_m = None
        self._decoder = Decoder()

    def _halt(self) -> None:
        for eye in self._eyes:
            eye.halt(self._clock.now_ns())

    def _answer(self, message: Message) -> None:
        if isinstance(message, SetTarget):
            applied_m = min(max(message.target_m, self._truth.min_m), self._truth.max_m)
            if applied_m != self._target_m:
                self._target_m = applied_m
                self._drive(applied_m)
            verdict = Verdict.APPLIED if applied_m == message.target_m else Verdict.CLAMPED
            self._send(Ack(message.seq, verdict, applied_m))
        elif isinstance(message, Hello):
            self._send(Welcome(VERSION, FIRMWARE, self._truth.min_m, self._truth.max_m))

    def _drive(self, target_m: float) -> None:
        if _DEAF & self._faults:
            return
        if ServoFault.WRONG_POSITION in self._faults:
            target_m = min(target_m + WRONG_BY_M, self._truth.max_m)
        sigma_m = self._truth.repeatability_sigma_m / math.sqrt(2)
        latency_ns = round(self._truth.latency_s * S * self._rng.uniform(0.75, 1.5))
        for eye in self._eyes:
            error_m = sigma_m * float(np.clip(self._rng.standard_normal(), -2, 2))
            eye.aim(target_m / 2 + error_m, self._clock.now_ns() + latency_ns)

    def _status(self) -> Status:
        now_ns = self._clock.now_ns()
        silent = StatusFlag.HOST_SILENT if now_ns - self._heard_ns > HOST_SILENT_NS else StatusFlag(0)
        cold = StatusFlag.COLD if self._target_m is None else StatusFlag(0)
        uptime_ms = (now_ns - self._booted_ns) // MS % 2**32
        return Status(uptime_ms, self._target_m, silent | cold, self._decoder.dropped_frames % 2**16)

    def _send(self, message: Message) -> None:
        if ServoFault.SILENT in self._faults or self._clock.now_ns() < self._ready_ns:
            return
        frame = encode(message)
        self._write(self._rng.bytes(len(frame)) if ServoFault.GARBAGE in self._faults else frame)


def _discard(data: bytes) -> None:
    """The other end of a cable that is not plugged in."""


@dataclass(frozen=True, slots=True)
class _Leg:
    """One motion of a screw: linear until `band_ns`, then exponential onto the goal."""

    start_ns: int
    screw_m: float
    eye_m: float
    goal_m: float


class _Eye:
    """One camera on its servo; positions are half baselines."""

    def __init__(self, truth: ServoTruth, speed_m_s: float, t_ns: int) -> None:
        self._speed_m_s = speed_m_s
        self._tau_s = truth.settle_s / 5
        self._play_m = truth.backlash_m
        start_m = truth.start_m / 2
        self._legs = [_Leg(t_ns, start_m, start_m, start_m)]

    def aim(self, goal_m: float, t_ns: int) -> None:
        """Head for `goal_m` from `t_ns` on."""
        t_ns = max(t_ns, self._legs[-1].start_ns)
        leg = self._leg(t_ns)
        self._legs.append(_Leg(t_ns, self._screw(leg, t_ns), self.at(t_ns), goal_m))
        while len(self._legs) > 2 and self._legs[1].start_ns < t_ns - HISTORY_NS:
            del self._legs[0]

    def halt(self, t_ns: int) -> None:
        """Stop where the servo is; a motion that was to begin later does not."""
        while len(self._legs) > 1 and self._legs[-1].start_ns > t_ns:
            self._legs.pop()
        self.aim(self._screw(self._legs[-1], t_ns), t_ns)

    def at(self, t_ns: int) -> float:
        """Return where the eye is."""
        leg = self._leg(t_ns)
        screw_m = self._screw(leg, t_ns)
        return min(max(leg.eye_m, screw_m - self._play_m), screw_m)

    def _leg(self, t_ns: int) -> _Leg:
        return self._legs[max(0, bisect_right(self._legs, t_ns, key=lambda leg: leg.start_ns) - 1)]

    def _screw(self, leg: _Leg, t_ns: int) -> float:
        """Return the screw of v = error/τ limited to ± speed, in closed form."""
        elapsed_s = max(0, t_ns - leg.start_ns) / S
        distance_m = abs(leg.goal_m - leg.screw_m)
        band_m = self._speed_m_s * self._tau_s
        linear_s = max(0.0, distance_m - band_m) / self._speed_m_s
        left_m = distance_m - self._speed_m_s * min(elapsed_s, linear_s)
        if elapsed_s > linear_s and self._tau_s > 0:
            left_m *= math.exp(-(elapsed_s - linear_s) / self._tau_s)
        elif elapsed_s > linear_s:
            left_m = 0.0
        return leg.goal_m - math.copysign(left_m, leg.goal_m - leg.screw_m)
