"""Files that come with the package: missions, the example configuration, the systemd unit.

In a checkout they lie at the top level; in an installed wheel inside the package. Names win over nothing: a path
that exists is taken as a path.
"""

from __future__ import annotations

from pathlib import Path

from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.config.yaml_errors import load_model

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped(name: str) -> Path:
    """Return the path of a shipped file or folder such as `missions` or `config.yaml`."""
    inside = _PACKAGE / "shipped" / name
    return inside if inside.exists() else _PACKAGE.parent / name


def load_config(path: Path | None) -> VehicleConfig:
    """Read and check a vehicle configuration; None takes ./config.yaml or the shipped example."""
    if path is None:
        path = Path("config.yaml") if Path("config.yaml").is_file() else shipped("config.yaml")
    return load_model(path, VehicleConfig)
