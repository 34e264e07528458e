"""YAML files into strict models, with errors that name file, line, key, what was found and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from morpheyes_daemon.errors import ConfigError

M = TypeVar("M", bound=BaseModel)


def load_model(path: Path, model: type[M]) -> M:
    """Read `path` and check it against `model`; raises ConfigError naming the line."""
    text = read_text(path)
    return parse_model(text, model, str(path))


def read_text(path: Path) -> str:
    """Read a text file; raises ConfigError with a sentence."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}).") from None


def parse_model(text: str, model: type[M], name: str) -> M:
    """Check YAML `text` against `model`; `name` stands for the file in errors."""
    data, root = parse_yaml(text, name)
    return validate(data, model, name, root)


def parse_yaml(text: str, name: str) -> tuple[Any, yaml.Node | None]:
    """Return the plain data and the node tree (for line numbers) of one YAML document."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{name}:{mark.line + 1}" if mark else name
        raise ConfigError(f"{where}: not valid YAML: {getattr(error, 'problem', None) or error}.") from None
    return ({} if data is None else data), root


def validate(data: Any, model: type[M], name: str, root: yaml.Node | None) -> M:
    """Build `model` from `data`; every violation becomes one line of the ConfigError."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines = [_sentence(dict(problem), name, root) for problem in error.errors()]
        raise ConfigError("\n".join(lines)) from None


def _sentence(problem: dict[str, Any], name: str, root: yaml.Node | None) -> str:
    location = [str(part) for part in problem["loc"]]
    keys, line = _find(location, root) if root is not None else (location, None)
    where = f"{name}:{line}" if line else name
    key = ".".join(keys) or "the file"
    if problem["type"] == "extra_forbidden":
        return f"{where}: {key}: there is no such key."
    if problem["type"] == "missing":
        return f"{where}: {'.'.join(location)}: is missing."
    allowed = problem["msg"].removeprefix("Value error, ")
    allowed = allowed[0].lower() + allowed[1:]
    if problem["type"] == "value_error" and isinstance(problem.get("input"), dict):
        return f"{where}: {key}: {allowed}."  # about several keys, which the sentence names
    found = repr(problem.get("input"))
    found = found if len(found) < 60 else found[:57] + "..."
    return f"{where}: {key}: found {found}; {allowed}."


def line_of(root: yaml.Node | None, *keys: str) -> int | None:
    """Return the line on which a nested key stands, or of the nearest one above it."""
    return _find(list(keys), root)[1]


def _find(location: list[str], root: yaml.Node | None) -> tuple[list[str], int | None]:
    """Follow `location` into the node tree; discriminator tags in it are no keys and are passed over."""
    node, keys = root, []
    line = root.start_mark.line + 1 if root is not None else None
    for part in location:
        if isinstance(node, yaml.MappingNode):
            for key_node, value_node in node.value:
                if key_node.value == part:
                    node, line = value_node, key_node.start_mark.line + 1
                    keys.append(part)
                    break
        elif isinstance(node, yaml.SequenceNode) and part.isdigit() and int(part) < len(node.value):
            node = node.value[int(part)]
            line = node.start_mark.line + 1
            keys.append(part)
    return keys, line
