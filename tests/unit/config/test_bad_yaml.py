"""YAML files made to mislead or to exhaust: one sentence with the line, within a second."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from morpheyes_daemon.calibration.solver.pipeline import read_board_file
from morpheyes_daemon.clock import stopwatch_s
from morpheyes_daemon.config.packaged import load_config, shipped
from morpheyes_daemon.config.yaml_reader import LARGEST_FILE, parse_yaml
from morpheyes_daemon.errors import CalibrationError, ConfigError
from morpheyes_daemon.strategies.missions import load_mission

GOOD = "camera: {backend: v4l2}\nservo: {backend: serial}\n"
LIMIT_S = 1.0


def refused(path: Path, content: str | bytes) -> str:
    """The one sentence with which both readers refuse a file, each in time."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    started_s = stopwatch_s()
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    with pytest.raises(ConfigError):
        load_mission(str(path))
    assert stopwatch_s() - started_s < 2 * LIMIT_S
    said = str(caught.value)
    assert len(said.splitlines()) == 1
    assert len(said) < 400
    return said


ALIAS_BOMB = "a: &x0 [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{i}: &x{i} [{','.join([f'*x{i - 1}'] * 9)}]\n" for i in range(1, 9)
)
MERGE_BOMB = "x0: &x0 {a: 1, b: 2}\n" + "".join(
    f"x{i}: &x{i} {{<<: [{','.join([f'*x{i - 1}'] * 9)}]}}\n" for i in range(1, 9)
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (ALIAS_BOMB + "mission: *x8\n", "holds more than 20000 keys and values"),
        (MERGE_BOMB, "holds more than 20000 keys and values"),
        ("mission: &a [*a]\n", "x.yaml:1: contains itself"),
        (GOOD + "mission: &a\n  b: *a\n", "x.yaml:3: contains itself"),
        ("mission: " + "[" * 3000 + "]" * 3000, "nest"),
        ("a: " + "{a: " * 2000 + "1" + "}" * 2000, "nest"),
        ("".join(" " * i + "a:\n" for i in range(1300)), "x.yaml:51: is nested more than 50 deep"),
        ("a0: &a0 []\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 90)), "nested more than 50 deep"),
        ("- a\n" * 200_000, "x.yaml:20000: holds more than 20000 keys and values"),
        (GOOD + "# \0\0", "x.yaml:3: not valid YAML: the character U+0000 may not stand in it"),
        (GOOD + "mission: \x07", "x.yaml:3: not valid YAML: the character U+0007"),
        ("camera:\n  width_px: " + "9" * 5000, "x.yaml:2: a number of 5000 digits"),
        ("camera: {backend: sim, width_px: " + "9:" * 3000 + "9}\n" + GOOD[24:], "x.yaml:1: camera.width_px: found"),
        ("# " + "x" * 3_000_000, "is larger than 1 MB"),
        (bytes(range(256)), "cannot be read as text"),
        ("mission: !!python/object/apply:os.system ['true']\n", "x.yaml:1: the tag 'python/object/apply:os.system'"),
        ("!!python/object/new:os.system [true]\n", "has no meaning here"),
        ("? [a, b]\n: c\n", "x.yaml:1: a key must be a word"),
        ("? {a: b}\n: c\n", "x.yaml:1: a key must be a word"),
        ("--- 1\n--- 2\n", "not valid YAML: but found another document"),
        (GOOD + '"' + "k" * 900 + '": 1\n', "there is no such key"),
        ('mission: "\\ud800"\n', "x.yaml:1"),
    ],
)
def test_bombs_and_oddities_are_one_sentence_in_a_second(tmp_path: Path, content: str | bytes, words: str) -> None:
    """Guards both readers: aliases of 10^8 values hung them, deep nesting and endless integers were tracebacks."""
    assert words in refused(tmp_path / "x.yaml", content)


