"""A three-cell battery, as far as a failsafe needs one."""

from __future__ import annotations

import random

_FULL_V, _EMPTY_V = 12.6, 9.9
_CAPACITY_AH = 1.5
_FLYING_A, _IDLE_A = 9.0, 0.6
_SAG_OHM = 0.03


class Battery:
    """Charge, voltage and current; `drop_to` empties it for a test of the failsafe."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(f"battery {seed}")
        self.fraction = 1.0
        self.current_a = _IDLE_A
        self.voltage_v = _FULL_V
        self._low_s = 0.0
        self._failed = False
        self._dt_s = 0.0

    def drop_to(self, fraction: float) -> None:
        """Set the remaining charge, 0 to 1."""
        self.fraction = max(0.0, min(1.0, fraction))

    @property
    def low(self) -> bool:
        """The low-voltage failsafe has been triggered."""
        return self._failed

    def advance(self, dt_s: float, *, flying: bool) -> None:
        """Draw current for `dt_s`."""
        self.current_a = (_FLYING_A if flying else _IDLE_A) * (1.0 + 0.02 * self._random.gauss())
        self.fraction = max(0.0, self.fraction - self.current_a * dt_s / 3600.0 / _CAPACITY_AH)
        self.voltage_v = _EMPTY_V + (_FULL_V - _EMPTY_V) * self.fraction - _SAG_OHM * self.current_a
        self._dt_s = dt_s

    def new_failsafe(self, low_v: float, timer_s: float) -> bool:
        """Return True once, when the voltage has been below `low_v` for `timer_s`; call once per advance."""
        if self._failed or low_v <= 0.0:
            return False
        self._low_s = self._low_s + self._dt_s if self.voltage_v < low_v else 0.0
        self._failed = self._low_s > timer_s
        return self._failed
