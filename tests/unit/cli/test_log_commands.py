"""`morpheyes log` and `morpheyes report`: what a person or a script gets to see of a flight log."""

import json
import sys
from pathlib import Path

import pytest

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.cli import main
from morpheyes_daemon.config.vehicle import MissionFile, NoServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.recorder.recorder import Recorder
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight, forest_scene


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    topics, events, clock = Topics.create(), EventLog(), HandClock()
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    config = VehicleConfig(camera=SimCameraConfig(), servo=NoServoConfig(backend="none"))
    mission = MissionFile(strategy="forest")
    header = flight_header("forest", mission, config, "5f1e", 0.0, scene=forest_scene().as_json())
    recorder = Recorder(topics, events, clock, path, header, image_rate_hz=2.0, threaded=False)
    SyntheticFlight(topics, events, clock).fly(16.0)
    recorder.close()
    return path


class Terminal:
    """Runs the command line and keeps what it prints."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._capsys, self._monkeypatch = capsys, monkeypatch

    def __call__(self, *arguments: object) -> tuple[int, str]:
        self._monkeypatch.setattr(sys, "argv", ["morpheyes", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = self._capsys.readouterr()
        return int(ended.value.code or 0), captured.out or captured.err


@pytest.fixture
def terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Terminal:
    return Terminal(capsys, monkeypatch)


def test_info_counts_topics_and_names_what_flew(log: Path, terminal: Terminal) -> None:
    code, out = terminal("log", "info", log, "--json")
    content = json.loads(out)
    assert code == 0
    assert (content["mission"], content["calibration_hash"], content["finished"]) == ("forest", "5f1e", True)
    assert content["topics"]["sticks"] == 800
    assert content["config"]["camera"]["backend"] == "sim"
    assert "800  sticks" in terminal("log", "info", log)[1]


def test_events_are_listed_with_their_reasons(log: Path, terminal: Terminal) -> None:
    rows = json.loads(terminal("log", "events", log, "--json")[1])
    assert [row["reason"] for row in rows] == ["engaged", "goal_reached"]
    assert rows[1]["t_s"] == pytest.approx(16.0)
    assert "the mission reached its goal" in terminal("log", "events", log)[1]


def test_a_cut_log_is_said_to_be_cut_and_recovered(log: Path, terminal: Terminal, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 8 // 10])
    assert f"morpheyes log recover {cut}" in terminal("log", "info", cut)[1]
    code, out = terminal("log", "recover", cut, "--json")
    saved = json.loads(out)
    assert code == 0
    assert Path(saved["out"]) == tmp_path / "cut.recovered.mcap"
    assert json.loads(terminal("log", "info", saved["out"], "--json")[1])["finished"]
    code, out = terminal("log", "recover", cut)
    assert (code, "is there already" in out) == (2, True)


def test_a_file_that_is_no_log_ends_with_two_and_a_sentence(terminal: Terminal, tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_text("hello")
    for command in (("log", "info"), ("log", "events"), ("log", "recover"), ("report",), ("replay",)):
        code, out = terminal(*command, tmp_path / "x.mcap")
        assert code == 2
        assert "is not a flight log" in out
        assert out.count("\n") == 1


def test_report_makes_figures_and_pictures(log: Path, terminal: Terminal, tmp_path: Path) -> None:
    code, out = terminal("report", log, "--out", tmp_path / "report", "--json")
    figures = json.loads(out)
    assert code == 0
    assert [Path(path).name for path in figures["written"]] == ["map.png", "strips.png", "flight.mp4"]
    assert all(Path(path).stat().st_size > 10_000 for path in figures["written"])
    assert figures["braking_events"] == 1
    assert figures["engaged_s"] == pytest.approx(16.0 - 1.2, abs=0.1)
    assert 0.1 <= figures["baseline_min_m"] < figures["baseline_max_m"] <= 0.3
    assert figures["peak_speed_m_s"] == pytest.approx(0.93 * 3.4, abs=0.05)
    assert figures["held_by"] == {
        "clear": pytest.approx(13.0 / 14.8, abs=0.01),
        "mission": pytest.approx(1.8 / 14.8, abs=0.01),
    }


def test_a_scene_comes_back_from_a_header() -> None:
    scene = forest_scene()
    assert ObstacleMap.from_json(scene.as_json()) == scene
    walled = ObstacleMap(polygons=(((0.0, 1.0), (2.0, 3.0), (4.0, 5.0)),), goal_m=(1.0, 2.0))
    assert ObstacleMap.from_json(walled.as_json()) == walled
