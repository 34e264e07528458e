"""The results page is made from campaign folders and keeps what others wrote."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from morpheyes_daemon.campaigns.results_page import BEGIN, END, write_page
from morpheyes_daemon.errors import InputError

SETTINGS = {
    "mission": "forest", "strategy": "forest", "world": "forest", "image_size": "320x240", "rate_hz": 1.0,
    "latency_ms": 1000.0, "disparities_fraction": 0.1, "wind_m_s": 2.0, "seeds": [0, 39],
    "baselines": ["variable", "0.1"],
}  # fmt: skip


def campaign(folder: Path, **changes: object) -> Path:
    folder.mkdir()
    (folder / "campaign.json").write_text(json.dumps({**SETTINGS, **changes}))
    (folder / "table.md").write_text(f"| {folder.name} |\n")
    return folder


def test_every_campaign_is_told_with_its_command(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    write_page([campaign(tmp_path / "slow"), campaign(tmp_path / "gap", strategy="gap", mission="gap")], page)
    text = page.read_text()
    command = (
        "morpheyes experiment forest --seeds 0-39 --size 320x240 --baselines variable,0.1 --rate-hz 1 "
        "--latency-ms 1000 --disparities 64 --world forest"
    )
    assert command in text
    assert text.index("## Forest") < text.index("| slow |") < text.index("## Gap") < text.index("| gap |")


@pytest.mark.parametrize(
    ("strategy", "calibration", "said"),
    [("forest", "solved", False), ("forest", "mounted", True), ("gap", "mounted", False), ("gap", "solved", True)],
)
def test_a_calibration_is_in_the_command_unless_it_is_the_usual_one(
    tmp_path: Path, strategy: str, calibration: str, said: bool
) -> None:
    page = tmp_path / "results.md"
    write_page([campaign(tmp_path / "a", strategy=strategy, calibration=calibration)], page)
    assert (f"--calibration {calibration}" in page.read_text()) == said


def test_the_rest_of_the_page_is_kept(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    page.write_text(f"# Results\n\nabove\n\n{BEGIN}\nold\n{END}\n\n## Safety\n\nbelow\n")
    for _ in range(2):
        write_page([campaign(tmp_path / "a") if not (tmp_path / "a").exists() else tmp_path / "a"], page)
    text = page.read_text()
    assert "old" not in text
    assert text.count(BEGIN) == text.count("| a |") == 1
    assert text.startswith("# Results\n\nabove\n")
    assert text.endswith("\n\n## Safety\n\nbelow\n")


def test_a_folder_without_a_campaign_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"campaign\.json"):
        write_page([tmp_path], tmp_path / "results.md")
    assert not (tmp_path / "results.md").exists()
