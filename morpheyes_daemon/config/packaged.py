"""Files that come with the package: missions, the example configuration, the systemd unit.

In a checkout they lie at the top level; in an installed wheel inside the package. Names win over nothing: a path
that exists is taken as a path.
"""

from __future__ import annotations

from pathlib import Path

from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.config.yaml_errors import load_model
from morpheyes_daemon.errors import ConfigError

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped(name: str) -> Path:
    """Return the path of a shipped file or folder such as `missions` or `config.yaml`."""
    inside = _PACKAGE / "shipped" / name
    return inside if inside.exists() else _PACKAGE.parent / name


def mission_names() -> list[str]:
    """Return the missions that the package ships."""
    return sorted(path.stem for path in shipped("missions").glob("*.yaml"))


def find_mission(mission: str) -> Path:
    """Return the file of a mission given by path or by shipped name; raises ConfigError naming those there are."""
    path = Path(mission)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise ConfigError(f"{path}: there is no such mission file.")
    named = shipped("missions") / f"{mission}.yaml"
    if named.is_file():
        return named
    raise ConfigError(f"there is no mission {mission!r}; give a path or one of: {', '.join(mission_names())}.")


def load_mission(mission: str) -> MissionFile:
    """Read and check a mission, its strategy's parameters included; raises ConfigError naming the line."""
    from morpheyes_daemon.strategies.registry import check_mission

    path = find_mission(mission)
    return check_mission(path, load_model(path, MissionFile))


def load_config(path: Path | None) -> VehicleConfig:
    """Read and check a vehicle configuration; None takes ./config.yaml or the shipped example."""
    if path is None:
        path = Path("config.yaml") if Path("config.yaml").is_file() else shipped("config.yaml")
    return load_model(path, VehicleConfig)