def test_files_that_are_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    for path in (tmp_path / "fifo.yaml", tmp_path / "loop.yaml", tmp_path, Path("/dev/zero"), Path("/proc/self/mem")):
        with pytest.raises(ConfigError, match=r"is not a file|cannot be read"):
            load_config(path)
    for path in (Path("a\0b"), tmp_path / ("a" * 300)):
        with pytest.raises(ConfigError):
            load_config(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "mission: a\nmission: b\n", "x.yaml:4: mission: stands there twice, first on line 3"),
        ("camera:\n  backend: sim\n  width_px: 640\n  width_px: 320\n", "x.yaml:4: width_px: stands there twice"),
        (GOOD + "safety:\n  dead_daemon_s: true\n", "x.yaml:4: safety.dead_daemon_s: found True"),
        (GOOD + "safety:\n  dead_daemon_s: '1.5'\n", "x.yaml:4: safety.dead_daemon_s: found '1.5'"),
        (GOOD + "safety:\n  dead_daemon_s: 1e400\n", "safety.dead_daemon_s: found inf"),
        (GOOD + "dashboard: {port: yes}\n", "x.yaml:3: dashboard.port: found True"),
        (GOOD + "dashboard: {port: '8080'}\n", "x.yaml:3: dashboard.port: found '8080'"),
        (GOOD + "dashboard: {port: 010}\n", "x.yaml:3: dashboard.port: found '010'"),
        (GOOD + "dashboard: {port: 1:30}\n", "x.yaml:3: dashboard.port: found '1:30'"),
        (GOOD + "dashboard: {port: 8_080}\n", "x.yaml:3: dashboard.port: found '8_080'"),
        (GOOD + "mission: true\n", "x.yaml:3: mission: found True"),
        (GOOD + "dashboard: {enabled: 1}\n", "x.yaml:3: dashboard.enabled: found 1"),
        (GOOD + "dashboard: {enabled: 'yes'}\n", "x.yaml:3: dashboard.enabled: found 'yes'"),
    ],
)
def test_what_a_file_does_not_say_is_not_guessed(tmp_path: Path, text: str, words: str) -> None:
    """Guards duplicate keys, of which the last one won, and booleans and texts that were taken for numbers."""
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert words in str(caught.value)


def test_parameters_of_missions_are_as_strict(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    for value in ("true", "'0.5'", "0x1"):
        path.write_text(f"strategy: forest\nparameters:\n  margin_m: {value}\n", encoding="utf-8")
        with pytest.raises(ConfigError, match=r"mine.yaml:3: parameters.margin_m: found "):
            load_mission(str(path))
    path.write_text("strategy: forest\nparameters:\n  margin_m: 0.5\n  margin_m: 0.6\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"mine.yaml:4: margin_m: stands there twice"):
        load_mission(str(path))


def test_numbers_as_people_write_them() -> None:
    text = "[1, -2, +3, 0, 1.5, .5, 5., 1e-3, 1E3, -1.5e+2, .inf, ~, yes, off, 640]"
    numbers, _ = parse_yaml(text, "x")
    assert numbers == [1, -2, 3, 0, 1.5, 0.5, 5.0, 1e-3, 1e3, -150.0, float("inf"), None, True, False, 640]
    assert parse_yaml("2026-01-01", "x")[0] == "2026-01-01"


def test_aliases_and_merges_of_a_sensible_size_are_fine(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("camera: &c {backend: v4l2, width_px: 640}\nservo: {backend: serial}\n")
    assert load_config(path).camera.width_px == 640
    assert parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: *a\n", "x")[0]["b"] == {"x": 1, "y": 2}


def test_a_large_file_with_a_bom_and_comments_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    comment = b"# " + b"x" * 70 + b"\n"
    path.write_bytes(b"\xef\xbb\xbf" + shipped("config.yaml").read_bytes() + comment * ((LARGEST_FILE - 5000) // 73))
    started_s = stopwatch_s()
    assert load_config(path).mission == "forest"
    assert stopwatch_s() - started_s < LIMIT_S


def test_board_files_are_read_with_the_same_care(tmp_path: Path) -> None:
    (tmp_path / "board.yaml").write_text(ALIAS_BOMB)
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_board_file(tmp_path)
