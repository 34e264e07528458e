"""Where the real images are; tests that need them skip with the reason."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def real_images(name: str) -> Path:
    """Return a folder of real images, from MORPHEYES_DATA or ../shared/data; skips the test when it is absent."""
    data = Path(os.environ.get("MORPHEYES_DATA", ROOT.parent / "shared" / "data"))
    if not (data / name).is_dir():
        pytest.skip(f"no real images in {data / name}; set MORPHEYES_DATA")
    return data / name
