"""The simulated side of a flight: world, vehicle and autopilot, Teensy, cameras and ground crew, put together.

Everything the daemon must not know lives here. The same stage serves lockstep (in-memory links, virtual clock) and
real time (sockets and a pty, in a process of its own).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from morpheyes_daemon.clock import MS, Clock, S
from morpheyes_daemon.config.vehicle import NoServoConfig, VehicleConfig
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.simulation.airframe.dynamics import Truth, Vehicle
from morpheyes_daemon.simulation.airframe.wind import WindConditions
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP, RECOMMENDED
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from morpheyes_daemon.simulation.camera.stereo_camera import CameraTwin, Sensor
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.simulation.rendering.renderer import Renderer
from morpheyes_daemon.simulation.servo.teensy import ServoTruth, TeensyTwin
from morpheyes_daemon.simulation.worlds.collision import VehicleShape
from morpheyes_daemon.simulation.worlds.loader import World, build_world, load_world

READOUT_NS = 10 * MS
"""From mid-exposure of the later eye to the daemon having the pair."""

WIND_M_S = 2.0
"""Mean wind at 6 m height of the default flight: a light breeze, with its gusts."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What differs between simulated flights; everything random comes from `seed`.

    `rig_seed` is the rig that was calibrated; it does not change from flight to flight. `without_gps` flies on optical
    flow.
    """

    world: str
    seed: int
    rig_seed: int = 0
    wind_m_s: float = WIND_M_S
    sensor: Sensor = Sensor()
    without_gps: bool = False


class FlyingVehicle(Protocol):
    """What flies: the autopilot twin with its vehicle, or a simulator of somebody else's.

    `drift` is the share of the way by which its own position estimate may be off at the end, beyond what GPS leaves.
    """

    radio: Radio
    drift: float

    async def catch_up(self) -> None:
        """Wait until the present is known, where that is told only now and then."""

    def truth_at(self, t_ns: int) -> Truth:
        """Return where the vehicle was; InputError when that is not known."""


class SimVehicle:
    """One simulated flight's truth; `vehicle` takes the place of the autopilot twin."""

    def __init__(
        self,
        scenario: Scenario,
        config: VehicleConfig,
        clock: Clock,
        render_threads: int = 1,
        vehicle: FlyingVehicle | None = None,
    ) -> None:
        seed = scenario.seed
        self.clock = clock
        file = load_world(scenario.world)
        self.world: World = build_world(file, seed)
        if vehicle is not None and not self.world.ground.level:
            raise ConfigError(f"The world {scenario.world} is not level, and a SITL knows no hills; choose another.")
        wind = WindConditions(scenario.wind_m_s, random.Random(f"wind from {seed}").uniform(-math.pi, math.pi))
        north, east, _ = self.world.start_ned_m
        craft = Vehicle(
            wind=wind, seed=seed, start_ned_m=(north, east), yaw_rad=self.world.heading_rad, ground=self.world.ground
        )
        parameters = {**RECOMMENDED, **(FLOW_SETUP if scenario.without_gps else {})}
        self.autopilot = AutopilotTwin(craft, clock, parameters, seed=seed)
        self.vehicle: FlyingVehicle = vehicle or self.autopilot
        self.radio = self.vehicle.radio
        self.teensy = TeensyTwin(_servo_truth(config), clock, seed)
        self._fixed_m = config.servo.baseline_mm / 1e3 if isinstance(config.servo, NoServoConfig) else None
        self.rig = RigTwin(config.camera.width_px, config.camera.height_px, scenario.rig_seed)
        sensor = replace(scenario.sensor, sync_offset_s=config.camera.sync_error_ms / 1e3)
        if file.light is not None:
            sensor = replace(sensor, flicker=max(sensor.flicker, file.light.unsteady))
        self._epoch_ns = clock.now_ns()
        self.camera = CameraTwin(
            Renderer(self.world.scene), self.rig, config.camera.mount, sensor, seed, self._epoch_ns, render_threads
        )
        self._shape = VehicleShape(config.footprint, config.camera.mount)
        self.skids_m = config.footprint.hull_height_mm / 2e3

    def baseline_m(self, t_ns: int) -> float:
        """True distance between the eyes."""
        return self.rig.actual_m(self._fixed_m or self.teensy.baseline_at(t_ns))

    def truth(self, t_ns: int) -> Truth:
        """Where the vehicle really was."""
        return self.vehicle.truth_at(t_ns)

    def world_s(self, t_ns: int) -> float:
        """Time of the world, by which things in it move."""
        return (t_ns - self._epoch_ns) / S

    def clearance_m(self, t_ns: int) -> float:
        """Distance from hull and bar to the nearest obstacle, ground aside; negative is a collision."""
        truth = self.truth(t_ns)
        T = truth.T_ned_frd
        return self.world.clearance_m(T[:3, 3], T[:3, :3], self._shape, self.baseline_m(t_ns), self.world_s(t_ns))

    def expose(self, seq: int, t_ns: int) -> RawPair:
        """Take a stereo pair at `t_ns`, which must lie a sync offset in the past."""
        return self.exposure(seq, t_ns)()

    def exposure(self, seq: int, t_ns: int) -> Callable[[], RawPair]:
        """Return what renders the pair of `t_ns`; it may be called in another thread, and later than poses are kept."""
        baseline_m = self.baseline_m(t_ns)
        poses = {at_ns: self.vehicle.truth_at(at_ns).T_ned_frd for at_ns in self.camera.instants_ns(t_ns)}
        return lambda: self.camera.render_pair(t_ns, seq, poses.__getitem__, baseline_m)

    @property
    def delivery_ns(self) -> int:
        """From mid-exposure of the left eye to the pair being there."""
        return round(self.camera.sensor.sync_offset_s * S) + READOUT_NS

    def close(self) -> None:
        """End the render threads."""
        self.camera.close()


class SimVehicleCamera:
    """The `sim` camera of a daemon on the same loop: exposures on a grid, delivered a little later."""

    def __init__(self, stage: SimVehicle, rate_hz: float) -> None:
        self._stage = stage
        self._period_ns = round(S / rate_hz)
        self._seq = 0
        self._next_ns = 0

    async def open(self) -> None:
        """Start the grid of exposures."""
        self._next_ns = self._stage.clock.now_ns() + self._period_ns

    async def read(self) -> RawPair:
        """Wait for the next exposure; those missed meanwhile are skipped."""
        clock = self._stage.clock
        exposed_ns = self._next_ns
        await clock.sleep_until_ns(exposed_ns + self._stage.delivery_ns)
        late = max(0, clock.now_ns() - exposed_ns - self._stage.delivery_ns) // self._period_ns
        self._next_ns += self._period_ns * (1 + late)
        self._seq += 1 + late
        return self._stage.expose(self._seq, exposed_ns + late * self._period_ns)

    async def close(self) -> None:
        """Nothing to close."""


def _servo_truth(config: VehicleConfig) -> ServoTruth:
    return ServoTruth() if isinstance(config.servo, NoServoConfig) else ServoTruth.from_config(config.servo.motion)
