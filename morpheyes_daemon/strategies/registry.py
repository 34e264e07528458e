"""Strategies by name: those of the package, and others through the entry point group `morpheyes.strategies`."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from pydantic import BaseModel, create_model

from morpheyes_daemon.config.vehicle import MissionFile
from morpheyes_daemon.config.yaml_errors import line_of, validate
from morpheyes_daemon.config.yaml_reader import compose, read_text
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.strategies.base import Strategy, StrategyParameters

BUILT_IN = {
    "forest": "morpheyes_daemon.strategies.forest.strategy:Forest",
    "imo": "morpheyes_daemon.strategies.imo.strategy:Imo",
    "gap": "morpheyes_daemon.strategies.gap.strategy:Gap",
}


def strategy_names() -> list[str]:
    """Return the names of all strategies that a mission file may use."""
    return sorted({*BUILT_IN, *(point.name for point in entry_points(group="morpheyes.strategies"))})


def find_strategy(name: str) -> type[Strategy]:
    """Return the class of a strategy; raises ConfigError naming the strategies that exist."""
    if name in BUILT_IN:
        module, _, attribute = BUILT_IN[name].partition(":")
        found = getattr(import_module(module), attribute)
    else:
        points = [point for point in entry_points(group="morpheyes.strategies") if point.name == name]
        if not points:
            raise ConfigError(f"there is no strategy {name!r}; there are: {', '.join(strategy_names())}.")
        try:
            found = points[0].load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"the strategy {name!r} cannot be loaded: {error}.") from error
    if not (isinstance(found, type) and issubclass(found, Strategy)):
        raise ConfigError(
            f"the strategy {name!r} is not a subclass of morpheyes_daemon.strategies.base.Strategy;"
            " correct its entry point."
        )
    return found


def check_mission(path: Path, mission: MissionFile) -> MissionFile:
    """Return the mission when its strategy exists and takes its parameters; raises ConfigError naming the line."""
    root = compose(read_text(path), str(path))
    try:
        kind = find_strategy(mission.strategy)
    except ConfigError as error:
        raise ConfigError(f"{path}:{line_of(root, 'strategy')}: strategy: {error}") from None
    validate({"parameters": mission.parameters}, _wrapped(kind.Parameters), str(path), root)
    return mission


def _wrapped(parameters: type[StrategyParameters]) -> type[BaseModel]:
    """Return a model with one key `parameters`, so that errors name the lines of the mission file."""
    return create_model("Parameters", parameters=(parameters, ...))
