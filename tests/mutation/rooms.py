"""Which tests must notice a change of which file, and why some changes can not be noticed.

The longest prefix decides. Of these tests those that name the changed module are run first.
"""

from __future__ import annotations

from pathlib import Path

TESTS: dict[str, tuple[str, ...]] = {
    "safety/": tuple(
        f"tests/safety/test_{name}.py"
        for name in (
            *("states", "engage_switch", "vehicle_health", "gate", "monitor", "takeover"),
            *("rules", "random_steps"),
        )
    ),
    "control/": ("tests/unit/control",),
    "strategies/": ("tests/unit/strategies",),
    "strategies/forest/": ("tests/unit/strategies/forest",),
    "strategies/obstacles/": ("tests/unit/strategies/obstacles", "tests/unit/strategies/forest"),
    "strategies/gap/": ("tests/unit/strategies/gap",),
    "strategies/imo/": ("tests/unit/strategies/imo",),
    "perception/": ("tests/unit/perception",),
    "stereo/": ("tests/unit/stereo",),
    "devices/": ("tests/unit/devices",),
    "devices/link.py": ("tests/unit/devices", "tests/contract/test_links.py"),
    "devices/camera/": ("tests/unit/devices/camera", "tests/contract/test_cameras.py"),
    "devices/servo/": (
        "tests/unit/devices/servo",
        "tests/contract/test_servo_device.py",
        "tests/contract/test_teensy_on_a_port.py",
    ),
    "devices/autopilot/": ("tests/unit/devices/autopilot", "tests/contract/autopilot"),
    "wire/": ("tests/unit/wire", "tests/contract/test_firmware_protocol.py"),
    "supervisor/": ("tests/unit/supervisor",),
    "recorder/": ("tests/unit/recorder",),
    "recorder/replay.py": ("tests/replay",),
    "theory/": ("tests/unit/theory",),
    "config/": ("tests/unit/config",),
    "tasks/": ("tests/unit/tasks", "tests/safety/test_avoidance.py", "tests/safety/test_obstacles.py"),
    "calibration/": ("tests/unit/calibration",),
    "simulation/": ("tests/unit/simulation",),
    "bus.py": ("tests/unit/test_bus.py",),
    "clock.py": ("tests/unit/test_clock.py",),
    "errors.py": ("tests/unit/test_errors.py",),
}
"""File or folder of the package (by prefix) -> the tests that must notice a change of it."""

NOT_TRIED = ("safety/generate_docs.py",)
"""Tried when it is named alone: it writes a page that a test compares."""


def groups_for(root: Path, file: str) -> list[list[str]]:
    """Return the test files for a source file in three groups: those of its name, those that name it, the rest.

    Empty when the table has no row for the file.
    """
    prefix = max((key for key in TESTS if file.startswith(key)), key=len, default=None)
    if prefix is None:
        return []
    module = f"morpheyes_daemon.{file.removesuffix('.py').removesuffix('/__init__').replace('/', '.')}"
    parent, _, name = module.rpartition(".")
    groups: tuple[list[str], list[str], list[str]] = ([], [], [])
    for test in _files(root, TESTS[prefix]):
        text = (root / test).read_text()
        named = module in text or f"from {parent} import {name}" in text
        own = Path(test).stem in {f"test_{name}", f"test_{name}_behaviour"}
        groups[0 if own else 1 if named else 2].append(test)
    return [group for group in groups if group]


def _files(root: Path, places: tuple[str, ...]) -> list[str]:
    found: list[str] = []
    for place in places:
        path = root / place
        if path.is_dir():
            found += sorted(str(test.relative_to(root)) for test in path.rglob("test_*.py"))
        elif path.exists():
            found.append(place)
    return found
