"""The gate on its own: what it lets through, what it makes of the rest, and how it lets go."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import Sticks
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.safety.gate import Gate, StickLimits
from morpheyes_daemon.safety.leases import LEASE_REASONS, Lease
from morpheyes_daemon.safety.states import EFFECTS, HOLDING

LIMITS = StickLimits((1000, 1010, 1020, 1030), (2000, 1990, 1980, 1970), (1500, 1490, 1510, 1505))
NEUTRAL = LIMITS.neutral
LATE_NS, LONGEST_LEASE_NS, RELEASE_REPEATS = 100 * MS, 10 * S, 20
SLOW_US = 80
"""4000 us/s over one period of 20 ms."""


class Bench:
    """A gate with limits, in ENGAGED, with every lease fresh; `step` is one period of 20 ms."""

    def __init__(self, limits: StickLimits | None = LIMITS) -> None:
        self.sent: list[GateOutput] = []
        self.gate = Gate(self.sent.append)
        self.now_ns = 1000 * S
        if limits is not None:
            self.gate.set_limits(limits)
        self.renew(5 * S)
        self.step()

    def renew(self, for_ns: int) -> None:
        for lease in Lease:
            self.gate.renew(lease, self.now_ns + for_ns)

    def offer(self, *widths: float, for_ns: int = 500 * MS) -> None:
        self.gate.offer(Sticks(self.now_ns, self.now_ns + for_ns, *widths))  # type: ignore[arg-type]

    def step(self, state: State = State.ENGAGED, dt_ns: int = 20 * MS, reason: Reason = Reason.READY) -> GateOutput:
        self.now_ns += dt_ns
        return self.gate.step(state, reason, self.now_ns)

    def reach(self, *widths: float) -> GateOutput:
        """Offer the same until it is reached."""
        for _ in range(20):
            self.offer(*widths)
            out = self.step()
        assert out.widths_us == widths
        return out


AWAY = (1560, 1430, 1540, 1520)


def test_fresh_sticks_pass_as_they_are() -> None:
    bench = Bench()
    bench.offer(*AWAY)
    out = bench.step()
    assert out == GateOutput(bench.now_ns, State.ENGAGED, Action.STICKS, None, *AWAY)
    assert bench.sent[-1] is out
    assert out.widths_us == AWAY


def test_the_first_period_of_flying_is_neutral_whatever_was_offered_before() -> None:
    bench = Bench()
    bench.step(State.STANDBY)
    bench.offer(*AWAY)
    out = bench.step(State.ENGAGED, reason=Reason.ENGAGED)
    assert (out.action, out.widths_us, out.reason) == (Action.NEUTRAL, NEUTRAL, Reason.ENGAGED)
    assert bench.step().action is Action.NEUTRAL, "and what was offered before is not used after"
    bench.offer(*AWAY)
    assert bench.step().action is Action.STICKS


@pytest.mark.parametrize("lease", Lease)
def test_each_lease_stops_the_sticks_at_its_very_expiry(lease: Lease) -> None:
    bench = Bench()
    bench.gate.revoke(lease)
    bench.gate.renew(lease, bench.now_ns + 40 * MS)
    bench.offer(*AWAY)
    assert bench.gate.stale(bench.now_ns + 40 * MS - 1) is None
    assert bench.step(dt_ns=40 * MS - 1).action is Action.STICKS
    bench.offer(*AWAY)
    assert bench.gate.stale(bench.now_ns + 1) is lease
    assert not bench.gate.is_fresh(lease, bench.now_ns + 1)
    out = bench.step(dt_ns=1)
    assert (out.action, out.reason, out.widths_us) == (Action.NEUTRAL, LEASE_REASONS[lease], NEUTRAL)


def test_each_lease_has_its_own_reason() -> None:
    assert list(LEASE_REASONS) == list(Lease)
    assert len(set(LEASE_REASONS.values())) == len(Lease)
    assert LEASE_REASONS == {
        Lease.LINK: Reason.LINK_LOST,
        Lease.SWITCH: Reason.SWITCH_STALE,
        Lease.SUPERVISOR: Reason.SUPERVISOR_STALE,
        Lease.VEHICLE: Reason.VEHICLE_STALE,
        Lease.FRAME: Reason.FRAME_STALE,
        Lease.DEPTH: Reason.DEPTH_STALE,
        Lease.MISSION: Reason.MISSION_STALE,
    }


def test_of_several_stale_leases_the_gravest_is_named() -> None:
    bench = Bench()
    for lease in reversed(Lease):
        bench.gate.revoke(lease)
        assert bench.gate.stale(bench.now_ns) is lease


def test_a_new_gate_trusts_nothing() -> None:
    gate = Gate(lambda out: None)
    assert gate.stale(0) is Lease.LINK
    assert not gate.has_limits
    assert gate.silent
    assert gate.rejected == 0
    assert gate.step(State.ENGAGED, Reason.READY, 0).action is Action.SILENT


def test_renewing_never_shortens_a_lease() -> None:
    bench = Bench()
    bench.gate.renew(Lease.FRAME, bench.now_ns + 1)
    assert bench.gate.is_fresh(Lease.FRAME, bench.now_ns + S)


def test_a_lease_too_long_to_be_true_is_stale_and_then_forgotten() -> None:
    bench = Bench()
    bench.gate.renew(Lease.FRAME, bench.now_ns + 20 * MS + LONGEST_LEASE_NS + 1)
    bench.offer(*AWAY)
    assert bench.step().reason is Reason.FRAME_STALE
    bench.gate.renew(Lease.FRAME, bench.now_ns + 20 * MS + LONGEST_LEASE_NS)
    bench.offer(*AWAY)
    assert bench.step().action is Action.STICKS


@pytest.mark.parametrize(
    ("for_ns", "passes"),
    [
        (20 * MS, False),
        (20 * MS + 1, True),
        (LONGEST_LEASE_NS + 20 * MS, True),
        (LONGEST_LEASE_NS + 20 * MS + 1, False),
    ],
)
def test_an_offer_counts_until_it_expires(for_ns: int, passes: bool) -> None:
    bench = Bench()
    bench.offer(*AWAY, for_ns=for_ns)
    out = bench.step()
    assert (out.action is Action.STICKS) is passes
    assert out.reason is (None if passes else Reason.COMMAND_INVALID)


def test_an_offer_is_flown_on_until_it_expires() -> None:
    bench = Bench()
    bench.offer(*AWAY, for_ns=50 * MS)
    assert [bench.step().action for _ in range(3)] == [Action.STICKS, Action.STICKS, Action.NEUTRAL]


def test_an_offer_that_was_refused_once_is_gone() -> None:
    bench = Bench()
    bench.gate.revoke(Lease.DEPTH)
    bench.offer(*AWAY)
    assert bench.step().action is Action.NEUTRAL
    bench.renew(S)
    assert bench.step().action is Action.NEUTRAL


def test_without_an_offer_the_state_gives_the_reason() -> None:
    assert Bench().step(reason=Reason.RECOVERED).reason is Reason.RECOVERED


@pytest.mark.parametrize(("dt_ns", "passes"), [(0, True), (LATE_NS, True), (LATE_NS + 1, False), (-1, False)])
def test_after_a_pause_the_sticks_start_from_neutral(dt_ns: int, passes: bool) -> None:
    bench = Bench()
    bench.reach(*AWAY)
    bench.offer(*AWAY)
    assert (bench.step(dt_ns=dt_ns).action is Action.STICKS) is passes


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(4))
def test_what_is_not_finite_is_refused_and_counted(axis: int, value: float) -> None:
    bench = Bench()
    bench.offer(*AWAY)
    wrong = [*AWAY]
    wrong[axis] = value  # type: ignore[call-overload]
    bench.offer(*wrong)
    assert bench.gate.rejected == 1
    assert bench.step().widths_us == NEUTRAL


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize(
    ("value", "bound"), [(1e300, "maximum"), (-1e300, "minimum"), (65535, "maximum"), (0, "minimum")]
)
def test_each_stick_ends_at_its_own_range(axis: int, value: float, bound: str) -> None:
    bench = Bench()
    wanted: list[float] = [*NEUTRAL]
    wanted[axis] = value
    for _ in range(20):
        bench.offer(*wanted)
        out = bench.step()
    assert out.widths_us[axis] == getattr(LIMITS, bound)[axis]
    assert [w for i, w in enumerate(out.widths_us) if i != axis] == [w for i, w in enumerate(NEUTRAL) if i != axis]
    assert all(type(width) is int for width in out.widths_us)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("axis", range(4))
def test_away_from_neutral_a_stick_moves_no_faster_than_its_rate(axis: int, side: int) -> None:
    bench = Bench()
    wanted: list[float] = [*NEUTRAL]
    wanted[axis] += side * 300
    went = []
    for _ in range(5):
        bench.offer(*wanted)
        went.append(side * (bench.step().widths_us[axis] - NEUTRAL[axis]))
    assert went == [SLOW_US, 2 * SLOW_US, 3 * SLOW_US, 300, 300]


def test_towards_neutral_a_stick_may_jump_and_past_it_only_at_its_rate() -> None:
    bench = Bench()
    bench.reach(1800, 1490, 1510, 1505)
    bench.offer(1520, 1490, 1510, 1505)
    assert bench.step().roll_us == 1520
    bench.reach(1800, 1490, 1510, 1505)
    bench.offer(1200, 1490, 1510, 1505)
    assert bench.step().roll_us == 1500 - SLOW_US


def test_the_rate_counts_the_time_that_has_passed() -> None:
    bench = Bench()
    bench.offer(1900, 1490, 1510, 1505)
    assert bench.step(dt_ns=100 * MS).roll_us == 1900
    bench = Bench()
    bench.offer(1900, 1490, 1510, 1505)
    assert bench.step(dt_ns=0).roll_us == 1500
    assert bench.step(dt_ns=MS).roll_us == 1504
    assert bench.step(dt_ns=100_000).roll_us == 1504, "rounded towards neutral"


def test_a_stick_a_microsecond_away_stays_there_though_no_time_has_passed() -> None:
    bench = Bench()
    bench.reach(1501, 1489, 1510, 1505)
    assert bench.step(dt_ns=0).widths_us == (1501, 1489, 1510, 1505)


def test_widths_are_whole_microseconds() -> None:
    bench = Bench()
    bench.offer(1510.6, 1480.4, 1510.5, 1505.0)
    assert bench.step().widths_us == (1511, 1480, 1510, 1505)


@pytest.mark.parametrize("state", [State.BRAKING, State.HOLD])
def test_holding_states_send_neutral_and_forget_what_was_offered(state: State) -> None:
    bench = Bench()
    bench.reach(*AWAY)
    bench.offer(*AWAY)
    out = bench.step(state, reason=Reason.DEPTH_STALE)
    assert out == GateOutput(bench.now_ns, state, Action.NEUTRAL, Reason.DEPTH_STALE, *NEUTRAL)
    bench.offer(*AWAY)
    assert bench.step(state).action is Action.NEUTRAL


@pytest.mark.parametrize("state", [state for state in State if state not in HOLDING])
def test_who_held_the_sticks_releases_them_in_any_other_state(state: State) -> None:
    bench = Bench()
    out = bench.step(state, reason=Reason.DISARMED)
    assert out == GateOutput(bench.now_ns, state, Action.RELEASE, Reason.DISARMED)
    assert bench.sent[-1] is out
    assert not bench.gate.silent


@pytest.mark.parametrize("state", [state for state in State if state not in HOLDING])
def test_who_held_no_stick_says_nothing(state: State) -> None:
    gate = Gate(lambda out: pytest.fail("nothing may be sent"))
    gate.set_limits(LIMITS)
    assert EFFECTS[state] in (Action.SILENT, Action.RELEASE)
    assert gate.step(state, Reason.READY, S) == GateOutput(S, state, Action.SILENT, Reason.READY)
    assert gate.silent


@pytest.mark.parametrize("state", State)
def test_release_always_passes(state: State) -> None:
    bench = Bench()
    bench.step(state)
    out = bench.gate.release(state, Reason.SWITCH_OFF, bench.now_ns)
    assert out == GateOutput(bench.now_ns, state, Action.RELEASE, Reason.SWITCH_OFF)
    assert bench.sent[-1] is out


def test_release_passes_before_the_limits_are_known() -> None:
    sent: list[GateOutput] = []
    gate = Gate(sent.append)
    assert gate.release(State.RELEASED, Reason.SHUTDOWN, 0).action is Action.RELEASE
    assert [out.action for out in sent] == [Action.RELEASE]


def test_a_release_is_repeated_for_its_time_and_then_there_is_silence() -> None:
    bench = Bench()
    bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
    actions = [bench.step(State.PILOT).action for _ in range(60)]
    assert actions == [Action.RELEASE] * 50 + [Action.SILENT] * 10
    assert bench.gate.silent
    assert bench.sent[-1].action is Action.RELEASE


def test_a_release_is_repeated_though_the_loop_is_slow() -> None:
    bench = Bench()
    bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
    actions = [bench.step(State.PILOT, dt_ns=2 * S).action for _ in range(RELEASE_REPEATS + 5)]
    assert actions == [Action.RELEASE] * (RELEASE_REPEATS - 1) + [Action.SILENT] * 6


def test_a_second_release_is_repeated_as_often_as_the_first_though_the_loop_is_slow() -> None:
    bench = Bench()
    for _ in range(2):
        bench.step(State.HOLD)
        bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
        actions = [bench.step(State.PILOT, dt_ns=2 * S).action for _ in range(RELEASE_REPEATS + 5)]
        assert actions.count(Action.RELEASE) == RELEASE_REPEATS - 1


def test_a_release_ends_though_the_clock_went_back() -> None:
    bench = Bench()
    bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
    bench.step(State.PILOT, dt_ns=-500 * S)
    actions = [bench.step(State.PILOT).action for _ in range(RELEASE_REPEATS)]
    assert actions[-1] is Action.SILENT


def test_a_release_is_repeated_in_a_silent_state_too() -> None:
    bench = Bench()
    bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
    assert bench.step(State.PREFLIGHT).action is Action.RELEASE


def test_a_second_release_is_repeated_as_long_as_the_first() -> None:
    bench = Bench()
    for _ in range(2):
        bench.step(State.HOLD)
        bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
        assert sum(bench.step(State.PILOT).action is Action.RELEASE for _ in range(80)) == 50


def test_holding_again_ends_the_release() -> None:
    bench = Bench()
    bench.gate.release(State.PILOT, Reason.SWITCH_OFF, bench.now_ns)
    assert bench.step(State.HOLD).action is Action.NEUTRAL
    assert bench.step(State.ENGAGED).action is Action.NEUTRAL
    assert not bench.gate.silent


def test_an_offer_does_not_outlive_a_release() -> None:
    bench = Bench()
    bench.offer(*AWAY)
    bench.gate.release(State.ENGAGED, Reason.SWITCH_OFF, bench.now_ns)
    assert bench.step(State.ENGAGED).action is Action.NEUTRAL


def test_after_a_release_the_sticks_start_from_neutral() -> None:
    bench = Bench()
    bench.reach(1900, 1490, 1510, 1505)
    bench.gate.release(State.ENGAGED, Reason.SWITCH_OFF, bench.now_ns)
    bench.offer(1900, 1490, 1510, 1505)
    assert bench.step().roll_us == 1500 + SLOW_US


def test_new_limits_count_from_the_next_period_on() -> None:
    bench = Bench()
    bench.reach(1900, 1490, 1510, 1505)
    bench.gate.set_limits(StickLimits((1200,) * 4, (1700,) * 4, (1450,) * 4))
    bench.offer(1900, 1490, 1510, 1505)
    assert bench.step().widths_us == (1700, 1490, 1510, 1505)
    assert bench.step(State.HOLD).widths_us == (1450,) * 4


@pytest.mark.parametrize(
    "wrong",
    [
        {"minimum": (799, 1010, 1020, 1030)},
        {"maximum": (2201, 1990, 1980, 1970)},
        {"neutral": (999, 1490, 1510, 1505)},
        {"neutral": (1500, 1490, 1981, 1505)},
        {"minimum": (1000, 1010, 1020)},
        {"maximum": (2000, 1990, math.nan, 1970)},
        {"slew_us_s": 0.0},
        {"slew_us_s": -1.0},
        {"slew_us_s": math.inf},
        {"slew_us_s": math.nan},
    ],
)
def test_limits_that_no_radio_has_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises((DeviceError, ValueError)):
        replace(LIMITS, **wrong)  # type: ignore[arg-type]


def test_the_widest_limits_are_taken() -> None:
    widest = StickLimits((800,) * 4, (2200,) * 4, (800, 2200, 1500, 1500))
    assert widest.neutral == (800, 2200, 1500, 1500)
    assert widest.slew_us_s == 4000.0
    assert replace(LIMITS, slew_us_s=1.0).slew_us_s == 1.0
    with pytest.raises(DeviceError, match=r"ranges from 1500 over 1400 to 1600 us.*calibrate the radio"):
        StickLimits((1500,) * 4, (1600,) * 4, (1400,) * 4)
