"""A recorded flight decided again: the same observations through the same strategy, commands compared.

What comes out differently was changed by the code, the mission file or the configuration since. Only `decide` is
replayed; images and the vehicle are as they were recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import MissionCommand, Perception
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.perception.craft import build_strategy
from morpheyes_daemon.recorder.encoding import to_plain
from morpheyes_daemon.recorder.reader import Flight, read_flight, read_header
from morpheyes_daemon.strategies.base import Strategy


@dataclass(frozen=True, slots=True)
class Difference:
    """One command that came out differently: when, and of each field what was recorded and what came out now."""

    t_s: float
    fields: dict[str, tuple[Any, Any]]


@dataclass(slots=True)
class Replay:
    """The outcome: decisions replayed, those without their percept, and every difference."""

    mission: str
    decisions: int = 0
    without_percept: int = 0
    differences: list[Difference] = field(default_factory=list)


def replay(path: Path, mission: MissionFile | None = None) -> Replay:
    """Decide a recorded flight again, with the recorded mission or another one.

    Raises InputError when the log does not hold what is needed, ConfigError when its configuration is not valid now.
    """
    header = read_header(path)
    if "mission_file" not in header or "config" not in header:
        raise InputError(f"{path}: holds no mission and configuration, so it cannot be replayed.")
    flown = mission or MissionFile.model_validate_json(header["mission_file"])
    strategy = build_strategy(flown, VehicleConfig.model_validate_json(header["config"]))
    flight = read_flight(path)
    if not flight.values("observation"):
        raise InputError(f"{path}: no decision was recorded in it; a flight that engaged has some.")
    return _decided_again(flight, strategy, Replay(flown.strategy))


def _decided_again(flight: Flight, strategy: Strategy, result: Replay) -> Replay:
    percepts: dict[int, Perception] = {seen.summary.seq: seen for seen in flight.values("perception")}
    start_ns = flight.records[0].log_ns
    now: MissionCommand | None = None
    for record in flight.records:
        if isinstance(record.value, Observation):
            seen = percepts.get(record.value.summary.seq)
            result.without_percept += seen is None
            now = strategy.decide(replace(record.value, percept=seen.percept)) if seen is not None else None
        elif isinstance(record.value, MissionCommand) and now is not None:
            result.decisions += 1
            changed = _compared(to_plain(record.value), to_plain(now))
            if changed:
                result.differences.append(Difference((record.log_ns - start_ns) / S, changed))
            now = None
    return result


def _compared(recorded: dict[str, Any], replayed: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    return {name: (was, replayed[name]) for name, was in recorded.items() if replayed[name] != was}
