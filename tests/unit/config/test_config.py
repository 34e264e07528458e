"""Configuration and mission files: strict, and every error names file, line, key, what was found, what is allowed."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel

import morpheyes_daemon
from morpheyes_daemon.config.packaged import load_config, shipped
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.config.yaml_errors import parse_model
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.strategies.missions import load_mission, mission_names

GOOD = "camera: {backend: v4l2}\nservo: {backend: serial}\n"


def errors(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_model(text, VehicleConfig, "config.yaml")
    return str(caught.value).splitlines()


PACKAGE = Path(morpheyes_daemon.__file__).parent


def test_the_shipped_files_are_good() -> None:
    assert load_config(shipped("config.yaml")).mission == "forest"
    assert "forest" in mission_names()
    for name in mission_names():
        assert load_mission(name).strategy


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (GOOD + "foo: 1\n", 3, ["foo", "there is no such key"]),
        ("camera:\n  backend: v4l2\n  width_px: 12\nservo: {backend: none}\n", 3, ["camera.width_px", "12", "160"]),
        ("camera: {backend: webcam}\nservo: {backend: none}\n", 1, ["camera", "webcam", "v4l2"]),
        ("camera: {backend: v4l2}\n", 1, ["servo", "missing"]),
        (GOOD + "safety:\n  dead_daemon_s: soon\n", 4, ["safety.dead_daemon_s", "'soon'", "number"]),
        (GOOD + "safety:\n  dead_daemon_s: .nan\n", 4, ["safety.dead_daemon_s", "finite"]),
        ("camera: [1, 2\n", 2, ["not valid YAML"]),
    ],
)
def test_errors_name_line_key_and_bounds(text: str, line: int, words: list[str]) -> None:
    first = errors(text)[0]
    assert first.startswith(f"config.yaml:{line}:")
    for word in words:
        assert word in first


def test_every_wrong_key_is_told_at_once() -> None:
    assert len(errors(GOOD + "foo: 1\nbar: 2\nmission: ''\n")) == 3


def test_baselines_must_be_in_order() -> None:
    text = "camera: {backend: v4l2}\nservo:\n  backend: serial\n  motion: {min_baseline_mm: 300, max_baseline_mm: 100}\n"
    assert "min_baseline_mm must be less than" in errors(text)[0]


def test_a_missing_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such file"):
        load_config(tmp_path / "nowhere.yaml")


def test_an_unknown_strategy_names_line_and_choices(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("description: x\nstrategy: florest\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"mine.yaml:2: strategy: .*florest.*forest"):
        load_mission(str(path))


def test_a_strategys_parameters_are_checked_in_their_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("strategy: forest\nparameters:\n  margin_m: 9\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"mine.yaml:3: parameters.margin_m: found 9"):
        load_mission(str(path))


@pytest.mark.parametrize(
    ("strategy", "parameters", "words"),
    [
        ("imo", "height_m: [3, 1]", "height_m must be the lowest and then the highest flying height"),
        ("imo", "height_m: [-1, 2]", "from 0.3 to 20 m"),
        ("imo", "behaviour: {kind: pursue, distance_m: 1, tolerance_m: 2}", "tolerance_m must be less than distance_m"),
        ("forest", "margin_m: 0.1", "tight_margin_m must not be greater than margin_m"),
        ("forest", "{reach_m: 4, safe_m: 5}", "reach_m must be at least 0.6 m more than safe_m"),
    ],
)
def test_ranges_the_wrong_way_round_are_refused_in_one_sentence(
    tmp_path: Path, strategy: str, parameters: str, words: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"strategy: {strategy}\nparameters:\n  {parameters}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=words) as caught:
        load_mission(str(path))
    assert re.match(r"\S*mine.yaml:[23]: parameters", str(caught.value))
    assert len(str(caught.value).splitlines()) == 1


def test_a_height_may_be_prescribed_by_equal_bounds(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("strategy: imo\nparameters: {height_m: [1.5, 1.5]}\n", encoding="utf-8")
    assert load_mission(str(path)).strategy == "imo"


@pytest.mark.parametrize(
    ("servo", "held_mm", "limits"),
    [("serial", 400, "100 to 300"), ("serial", 50, "100 to 300"), ("none", 150, "200 to 200")],
)
def test_only_a_baseline_that_the_rig_can_take_is_held(servo: str, held_mm: float, limits: str) -> None:
    text = f"camera: {{backend: v4l2}}\nservo: {{backend: {servo}}}\nhold_baseline_mm: {held_mm}\n"
    assert errors(text) == [f"config.yaml:1: the file: hold_baseline_mm must be what the rig can take, from {limits}."]
    parse_model(text.replace(f": {held_mm}", ": 200"), VehicleConfig, "config.yaml")


def test_every_setting_is_read_somewhere() -> None:
    text = "".join(path.read_text() for path in PACKAGE.rglob("*.py") if path.name != "config.py")
    unread = {name for name in settings(VehicleConfig) if not re.search(rf"\b{name}\b", text)}
    assert not unread


def settings(model: type[BaseModel]) -> Iterator[str]:
    """Every name that a configuration may use."""
    for name, field in model.model_fields.items():
        yield name
        for part in (field.annotation, *get_args(field.annotation)):
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from settings(part)


def test_reason_numbers_are_used_once() -> None:
    numbers = [reason.number for reason in Reason]
    assert len(numbers) == len(set(numbers))
    assert all(reason.text for reason in Reason)
