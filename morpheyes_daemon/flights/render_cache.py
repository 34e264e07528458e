"""A stage whose pictures are kept in a folder, so that branches of one flight that go the same way render once.

A picture is a pure function of the world, the sensor, the number of the frame and the poses during both exposures;
what is kept is therefore the very bits that would have been rendered.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from morpheyes_daemon.clock import Clock
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.flights.sim_vehicle import Scenario, SimVehicle
from morpheyes_daemon.messages.core import RawPair, frozen


class CachedVehicle(SimVehicle):
    """A `SimVehicle` of one world and rig with its own `folder`; it renders in one thread: threads end at a fork."""

    def __init__(self, scenario: Scenario, config: VehicleConfig, clock: Clock, folder: Path) -> None:
        super().__init__(scenario, config, clock)
        self._folder = folder

    def exposure(self, seq: int, t_ns: int) -> Callable[[], RawPair]:
        """Return what renders the pair of `t_ns`, or reads it where a branch has rendered it before."""
        render = super().exposure(seq, t_ns)
        path = self._folder / f"{self._name(seq, t_ns)}.npy"

        def look() -> RawPair:
            if path.exists():
                left, right = np.load(path)
                return RawPair(seq, t_ns, frozen(left), frozen(right))
            pair = render()
            unfinished = path.with_suffix(f".{os.getpid()}.npy")
            np.save(unfinished, np.stack([pair.left, pair.right]))
            unfinished.replace(path)
            return pair

        return look

    def _name(self, seq: int, t_ns: int) -> str:
        """A name that two exposures share only when they show the same."""
        told = hashlib.sha256(f"{seq} {t_ns} {self.baseline_m(t_ns)!r} {self.camera.sensor}".encode())
        for instant_ns in self._instants(t_ns):
            told.update(self.truth(instant_ns).T_ned_frd.tobytes())
        return told.hexdigest()[:32]

    def _instants(self, t_ns: int) -> Iterator[int]:
        """Begin, middle and end of both exposures."""
        sensor = self.camera.sensor
        half_ns = round(sensor.exposure_time_s * 5e8)
        for eye_ns in (t_ns, t_ns + round(sensor.sync_offset_s * 1e9)):
            yield from (eye_ns - half_ns, eye_ns, eye_ns + half_ns)
