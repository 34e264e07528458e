"""Where the real images are; tests that need them skip with the reason, or fail where CI_DATA=1 says that they are there."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def real_images(name: str) -> Path:
    """Return a folder of real images, from MORPHEYES_DATA or ../shared/data.

    When it is absent the test skips and says where it was looked for; with CI_DATA=1 in the environment it fails.
    """
    data = Path(os.environ.get("MORPHEYES_DATA", ROOT.parent / "shared" / "data"))
    if not (data / name).is_dir():
        missing = f"no real images in {data / name}; set MORPHEYES_DATA to the folder that has {name}"
        if os.environ.get("CI_DATA") == "1":
            pytest.fail(f"{missing}, or do not ask for them by CI_DATA=1")
        pytest.skip(missing)
    return data / name
