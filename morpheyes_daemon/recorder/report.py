"""The report of a recorded flight: its figures, the map, the strips and the film, from the log alone.

Uses what the autopilot reported; the simulator's own `summary.json` knows the truth.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morpheyes_daemon.config.vehicle import Footprint, VehicleConfig
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.recorder.pictures.film import FlightFilm
from morpheyes_daemon.recorder.pictures.map import draw_map
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.recorder.pictures.strips import draw_strips
from morpheyes_daemon.recorder.reader import Flight
from morpheyes_daemon.recorder.series import FlightSeries


@dataclass(frozen=True, slots=True)
class Figures:
    """A flight in numbers; NaN where nothing was recorded. Engaged time alone counts for path and speed."""

    mission: str
    seconds: float
    engaged_s: float
    path_m: float
    mean_speed_m_s: float
    peak_speed_m_s: float
    baseline_min_m: float
    baseline_max_m: float
    nearest_m: float
    perception_rate_hz: float
    braking_events: int
    events: int
    held_by: dict[str, float]
    """Share of the engaged time in which the mission, or else which bound of the governor, kept the speed down."""


def figures(series: FlightSeries, mission: str) -> Figures:
    """Return the figures of a flight."""
    engaged = [(a, b) for a, b, state in series.spans("gate", "state") if state == State.ENGAGED]
    engaged_s = sum(b - a for a, b in engaged)
    path_m = sum(_path_m(series, a, b) for a, b in engaged)
    v = series.column("vehicle", "v_ned_m_s").reshape(-1, 3)
    baseline = series.column("baseline", "baseline_m")
    nearest, frames = series.column("perception", "nearest_m"), len(series.messages("perception"))
    return Figures(
        mission=mission,
        seconds=series.duration_s,
        engaged_s=engaged_s,
        path_m=path_m,
        mean_speed_m_s=path_m / engaged_s if engaged_s else math.nan,
        peak_speed_m_s=float(np.hypot(v[:, 0], v[:, 1]).max(initial=0.0)),
        baseline_min_m=float(baseline.min()) if baseline.size else math.nan,
        baseline_max_m=float(baseline.max()) if baseline.size else math.nan,
        nearest_m=float(np.nanmin(nearest, initial=math.inf)) if frames else math.nan,
        perception_rate_hz=frames / series.duration_s if series.duration_s else math.nan,
        braking_events=len(series.braking()),
        events=len(series.events),
        held_by=_held_by(series, engaged),
    )


def _held_by(series: FlightSeries, engaged: list[tuple[float, float]]) -> dict[str, float]:
    flown = [
        governed.bound if governed.wanted_m_s > 0.999 * governed.limit_m_s else "mission"
        for t_s, governed in zip(series.times_s("governed"), series.messages("governed"), strict=True)
        if any(start_s <= t_s <= end_s for start_s, end_s in engaged)
    ]
    return {name: times / len(flown) for name, times in Counter(flown).most_common()}


def _path_m(series: FlightSeries, start_s: float, end_s: float) -> float:
    times, path = series.path_ned_m()
    flown = path[(times >= start_s) & (times <= end_s)]
    return float(np.linalg.norm(np.diff(flown, axis=0), axis=1).sum())


def draw_report(flight: Flight, out: Path) -> list[Path]:
    """Write map.png, strips.png and, when the log holds images, flight.mp4 into `out`; returns what was written."""
    out.mkdir(parents=True, exist_ok=True)
    series, header = flight.series(), flight.header
    scene = ObstacleMap.from_json(header["scene"]) if "scene" in header else ObstacleMap()
    config = header.get("config")
    footprint = VehicleConfig.model_validate_json(config).footprint if config else Footprint()
    title = f"{header.get('mission', '')}  {header.get('wall_time', '')[:16].replace('T', ' ')}".strip()
    draw_map(out / "map.png", series, scene, footprint, title=title)
    draw_strips(out / "strips.png", series, title=title)
    written = [out / "map.png", out / "strips.png"]
    if flight.values("image/depth"):
        FlightFilm.of_log(out / "flight.mp4", flight, scene, footprint)
        written.append(out / "flight.mp4")
    return written
