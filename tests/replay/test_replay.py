"""A recorded flight decides the same again; a changed mission or code shows as differences."""

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.cli import main
from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import MissionFile, SimCameraConfig, VehicleConfig
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import DepthSummary, FloatMap, Intent, MissionCommand, Perception, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.perception.craft import build_craft
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.recorder.replay import replay
from morpheyes_daemon.strategies.base import Craft, Strategy, StrategyParameters
from morpheyes_daemon.strategies.registry import BUILT_IN
from tests.support.hand_clock import HandClock

STEPS = 25


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A percept with all that is hard to write down: single precision, an empty array, an infinity."""

    points_ned_m: FloatMap
    nearest_m: float


class WeaverParameters(StrategyParameters):
    gain: float = 0.04


class Weaver(Strategy):
    """Flies by everything it ever saw, so that one wrong bit anywhere shows in all that follows."""

    Parameters = WeaverParameters

    def __init__(self, parameters: StrategyParameters, craft: Craft) -> None:
        super().__init__(parameters, craft)
        self._sum = 0.0

    def decide(self, observation: Observation) -> MissionCommand:
        sighting: Sighting = observation.percept
        self._sum += float(np.sin(sighting.points_ned_m.astype(np.float64)).sum()) + observation.vehicle.p_ned_m[0]
        clear_m = min(sighting.nearest_m, observation.reserve_m)
        assert isinstance(self.parameters, WeaverParameters)
        return MissionCommand(
            observation.summary.seq,
            observation.now_ns,
            observation.now_ns + S,
            Intent.FLY,
            None,
            (math.cos(self._sum), math.sin(self._sum), 0.0),
            self._sum,
            None,
            self.parameters.gain * clear_m,
            clear_m,
            observation.at_exposure.p_ned_m,
            clear_m,
            detail={"sum": self._sum},
        )


@pytest.fixture(autouse=True)
def known_strategy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BUILT_IN, "weaver", f"{__name__}:Weaver")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = VehicleConfig(camera=SimCameraConfig(), servo={"backend": "serial"})
    topics, events, clock, rng = Topics.create(), EventLog(), HandClock(), np.random.default_rng(3)
    path = tmp_path_factory.mktemp("replay") / "flight.mcap"
    header = flight_header("weaver", MissionFile(strategy="weaver"), config, "5f1e", 0.0)
    recorder = Recorder(topics, events, clock, path, header, image_rate_hz=None, threaded=False)
    strategy = Weaver(WeaverParameters(), build_craft(config))
    for k in range(STEPS):
        clock.t_ns += S // 5
        summary = DepthSummary(
            k,
            clock.t_ns - S // 10,
            clock.t_ns,
            0.2,
            0.001,
            370.0,
            0.82,
            0.25,
            0.5,
            0.9,
            0.0,
            9.0 - 0.3 * k,
            0.05,
            "5f1e",
        )
        points = rng.normal(size=(k % 4 * 30, 2)).astype(np.float32)
        sighting = Sighting(points, math.inf if k % 7 == 0 else float(rng.uniform(1, 9)))
        topics.perception.publish(Perception(summary, sighting, np.full(72, math.nan, np.float32)))
        vehicles = [VehicleState(t_ns=clock.t_ns, p_ned_m=tuple(rng.normal(size=3).tolist())) for _ in range(2)]
        observation = Observation(clock.t_ns, sighting, summary, vehicles[0], vehicles[1], 0.2, 2.0, math.pi, True)
        topics.observation.publish(observation)
        topics.command.publish(strategy.decide(observation))
    recorder.close()
    return path


def test_the_same_observations_give_the_same_commands_bit_for_bit(log: Path) -> None:
    result = replay(log)
    assert (result.decisions, result.without_percept) == (STEPS, 0)
    assert result.differences == []


def test_a_changed_mission_shows_where_it_decides_differently(log: Path) -> None:
    result = replay(log, MissionFile(strategy="weaver", parameters={"gain": 0.05}))
    assert len(result.differences) == STEPS
    assert set(result.differences[0].fields) == {"baseline_m"}


def test_one_wrong_bit_shows(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def once_wrong(self: Weaver, observation: Observation) -> MissionCommand:
        if observation.summary.seq == 10:
            self._sum = math.nextafter(self._sum, math.inf)
        return decide(self, observation)

    decide = Weaver.decide
    monkeypatch.setattr(Weaver, "decide", once_wrong)
    differences = replay(log).differences
    assert differences
    assert differences[0].t_s == pytest.approx(11 * 0.2)


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
    changed.write_text("strategy: weaver\nparameters: {gain: 0.05}\n")
    code, out = run(capsys, monkeypatch, "replay", str(log), "--mission", str(changed))
    assert code == 1
    assert "baseline_m" in out
    assert "and 15 more" in out


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
