"""JSON schemas of the log's channels: ours derived from the dataclasses, Foxglove's where a viewer knows them.

Foxglove's are written down from its public list of message schemas, reduced to names and types.
"""

from __future__ import annotations

import json
import types
import typing
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.recorder.encoding import OMITTED, type_hints, type_name

_TIME = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_TEXT = {"type": "string"}


def _numbers(names: str) -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": "number"} for name in names}}


_FOXGLOVE: dict[str, dict[str, Any]] = {
    "foxglove.CompressedImage": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": _TEXT,
    },
    "foxglove.PoseInFrame": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "pose": {"type": "object", "properties": {"position": _numbers("xyz"), "orientation": _numbers("xyzw")}},
    },
    "foxglove.FrameTransform": {
        "timestamp": _TIME,
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _numbers("xyz"),
        "rotation": _numbers("xyzw"),
    },
    "foxglove.Log": {
        "timestamp": _TIME,
        "level": {"type": "integer"},
        "message": _TEXT,
        "name": _TEXT,
        "file": _TEXT,
        "line": {"type": "integer"},
        "event": {"type": "object", "title": "morpheyes_daemon.messages.core.Event"},
    },
}


@cache
def schema_text(name: str) -> bytes:
    """Return the JSON schema of one of Foxglove's messages."""
    return _as_bytes({"title": name, "type": "object", "properties": _FOXGLOVE[name]})


@cache
def dataclass_schema(cls: type) -> bytes:
    """Return the JSON schema of what `encoding.to_plain` makes of a dataclass."""
    return _as_bytes(_schema(cls))


def timestamp(t_ns: int) -> dict[str, int]:
    """Return Foxglove's time of a stamp."""
    return {"sec": t_ns // S, "nsec": t_ns % S}


def _as_bytes(schema: dict[str, Any]) -> bytes:
    return json.dumps(schema).encode()


def _schema(hint: Any) -> dict[str, Any]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _schema(next(a for a in arguments if a is not type(None)))
    if isinstance(hint, type) and is_dataclass(hint):
        hints = type_hints(hint)
        kept = [f.name for f in fields(hint) if f.name not in OMITTED.get(hint, ())]
        return {"title": type_name(hint), "type": "object", "properties": {n: _schema(hints[n]) for n in kept}}
    if origin in (tuple, list) or origin is np.ndarray:
        item = arguments[0] if arguments and origin is not np.ndarray else float
        return {"type": "array", "items": _schema(item)}
    return _scalar_schema(hint)


def _scalar_schema(hint: Any) -> dict[str, Any]:
    if hint is bool:
        return {"type": "boolean"}
    if hint is int:
        return {"type": "integer"}
    if hint is float:
        return {"type": "number"}
    if hint is str or (isinstance(hint, type) and issubclass(hint, Enum)):
        return {"type": "string"}
    return {"type": "object"}
