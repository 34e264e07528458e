"""`morpheyes doctor`: may this vehicle fly, and if not, what exactly to do about it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from morpheyes_daemon.config.vehicle import VehicleConfig
    from morpheyes_daemon.doctor.examination import Examination


def command(
    config: Annotated[Path | None, typer.Option("--config", help="The vehicle; none: ./config.yaml.")] = None,
    autopilot: Annotated[
        str | None, typer.Option("--autopilot", help="Link to the autopilot instead of the configured one.")
    ] = None,
    takeover_test: Annotated[
        bool, typer.Option("--takeover-test", help="Lead the pilot through taking over, on the ground, and time it.")
    ] = False,
    params_out: Annotated[
        Path | None, typer.Option("--params-out", help="Write the parameters to be set to this file.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Examine machine, calibration, servo, camera and autopilot on the ground.

    Exit 0: fly, or fly with care. Exit 1: do not fly.
    """
    import asyncio

    from morpheyes_daemon.config.packaged import load_config
    from morpheyes_daemon.doctor.findings import Verdict, verdict

    vehicle = _with_link(load_config(config), autopilot)
    report = asyncio.run(_examine(vehicle, takeover_test, lambda text: typer.echo(text, err=True)))
    found = verdict(report.findings)
    if params_out is not None:
        _write_parameters(params_out, report)
    if as_json:
        typer.echo(json.dumps(_document(report), indent=2))
    else:
        _print(report, params_out)
    if found is Verdict.STOP:
        raise typer.Exit(1)


def _with_link(config: VehicleConfig, url: str | None) -> VehicleConfig:
    if url is None:
        return config
    return config.model_copy(update={"autopilot": config.autopilot.model_copy(update={"url": url})})


async def _examine(config: VehicleConfig, takeover_test: bool, say: Callable[[str], None]) -> Examination:
    from morpheyes_daemon.clock import running_clock
    from morpheyes_daemon.devices.link import open_link
    from morpheyes_daemon.doctor.examination import examine

    return await examine(config, running_clock(), open_link, say, takeover_test)


def _write_parameters(path: Path, report: Examination) -> None:
    from morpheyes_daemon.devices.autopilot.parameters import parameter_file
    from morpheyes_daemon.doctor.findings import by_weight, remedies
    from morpheyes_daemon.errors import UsageError

    reasons = [f"{f.id}: {', '.join(f.parameters)}: {f.risk}" for f in by_weight(report.findings) if f.parameters]
    comment = "\n".join(["What `morpheyes doctor` asks to set, and why.", *reasons])
    try:
        path.write_text(parameter_file(remedies(report.findings), comment), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror}).") from None


def _document(report: Examination) -> dict[str, Any]:
    from dataclasses import asdict

    from morpheyes_daemon.doctor.findings import by_weight, verdict

    return {
        "verdict": verdict(report.findings).value,
        "findings": [asdict(finding) for finding in by_weight(report.findings)],
        "examined": report.examined,
        "handovers": [asdict(handover) for handover in report.handovers],
    }


def _print(report: Examination, params_out: Path | None) -> None:
    from morpheyes_daemon.doctor.findings import Severity, by_weight, remedies, verdict

    signs = {Severity.STOP: "do not fly", Severity.CARE: "care", Severity.NOTE: "note"}
    for finding in by_weight(report.findings):
        typer.echo(f"\n[{signs[finding.severity]}] {finding.id}")
        typer.echo(f"  found   {finding.evidence}")
        typer.echo(f"  risk    {finding.risk}")
        typer.echo(f"  remedy  {finding.remedy}")
    for handover in report.handovers:
        typer.echo(f"\nTake-over by {handover.way}: {handover.seconds * 1e3:.0f} ms")
    typer.echo(f"\nExamined: {', '.join(report.examined)}.")
    changes = remedies(report.findings)
    if changes and params_out is None:
        typer.echo(f"{len(changes)} parameters to set: write them to a file with --params-out FILE and load it.")
    elif params_out is not None:
        typer.echo(f"{params_out}: {len(changes)} parameters; load the file in the ground station, then ask again.")
    typer.echo(f"Verdict: {verdict(report.findings)}")
