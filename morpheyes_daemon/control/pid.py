"""PID control with explicit time steps and conditional anti-windup.

No clock and no units: error, output and gains are the caller's. The output is not slewed here.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PidGains:
    """Gains of u = kp e + ki ∫e dt + kd de/dt; the integral's share of the output stays within ± `i_limit`."""

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    i_limit: float = float("inf")


class Pid:
    """One loop. The integral grows only while the output is inside its bounds or the error drives it back into them."""

    def __init__(self, gains: PidGains) -> None:
        self.gains = gains
        self._integral = 0.0
        self._last_error: float | None = None

    @property
    def integral(self) -> float:
        """The integral term of the last output, in the output's unit."""
        return self._integral

    def reset(self) -> None:
        """Clear the integral and the last error."""
        self._integral = 0.0
        self._last_error = None

    def step(
        self,
        error: float,
        dt_s: float,
        low: float = float("-inf"),
        high: float = float("inf"),
        feed_forward: float = 0.0,
    ) -> float:
        """Return the output in [low, high] for `error` after `dt_s` > 0; `feed_forward` is added inside the bounds.

        Raises ValueError when `dt_s` is not positive or the bounds are crossed.
        """
        if not dt_s > 0.0 or low > high:
            raise ValueError("a PID step needs dt_s > 0 and low <= high")
        rate = 0.0 if self._last_error is None else (error - self._last_error) / dt_s
        self._last_error = error
        gains = self.gains
        proportional = feed_forward + gains.kp * error + gains.kd * rate
        grown = max(-gains.i_limit, min(gains.i_limit, self._integral + gains.ki * error * dt_s))
        output = proportional + grown
        if low <= output <= high or (output > high) == (error < 0.0):
            self._integral = grown
        return max(low, min(high, proportional + self._integral))
