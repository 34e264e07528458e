"""What a simulated flight leaves in its folder: summary, log, map, strips and film."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from morpheyes_daemon.clock import S, wall_time_s
from morpheyes_daemon.daemon.composition import Daemon
from morpheyes_daemon.flights.lockstep import FlightPlan, Summary, Watchers
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.pictures.film import FlightFilm
from morpheyes_daemon.recorder.pictures.map import draw_map
from morpheyes_daemon.recorder.pictures.scene import Disc, ObstacleMap, Polygon
from morpheyes_daemon.recorder.pictures.strips import draw_strips
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.recorder.series import FlightSeries
from morpheyes_daemon.simulation.worlds.loader import World
from morpheyes_daemon.simulation.worlds.world import GapTruth
from morpheyes_daemon.stereo.calibration_file import calibration_hash, read_calibration
from morpheyes_daemon.transforms import inverse

FILES = ("summary.json", "flight.mcap", "map.png", "strips.png", "flight.mp4")


def scene_of(world: World, t_s: float = 0.0) -> ObstacleMap:
    """Return what the top view shows of a world at a time of its own."""
    return ObstacleMap(
        discs=tuple(Disc(disc.x_m, disc.y_m, disc.radius_m) for disc in world.discs),
        polygons=tuple(piece for gap in world.gaps for piece in wall_plan(gap, t_s)),
        start_m=world.start_ned_m[:2],
        goal_m=world.goal_ned_m[:2] if world.goal_ned_m else None,
    )


def wall_plan(gap: GapTruth, t_s: float) -> tuple[Polygon, ...]:
    """Return a wall from above (north, east), cut open as wide as its openings are at half their height."""
    ends = [-gap.half_width_m, gap.half_width_m]
    for outline in gap.outlines:
        middle = 0.5 * (outline[:, 1].min() + outline[:, 1].max())
        above = outline[:, 1] < middle
        y0, z0, y1, z1 = np.hstack([outline, np.roll(outline, -1, axis=0)])[above != np.roll(above, -1)].T
        ends += (y0 + (y1 - y0) * (middle - z0) / (z1 - z0)).tolist()
    ends.sort()
    T, half = gap.T_ned_wall(t_s), gap.thickness_m / 2
    pieces = []
    for left, right in zip(ends[::2], ends[1::2], strict=True):
        corners = np.array([(-half, left), (-half, right), (half, right), (half, left)])
        pieces.append(tuple((float(x), float(y)) for x, y in corners @ T[:2, :2].T + T[:2, 3]))
    return tuple(pieces)


class FlightArtifacts:
    """Attach to a flight's watchers, then `finish` with its summary."""

    def __init__(self, folder: Path, plan: FlightPlan) -> None:
        self._folder = folder
        self._plan = plan
        self._series = FlightSeries()
        self._recorder: Recorder | None = None
        self._film: FlightFilm | None = None
        self._scene = ObstacleMap()
        self._stage: SimVehicle | None = None
        self._through_s: float | None = None

    def watch(self, watchers: Watchers) -> None:
        """Have every frame filmed and every topic logged."""
        watchers.image_rate_hz = self._plan.config.camera.rate_hz
        watchers.attach.append(self._attach)

    def finish(self, summary: Summary) -> None:
        """Close log and film, draw the pictures, write the summary."""
        assert self._recorder is not None
        assert self._film is not None
        assert self._stage is not None
        self._recorder.close()
        self._film.close()
        title = f"{summary.mission}, seed {summary.seed}, baseline {summary.baseline_mode}: {summary.outcome}"
        speed, room = summary.mean_speed_m_s, summary.min_clearance_m
        figures = f"{summary.time_s:.1f} s, {speed:.2f} m/s, clearance {1e3 * room:.0f} mm"
        draw_map(
            self._folder / "map.png",
            self._series,
            self._scene if self._through_s is None else scene_of(self._stage.world, self._through_s),
            self._plan.config.footprint,
            title=f"{title}, {figures}",
            collided=summary.outcome == "collided",
        )
        draw_strips(self._folder / "strips.png", self._series, title=title)
        (self._folder / "summary.json").write_text(json.dumps(summary.as_json(), indent=2) + "\n", encoding="utf-8")

    def _attach(self, daemon: Daemon, stage: SimVehicle) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            (self._folder / name).unlink(missing_ok=True)
        world, plan = stage.world, self._plan
        self._stage = stage
        self._scene = scene_of(world)
        header = flight_header(
            mission=plan.mission_name,
            mission_file=plan.mission,
            config=plan.config,
            calibration_hash=calibration_hash(read_calibration(plan.calibration)),
            wall_s=wall_time_s(),
            scene=self._scene.as_json(),
        )
        self._recorder = Recorder(
            daemon.topics,
            daemon.events,
            stage.clock,
            self._folder / "flight.mcap",
            header,
            image_rate_hz=plan.config.recorder.image_rate_hz if plan.config.recorder.images else None,
            threaded=False,
        )
        self._series.watch(daemon.topics, daemon.events)
        self._film = FlightFilm(self._folder / "flight.mp4", self._scene, plan.config.footprint)
        self._film.watch(daemon.topics)
        daemon.topics.vehicle.tap(lambda state: self._note_truth(state, stage))

    def _note_truth(self, state: VehicleState, stage: SimVehicle) -> None:
        now_ns = stage.clock.now_ns()
        truth = self._series.truth
        if not truth or now_ns - truth[-1][0] >= S // 20:
            p_ned_m = stage.truth(now_ns).p_ned_m
            self._series.add_truth(now_ns, p_ned_m)
            self._note_wall(p_ned_m, stage, now_ns)

    def _note_wall(self, p_ned_m: Sequence[float], stage: SimVehicle, now_ns: int) -> None:
        """Keep the time when the vehicle reaches a wall: on the map a wall that sways stands as it was then."""
        t_s = stage.world_s(now_ns)
        for gap in stage.world.gaps[:1]:
            if self._through_s is None and (inverse(gap.T_ned_wall(t_s)) @ np.array([*p_ned_m, 1.0]))[0] > 0.0:
                self._through_s = t_s
