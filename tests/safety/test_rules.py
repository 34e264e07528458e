"""Hypothesis looks for the shortest sequence of events after which the gate lets out what the witness forbids."""

from __future__ import annotations

import math

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitorLimits
from morpheyes_daemon.safety.states import EFFECTS, HOLDING
from tests.support.cockpit import HEALTHY, LIMITS, OFF_US, ON_US, OTHER_LIMITS, Cockpit

widths = st.floats() | st.integers(-(10**9), 10**9) | st.sampled_from((0.0, 1000.0, 1900.0, 65535.0))
leases = st.sampled_from(list(Lease))
jumps_ns = st.sampled_from((1, 19 * MS, 20 * MS, 100 * MS, 101 * MS, 300 * MS, 499 * MS, 500 * MS, 501 * MS, 3 * S))


class MonitorRules(RuleBasedStateMachine):
    """Whole periods and single messages in any order; `Cockpit` and `Witness` hold the assertions."""

    @initialize(state=st.sampled_from(list(State)), gcs=st.none() | st.just(4.0))
    def start(self, state: State, gcs: float | None) -> None:
        self.cockpit = Cockpit(SafetyMonitorLimits(gcs_timeout_s=gcs)).into(state)

    @rule(periods=st.integers(1, 30))
    def live(self, periods: int) -> None:
        for _ in range(periods):
            self.cockpit.period()

    @rule()
    def flip(self) -> None:
        self.cockpit.said.update(HEALTHY, gcs_t_ns=self.cockpit.now_ns, battery_fraction=0.9)
        self.cockpit.silent.clear()
        for us in (OFF_US, ON_US):
            self.cockpit.switch_us = us
            self.live(13)

    @rule(us=st.sampled_from((OFF_US, 1500, ON_US, 0, 65535)))
    def move_switch(self, us: int) -> None:
        self.cockpit.switch_us = us

    @rule(us=st.sampled_from((OFF_US, ON_US)) | st.floats(0, 3000), late_ns=st.integers(0, S))
    def one_pulse(self, us: float, late_ns: int) -> None:
        self.cockpit.rc(us, self.cockpit.now_ns - late_ns)

    @rule(mode=st.integers(0, 30), armed=st.booleans(), status=st.integers(0, 8))
    def one_heartbeat(self, mode: int, armed: bool, status: int) -> None:
        self.cockpit.heartbeat(custom_mode=mode, armed=armed, system_status=status)

    @rule()
    def heal(self) -> None:
        self.cockpit.hear(**HEALTHY)
        self.cockpit.silent.clear()

    @rule(landed=st.booleans(), flags=st.sampled_from((0, 8, 0x10, 0x88)), charge=st.floats(0, 1) | st.just(math.nan))
    def report(self, landed: bool, flags: int, charge: float) -> None:
        self.cockpit.hear(landed=landed, ekf_flags=flags, battery_fraction=charge)

    @rule(v=st.floats())
    def move(self, v: float) -> None:
        self.cockpit.motion(v_ned_m_s=(v, 0.0, 0.0))

    @rule(lease=leases)
    def silence(self, lease: Lease) -> None:
        self.cockpit.silent.add(lease)

    @rule(lease=leases)
    def find(self, lease: Lease) -> None:
        self.cockpit.silent.discard(lease)

    @rule(lease=leases, for_ns=st.integers(-S, 12 * S) | st.just(3600 * S))
    def renew(self, lease: Lease, for_ns: int) -> None:
        self.cockpit.renew(lease, for_ns)

    @rule(lease=leases)
    def revoke(self, lease: Lease) -> None:
        self.cockpit.revoke(lease)

    @rule(wanted=st.none() | st.tuples(widths, widths, widths, widths))
    def want(self, wanted: tuple[float, float, float, float] | None) -> None:
        self.cockpit.wanted = wanted

    @rule(wanted=st.tuples(widths, widths, widths, widths), for_ns=st.integers(0, 20 * S))
    def offer(self, wanted: tuple[float, float, float, float], for_ns: int) -> None:
        self.cockpit.offer(wanted, for_ns)

    @rule(jump_ns=jumps_ns | jumps_ns.map(lambda ns: -ns))
    def jump(self, jump_ns: int) -> None:
        self.cockpit.wait(jump_ns)

    @rule()
    def step(self) -> None:
        self.cockpit.step()

    @rule(source=st.sampled_from("ab"))
    def fail(self, source: str) -> None:
        self.cockpit.fault(Reason.TASK_DIED, source)

    @rule(source=st.sampled_from("ab"))
    def mend(self, source: str) -> None:
        self.cockpit.clear(Reason.TASK_DIED, source)

    @rule(reason=st.sampled_from((Reason.GOAL_REACHED, Reason.MISSION_REFUSED)))
    def finish(self, reason: Reason) -> None:
        self.cockpit.mission_over(reason)

    @rule(missing=st.none() | st.just(Reason.DOCTOR_SAYS_NO))
    def judge(self, missing: Reason | None) -> None:
        self.cockpit.set_missing(missing)

    @rule(limits=st.sampled_from((LIMITS, OTHER_LIMITS)))
    def change_limits(self, limits: object) -> None:
        self.cockpit.set_limits(limits)  # type: ignore[arg-type]

    @precondition(lambda self: self.cockpit.state in HOLDING)
    @rule()
    def shutdown(self) -> None:
        self.cockpit.shutdown()

    @precondition(lambda self: self.cockpit.state in HOLDING)
    @rule()
    def release_now(self) -> None:
        self.cockpit.release_now(Reason.TASK_DIED)

    @invariant()
    def who_holds_no_stick_is_silent_or_releases(self) -> None:
        if self.cockpit.sent and self.cockpit.state not in HOLDING:
            assert self.cockpit.sent[-1].action is Action.RELEASE

    @invariant()
    def only_engaged_moves_a_stick(self) -> None:
        if self.cockpit.sent and self.cockpit.sent[-1].action is Action.STICKS:
            assert self.cockpit.sent[-1].state is State.ENGAGED
            assert EFFECTS[self.cockpit.sent[-1].state] is Action.STICKS


MonitorRules.TestCase.settings = settings(
    max_examples=60,
    stateful_step_count=40,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
TestMonitorRules = MonitorRules.TestCase
