"""`morpheyes run`: the daemon on the vehicle; systemd starts it like this."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    config: Annotated[Path | None, typer.Option("--config", help="The vehicle; none: ./config.yaml.")] = None,
    mission: Annotated[
        str | None, typer.Option("--mission", help="Mission by name or path, instead of the configured one.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="Calibration file, instead of the configured one.")
    ] = None,
) -> None:
    """Run the daemon until Ctrl-C or SIGTERM; what is missing is waited for, and said on standard error.

    It never arms and never takes off. It ends in neutral, then release; a second Ctrl-C releases at once.
    """
    import asyncio

    from morpheyes_daemon.config.packaged import load_config
    from morpheyes_daemon.daemon.service import load_rig, real_time_runner, serve
    from morpheyes_daemon.daemon.stdio import given_away
    from morpheyes_daemon.perception.pipeline import PipelineFactory
    from morpheyes_daemon.strategies.missions import find_mission, load_mission

    vehicle = load_config(config)
    if calibration is not None:
        vehicle = vehicle.model_copy(update={"calibration": calibration})
    name = mission or vehicle.mission
    pipeline = PipelineFactory(vehicle, load_mission(name), load_rig(vehicle))
    with real_time_runner() as runner, given_away() as journal:
        try:
            runner.run(serve(pipeline, find_mission(name).stem, journal))
        except asyncio.CancelledError:
            raise typer.Exit(130) from None
