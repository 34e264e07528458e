"""`morpheyes config`: check and show configuration and mission files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Check and show configuration and mission files.", no_args_is_help=True, rich_markup_mode=None)


@app.command()
def check(
    files: Annotated[
        list[Path] | None, typer.Argument(help="Files to check; default: ./config.yaml and every shipped mission.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Check configuration and mission files; errors name file, line, key, what was found and what is allowed."""
    from morpheyes_daemon.config.packaged import load_config, shipped
    from morpheyes_daemon.errors import ConfigError
    from morpheyes_daemon.strategies.missions import find_mission, load_mission, mission_names

    if not files:
        own = Path("config.yaml")
        files = [own if own.is_file() else shipped("config.yaml"), *(find_mission(name) for name in mission_names())]
    errors: dict[str, list[str]] = {}
    for file in files:
        try:
            load_mission(str(file)) if _is_mission(file) else load_config(file)
            errors[str(file)] = []
        except ConfigError as error:
            errors[str(file)] = str(error).splitlines()
    if as_json:
        rows = [{"file": name, "ok": not found, "errors": found} for name, found in errors.items()]
        typer.echo(json.dumps(rows, indent=2))
    else:
        for name, found in errors.items():
            typer.echo("\n".join(found) or f"{name}: valid", err=bool(found))
    if any(errors.values()):
        raise typer.Exit(2)


@app.command()
def show(
    file: Annotated[
        Path | None, typer.Argument(help="config.yaml or a mission; default: the configuration in use.")
    ] = None,
    keys: Annotated[bool, typer.Option("--keys", help="List every key with its bounds and meaning.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Show a file with all defaults, or with --keys the bounds and meaning of each key."""
    import yaml

    from morpheyes_daemon.config.packaged import load_config
    from morpheyes_daemon.config.vehicle import VehicleConfig
    from morpheyes_daemon.strategies.missions import load_mission
    from morpheyes_daemon.strategies.registry import find_strategy

    if file is not None and _is_mission(file):
        mission = load_mission(str(file))
        kind = find_strategy(mission.strategy).Parameters
        filled = kind.model_validate(mission.parameters).model_dump(mode="json")
        content = {**mission.model_dump(mode="json"), "parameters": filled}
        model: type = kind
    else:
        content, model = load_config(file).model_dump(mode="json"), VehicleConfig
    if keys:
        rows = list(_rows(model, ""))
        typer.echo(json.dumps(rows, indent=2) if as_json else "\n".join(_line(row) for row in rows))
    else:
        typer.echo(json.dumps(content, indent=2) if as_json else yaml.safe_dump(content, sort_keys=False).rstrip())


def _is_mission(file: Path) -> bool:
    """Return whether a file is a mission: it names a strategy; everything else is a vehicle configuration."""
    import yaml

    from morpheyes_daemon.config.yaml_reader import parse_yaml, read_text

    if not file.suffix:
        return not file.is_file()
    data, root = parse_yaml(read_text(file), str(file))
    return isinstance(data, dict) and "strategy" in data and isinstance(root, yaml.MappingNode)


def _rows(model: type, prefix: str) -> list[dict[str, str]]:
    from typing import get_args

    from pydantic import BaseModel

    rows: list[dict[str, str]] = []
    if not issubclass(model, BaseModel):
        return rows
    for name, field in model.model_fields.items():
        kinds = [field.annotation, *get_args(field.annotation)]
        nested = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        if nested:
            for kind in nested:
                label = f"{prefix}{name}." if len(nested) == 1 else f"{prefix}{name} ({kind.__name__})."
                rows += _rows(kind, label)
            continue
        bounds = ", ".join(str(bound) for bound in field.metadata if any(c in str(bound) for c in "gl"))
        default = "required" if field.is_required() else repr(field.get_default(call_default_factory=True))
        rows.append({"key": prefix + name, "default": default, "bounds": bounds, "meaning": field.description or ""})
    return rows


def _line(row: dict[str, str]) -> str:
    bounds = f" [{row['bounds']}]" if row["bounds"] else ""
    meaning = f"  # {row['meaning']}" if row["meaning"] else ""
    return f"{row['key']}: {row['default']}{bounds}{meaning}"
