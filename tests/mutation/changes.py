"""Every small change of a source file that the mutation tester knows: what is changed, and how.

Changes are made to the syntax tree. Left alone are annotations, imports, docstrings, decorators, and texts that only
a person reads (of errors, of a field's description), where a change says nothing about the tests.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}
EXTREMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
ENUM_BASES = {"Enum", "IntEnum", "StrEnum"}
READ_BY_PERSONS = {"description", "help", "title"}

Change = Callable[[ast.AST], None]
Members = dict[str, list[str]]
"""The member names of each enum that a file knows, by the name it has there."""


@dataclass(frozen=True)
class Mutant:
    """One change of one file; `node` counts in the order of ast.walk. `file` is relative to the package."""

    file: str
    line: int
    source: str
    change: str
    node: int
    apply: Change

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.change}: {self.source}"


def mutants_of(file: str, text: str, members: Members) -> Iterator[Mutant]:
    """Yield every mutant of a file's source."""
    tree = ast.parse(text)
    lines = text.splitlines()
    skipped = _not_code(tree)
    for index, node in enumerate(ast.walk(tree)):
        if id(node) in skipped:
            continue
        for line, change, apply in _changes(node, members, skipped):
            yield Mutant(file, line, lines[line - 1].strip(), change, index, apply)


def mutated(mutant: Mutant, text: str) -> ast.Module:
    """Return the changed tree."""
    tree = ast.parse(text)
    mutant.apply(list(ast.walk(tree))[mutant.node])
    return ast.fix_missing_locations(tree)


def enums_in(package: Path, text: str) -> Members:
    """Return the enums that a source defines or imports from the package, read and never imported."""
    tree = ast.parse(text)
    members = _defined_enums(tree)
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(package.name):
            path = package.parent / Path(*node.module.split("."))
            source = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
            there = _defined_enums(ast.parse(source.read_text()))
            members |= {name.asname or name.name: there[name.name] for name in node.names if name.name in there}
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Name) and node.value.id in members:
            members |= {target.id: members[node.value.id] for target in node.targets if isinstance(target, ast.Name)}
    return members


def _defined_enums(tree: ast.Module) -> Members:
    return {
        node.name: [
            target.id
            for statement in node.body
            if isinstance(statement, ast.Assign)
            for target in statement.targets
            if isinstance(target, ast.Name)
        ]
        for node in tree.body
        if isinstance(node, ast.ClassDef) and any(getattr(base, "id", "") in ENUM_BASES for base in node.bases)
    }


