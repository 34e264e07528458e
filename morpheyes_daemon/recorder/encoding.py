"""Messages to plain JSON values and back, for any dataclass, so that a new message is logged without new code.

Not a number is null, infinities are the strings "inf" and "-inf", since JSON has neither. Rows of up to 64 numbers
are lists that a viewer can plot, other arrays a block of base64 with their shape. A value whose field does not say
its type carries it under "_type". Camera images are left out: the log keeps them apart, small and compressed.
"""

from __future__ import annotations

import base64
import importlib
import math
import sys
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from morpheyes_daemon.errors import RecordingError
from morpheyes_daemon.messages.core import Perception, StereoFrame
from morpheyes_daemon.messages.mission import Observation

LARGEST_LIST = 64
LARGEST_WHOLE = 2**64
"""Stamps, counts and numbers of messages are smaller."""
OMITTED: Mapping[type, frozenset[str]] = {
    StereoFrame: frozenset({"left", "right"}),
    Perception: frozenset({"left_rect", "depth_m"}),
    Observation: frozenset({"percept"}),
}
"""Fields that are never encoded: full images, and what another channel holds already."""


def to_plain(value: Any) -> Any:
    """Return `value` made of dict, list, str, int, float, bool and None only; what is unknown becomes its repr."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, Enum):
        return to_plain(value.value)
    if isinstance(value, (int, str)):
        return value
    if isinstance(value, float):
        return _plain_float(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _plain_dataclass(value)
    return _plain_container(value)


def _plain_float(value: float) -> float | str | None:
    if math.isfinite(value):
        return float(value)
    return None if math.isnan(value) else ("inf" if value > 0 else "-inf")


def _plain_dataclass(value: Any) -> dict[str, Any]:
    cls: type = type(value)
    return {
        name: to_plain_any(getattr(value, name)) if untyped else to_plain(getattr(value, name))
        for name, untyped in _kept_fields(cls)
    }


def to_plain_any(value: Any) -> Any:
    """`to_plain`, with the type's name inside when it is a dataclass."""
    plain = to_plain(value)
    if isinstance(plain, dict) and is_dataclass(value):
        return {"_type": type_name(type(value)), **plain}
    return plain


@cache
def _kept_fields(cls: type) -> tuple[tuple[str, bool], ...]:
    hints = type_hints(cls)
    omitted = OMITTED.get(cls, frozenset())
    return tuple((f.name, hints.get(f.name) is Any) for f in fields(cls) if f.name not in omitted)


def _plain_container(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain_array(value)
    if isinstance(value, np.generic):
        return to_plain(value.item())
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(key): to_plain_any(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain_any(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted((to_plain(item) for item in value), key=repr)
    return repr(value)


def _plain_array(array: NDArray[Any]) -> Any:
    if array.ndim == 1 and array.size <= LARGEST_LIST and array.dtype.kind in "biuf":
        return to_plain(array.tolist())
    data = np.ascontiguousarray(array)
    block = base64.b64encode(data.tobytes()).decode("ascii")
    return {"dtype": array.dtype.str, "shape": list(array.shape), "base64": block}


def type_name(cls: type) -> str:
    """Return the name under which `cls` stands in a log."""
    return f"{cls.__module__}.{cls.__qualname__}"


def find_type(name: str) -> type | None:
    """Return the dataclass called `name`; None when it is not ours and nobody has imported it.

    A log is data: it may name a type that is already loaded, or one of this package, and load nothing else.
    """
    module_name, _, class_name = name.rpartition(".")
    if module_name not in sys.modules and module_name.startswith("morpheyes_daemon."):
        try:
            importlib.import_module(module_name)
        except ImportError:
            return None
    found = getattr(sys.modules.get(module_name), class_name, None)
    return found if isinstance(found, type) and is_dataclass(found) else None


@cache
def type_hints(cls: type) -> dict[str, Any]:
    """Return the resolved type of each field; Any where an annotation cannot be resolved."""
    try:
        return typing.get_type_hints(cls)
    except NameError:
        return dict.fromkeys((f.name for f in fields(cls)), Any)


def from_plain(plain: Any, hint: Any) -> Any:
    """Return the value of type `hint` that `to_plain` made `plain` from; raises RecordingError when it cannot be."""
    try:
        return _typed(plain, hint)
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise RecordingError(f"a recorded {getattr(hint, '__name__', hint)} cannot be read back ({error}).") from None


def _typed(plain: Any, hint: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return None if plain is None else _typed(plain, next(a for a in arguments if a is not type(None)))
    if isinstance(hint, type) and is_dataclass(hint):
        return _typed_dataclass(plain, hint)
    if origin is np.ndarray or hint is np.ndarray:
        return _typed_array(plain, arguments)
    if origin in (tuple, list):
        return origin(_typed_items(plain, arguments, origin))
    if origin is dict:
        return {key: _typed(item, arguments[1]) for key, item in plain.items()}
    return _typed_scalar(plain, hint)


def _typed_items(plain: list[Any], arguments: tuple[Any, ...], origin: Any) -> list[Any]:
    if origin is tuple and arguments and arguments[-1] is not Ellipsis:
        return [_typed(item, hint) for item, hint in zip(plain, arguments, strict=True)]
    return [_typed(item, arguments[0] if arguments else Any) for item in plain]


def _typed_scalar(plain: Any, hint: Any) -> Any:
    if hint is float:
        return math.nan if plain is None else float(plain)
    if hint is int:
        return _whole(plain)
    if isinstance(hint, type) and issubclass(hint, (Enum, int, str)):
        return hint(plain)
    return _typed_unsaid(plain)


def _whole(plain: Any) -> int:
    """Return a whole number that arithmetic with floats can bear; ValueError for any other."""
    number = int(plain)
    if abs(number) > LARGEST_WHOLE:
        raise ValueError("a number too large")
    return number


def _typed_unsaid(plain: Any) -> Any:
    """A value whose field does not say its type: it may say so itself."""
    if isinstance(plain, list):
        return [_typed_unsaid(item) for item in plain]
    if not isinstance(plain, dict):
        return plain
    if "base64" in plain:
        return _typed_array(plain, ())
    cls = find_type(str(plain.get("_type", "")))
    if cls is not None:
        return _typed_dataclass(plain, cls)
    return {key: _typed_unsaid(item) for key, item in plain.items()}


def _typed_array(plain: Any, arguments: tuple[Any, ...]) -> NDArray[Any]:
    if isinstance(plain, dict):
        array = np.frombuffer(base64.b64decode(plain["base64"]), dtype=np.dtype(plain["dtype"]))
        return array.reshape(plain["shape"])
    dtype = typing.get_args(arguments[1])[0] if len(arguments) == 2 and typing.get_args(arguments[1]) else None
    array = np.array(plain, dtype=dtype if isinstance(dtype, type) else None)
    array.flags.writeable = False
    return array


def _typed_dataclass(plain: Mapping[str, Any], cls: type) -> Any:
    hints = type_hints(cls)
    values = {f.name: _typed(plain[f.name], hints[f.name]) for f in fields(cls) if f.init and f.name in plain}
    for f in fields(cls):
        if f.init and f.name not in values and _has_no_default(f):
            if f.name not in OMITTED.get(cls, ()):
                raise KeyError(f"{f.name} is missing, another version wrote it")
            values[f.name] = None
    return cls(**values)


def _has_no_default(f: Field[Any]) -> bool:
    return f.default is MISSING and f.default_factory is MISSING
