"""Changes the code of safety/ in every small way it knows, one at a time, and counts how many the tests notice.

    python tests/safety/mutate.py [--jobs N] [--only MODULE] [--resume FILE] [--list]

Mutation testers from the package index change function bodies only; here the tables are the program, so this one
also drops rows and swaps enum members anywhere. Each mutant lives in a forked process and never on disk. What was
noticed once, by the same source, need not be tried again (`--resume`); survivors are, against today's tests. Exits 1
when fewer than 95 % are noticed or when a survivor is not explained in `EQUIVALENT`.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import importlib
import importlib.machinery
import os
import resource
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "morpheyes_daemon.safety"
MODULES = ("states", "engage_switch", "vehicle_health", "gate", "monitor")
FAST = ("states", "engage_switch", "vehicle_health", "gate", "monitor", "takeover")
SLOW = ("rules", "random_steps")
PYTEST = (
    *("-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--assert=plain", "--disable-warnings"),
    *("-c", os.devnull, "--rootdir", str(ROOT)),
)
"""Without the plug-ins and the rewriting of assertions that only serve a reader: half the time."""
PER_MUTANT_S = 180
"""Seconds of CPU; a mutant that loops for ever has been noticed."""
WANTED = 0.95

_UNHEARD = "until the switch is heard `on` is False, and hearing it sets the flip"
_UNSENT = "set before it is read: by the first step, or by the beginning of a release"

_BEGINNING = "a nanosecond about the clock's beginning"
_FIRST_STEP = "the first step enters a state, which forgets the offer whatever the pause"
_NOTHING_ADDED = "zero away is neutral, and zero had adds nothing"
_LEAVING = "on the way out only RELEASED and PILOT are outside flight, and neither heeds readiness or faults"
_HOLD = "in HOLD nothing that asks for it has a row, and every way out sets it anew"
_ENTERED = "the first transition sets it, and it is read in flight"

EQUIVALENT: dict[tuple[str, str, str], str] = {
    ("engage_switch", "self._flipped = False", "drop assign"): _UNHEARD,
    ("engage_switch", "self._flipped = False", "False to True"): _UNHEARD,
    ("engage_switch", "self._since_ns = self._heard_ns = 0", "0 plus 1"): _BEGINNING,
    ("engage_switch", "self._since_ns = self._heard_ns = 0", "0 minus 1"): _BEGINNING,
    (
        "engage_switch",
        "self._flipped = on and self._on is False and t_ns - self._since_ns >= STEADY_NS",
        "drop term 0",
    ): "what differs from off is on",
    ("gate", "self._offer: Sticks | None = None", "drop annassign"): _UNSENT,
    ("gate", "self._expiry: dict[Lease, int] = dict.fromkeys(Lease, 0)", "0 minus 1"): _BEGINNING,
    ("gate", "self._expiry[lease] = 0", "0 plus 1"): _BEGINNING,
    ("gate", "self._expiry[lease] = 0", "0 minus 1"): _BEGINNING,
    ("gate", "self._stepped_ns = self._pause_ns = 0", "0 plus 1"): _FIRST_STEP,
    ("gate", "self._stepped_ns = self._pause_ns = 0", "0 minus 1"): _FIRST_STEP,
    ("gate", "self._releases = 0", "drop assign"): _UNSENT,
    ("gate", "self._releases = 0", "0 plus 1"): _UNSENT,
    ("gate", "self._releases = 0", "0 minus 1"): _UNSENT,
    ("gate", "self._release_ns = None", "drop assign"): "who lets go of a stick begins a release anew",
    ("gate", "same_side = (had - neutral) * away > 0", "Gt to GtE"): _NOTHING_ADDED,
    ("gate", "same_side = (had - neutral) * away > 0", "0 minus 1"): _NOTHING_ADDED,
    (
        "gate",
        "return neutral + (away if abs(away) <= reach else int(math.copysign(reach, away)))",
        "LtE to Lt",
    ): "as far as it reaches is where it wants to be",
    ("monitor", "self._vehicle = VehicleState()", "drop assign"): "not before it is heard is every lease fresh",
    ("monitor", "self._latched = False", "drop assign"): _ENTERED,
    ("monitor", "self._latched = False", "False to True"): _ENTERED,
    ("monitor", "self._flown_ns = 0", "0 plus 1"): "the later of it and engaging counts",
    ("monitor", "self._flown_ns = 0", "0 minus 1"): "the later of it and engaging counts",
    (
        "monitor",
        "return self._leaving and self.state not in HOLDING and self.gate.silent",
        "drop term 1",
    ): "a gate that holds sticks is not silent",
    ("monitor", "if self._leaving:", "drop if"): _LEAVING,
    ("monitor", "if self._leaving:", "if False"): _LEAVING,
    ("monitor", "return", "drop return"): _LEAVING,
    ("monitor", "return None", "drop return"): "who returns nothing returns None",
    ("monitor", "self._switch.use()", "drop expr"): "out of flight the way back is by the switch off",
    ("monitor", "if self.state is State.BRAKING:", "if True"): "what it fires has no row in the other two states",
    ("monitor", "elif step.after is not State.HOLD:", "if True"): _HOLD,
    ("monitor", "elif step.after is not State.HOLD:", "HOLD to PILOT"): _HOLD,
}
"""(module, line of source, change) -> why no test could notice; each reason excuses one survivor."""

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
ENUMS = {"State": "State", "Trigger": "Trigger", "Action": "Action", "Lease": "Lease", "_S": "State", "_T": "Trigger"}

Change = Callable[[Any], object]


@dataclass(frozen=True)
class Mutant:
    """One change of one module; `node` counts in the order of ast.walk."""

    module: str
    line: int
    source: str
    change: str
    node: int
    apply: Change

    def __str__(self) -> str:
        return f"{self.module}.py:{self.line}: {self.change}: {self.source}"


def mutants_of(module: str, text: str, members: dict[str, list[str]]) -> Iterator[Mutant]:
    """Yield every mutant of a module's source; `members` has the names of each enum."""
    tree = ast.parse(text)
    lines = text.splitlines()
    skipped = _not_code(tree)
    for index, node in enumerate(ast.walk(tree)):
        if id(node) in skipped:
            continue
        for line, change, apply in _changes(node, members, skipped):
            yield Mutant(module, line, lines[line - 1].strip(), change, index, apply)


