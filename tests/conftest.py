"""Hypothesis: the same examples on every run, and no deadline, since a busy machine is no bug.

Tests in e2e/ and hw/ run at the clock's pace over sockets and processes: they are marked `realtime` and need a calm
machine, so the ordinary run leaves them out (`python3 start.py test -m realtime` runs them).
"""

import os
from pathlib import Path

import pytest
from hypothesis import Phase, settings

settings.register_profile("morpheyes", deadline=None, derandomize=True)
# that it fails is enough to know of a mutant: no search for the smallest example
settings.register_profile("mutants", settings.get_profile("morpheyes"), phases=(Phase.explicit, Phase.generate))
settings.load_profile("mutants" if "MUTATING" in os.environ else "morpheyes")

AT_THE_CLOCKS_PACE = {"e2e", "hw"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what runs in real time by its folder."""
    for item in items:
        if AT_THE_CLOCKS_PACE & set(Path(str(item.fspath)).parts):
            item.add_marker(pytest.mark.realtime)
