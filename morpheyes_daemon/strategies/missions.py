"""Mission files: by path or by packaged name, checked together with the parameters of their strategy."""

from __future__ import annotations

from pathlib import Path

from morpheyes_daemon.config.packaged import shipped
from morpheyes_daemon.config.vehicle import MissionFile
from morpheyes_daemon.config.yaml_errors import load_model
from morpheyes_daemon.errors import ConfigError


def mission_names() -> list[str]:
    """Return the names of the missions that the package ships."""
    return sorted(path.stem for path in shipped("missions").glob("*.yaml"))


def find_mission(mission: str) -> Path:
    """Return the file of a mission given by path or by shipped name; raises ConfigError naming all missions."""
    path = Path(mission)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise ConfigError(f"{path}: there is no such mission file; check the path.")
    named = shipped("missions") / f"{mission}.yaml"
    if named.is_file():
        return named
    raise ConfigError(f"there is no mission {mission!r}; give a path or one of: {', '.join(mission_names())}.")


def load_mission(mission: str) -> MissionFile:
    """Read and check a mission, its strategy's parameters included; raises ConfigError naming the line."""
    from morpheyes_daemon.strategies.registry import check_mission

    path = find_mission(mission)
    return check_mission(path, load_model(path, MissionFile))
