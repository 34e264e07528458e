"""A made-up forest flight for tests of log and pictures: smooth, seeded, and through every topic of the bus."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import (
    BaselineEstimate,
    DepthSummary,
    Event,
    Governed,
    Intent,
    MissionCommand,
    Perception,
    Sticks,
    VehicleState,
)
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.recorder.pictures.scene import Disc, ObstacleMap
from tests.support.hand_clock import HandClock

STICK_HZ = 50
CAMERA_HZ = 5


def forest_scene(seed: int = 0) -> ObstacleMap:
    """400 trunks per hectare, none on the made-up path."""
    rng = np.random.default_rng(seed)
    discs = []
    while len(discs) < 150:
        x, y, radius = rng.uniform(0, 80), rng.uniform(-14, 14), rng.uniform(0.1, 0.4)
        if abs(y - path_y_m(x)) > radius + 0.5:
            discs.append(Disc(float(x), float(y), float(radius)))
    return ObstacleMap(tuple(discs), start_m=(0.0, 0.0), goal_m=(80.0, 0.0))


def path_y_m(x_m: float) -> float:
    """The path: a wandering line from (0, 0) to (80, 0)."""
    return 2.2 * math.sin(x_m / 7.0) * math.sin(math.pi * x_m / 80.0) + 0.5 * math.sin(x_m / 2.3)


@dataclass
class SyntheticFlight:
    """Publishes the flight on `topics` and `events`, moving `clock`."""

    topics: Topics
    events: EventLog
    clock: HandClock
    images: bool = True

    def fly(self, seconds: float = 32.0) -> None:
        """Publish `seconds` of flight."""
        self.x_m = 0.0
        self.baseline_m = 0.2
        self.events.publish(Event(self.clock.t_ns, "safety", Reason.ENGAGED))
        for i in range(round(seconds * STICK_HZ)):
            self.clock.t_ns += S // STICK_HZ
            self._step(i)
        self.events.publish(Event(self.clock.t_ns, "mission", Reason.GOAL_REACHED))

    def _step(self, i: int) -> None:
        t = self.clock.t_ns
        s = i / STICK_HZ
        braking = 14.0 < s < 15.2
        z_close = 4.0 + 3.0 * math.sin(s / 2.1) ** 2 - 3.0 * math.exp(-((s - 14.3) ** 2))
        limit = 3.4 - 2.2 * math.exp(-((s - 14.0) ** 2) / 3)
        speed = 0.0 if braking else min(limit, 0.6 * s) * 0.93
        self.x_m = min(80.0, self.x_m + speed / STICK_HZ)
        wanted = float(np.clip(0.04 * z_close, 0.1, 0.3))
        wanted_m_s = 0.5 if s > 13.0 else 3.5
        self.baseline_m += float(np.clip(wanted - self.baseline_m, -0.001, 0.001))
        self._publish_vehicle(t, s, speed, braking)
        self.topics.baseline.publish(BaselineEstimate(t, wanted, self.baseline_m, 0.0015, wanted != self.baseline_m))
        self.topics.governed.publish(Governed(t, limit, "clear", z_close, 30 * self.baseline_m, speed, wanted_m_s))
        if i % (STICK_HZ // CAMERA_HZ) == 0:
            self._publish_perception(t, i, z_close, wanted, braking)

    def _publish_vehicle(self, t: int, s: float, speed: float, braking: bool) -> None:
        y = path_y_m(self.x_m)
        slope = (path_y_m(self.x_m + 0.1) - y) / 0.1
        yaw = math.atan(slope)
        v = (speed * math.cos(yaw), speed * math.sin(yaw), 0.0)
        self.topics.vehicle.publish(
            VehicleState(
                t_ns=t,
                attitude_t_ns=t,
                pitch_rad=-0.05 * speed,
                yaw_rad=yaw,
                position_t_ns=t,
                p_ned_m=(self.x_m, y, -1.5),
                v_ned_m_s=v,
                heartbeat_t_ns=t,
                armed=True,
                custom_mode=5,
                landed=False,
            )
        )
        pitch = 1500 if braking else round(1500 - 90 * speed)
        yaw_us = round(1500 + 120 * math.sin(s * 1.3))
        self.topics.sticks.publish(Sticks(t, t + S // 5, 1500, pitch, 1500, yaw_us))
        state = State.BRAKING if braking else State.ENGAGED
        reason = Reason.NO_FREE_PATH if braking else Reason.ENGAGED
        action = Action.NEUTRAL if braking else Action.STICKS
        self.topics.gate.publish(GateOutput(t, state, action, reason, 1500, pitch, 1500, yaw_us))

    def _publish_perception(self, t: int, i: int, z_close: float, wanted: float, braking: bool) -> None:
        near = 320 * 0.9 * self.baseline_m / 80
        summary = DepthSummary(
            i, t - S // 10, t, self.baseline_m, 0.0015, 370.0, 0.82, 0.25, near, 0.91, 0.01, z_close, 0.06, "5f1e"
        )
        left, depth = synthetic_images(i) if self.images else (None, None)
        percept = {"points": np.full((40, 3), 0.5)}
        self.topics.perception.publish(Perception(summary, percept, np.full(72, z_close, np.float32), (), left, depth))
        intent = Intent.STOP if braking else Intent.FLY
        self.topics.command.publish(
            MissionCommand(
                i,
                t,
                t + S // 2,
                intent,
                Reason.NO_FREE_PATH if braking else None,
                (3.0, 0.0, 0.0),
                0.0,
                1.5,
                wanted,
                z_close,
                (self.x_m, 0.0, -1.5),
                z_close,
            )
        )


def synthetic_images(i: int) -> tuple[np.ndarray, np.ndarray]:
    """A grey ramp with posts, and a depth map that goes with it; (240, 320, 3) uint8 and (240, 320) float32."""
    v, u = np.mgrid[0:240, 0:320]
    depth = np.where(v > 130, 370 * 1.5 / np.maximum(v - 119.5, 1), 28.0).astype(np.float32)
    left = np.stack([80 + v // 3, 110 + v // 3, 70 + v // 4], axis=-1).astype(np.uint8)
    for k in range(5):
        z = 3.0 + 2.5 * k
        centre, half = (70 * k + 3 * i) % 320, 60 / z
        post = np.abs(u - centre) < half
        nearer = post & (depth > z)
        depth[nearer] = z
        left[nearer] = (40, 60 + 8 * k, 80 + 8 * k)
    depth[:, :12] = np.nan
    return left, depth
