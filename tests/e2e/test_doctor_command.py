"""`morpheyes doctor` from the command line, on a machine to which nothing is connected."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from morpheyes_daemon.cli import build
from morpheyes_daemon.doctor import examination, vehicle
from morpheyes_daemon.doctor.findings import Finding, Severity

CONFIG = """
camera: {backend: recording, path: nowhere}
servo: {backend: none}
autopilot: {url: "serial:/dev/no-such-port:57600"}
recorder: {folder: flights}
"""


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(vehicle, "LINK_S", 0.1)
    path = tmp_path / "config.yaml"
    path.write_text(CONFIG)
    return path


def closed_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp:127.0.0.1:{probe.getsockname()[1]}"


def test_json_is_all_there_is_on_standard_output(config: Path) -> None:
    result = CliRunner().invoke(build(), ["doctor", "--json", "--autopilot", closed_port()])
    assert result.exit_code == 1
    report = json.loads(result.stdout)
    assert report["verdict"] == "do not fly"
    found = {finding["id"]: finding for finding in report["findings"]}
    assert {"autopilot-missing", "camera-missing", "calibration-unusable"} <= found.keys()
    assert "nobody listens" in found["autopilot-missing"]["evidence"]
    assert all(finding.keys() >= {"id", "severity", "evidence", "remedy"} for finding in report["findings"])


def test_people_get_evidence_risk_and_remedy(config: Path) -> None:
    result = CliRunner().invoke(build(), ["doctor", "--takeover-test"])
    assert result.exit_code == 1
    for words in ("[do not fly] autopilot-missing", "risk ", "remedy ", "takeover-untested", "Verdict: do not fly"):
        assert words in result.stdout


def test_parameter_file_says_what_and_why(config: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    async def examined(*args: object, **kwargs: object) -> examination.Examination:
        finding = Finding("brake-delay", Severity.CARE, "late", "coasts", "set it", {"LOIT_BRK_DELAY": 0.2})
        return examination.Examination([finding], ["autopilot"])

    monkeypatch.setattr(examination, "examine", examined)
    out = tmp_path / "remedy.parm"
    result = CliRunner().invoke(build(), ["doctor", "--params-out", str(out)])
    assert result.exit_code == 0
    assert "Verdict: fly with care" in result.stdout
    lines = out.read_text().splitlines()
    assert lines[-1] == "LOIT_BRK_DELAY,0.2"
    assert any("brake-delay" in line and line.startswith("#") for line in lines)


def test_impossible_address_is_wrong_usage(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = CliRunner().invoke(build(), ["doctor", "--autopilot", "carrier-pigeon:7"])
    assert result.exit_code != 0
    assert "unknown link 'carrier-pigeon'" in str(result.exception)
