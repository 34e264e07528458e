"""Changes the code in every small way it knows, one change at a time, and counts how many the tests notice.

    python tests/mutate.py WHAT... [--sample N --seed S] [--jobs N] [--json] [--list] [--resume FILE]

WHAT is a folder or file of the package (`safety`, `control/governor.py`), or `all`. Mutation testers from the package
index change function bodies only; here tables are part of the program, so this one also drops rows and swaps enum
members anywhere. Each mutant lives in a forked process and never on disk; `tests/mutation/rooms.py` says which tests
must notice it. What was noticed once, by the same source, need not be tried again (`--resume`); survivors are,
against today's tests. Exits 1 when fewer than the wanted share is noticed or a survivor has no reason in
`tests/mutation/equivalent.py`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.mutation.changes import Mutant, enums_in, mutants_of  # noqa: E402
from tests.mutation.equivalent import reason_of  # noqa: E402
from tests.mutation.rooms import NOT_TRIED, groups_for  # noqa: E402
from tests.mutation.trial import PACKAGE, Nursery  # noqa: E402

WANTED = {"safety": 0.95}
WANTED_ELSEWHERE = 0.90
AT_A_TIME = 8
"""Mutants that one nursery tries before the next one may begin."""


class Noticed:
    """The mutants noticed so far, by a line each in a file (None: not kept); a changed module counts anew."""

    def __init__(self, path: Path | None, texts: dict[str, str]) -> None:
        self._path = path
        self._hashes = {file: hashlib.sha256(text.encode()).hexdigest()[:12] for file, text in texts.items()}
        self._lines = set(path.read_text().splitlines()) if path is not None and path.exists() else set()

    def __contains__(self, mutant: Mutant) -> bool:
        return self._line(mutant) in self._lines

    def add(self, mutant: Mutant) -> None:
        """Keep a mutant that was noticed."""
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(self._line(mutant) + "\n")

    def _line(self, mutant: Mutant) -> str:
        return f"{self._hashes[mutant.file]} {mutant.node} {mutant}"


def files_of(what: list[str]) -> list[str]:
    """Return the files of the package that WHAT names, relative to it; those without tests of their own left out."""
    package, found = ROOT / PACKAGE, []
    for name in what:
        path = package if name == "all" else package / name.removeprefix(f"{PACKAGE}/")
        if not path.exists():
            raise SystemExit(f"There is no {name} in {PACKAGE}: name a folder or a file of it, or `all`.")
        files = [path] if path.is_file() else sorted(path.rglob("*.py"))
        relative = [str(file.relative_to(package)) for file in files]
        named_alone = path.is_file()
        found += [file for file in relative if groups_for(ROOT, file) and (named_alone or file not in NOT_TRIED)]
    return list(dict.fromkeys(found))


def run(mutants: list[Mutant], texts: dict[str, str], jobs: int, noticed: Noticed) -> list[Mutant]:
    """Try every mutant not yet noticed, `jobs` at a time, and return the survivors."""
    _require_sound({mutant.file for mutant in mutants})
    waiting = list(_batches([mutant for mutant in mutants if mutant not in noticed]))
    tried = len(mutants) - sum(len(batch) for batch in waiting)
    running: dict[int, tuple[int, list[Mutant]]] = {}
    survivors: list[Mutant] = []
    while waiting or running:
        while waiting and len(running) < jobs:
            batch = waiting.pop(0)
            pid, answers = _begun(batch, texts[batch[0].file])
            running[pid] = answers, batch
        pid, status = os.wait()
        answers, batch = running.pop(pid)
        with os.fdopen(answers) as lines:
            verdicts = lines.read().split()
        if status or len(verdicts) != len(batch):
            raise SystemExit(f"The mutants of {batch[0].file} could not be tried: see above.")
        for mutant, verdict in zip(batch, verdicts, strict=True):
            if verdict == "noticed":
                noticed.add(mutant)
            else:
                survivors.append(mutant)
                print(f"survives {mutant}", file=sys.stderr)
        tried += len(batch)
        print(f"{tried}/{len(mutants)}", file=sys.stderr)
    return sorted(survivors, key=lambda mutant: (mutant.file, mutant.line))


def _require_sound(files: set[str]) -> None:
    """Run the tests on the files as they are, each set of tests once; ends the program where one fails."""
    done: set[frozenset[str]] = set()
    for file in sorted(files):
        groups = groups_for(ROOT, file)
        tests = frozenset(test for group in groups for test in group)
        if tests in done:
            continue
        done.add(tests)
        nursery = Nursery(ROOT, file, "", groups)
        if nursery.finish(nursery.start(None)):
            raise SystemExit(f"The tests of {file} fail without any change: mend them first.")


def _batches(mutants: list[Mutant]) -> Iterator[list[Mutant]]:
    """Yield mutants of one file, a few at a time."""
    by_file: dict[str, list[Mutant]] = {}
    for mutant in mutants:
        by_file.setdefault(mutant.file, []).append(mutant)
    for same in by_file.values():
        for i in range(0, len(same), AT_A_TIME):
            yield same[i : i + AT_A_TIME]


def _begun(batch: list[Mutant], text: str) -> tuple[int, int]:
    """Fork a nursery for mutants of one file; return its process and where it writes a word for each."""
    read, write = os.pipe()
    pid = os.fork()
    if pid != 0:
        os.close(write)
        return pid, read
    status = 1
    try:
        os.close(read)
        nursery = Nursery(ROOT, batch[0].file, text, groups_for(ROOT, batch[0].file))
        nursery.prepare()
        for mutant in batch:
            os.write(write, b"noticed " if nursery.finish(nursery.start(mutant)) else b"survives ")
        status = 0
    finally:
        os._exit(status)


def main() -> int:
    """Count, print the survivors and what explains them, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", nargs="+", help="folder or file of the package, or `all`")
    parser.add_argument("--sample", type=int, help="try so many, chosen at random by --seed")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true", help="print {tried, noticed, survivors} alone")
    parser.add_argument("--resume", type=Path, help="keep here what was noticed, and do not try it again")
    parser.add_argument("--list", action="store_true", help="print the mutants and try none")
    arguments = parser.parse_args()
    texts = {file: (ROOT / PACKAGE / file).read_text() for file in files_of(arguments.what)}
    mutants = [m for file, text in texts.items() for m in mutants_of(file, text, enums_in(ROOT / PACKAGE, text))]
    if arguments.sample is not None and arguments.sample < len(mutants):
        chosen = random.Random(arguments.seed).sample(range(len(mutants)), arguments.sample)
        mutants = [mutants[i] for i in sorted(chosen)]
    if arguments.list:
        print(*mutants, sep="\n")
        return 0
    survivors = run(mutants, texts, arguments.jobs, Noticed(arguments.resume, texts))
    reasons = [reason_of(mutant) for mutant in survivors]
    tried, noticed = len(mutants), len(mutants) - len(survivors)
    unexplained = reasons.count(None)
    if arguments.json:
        rows = [
            {"file": m.file, "line": m.line, "mutation": m.change, "source": m.source, "reason": reason}
            for m, reason in zip(survivors, reasons, strict=True)
        ]
        print(json.dumps({"tried": tried, "noticed": noticed, "survivors": rows}, indent=1))
    else:
        for mutant, reason in zip(survivors, reasons, strict=True):
            print(f"{mutant}\n    {reason or 'not explained'}")
        print(f"{tried} mutants, {noticed} noticed ({noticed / max(1, tried):.1%}), {len(survivors)} survive,", end=" ")
        print(f"{unexplained} of them unexplained")
    wanted = max(WANTED.get(name.partition("/")[0], WANTED_ELSEWHERE) for name in arguments.what)
    return 0 if noticed >= wanted * tried and not unexplained else 1


if __name__ == "__main__":
    sys.exit(main())
