"""Tries mutants: forked, in memory, each in a process of its own that runs the tests until one fails.

A nursery is a process for one file: it imports, before it forks, what the tests need and what does not depend on the
file. Nothing is ever written to the source tree.
"""

from __future__ import annotations

import ast
import importlib
import importlib.machinery
import os
import resource
import shutil
import signal
import sys
from functools import cache
from pathlib import Path

from tests.mutation.changes import Mutant, mutated

PACKAGE = "morpheyes_daemon"
PER_MUTANT_S = 90
"""Seconds of CPU, and with `WALL_FACTOR` of the wall; a mutant that loops or waits for ever has been noticed."""
WALL_FACTOR = 4
PYTEST = (
    *("-x", "-q", "-m", "not slow and not realtime", "-p", "no:cacheprovider", "--assert=plain", "--disable-warnings"),
    *("-c", os.devnull, "-o", "asyncio_mode=auto", "-p", "pytest_asyncio"),
)
"""Without the plug-ins and the rewriting of assertions that only serve a reader: half the time."""
PRELOADED = ("pytest", "pytest_asyncio", "hypothesis.stateful", "numpy", "cv2", "pydantic", "scipy.spatial")
NO_TESTS = 5
"""pytest's exit code when everything was deselected."""


class Nursery:
    """Where the mutants of one file are tried."""

    def __init__(self, root: Path, file: str, text: str, groups: list[list[str]]) -> None:
        self.root, self.file, self.text, self.groups = root, file, text, groups
        self.module = _name(Path(PACKAGE) / file)

    def prepare(self) -> None:
        """Import what the tests need and what is independent of the file; call in the nursery's own process."""
        wanted: set[str] = set()
        for test in (test for group in self.groups for test in group):
            for name in _imports(self.root, self.root / test):
                wanted |= _closure(self.root, name)
        for name in (*PRELOADED, *sorted(wanted)):
            if name not in PRELOADED and self.module in _closure(self.root, name):
                continue
            try:
                importlib.import_module(name)
            except ImportError:
                continue
        if self.module in sys.modules:
            raise RuntimeError(f"{self.module} was imported before it was changed")

    def start(self, mutant: Mutant | None) -> int:
        """Start a process that ends with 1 when the mutant is noticed, 0 when it survives; a time-out notices too.

        None is the file as it is. Returns the process id.
        """
        pid = os.fork()
        if pid == 0:
            os.environ |= {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "MUTATING": "1"}
            os.chdir(self.root)
            resource.setrlimit(resource.RLIMIT_CPU, (PER_MUTANT_S, PER_MUTANT_S))
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(WALL_FACTOR * PER_MUTANT_S)
            status = 1
            try:
                if mutant is not None:
                    self._put(mutant)
                status = int(self._tests_fail())
            finally:
                os._exit(status)
        return pid

    def finish(self, pid: int) -> bool:
        """Wait for a started process; return whether it noticed."""
        status = os.waitpid(pid, 0)[1]
        shutil.rmtree(_scratch(pid), ignore_errors=True)
        return status != 0

    def _put(self, mutant: Mutant) -> None:
        code = compile(mutated(mutant, self.text), str(self.root / PACKAGE / self.file), "exec")
        original = importlib.machinery.SourceFileLoader.get_code

        def get_code(loader: importlib.machinery.SourceFileLoader, fullname: str) -> object:
            return code if fullname == self.module else original(loader, fullname)

        importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]

    def _tests_fail(self) -> bool:
        import pytest

        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        scratch = f"--basetemp={_scratch(os.getpid())}"
        for group in self.groups:
            if pytest.main([*PYTEST, "--rootdir", str(self.root), scratch, *group]) not in (0, NO_TESTS):
                return True
        return False


def _scratch(pid: int) -> Path:
    return Path("/tmp") / f"mutant-{pid}"


def _name(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def _path(root: Path, module: str) -> Path | None:
    base = root / Path(*module.split("."))
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.exists():
            return path
    return None


@cache
def _imports(root: Path, path: Path) -> frozenset[str]:
    """Modules of the package and of tests/support that a file imports anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        found |= {name for name in names if name.startswith((PACKAGE, "tests.support")) and _path(root, name)}
    return frozenset(found)


@cache
def _closure(root: Path, module: str) -> frozenset[str]:
    """The module, its packages, and everything of the same kind that they import in turn."""
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        parent = name.rpartition(".")[0]
        if parent and parent != "tests":
            waiting.append(parent)
        path = _path(root, name)
        waiting += _imports(root, path) if path is not None else ()
    return frozenset(seen)
