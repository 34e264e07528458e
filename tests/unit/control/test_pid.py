"""PID: the three terms, the bounds and what the integral does at them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.control.pid import Pid, PidGains


def test_terms_add_up() -> None:
    pid = Pid(PidGains(kp=2.0, ki=0.5, kd=0.1))
    assert pid.step(1.0, 0.1) == pytest.approx(2.0 + 0.05)
    assert pid.step(2.0, 0.1, feed_forward=1.0) == pytest.approx(1.0 + 4.0 + 0.15 + 1.0)


def test_saturated_output_does_not_wind_the_integral_up() -> None:
    pid = Pid(PidGains(kp=1.0, ki=1.0))
    for _ in range(1000):
        assert pid.step(5.0, 0.1, high=1.0) == 1.0
    assert pid.integral == 0.0
    assert pid.step(-0.5, 0.1, low=-1.0, high=1.0) < 0.0


def test_integral_unwinds_while_saturated() -> None:
    pid = Pid(PidGains(kp=0.0, ki=1.0))
    for _ in range(20):
        pid.step(1.0, 0.1)
    before = pid.integral
    pid.step(-1.0, 0.1, high=0.5)
    assert pid.integral < before


def test_wrong_time_step_is_refused() -> None:
    with pytest.raises(ValueError, match="dt_s > 0"):
        Pid(PidGains(1.0)).step(1.0, 0.0)


@given(
    st.lists(st.floats(-100, 100), min_size=1, max_size=50),
    st.floats(0.001, 1.0),
    st.floats(-5, 0),
    st.floats(0, 5),
)
def test_output_stays_in_bounds(errors: list[float], dt_s: float, low: float, high: float) -> None:
    pid = Pid(PidGains(kp=3.0, ki=2.0, kd=0.2, i_limit=4.0))
    for error in errors:
        assert low <= pid.step(error, dt_s, low, high) <= high
        assert abs(pid.integral) <= 4.0
