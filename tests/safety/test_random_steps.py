"""A plain seeded driver does a great many things in no sensible order; the witness watches every output.

Beside hypothesis (test_rules.py), which finds short counterexamples, this one walks far.
"""

from __future__ import annotations

import math
import random
from collections import Counter

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitorLimits
from tests.support.cockpit import HEALTHY, LIMITS, OFF_US, ON_US, OTHER_LIMITS, Cockpit

OURS = (Lease.SUPERVISOR, Lease.FRAME, Lease.DEPTH, Lease.MISSION)
WILD = (math.nan, math.inf, -math.inf, 1e300, -1e9, 0.0, 65535.0, 1500.5, -1500.0)


class Chaos(Cockpit):
    """A cockpit in which anything may happen; most turns are ordinary stick periods, so that flying happens too."""

    def __init__(self, rng: random.Random) -> None:
        super().__init__(SafetyMonitorLimits(gcs_timeout_s=3.0 if rng.random() < 0.3 else None))
        self._rng = rng
        self._ready_ns = self.now_ns
        self.seen: Counter[str] = Counter()
        self.monitor.boot_done(self.now_ns)
        self.set_missing(None)
        if rng.random() < 0.9:
            self.set_limits(LIMITS)
        if rng.random() < 0.9:
            self.heartbeat(armed=False, landed=True)
        self._events = (
            self._flip, self._flip, self._flip, self._flip, self._flip, self._flick, self._mode, self._disarm,
            self._heal, self._heal, self._heal, self._heal, self._lose_any, self._lose_any, self._find, self._find,
            self._fail, self._mend, self._mend, self._mend, self._finish, self._trouble,
            self._pause, self._jump_back, self._wrong_stamp, self._wrong_numbers, self._change_limits,
            self._overtaken, self._absent, self._early_offer, self._land, self._revoke,
        )  # fmt: skip

    def turn(self) -> None:
        """Do one random thing."""
        self.seen[self.state] += 1
        if self._rng.random() < 0.98:
            self._period()
        else:
            self._rng.choice(self._events)()

    def _period(self) -> None:
        rng = self._rng
        self.wait(20 * MS if rng.random() < 0.95 else rng.choice((0, 1, MS, 55 * MS, 130 * MS)))
        kind = rng.random()
        if kind < 0.4:
            if Lease.SWITCH not in self.silent:
                self.rc(self.switch_us)
        elif kind < 0.7:
            if Lease.LINK not in self.silent:
                self.heartbeat()
        elif Lease.VEHICLE not in self.silent:
            self.motion(gcs_t_ns=self.now_ns)
        if rng.random() < 0.3:
            for lease in OURS:
                if lease not in self.silent:
                    self.renew(lease, 300 * MS)
        if self.state is State.ENGAGED or rng.random() < 0.02:
            a, b, c, d = (rng.uniform(900.0, 2100.0) for _ in range(4))
            self.offer((a, b, c, d), rng.choice((20, 100, 300)) * MS)
        self.step()

    def _flip(self) -> None:
        self._heal()
        for us in (OFF_US, ON_US):
            self.switch_us = us
            for _ in range(self._rng.randrange(8, 30)):
                self._period()

    def _flick(self) -> None:
        self.rc(OFF_US)
        self.rc(ON_US)

    def _mode(self) -> None:
        self.heartbeat(custom_mode=self._rng.choice((0, 2, 6, 9, 17)))
        if self._rng.random() < 0.7:
            self.heartbeat(custom_mode=5)

    def _disarm(self) -> None:
        self.heartbeat(armed=False)

    def _heal(self) -> None:
        """The vehicle is well and flies, the daemon too."""
        if self._rng.random() < 0.8:
            self._mend()
        self.silent.clear()
        self.heartbeat(**HEALTHY, ekf_t_ns=self.now_ns, battery_fraction=self._rng.choice((math.nan, 0.9)))

    def _lose_any(self) -> None:
        self.silent.add(self._rng.choice(list(Lease)))

    def _find(self) -> None:
        if self.silent:
            self.silent.remove(self._rng.choice(sorted(self.silent)))

    def _fail(self) -> None:
        self.fault(self._rng.choice((Reason.TASK_DIED, Reason.CAMERA_LOST)), self._rng.choice("ab"))

    def _mend(self) -> None:
        for reason, source in sorted(self.witness.faults):
            self.clear(reason, source)

    def _finish(self) -> None:
        self.mission_over(self._rng.choice((Reason.GOAL_REACHED, Reason.MISSION_REFUSED)))

    def _trouble(self) -> None:
        self.hear(
            **self._rng.choice(({"system_status": 5}, {"ekf_flags": 0x88}, {"battery_fraction": 0.1}, {"rc_rssi": 0}))
        )

    def _pause(self) -> None:
        self.wait(round(self._rng.choice((0.3, 0.99, 1.01, 5.0)) * S))
        self.step()

    def _jump_back(self) -> None:
        self.wait(-round(self._rng.choice((1e-9, 0.01, 1.0, 100.0)) * S))
        self.step()

    def _wrong_stamp(self) -> None:
        self.renew(self._rng.choice(list(Lease)), self._rng.choice((3600 * S, -S, 0, 1)))

    def _wrong_numbers(self) -> None:
        if self._rng.random() < 0.5:
            self.motion(v_ned_m_s=(self._rng.choice(WILD), 0.0, 0.0))
            self.motion(v_ned_m_s=(0.0, 0.0, 0.0))
        else:
            a, b, c, d = (self._rng.choice(WILD) for _ in range(4))
            self.offer((a, b, c, d), self._rng.choice((MS, S, 3600 * S)))

    def _change_limits(self) -> None:
        self.set_limits(self._rng.choice((LIMITS, OTHER_LIMITS)))

    def _overtaken(self) -> None:
        self.rc(self._rng.choice((OFF_US, ON_US)), self.now_ns - round(self._rng.random() * S))

    def _absent(self) -> None:
        self.rc(self._rng.choice((0, 65535, math.nan)))

    def _early_offer(self) -> None:
        self.offer((1900.0, 1100.0, 1900.0, 1100.0), 5 * S)

    def _land(self) -> None:
        self.hear(landed=self._rng.random() < 0.3)

    def _revoke(self) -> None:
        self.revoke(self._rng.choice(list(Lease)))


def walk(seed: int, steps: int) -> Counter[str]:
    """Take `steps` turns in lives of a random length, each ended by a shutdown; returns what happened how often."""
    rng = random.Random(seed)
    counts: Counter[str] = Counter()
    while steps > 0:
        chaos = Chaos(rng)
        turns = min(steps, rng.randrange(500, 5000))
        for _ in range(turns):
            chaos.turn()
        steps -= turns
        if rng.random() < 0.5:
            chaos.release_now(Reason.TASK_DIED)
        else:
            chaos.shutdown()
        for _ in range(300):
            chaos.period()
        assert chaos.monitor.let_go
        counts += chaos.witness.counts + chaos.seen
    return counts


def assert_busy(counts: Counter[str], steps: int) -> None:
    """The walk was worth something: it flew, braked, resumed, held and was taken over, many times over."""
    assert counts[State.ENGAGED] > steps / 10
    for state in State:
        assert counts[state] > steps / 1000 or state is State.BOOT, state
    assert counts["engagements"] > steps / 2000


def test_a_hundred_thousand_random_steps() -> None:
    assert_busy(walk(seed=1, steps=100_000), 100_000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 20))
def test_a_million_random_steps(seed: int) -> None:
    assert_busy(walk(seed, steps=100_000), 100_000)
