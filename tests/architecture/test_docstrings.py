"""Public functions that take or return arrays state shape and unit; those that raise say so.

A function is public when neither it nor its class begins with an underscore. It has arrays when an annotation names one
of ARRAYS. Its docstring must contain a shape such as `(N, 3)` or `(H, W)`, and a unit: a word such as `px`, `metres`,
`m/s`, `unitless`, the type of samples without a unit (`uint8`, `bool`), or a name with a unit's suffix (`range_m`).
ROOMS are the folders and modules that are finished; add a room when it is.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "morpheyes_daemon"
ROOMS = ("control", "strategies")
"""Folders or modules of the package in which no function may lack a shape, a unit, or what it raises."""

ARRAYS = {"Array", "FloatMap", "Image", "Mask", "NDArray", "Vector", "ndarray"}
DIMENSION = r"(?:\d+|[A-Za-z]|\.\.\.|[A-Z_]{2,}(?: [+-] \d)?|len\(\w+\))"
SHAPE = re.compile(rf"\({DIMENSION},(?: {DIMENSION},?)*\)|\(\.\.\.\)|any shape")
WORDS = (
    *("unitless", "uint8", "bool", "px", "pixels?", "grey levels?", "degrees", "rad", "rad/s", "radians", "%"),
    *(
        "metres?",
        "m",
        "m/s",
        "m/s2",
        "m²",
        "rad²",
        "1/m",
        "px/m",
        "px/s",
        "per px",
        "s",
        "ns",
        "seconds",
        "us",
        "Hz",
        "bytes",
    ),
)
SUFFIXED = r"\w+_(?:m|m_s|m_s2|rad|rad_s|px|s|ns|us|hz|1_m|1_s)"
UNIT = re.compile(rf"(?<![\w'/])(?:{'|'.join([*map(str, WORDS), SUFFIXED])})(?![\w/])")


@dataclass(frozen=True)
class Function:
    """A public function and where it stands."""

    place: str
    node: ast.FunctionDef | ast.AsyncFunctionDef

    @property
    def text(self) -> str:
        return ast.get_docstring(self.node) or ""


def public_functions(source: str, file: str) -> Iterator[Function]:
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from (Function(f"{file}:{part.lineno} {node.name}.{part.name}", part) for part in functions(node.body))
    yield from (Function(f"{file}:{part.lineno} {part.name}", part) for part in functions(ast.parse(source).body))


def functions(body: list[ast.stmt]) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    found = [part for part in body if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef)]
    return [part for part in found if not part.name.startswith("_") and "overload" not in names(part.decorator_list)]


def names(nodes: list[ast.expr]) -> set[str]:
    parts = [part for node in nodes for part in ast.walk(node)]
    return {part.id for part in parts if isinstance(part, ast.Name)} | {
        part.attr for part in parts if isinstance(part, ast.Attribute)
    }


def has_arrays(function: Function) -> bool:
    arguments = function.node.args
    annotations = [a.annotation for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return bool(ARRAYS & names([a for a in (*annotations, function.node.returns) if a is not None]))


def raised(function: Function) -> set[str]:
    """Names of the exceptions that the function's own body raises anew."""
    raises = [part.exc for part in ast.walk(function.node) if isinstance(part, ast.Raise) and part.exc is not None]
    calls = [part.func for part in raises if isinstance(part, ast.Call)]
    return {part.id for part in calls if isinstance(part, ast.Name) and part.id.endswith("Error")}


def array_faults(function: Function) -> list[str]:
    missing = [what for what, rule in (("shape", SHAPE), ("unit", UNIT)) if not rule.search(function.text)]
    return [f"{function.place}: no {what}" for what in missing]


def raise_faults(function: Function) -> list[str]:
    return [
        f"{function.place}: does not say that it raises {e}" for e in sorted(raised(function)) if e not in function.text
    ]


def of_the_rooms() -> list[Function]:
    places = [PACKAGE / room for room in ROOMS]
    files = [file for place in places for file in (sorted(place.rglob("*.py")) if place.is_dir() else [place])]
    return [f for file in files for f in public_functions(file.read_text(), str(file.relative_to(ROOT)))]


def test_functions_with_arrays_state_shape_and_unit() -> None:
    found = [fault for function in of_the_rooms() if has_arrays(function) for fault in array_faults(function)]
    assert not found, "\n" + "\n".join(found)


def test_functions_that_raise_say_so() -> None:
    found = [fault for function in of_the_rooms() for fault in raise_faults(function)]
    assert not found, "\n" + "\n".join(found)


def test_the_rooms_exist_and_have_functions_with_arrays() -> None:
    assert all((PACKAGE / room).exists() for room in ROOMS)
    assert sum(map(has_arrays, of_the_rooms())) > 40


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("Return the points.", ["shape", "unit"]),
        ("Return the points (N, 3) of the vehicle's view.", ["unit"]),
        ("Return the distances, metres (left, right).", ["shape"]),
        ("Return points (N, 3), metres.", []),
        ("Return (N,) bool.", []),
        ("Return `range_m` (..., 3).", []),
        ("Return edges (CELLS + 1,), px.", []),
    ],
)
def test_a_docstring_without_is_named(text: str, missing: list[str]) -> None:
    (function,) = public_functions(f"def f(p: Array) -> Mask:\n    '''{text}'''", "file.py")
    assert has_arrays(function)
    assert [fault.rsplit(" ", 1)[1] for fault in array_faults(function)] == missing


def test_what_is_private_or_without_arrays_is_left_out() -> None:
    source = "def _f(p: Array) -> None: ...\nclass _C:\n    def f(self, p: Array) -> None: ...\ndef g(p: float) -> None: ...\n"
    assert [f.node.name for f in public_functions(source, "file.py") if has_arrays(f)] == []


def test_an_error_that_is_not_told_is_named() -> None:
    source = "def f(x: int) -> None:\n    '''Check {}.'''\n    raise ValueError('x')\n"
    (silent,) = public_functions(source.format("x"), "file.py")
    (told,) = public_functions(source.format("x; raises ValueError"), "file.py")
    assert raise_faults(silent) == ["file.py:1 f: does not say that it raises ValueError"]
    assert raise_faults(told) == []