def _not_code(tree: ast.Module) -> set[int]:
    """Nodes where a change says nothing about the tests."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST | None] = []
        if isinstance(node, ast.AnnAssign | ast.arg):
            parts.append(node.annotation)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            parts += [node.returns, *node.decorator_list]
        elif isinstance(node, ast.ClassDef):
            parts += [node] if _is_protocol(node) else node.decorator_list
        elif isinstance(node, ast.Import | ast.ImportFrom | ast.JoinedStr) or _is_docstring(node):
            parts.append(node)
        elif isinstance(node, ast.Raise):
            parts += [inner for inner in ast.walk(node) if _is_text(inner)]
        elif isinstance(node, ast.keyword) and node.arg in READ_BY_PERSONS:
            parts.append(node.value)
        elif isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            parts.append(node)
        skipped |= {id(inner) for part in parts if part is not None for inner in ast.walk(part)}
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript):
            skipped |= {id(inner) for inner in ast.walk(node)}
    return skipped


def _is_protocol(node: ast.ClassDef) -> bool:
    return any(getattr(base, "id", "") == "Protocol" for base in node.bases)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _changes(node: ast.AST, members: Members, skipped: set[int]) -> Iterator[tuple[int, str, Change]]:
    line = getattr(node, "lineno", 0)
    if isinstance(node, ast.Compare):
        for i, op in enumerate(node.ops):
            for other in COMPARISONS[type(op)]:
                yield line, f"{_name(op)} to {other.__name__}", lambda n, i=i, other=other: _put(n.ops, i, other())
    elif isinstance(node, ast.BoolOp):
        other_bool = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield line, f"{_name(node.op)} to {other_bool.__name__}", lambda n: setattr(n, "op", other_bool())
        for i in range(len(node.values)):
            yield line, f"drop term {i}", lambda n, i=i: _drop_term(n, i)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield line, "drop not", lambda n: setattr(n, "operand", ast.UnaryOp(ast.Not(), n.operand))  # type: ignore[attr-defined]
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        operator = OPERATORS[type(node.op)]
        yield line, f"{_name(node.op)} to {operator.__name__}", lambda n: setattr(n, "op", operator())
    elif isinstance(node, ast.Constant):
        yield from _constant(node)
    elif isinstance(node, ast.Name) and node.id in EXTREMES:
        yield line, f"{node.id} to {EXTREMES[node.id]}", lambda n: setattr(n, "id", EXTREMES[n.id])  # type: ignore[attr-defined]
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in members:
        names = members[node.value.id]
        if node.attr in names:
            other_name = names[(names.index(node.attr) + 1) % len(names)]
            yield line, f"{node.attr} to {other_name}", lambda n: setattr(n, "attr", other_name)
    elif isinstance(node, ast.If | ast.IfExp):
        for value in (True, False):
            yield line, f"if {value}", lambda n, value=value: setattr(n, "test", ast.Constant(value))
    elif isinstance(node, ast.Dict):
        for i, value_node in enumerate(node.values):
            yield value_node.lineno, "drop row", lambda n, i=i: (n.keys.pop(i), n.values.pop(i))
    elif isinstance(node, ast.Set | ast.Tuple) and _is_table(node):
        for i, element in enumerate(node.elts):
            yield element.lineno, f"drop element {i}", lambda n, i=i: n.elts.pop(i)
    yield from _statements(node, skipped)


def _is_table(node: ast.Set | ast.Tuple) -> bool:
    read = not isinstance(getattr(node, "ctx", None), ast.Store)
    return read and len(node.elts) > 1 and any(isinstance(x, ast.Attribute | ast.Tuple) for x in node.elts)


def _constant(node: ast.Constant) -> Iterator[tuple[int, str, Change]]:
    value = node.value
    if isinstance(value, bool):
        yield node.lineno, f"{value} to {not value}", lambda n: setattr(n, "value", not n.value)  # type: ignore[attr-defined]
    elif isinstance(value, int | float):
        yield node.lineno, f"{value} plus 1", lambda n: setattr(n, "value", n.value + 1)  # type: ignore[attr-defined]
        yield node.lineno, f"{value} minus 1", lambda n: setattr(n, "value", n.value - 1)  # type: ignore[attr-defined]
    elif isinstance(value, str):
        yield node.lineno, "another text", lambda n: setattr(n, "value", f"{n.value}?")  # type: ignore[attr-defined]


def _statements(node: ast.AST, skipped: set[int]) -> Iterator[tuple[int, str, Change]]:
    for field in ("body", "orelse"):
        block = getattr(node, field, None)
        if not isinstance(block, list) or isinstance(node, ast.ClassDef | ast.Module):
            continue
        for i, statement in enumerate(block):
            if id(statement) in skipped or isinstance(statement, ast.Pass):
                continue
            yield (
                statement.lineno,
                f"drop {type(statement).__name__.lower()}",
                lambda n, field=field, i=i: _put(getattr(n, field), i, ast.Pass()),
            )


def _put(items: list[ast.AST], index: int, item: ast.AST) -> None:
    items[index] = item


def _drop_term(node: ast.AST, index: int) -> None:
    assert isinstance(node, ast.BoolOp)
    del node.values[index]
    if len(node.values) == 1:
        node.values.append(copy.deepcopy(node.values[0]))


def _name(node: ast.AST) -> str:
    return type(node).__name__
