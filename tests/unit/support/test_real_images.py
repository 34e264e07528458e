"""Real data that is missing is never passed over in silence."""

from __future__ import annotations

from pathlib import Path

import pytest
from _pytest.outcomes import Failed, Skipped

from tests.support.real_images import real_images


def test_where_it_is_missing_the_skip_says_where_it_was_looked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MORPHEYES_DATA", str(tmp_path))
    monkeypatch.delenv("CI_DATA", raising=False)
    with pytest.raises(Skipped, match=str(tmp_path / "boards")):
        real_images("boards")


def test_where_ci_asks_for_it_the_test_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MORPHEYES_DATA", str(tmp_path))
    monkeypatch.setenv("CI_DATA", "1")
    with pytest.raises(Failed, match="CI_DATA=1"):
        real_images("boards")


def test_where_it_is_its_folder_is_returned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MORPHEYES_DATA", str(tmp_path))
    (tmp_path / "boards").mkdir()
    assert real_images("boards") == tmp_path / "boards"
