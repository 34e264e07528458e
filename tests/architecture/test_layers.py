"""The house rules that a machine can check: layers, clocks, and no second way to the sticks."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "morpheyes_daemon"
SOURCES = sorted(PACKAGE.rglob("*.py"))


def offenders(pattern: str, *allowed: str) -> list[str]:
    found = []
    for path in SOURCES:
        name = path.relative_to(PACKAGE).as_posix()
        if name.startswith(allowed):
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if re.search(pattern, line):
                found.append(f"{name}:{number}: {line.strip()}")
    return found


def test_layers_point_down() -> None:
    pytest.importorskip("importlinter")
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_only_the_clock_reads_time() -> None:
    assert not offenders(r"\btime\.(time|monotonic|monotonic_ns|sleep|perf_counter)\(", "clock.py")


def test_only_the_command_line_prints() -> None:
    assert not offenders(r"^\s*print\(", "cli/")


def test_overrides_are_made_in_one_place_and_sent_through_one_function() -> None:
    assert not offenders(r"rc_channels_override_message|rc_channels_override_send", "wire/")
    claims = offenders(r"\.claim_stick_output\(", "devices/")
    # doctor has a connection of its own, for the take-over test on the ground
    assert {claim.split(":")[0] for claim in claims} == {"daemon/composition.py", "doctor/examination.py"}


def test_the_daemon_never_imports_the_simulator() -> None:
    below = (
        "simulation/",
        "experiments/",
        "cli/",
        "flights/",
        "campaigns/",
        "fault_injection/",
        "benchmarks/",
        "paper/",
    )
    assert not offenders(r"morpheyes_daemon\.(simulation|experiments)", *below)


def test_broad_excepts_stand_at_task_boundaries_only() -> None:
    broad = offenders(r"except( Exception| BaseException)?( as \w+)?:")
    assert all("BLE001" in line for line in broad), broad


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_modules_can_be_read_in_one_sitting(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 400
    assert lines == [] or lines[0].startswith(('"""', "#")), "a module says why it exists"