def _not_code(tree: ast.Module) -> set[int]:
    """Nodes of annotations, imports, docstrings and decorators, where a change says nothing about the tests."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST | None] = []
        if isinstance(node, ast.AnnAssign | ast.arg):
            parts.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            parts += [node.returns, *node.decorator_list]
        elif isinstance(node, ast.ClassDef):
            parts += node.decorator_list
        elif isinstance(node, ast.Import | ast.ImportFrom | ast.JoinedStr) or _is_docstring_or_alias(node):
            parts.append(node)
        skipped |= {id(inner) for part in parts if part is not None for inner in ast.walk(part)}
    return skipped


def _is_docstring_or_alias(node: ast.AST) -> bool:
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    return isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript)


def _changes(node: ast.AST, members: dict[str, list[str]], skipped: set[int]) -> Iterator[tuple[int, str, Change]]:
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
        yield line, "drop not", lambda n: setattr(n, "operand", ast.UnaryOp(ast.Not(), n.operand))
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        operator = OPERATORS[type(node.op)]
        yield line, f"{_name(node.op)} to {operator.__name__}", lambda n: setattr(n, "op", operator())
    elif isinstance(node, ast.Constant):
        yield from _constant(node)
    elif isinstance(node, ast.Name) and node.id in EXTREMES:
        yield line, f"{node.id} to {EXTREMES[node.id]}", lambda n: setattr(n, "id", EXTREMES[n.id])
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ENUMS:
        names = members[ENUMS[node.value.id]]
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
        yield node.lineno, f"{value} to {not value}", lambda n: setattr(n, "value", not n.value)
    elif isinstance(value, int | float):
        yield node.lineno, f"{value} plus 1", lambda n: setattr(n, "value", n.value + 1)
        yield node.lineno, f"{value} minus 1", lambda n: setattr(n, "value", n.value - 1)
    elif isinstance(value, str):
        yield node.lineno, "another text", lambda n: setattr(n, "value", f"{n.value}?")


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


def notices(mutant: Mutant, text: str) -> bool:
    """Run the tests on the mutant in this (forked) process; returns whether any fails."""
    tree = ast.parse(text)
    mutant.apply(list(ast.walk(tree))[mutant.node])
    code = compile(ast.fix_missing_locations(tree), f"{mutant.module}.py", "exec")
    name = f"{PACKAGE}.{mutant.module}"
    original = importlib.machinery.SourceFileLoader.get_code

    def get_code(self: importlib.machinery.SourceFileLoader, fullname: str) -> object:
        return code if fullname == name else original(self, fullname)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]
    return _tests_fail(mutant.module)


def _tests_fail(first: str) -> bool:
    import pytest

    others = [name for name in FAST if name != first]
    for group in ([first], others, SLOW):
        if pytest.main([*PYTEST, *(f"tests/safety/test_{name}.py" for name in group)]) != 0:
            return True
    return False


def _forked(mutant: Mutant, text: str) -> int:
    """Start a process that ends with 1 when the mutant is noticed, 0 when it survives; a time-out notices too."""
    pid = os.fork()
    if pid == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (PER_MUTANT_S, PER_MUTANT_S))
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        status = 1
        try:
            status = int(notices(mutant, text))
        finally:
            os._exit(status)
    return pid


class Noticed:
    """The mutants noticed so far, by a line each in a file (None: not kept); a changed module counts anew."""

    def __init__(self, path: Path | None, texts: dict[str, str]) -> None:
        self._path = path
        self._hashes = {module: hashlib.sha256(text.encode()).hexdigest()[:12] for module, text in texts.items()}
        self._lines = set(path.read_text().splitlines()) if path is not None and path.exists() else set()

    def __contains__(self, mutant: Mutant) -> bool:
        return self._line(mutant) in self._lines

    def add(self, mutant: Mutant) -> None:
        """Keep a mutant that was noticed."""
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(self._line(mutant) + "\n")

    def _line(self, mutant: Mutant) -> str:
        return f"{self._hashes[mutant.module]} {mutant.node} {mutant}"


def run(mutants: list[Mutant], texts: dict[str, str], jobs: int, noticed: Noticed) -> list[Mutant]:
    """Try every mutant not yet noticed, `jobs` at a time, and return the survivors."""
    running: dict[int, Mutant] = {}
    survivors: list[Mutant] = []
    waiting = [mutant for mutant in reversed(mutants) if mutant not in noticed]
    while waiting or running:
        while waiting and len(running) < jobs:
            mutant = waiting.pop()
            running[_forked(mutant, texts[mutant.module])] = mutant
        pid, status = os.wait()
        mutant = running.pop(pid)
        if status == 0:
            survivors.append(mutant)
            print(f"\nsurvives {mutant}", file=sys.stderr)
        else:
            noticed.add(mutant)
        print(f"\r{len(mutants) - len(waiting) - len(running)}/{len(mutants)}", end="", file=sys.stderr)
    print(file=sys.stderr)
    return sorted(survivors, key=lambda m: (m.module, m.line))


def _members() -> dict[str, list[str]]:
    """The names of each enum, read from the source: this process must never import what is to be mutated."""
    text = {module: (ROOT / PACKAGE.replace(".", "/") / f"{module}.py").read_text() for module in ("states", "gate")}
    members: dict[str, list[str]] = {}
    for node in (node for source in text.values() for node in ast.parse(source).body):
        if isinstance(node, ast.ClassDef) and any(getattr(base, "id", "") == "StrEnum" for base in node.bases):
            members[node.name] = [
                target.id
                for statement in node.body
                if isinstance(statement, ast.Assign)
                for target in statement.targets
                if isinstance(target, ast.Name)
            ]
    return members


def main() -> int:
    """Count, print the survivors and what explains them, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", choices=MODULES)
    parser.add_argument("--resume", type=Path, help="keep here what was noticed, and do not try it again")
    parser.add_argument("--list", action="store_true", help="print the mutants and try none")
    arguments = parser.parse_args()
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    modules = [arguments.only] if arguments.only else list(MODULES)
    texts = {module: (ROOT / PACKAGE.replace(".", "/") / f"{module}.py").read_text() for module in modules}
    mutants = [mutant for module in modules for mutant in mutants_of(module, texts[module], _members())]
    if arguments.list:
        print(*mutants, sep="\n")
        return 0
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for preload in (
        "pytest",
        "hypothesis.stateful",
        "morpheyes_daemon.config.vehicle",
        "morpheyes_daemon.messages.core",
    ):
        importlib.import_module(preload)
    if _fails_unchanged(modules[0], texts[modules[0]]):
        print("The tests fail without any change: mend them first.")
        return 1
    survivors = run(mutants, texts, arguments.jobs, Noticed(arguments.resume, texts))
    noticed = len(mutants) - len(survivors)
    unused, unexplained = dict(EQUIVALENT), 0
    for mutant in survivors:
        reason = unused.pop((mutant.module, mutant.source, mutant.change), None)
        unexplained += reason is None
        print(f"{mutant}\n    {reason or 'not explained'}")
    share = noticed / len(mutants)
    print(f"{len(mutants)} mutants, {noticed} noticed ({share:.1%}), {len(survivors)} survive,", end=" ")
    print(f"{unexplained} of them unexplained")
    return 0 if share >= WANTED and not unexplained else 1


def _fails_unchanged(module: str, text: str) -> bool:
    """True when the tests fail on a mutant without a change."""
    pid = _forked(Mutant(module, 0, "", "nothing", 0, lambda node: None), text)
    return os.waitpid(pid, 0)[1] != 0


if __name__ == "__main__":
    sys.exit(main())
