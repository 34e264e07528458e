"""Every constant of `strategies/` and `control/` carries its unit and its source.

A constant is a name in capitals that is assigned at module level, tables of texts excepted. The statement is followed
by a docstring, and

- the unit of each name is its suffix (`_M`, `_RAD_S`, ...) or `Unit: ...` in the docstring;
- the source is one of
  `Source: equation, ...`             derived, with the formula or where it is printed,
  `Source: data sheet, ...`           a property of a device or of its firmware,
  `Source: measured, `command``       with the command that measures it again,
  `Chosen: ...`                       with what a larger or smaller value trades.

A command is `pytest FILE::TEST` or `morpheyes SUBCOMMAND OPTIONS`; file, test, subcommand and options must exist.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from morpheyes_daemon import cli

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "morpheyes_daemon"
ROOMS = ("strategies", "control")
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")
SUFFIXES = (
    *("M", "M_S", "M_S2", "M_S3", "1_M", "PX", "PX2", "RAD", "RAD_S", "M_RAD"),
    *("S", "NS", "US", "HZ", "1_S", "1_S2", "PCT"),
)
UNIT = re.compile(r"\bUnit:\s+\S")
SOURCE = re.compile(r"\bSource:\s+(equation|data sheet|measured),\s+\S")
CHOSEN = re.compile(r"\bChosen:\s+(?P<why>.*)", re.DOTALL)
COMMAND = re.compile(r"\bSource:\s+measured,\s+`(?P<command>[^`]+)`")
LEAST_REASON = 20
"""Characters of the shortest reason that says what a value trades."""


@dataclass(frozen=True)
class Constant:
    """A statement that assigns constants, where it stands, and the docstring behind it."""

    place: str
    names: tuple[str, ...]
    text: str


def constants(source: str, file: str) -> list[Constant]:
    body = ast.parse(source).body
    found = []
    for statement, after in zip(body, [*body[1:], ast.Pass()], strict=True):
        names = tuple(name for name in assigned(statement) if CONSTANT.fullmatch(name))
        if names and not is_text(statement):
            found.append(Constant(f"{file}:{statement.lineno}", names, docstring(after)))
    return found


def assigned(statement: ast.stmt) -> list[str]:
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    else:
        return []
    return [node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]


def is_text(statement: ast.stmt) -> bool:
    """Return whether a statement assigns texts and no number."""
    values = [node.value for node in ast.walk(statement) if isinstance(node, ast.Constant)]
    return any(isinstance(value, str) for value in values) and not any(isinstance(v, int | float) for v in values)


def docstring(statement: ast.stmt) -> str:
    is_text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    return str(statement.value.value) if is_text and isinstance(statement.value.value, str) else ""  # type: ignore[attr-defined]


def faults(constant: Constant) -> list[str]:
    where = f"{constant.place} {', '.join(constant.names)}"
    if not constant.text:
        return [f"{where}: no docstring"]
    found = []
    for name in constant.names:
        if not name.endswith(tuple(f"_{suffix}" for suffix in SUFFIXES)) and not UNIT.search(constant.text):
            found.append(f"{where}: {name} has no unit")
    chosen = CHOSEN.search(constant.text)
    reasoned = chosen is not None and len(chosen["why"].strip()) >= LEAST_REASON
    if not SOURCE.search(constant.text) and not reasoned:
        found.append(f"{where}: no source")
    return found


def of_the_rooms() -> list[Constant]:
    files = sorted(file for room in ROOMS for file in (PACKAGE / room).rglob("*.py"))
    return [constant for file in files for constant in constants(file.read_text(), str(file.relative_to(ROOT)))]


def test_every_constant_has_a_unit_and_a_source() -> None:
    found = [fault for constant in of_the_rooms() for fault in faults(constant)]
    assert not found, "\n" + "\n".join(found)


def test_the_rooms_have_constants() -> None:
    assert len(of_the_rooms()) > 100


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("A_M = 1.0", "no docstring"),
        ("A = 1.0\n'''A share. Chosen: larger is slower, smaller is riskier.'''", "A has no unit"),
        ("A_M, B = 1.0, 2.0\n'''Chosen: larger is slower, smaller is riskier.'''", "B has no unit"),
        ("A_M: float = 1.0\n'''A length. Unit: m.'''", "no source"),
        ("A_M = 1.0\n'''A length. Chosen: so.'''", "no source"),
        ("A_M = 1.0\n'''A length. Source: measured'''", "no source"),
        ("A_M = 1.0\nf()\n'''A length. Source: equation, 1 + 1.'''", "no docstring"),
    ],
)
def test_a_constant_without_is_named(source: str, fault: str) -> None:
    (constant,) = constants(source, "file.py")
    assert [found.split(": ", 1)[1] for found in faults(constant)] == [fault]


def test_a_table_of_texts_is_none() -> None:
    assert constants("A = {'forest': 'module:Forest'}", "file.py") == []
    assert len(constants("A = {'forest': 2}", "file.py")) == 1


@pytest.mark.parametrize(
    "text",
    [
        "Source: equation, 1 + 1.",
        "Source: data sheet, L12-R.",
        "Source: measured, `pytest a::b`.",
        "Chosen: " + 20 * "x",
    ],
)
def test_a_constant_with_is_not(text: str) -> None:
    (constant,) = constants(f"A_M = 1.0\n'''A length. {text}'''", "file.py")
    assert not faults(constant)


def unresolved(command: str) -> str | None:
    """Return why a command does not resolve, None when it does."""
    words = command.split()
    if words[0] == "pytest":
        return unresolved_test(words[1])
    return unresolved_subcommand(words[1:]) if words[0] == "morpheyes" else "neither pytest nor morpheyes"


def unresolved_test(node: str) -> str | None:
    file, _, name = node.partition("::")
    if not (ROOT / file).is_file():
        return f"no file {file}"
    functions = [part for part in ast.walk(ast.parse((ROOT / file).read_text())) if isinstance(part, ast.FunctionDef)]
    return None if not name or name in {part.name for part in functions} else f"no test {name} in {file}"


def unresolved_subcommand(words: list[str]) -> str | None:
    command = typer.main.get_command(cli.build())
    for word in words:
        if word.startswith("--"):
            known = {option for parameter in command.params for option in parameter.opts}
            if word not in known:
                return f"no option {word}"
        elif hasattr(command, "commands"):
            if word not in command.commands:
                return f"no subcommand {word}"
            command = command.commands[word]
    return None


def test_every_command_that_is_named_as_a_source_resolves() -> None:
    commands = {(c.place, match["command"]) for c in of_the_rooms() for match in COMMAND.finditer(c.text)}
    assert commands, "some constants are measured"
    reasons = [(place, command, unresolved(command)) for place, command in sorted(commands)]
    found = [f"{place}: `{command}`: {why}" for place, command, why in reasons if why is not None]
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("pytest tests/architecture/test_constants.py::test_every_constant_has_a_unit_and_a_source", None),
        ("pytest tests/architecture/test_nothing.py", "no file tests/architecture/test_nothing.py"),
        ("pytest tests/conftest.py::test_x", "no test test_x in tests/conftest.py"),
        ("morpheyes sim forest --seed 3", None),
        ("morpheyes calibrate evaluate rig.yaml held --json", None),
        ("morpheyes calibrate levitate", "no subcommand levitate"),
        ("morpheyes sim forest --sead 3", "no option --sead"),
        ("make measurements", "neither pytest nor morpheyes"),
    ],
)
def test_commands_are_resolved(command: str, why: str | None) -> None:
    assert unresolved(command) == why
