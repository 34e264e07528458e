"""Switches on RC channels that act through RCn_OPTION, as far as the twin knows their functions."""

from __future__ import annotations

from enum import IntEnum

from morpheyes_daemon.simulation.autopilot.parameters import CHANNELS, ParameterTable

_SETTLE_NS = 200_000_000
_LOW_US, _HIGH_US = 1200, 1800


class AuxFunction(IntEnum):
    """RCn_OPTION and MAV_CMD_DO_AUX_FUNCTION numbers."""

    AVOID_PROXIMITY = 40
    RC_OVERRIDE_ENABLE = 46


class Position(IntEnum):
    """AuxSwitchPos."""

    LOW = 0
    MIDDLE = 1
    HIGH = 2


def position_of(pulse_us: int) -> Position | None:
    """Return where a three-position switch stands; None for no signal."""
    if not 900 < pulse_us < 2200:
        return None
    if pulse_us < _LOW_US:
        return Position.LOW
    return Position.HIGH if pulse_us > _HIGH_US else Position.MIDDLE


class AuxSwitches:
    """Reports each switch once when it has settled on a new position."""

    def __init__(self, table: ParameterTable) -> None:
        self._table = table
        self._version = -1
        self._functions: dict[int, AuxFunction] = {}
        self._settled: dict[int, Position] = {}
        self._candidates: dict[int, tuple[Position, int]] = {}

    def changes(self, t_ns: int, channels_us: list[int]) -> list[tuple[AuxFunction, Position]]:
        """Return what has just been switched, given the channels that the autopilot flies on."""
        if self._table.version != self._version:
            self._version = self._table.version
            self._functions = _functions(self._table)
        changed = []
        for index, function in self._functions.items():
            position = position_of(channels_us[index])
            if position is not None and self._settles(index, position, t_ns):
                changed.append((function, position))
        return changed

    def _settles(self, index: int, position: Position, t_ns: int) -> bool:
        if self._settled.get(index) is position:
            self._candidates.pop(index, None)
            return False
        candidate, since_ns = self._candidates.get(index, (None, 0))
        if candidate is not position:
            self._candidates[index] = position, t_ns
            return False
        if t_ns - since_ns < _SETTLE_NS:
            return False
        self._settled[index] = position
        return True


def _functions(table: ParameterTable) -> dict[int, AuxFunction]:
    options = {n - 1: int(table[f"RC{n}_OPTION"]) for n in range(1, CHANNELS + 1)}
    known = {int(function) for function in AuxFunction}
    return {index: AuxFunction(option) for index, option in options.items() if option in known}
