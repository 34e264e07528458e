"""A critically damped second-order lag: the lean response of the airframe."""

from __future__ import annotations

GRAVITY_M_S2 = 9.80665


LEAN_LAG_S = 0.075
"""Both poles of the lean response; from recorded steps."""


class SecondOrder:
    """A critically damped second-order lag."""

    __slots__ = ("_rate", "_w", "value")

    def __init__(self, lag_s: float, value: float = 0.0) -> None:
        self._w = 1.0 / lag_s
        self._rate = 0.0
        self.value = value

    def step(self, target: float, dt_s: float) -> float:
        """Move towards `target` for `dt_s` and return the new value."""
        self._rate += (self._w * self._w * (target - self.value) - 2.0 * self._w * self._rate) * dt_s
        self.value += self._rate * dt_s
        return self.value

    def reset(self, value: float) -> None:
        """Come to rest at `value`."""
        self.value, self._rate = value, 0.0
