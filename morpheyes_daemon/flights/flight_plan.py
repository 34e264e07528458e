"""From what a person asks for to a flight plan; every wrong wish becomes one sentence."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from morpheyes_daemon.config.packaged import load_config
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.errors import UsageError
from morpheyes_daemon.flights.lockstep import FlightPlan, sim_config
from morpheyes_daemon.flights.sim_vehicle import Scenario
from morpheyes_daemon.perception.craft import fitting_rig
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.simulation.worlds.loader import load_world
from morpheyes_daemon.stereo.calibration_file import write_calibration
from morpheyes_daemon.strategies.missions import find_mission, load_mission

DISPARITIES_OF_PX = 640
"""Width of the images that a number of disparities is said for; smaller images search in proportion."""


def make_plan(
    mission: str,
    *,
    seed: int = 0,
    baseline: str = "variable",
    rate_hz: float = 5.0,
    size: str = "640x480",
    config: Path | None = None,
    calibration: str | None = None,
    world: str | None = None,
    wind_m_s: float = 2.0,
    latency_ms: float | None = None,
    disparities: int | None = None,
    limit_s: float = 180.0,
    threads: int = 1,
    progress: Progress = silent,
) -> FlightPlan:
    """Return the plan of one simulated flight; raises UsageError, ConfigError or CalibrationError."""
    file = load_mission(mission)
    vehicle = sim_config(load_config(config), rate_hz, parse_size(size), None)
    vehicle = hold(vehicle, parse_baseline(baseline))
    stereo: dict[str, float] = {}
    if latency_ms is not None:
        stereo["latency_ms"] = latency_ms
    if disparities is not None:
        stereo["disparities_fraction"] = disparities / DISPARITIES_OF_PX
    vehicle = vehicle.model_copy(update={"stereo": vehicle.stereo.model_copy(update=stereo)})
    place = world or file.world
    load_world(place)
    path = calibration_file(calibration or usual_calibration(file.strategy), progress)
    fitting_rig(path, vehicle)
    return FlightPlan(
        mission_name=find_mission(mission).stem,
        mission=file,
        config=vehicle,
        calibration=path,
        scenario=Scenario(place, seed, wind_m_s=wind_m_s),
        limit_s=limit_s,
        threads=threads,
    )


def with_seed(plan: FlightPlan, seed: int) -> FlightPlan:
    """Return the same flight with another seed."""
    return replace(plan, scenario=replace(plan.scenario, seed=seed))


def hold(config: VehicleConfig, baseline_m: float | None) -> VehicleConfig:
    """Return the configuration with a baseline held; raises UsageError when the rig cannot take it."""
    low, high = config.baseline_range_m
    if baseline_m is None:
        return config
    if not low <= baseline_m <= high:
        raise UsageError(f"--baseline {baseline_m:g}: the rig goes from {low:g} to {high:g} metres.")
    return config.model_copy(update={"hold_baseline_mm": 1e3 * baseline_m})


def parse_baseline(text: str) -> float | None:
    """Return the length to hold in metres, None for 'variable'; raises UsageError."""
    if text == "variable":
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--baseline {text}: give 'variable' or a length in metres such as 0.2.") from None


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) of a text like 640x480; raises UsageError."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found:
        raise UsageError(f"--size {text}: give WIDTHxHEIGHT such as 640x480.")
    width, height = int(found[1]), int(found[2])
    if not (160 <= width <= 1920 and width * 3 == height * 4):
        raise UsageError(f"--size {text}: the simulated camera has 4:3 images from 160x120 to 1920x1440.")
    return width, height


def usual_calibration(strategy: str) -> str:
    """Return how the rig of a mission is calibrated unless said otherwise: with its mount where openings are tight."""
    return "mounted" if strategy == "gap" else "solved"


def calibration_file(kind: str, progress: Progress = silent) -> Path:
    """Return the calibration file to fly with: solved or mounted (made once and kept), exact, or a path."""
    from morpheyes_daemon.flights.sim_calibration import mounted_rig_file, solved_rig_file
    from morpheyes_daemon.simulation.rendering.texture_cache import cache_folder

    if kind == "solved":
        return solved_rig_file(0, progress=progress)
    if kind == "mounted":
        return mounted_rig_file(0, progress=progress)
    if kind == "exact":
        from morpheyes_daemon.simulation.camera.true_rig import RigTwin

        path = cache_folder("calibration") / "exact.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_calibration(RigTwin(640, 480, 0).exact_rig(), path)
        return path
    return Path(kind)
