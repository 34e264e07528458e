"""Device families: a table name -> backend, open to other packages by entry point, each backend loaded when named.

A backend is a class with `from_config(config, context)`. The backends of this package have configurations of their
own in `config.vehicle`; one of another package declares `Options`, a pydantic model, for the `options` of its
`PluginCameraConfig` or `PluginServoConfig`, and is found through the entry point group
`morpheyes.cameras`, `morpheyes.servos` or `morpheyes.autopilots`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import PluginConfig
from morpheyes_daemon.config.yaml_errors import validate
from morpheyes_daemon.devices.link import LinkOpener, open_link
from morpheyes_daemon.errors import ConfigError


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """What a backend may use: the clock, where it reports losses and recoveries, how links are opened."""

    clock: Clock
    events: EventLog
    topics: Topics
    opener: LinkOpener = open_link

    @classmethod
    def alone(cls, clock: Clock, opener: LinkOpener = open_link) -> DeviceContext:
        """Return a context for one device outside the daemon, whose events nobody hears."""
        return cls(clock, EventLog(), Topics.create(), opener)


@dataclass(frozen=True, slots=True)
class Family:
    """One kind of device; `built_in` names `module:Class` of each backend of this package."""

    name: str
    built_in: Mapping[str, str]

    @property
    def group(self) -> str:
        """Entry point group through which other packages add backends."""
        return f"morpheyes.{self.name}s"

    def names(self) -> list[str]:
        """Return every backend that is installed."""
        return sorted({*self.built_in, *(point.name for point in entry_points(group=self.group))})

    def load(self, backend: str) -> Any:
        """Return a backend's class; raises ConfigError naming those that are installed."""
        if backend in self.built_in:
            module, _, attribute = self.built_in[backend].partition(":")
            return getattr(import_module(module), attribute)
        points = [point for point in entry_points(group=self.group) if point.name == backend]
        if not points:
            raise ConfigError(
                f"{self.name}.backend: there is no backend {backend!r}; installed are: {', '.join(self.names())}."
            )
        try:
            return points[0].load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"{self.name}.backend: {backend!r} cannot be loaded: {error}.") from error

    def build(self, config: Any, context: DeviceContext) -> Any:
        """Return the configured backend, not yet open; raises ConfigError for one that can never work."""
        backend = self.load(config.backend)
        if isinstance(config, PluginConfig) and hasattr(backend, "Options"):
            options = validate(config.options, backend.Options, f"{self.name}.options", None)
            config = config.model_copy(update={"options": options})
        return backend.from_config(config, context)
