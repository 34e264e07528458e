"""The example of docs/strategies.md works as it stands there: found by entry point, flown, stopped before a trunk."""

import re
import types
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from morpheyes_daemon.errors import ConfigError, MorphEyesError
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.lockstep import Watchers, fly
from morpheyes_daemon.messages.core import MissionCommand
from morpheyes_daemon.strategies import registry

DOC = Path(__file__).parents[2] / "docs" / "strategies.md"


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", DOC.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    return found[1]


def test_the_documented_strategy_flies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("documented_ahead")
    exec(compile(block("python"), str(DOC), "exec"), module.__dict__)
    monkeypatch.setitem(__import__("sys").modules, "documented_ahead", module)
    point = EntryPoint("ahead", "documented_ahead:Ahead", "morpheyes.strategies")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    (tmp_path / "ahead.yaml").write_text(block("yaml"), encoding="utf-8")
    world = {"kind": "forest", "course_m": 10, "half_width_m": 12, "run_in_m": 6, "trees_per_ha": 900, "goal": False}
    (tmp_path / "grove.yaml").write_text(yaml.safe_dump({"world": world}), encoding="utf-8")
    plan = make_plan(
        str(tmp_path / "ahead.yaml"),
        world=str(tmp_path / "grove.yaml"),
        size="160x120",
        calibration="exact",
        limit_s=40,
    )
    commands: list[MissionCommand] = []
    summary = fly(plan, Watchers(attach=[lambda daemon, stage: daemon.topics.command.tap(commands.append)]))
    assert summary.outcome == "reached"
    assert max(command.v_ned_m_s[0] for command in commands) == pytest.approx(1.5, abs=0.05)
    assert commands[-1].z_close_m < 16.0


REFUSE = """
        return replace(command, intent=Intent.REFUSE, reason=Reason.MISSION_REFUSED, text="the trees are too tall")"""
STUMBLE = """
        return command.no_such_thing"""


@pytest.mark.parametrize(
    ("after_engaging", "outcome", "text"),
    [(REFUSE, "refused", "the trees are too tall"), (STUMBLE, "aborted", "mission: .*no_such_thing.*")],
)
def test_the_summary_tells_why_a_flight_was_refused_or_aborted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after_engaging: str, outcome: str, text: str
) -> None:
    source = block("python") + (
        "\n\nfrom dataclasses import replace\n"
        "class Moody(Ahead):\n"
        "    def decide(self, observation):\n"
        "        command = super().decide(observation)\n"
        "        if not observation.engaged:\n"
        f"            return command{after_engaging}\n"
    )
    module = types.ModuleType("moody")
    exec(compile(source, "moody.py", "exec"), module.__dict__)
    monkeypatch.setitem(__import__("sys").modules, "moody", module)
    monkeypatch.setattr(registry, "entry_points", lambda group: [EntryPoint("moody", "moody:Moody", group)])
    (tmp_path / "moody.yaml").write_text("strategy: moody\n", encoding="utf-8")
    summary = fly(make_plan(str(tmp_path / "moody.yaml"), world="glade", size="160x120", calibration="exact"))
    assert summary.outcome == outcome
    assert re.fullmatch(text, summary.text)


@pytest.mark.parametrize(("method", "what"), [("perceive", "'View' object"), ("decide", "'Observation' object")])
def test_a_mistake_in_a_strategy_is_named_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, what: str
) -> None:
    source = (
        "from morpheyes_daemon.strategies.base import Strategy\n"
        "class Slip(Strategy):\n"
        f"    def {method}(self, given):\n"
        "        return given.nothing_of_the_kind\n"
    )
    module = types.ModuleType("slip")
    if method == "perceive":
        source += "    def decide(self, observation):\n        raise NotImplementedError\n"
    exec(compile(source, "slip.py", "exec"), module.__dict__)
    monkeypatch.setitem(__import__("sys").modules, "slip", module)
    monkeypatch.setattr(registry, "entry_points", lambda group: [EntryPoint("slip", "slip:Slip", group)])
    (tmp_path / "slip.yaml").write_text("strategy: slip\n", encoding="utf-8")
    plan = make_plan(str(tmp_path / "slip.yaml"), world="glade", size="160x120", calibration="exact")
    with pytest.raises(MorphEyesError, match=rf"{what} has no attribute 'nothing_of_the_kind' \(slip.py:4\)"):
        fly(plan)


def test_a_strategy_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("odd", "pathlib:Path", "morpheyes.strategies")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    with pytest.raises(ConfigError, match="not a subclass"):
        registry.find_strategy("odd")
