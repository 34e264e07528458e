"""Strategies by name: those of the package, and others through the entry point group `morpheyes.strategies`."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points

from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.strategies.base import Strategy

BUILT_IN = {
    "forest": "morpheyes_daemon.strategies.forest:Forest",
}


def strategy_names() -> list[str]:
    """Return every strategy that can be named in a mission file."""
    return sorted({*BUILT_IN, *(point.name for point in entry_points(group="morpheyes.strategies"))})


def find_strategy(name: str) -> type[Strategy]:
    """Return the class of a strategy; raises ConfigError naming those there are."""
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
        raise ConfigError(f"the strategy {name!r} is not a subclass of morpheyes_daemon.strategies.base.Strategy.")
    return found
