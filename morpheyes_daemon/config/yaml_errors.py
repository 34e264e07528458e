"""YAML files into strict models, with errors that name file, line, key, what was found and what is allowed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from morpheyes_daemon.config.yaml_reader import parse_yaml, read_text
from morpheyes_daemon.errors import ConfigError

__all__ = ["line_of", "load_model", "parse_model", "parse_yaml", "read_text", "validate"]

MOST_SENTENCES = 20
LONGEST_KEY = 80

M = TypeVar("M", bound=BaseModel)


def load_model(path: Path, model: type[M]) -> M:
    """Read `path` and check it against `model`; raises ConfigError naming the line."""
    text = read_text(path)
    return parse_model(text, model, str(path))


def parse_model(text: str, model: type[M], name: str) -> M:
    """Check YAML `text` against `model`; `name` stands for the file in errors."""
    data, root = parse_yaml(text, name)
    return validate(data, model, name, root)


def validate(data: Any, model: type[M], name: str, root: yaml.Node | None) -> M:
    """Build `model` from `data`; every violation becomes one line of the ConfigError, up to MOST_SENTENCES.

    Strict: neither a boolean nor a text is taken for a number. It goes through JSON, since pydantic's strictness is
    then about what a file can say: a list may still be a tuple, a word an enum or a path.
    """
    try:
        return model.model_validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        problems = error.errors()
        lines = [_sentence(dict(problem), name, root) for problem in problems[:MOST_SENTENCES]]
        if len(problems) > MOST_SENTENCES:
            lines.append(f"{name}: and {len(problems) - MOST_SENTENCES} more of the kind.")
        raise ConfigError("\n".join(lines)) from None


def _sentence(problem: dict[str, Any], name: str, root: yaml.Node | None) -> str:
    location = [str(part) for part in problem["loc"]]
    keys, line = _find(location, root) if root is not None else (location, None)
    where = f"{name}:{line}" if line else name
    key = _shortened(".".join(keys)) or "the file"
    if problem["type"] == "extra_forbidden":
        return f"{where}: {key}: there is no such key."
    if problem["type"] == "missing":
        return f"{where}: {_shortened('.'.join(location))}: is missing."
    allowed = problem["msg"].removeprefix("Value error, ")
    allowed = allowed[0].lower() + allowed[1:]
    if problem["type"] == "value_error" and isinstance(problem.get("input"), dict):
        return f"{where}: {key}: {allowed}."  # about several keys, which the sentence names
    found = repr(problem.get("input"))
    found = found if len(found) < 60 else found[:57] + "..."
    return f"{where}: {key}: found {found}; {allowed}."


def _shortened(key: str) -> str:
    return key if len(key) <= LONGEST_KEY else key[:LONGEST_KEY] + "..."


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
