"""A recorded flight decides the same again; a changed mission or code shows as differences."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.cli import main
from morpheyes_daemon.clock import S
from morpheyes_daemon.config import MissionFile, SimCameraConfig, VehicleConfig
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.experiments.replay import replay
from morpheyes_daemon.messages import DepthSummary, Perception, VehicleState
from morpheyes_daemon.perception import build_strategy
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.shipped import load_mission
from morpheyes_daemon.strategies.base import Observation
from morpheyes_daemon.strategies.profile import ObstacleProfile
from tests.hand_clock import HandClock

STEPS = 25


def vehicle_at(x_m: float, t_ns: int) -> VehicleState:
    return VehicleState(t_ns=t_ns, position_t_ns=t_ns, attitude_t_ns=t_ns, p_ned_m=(x_m, 0.1, -1.5),
                        v_ned_m_s=(1.5, 0.02, 0.0), height_m=1.5, rc_us=(1500, 1500), armed=True, landed=False)


def profile_at(x_m: float, t_ns: int, rng: np.random.Generator) -> ObstacleProfile:
    """A tree ahead and one beside, in 64 bins, now and then nothing at all."""
    azimuth = np.linspace(-0.4, 0.4, 80)
    range_m = np.where(np.abs(azimuth - 0.1) < 0.03, 9.0 - x_m, np.inf)
    points = rng.normal((8.0, 0.8), 0.05, size=(0 if t_ns % (7 * S) == 0 else 12, 2))
    none = np.zeros(80, dtype=bool)
    return ObstacleProfile(t_ns, (x_m, 0.1, -1.5), (x_m + 0.09, 0.1), azimuth, range_m, none, none, points, 7.5, 0.5)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of 25 decisions of the real forest strategy on made-up profiles."""
    config, mission = VehicleConfig(camera=SimCameraConfig(), servo={"backend": "serial"}), load_mission("forest")
    topics, events, clock = Topics.create(), EventLog(), HandClock()
    path = tmp_path_factory.mktemp("replay") / "flight.mcap"
    header = flight_header("forest", mission, config, "5f1e", 0.0)
    recorder = Recorder(topics, events, clock, path, header, image_rate_hz=None, threaded=False)
    strategy, rng = build_strategy(mission, config), np.random.default_rng(3)
    for k in range(STEPS):
        clock.t_ns += S // 5
        x_m = 0.3 * k
        summary = DepthSummary(k, clock.t_ns - S // 10, clock.t_ns, 0.2, 0.001, 370.0, 0.82, 0.25, 0.5, 0.9, 0.0,
                               9.0 - x_m, 0.05, "5f1e")
        seen = Perception(summary, profile_at(x_m, summary.t_ns, rng), np.full(72, math.nan, np.float32))
        topics.perception.publish(seen)
        now, then = vehicle_at(x_m + 0.15, clock.t_ns), vehicle_at(x_m, summary.t_ns)
        observation = Observation(clock.t_ns, seen.percept, summary, now, then, 0.2, 1.1, True)
        topics.observation.publish(observation)
        topics.command.publish(strategy.decide(observation))
    recorder.close()
    return path


def test_the_same_observations_give_the_same_commands_bit_for_bit(log: Path) -> None:
    result = replay(log)
    assert result.decisions == STEPS
    assert result.without_percept == 0
    assert result.differences == []


def test_a_changed_mission_shows_where_it_decides_differently(log: Path) -> None:
    mission = load_mission("forest")
    other = MissionFile(strategy="forest", parameters={**mission.parameters, "baseline_gain": 0.02})
    result = replay(log, other)
    assert len(result.differences) > 0
    assert {name for difference in result.differences for name in difference.fields} <= {"baseline_m", "detail"}


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["morpheyes", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out or captured.err


def test_command_says_same_or_different(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out = run(capsys, monkeypatch, "replay", str(log), "--json")
    assert (code, json.loads(out)["same"], json.loads(out)["decisions"]) == (0, True, STEPS)
    changed = tmp_path / "changed.yaml"
    changed.write_text("strategy: forest\nparameters: {goal: {forward_m: 20.0}, speed_m_s: 0.5}\n")
    code, out = run(capsys, monkeypatch, "replay", str(log), "--mission", str(changed))
    assert code == 1
    assert "v_ned_m_s" in out


def test_a_log_without_decisions_is_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    Recorder(Topics.create(), EventLog(), HandClock(), path, {}, image_rate_hz=None, threaded=False).close()
    with pytest.raises(InputError, match="cannot be replayed"):
        replay(path)
    code, out = run(capsys, monkeypatch, "replay", str(path))
    assert code == 2
    assert out.startswith("morpheyes: ")
