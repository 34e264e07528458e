"""What a simulated flight leaves in its folder: summary, log, map, strips and film."""

from __future__ import annotations

import json
from pathlib import Path

from morpheyes_daemon.app import Daemon
from morpheyes_daemon.clock import S, wall_time_s
from morpheyes_daemon.experiments.flight import FlightPlan, Summary, Watchers
from morpheyes_daemon.experiments.stage import Stage
from morpheyes_daemon.messages import VehicleState
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.pictures.film import FlightFilm
from morpheyes_daemon.recorder.pictures.map import draw_map
from morpheyes_daemon.recorder.pictures.scene import Disc, Scene
from morpheyes_daemon.recorder.pictures.strips import draw_strips
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.recorder.series import FlightSeries
from morpheyes_daemon.simulation.worlds import World
from morpheyes_daemon.stereo.rig import RigModel

FILES = ("summary.json", "flight.mcap", "map.png", "strips.png", "flight.mp4")


def scene_of(world: World) -> Scene:
    """Return what the top view shows of a world."""
    return Scene(
        discs=tuple(Disc(disc.x_m, disc.y_m, disc.radius_m) for disc in world.discs),
        start_m=world.start_ned_m[:2],
        goal_m=world.goal_ned_m[:2] if world.goal_ned_m else None,
    )


class FlightOutputs:
    """Attach to a flight's watchers, then `finish` with its summary."""

    def __init__(self, folder: Path, plan: FlightPlan) -> None:
        self._folder = folder
        self._plan = plan
        self._series = FlightSeries()
        self._recorder: Recorder | None = None
        self._film: FlightFilm | None = None
        self._scene = Scene()

    def watch(self, watchers: Watchers) -> None:
        """Have every frame filmed and every topic logged."""
        watchers.image_rate_hz = self._plan.config.camera.rate_hz
        watchers.attach.append(self._attach)

    def finish(self, summary: Summary) -> None:
        """Close log and film, draw the pictures, write the summary."""
        assert self._recorder is not None
        assert self._film is not None
        self._recorder.close()
        self._film.close()
        title = f"{summary.mission}, seed {summary.seed}, baseline {summary.baseline_mode}: {summary.outcome}"
        speed, room = summary.mean_speed_m_s, summary.min_clearance_m
        figures = f"{summary.time_s:.1f} s, {speed:.2f} m/s, clearance {room:.2f} m"
        draw_map(
            self._folder / "map.png",
            self._series,
            self._scene,
            self._plan.config.footprint,
            title=f"{title}, {figures}",
            collided=summary.outcome == "collided",
        )
        draw_strips(self._folder / "strips.png", self._series, title=title)
        (self._folder / "summary.json").write_text(json.dumps(summary.as_json(), indent=2) + "\n", encoding="utf-8")

    def _attach(self, daemon: Daemon, stage: Stage) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            (self._folder / name).unlink(missing_ok=True)
        world, plan = stage.world, self._plan
        self._scene = scene_of(world)
        header = flight_header(
            mission=plan.mission_name,
            mission_file=plan.mission,
            config=plan.config,
            calibration_hash=RigModel.load(plan.calibration).hash,
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

    def _note_truth(self, state: VehicleState, stage: Stage) -> None:
        now_ns = stage.clock.now_ns()
        truth = self._series.truth
        if not truth or now_ns - truth[-1][0] >= S // 20:
            self._series.add_truth(now_ns, stage.truth(now_ns).p_ned_m)
