"""What a mission strategy is: how to look (`perceive`) and where to fly (`decide`).

`perceive` runs in the vision worker and sees the images; `decide` runs in the event loop on what `perceive` found.
The two run in different processes: state kept on `self` by one is not seen by the other. Neither may read a clock
or open anything; both must be deterministic.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from morpheyes_daemon.config.vehicle import Footprint, Section
from morpheyes_daemon.messages.core import DepthMap, Image, MissionCommand, Track, Vector, VehicleState
from morpheyes_daemon.messages.mission import Observation
from morpheyes_daemon.transforms import R_from_rpy


class StrategyParameters(Section):
    """Base of every strategy's parameters: strict and frozen."""


@dataclass(frozen=True, slots=True)
class Craft:
    """What a strategy may know of the vehicle it flies on.

    `T_frd_rig` is where the stereo bar sits on the body. `baseline_range_m` is what the rig can take.
    """

    footprint: Footprint
    T_frd_rig: Vector
    baseline_range_m: tuple[float, float]
    frame_period_s: float
    depth_sigmas: float
    max_relative_depth_error: float


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One frame as the strategy sees it in the vision worker.

    `left` is the rectified left image (H, W) uint8 grey, `right` its partner; `vehicle` is the state at exposure.
    """

    depth: DepthMap
    left: Image
    right: Image
    vehicle: VehicleState
    T_frd_rig: Vector

    @property
    def T_ned_rect(self) -> Vector:
        """Pose (4, 4) of the rectified left camera at exposure."""
        T = np.eye(4)
        T[:3, :3] = R_from_rpy(self.vehicle.roll_rad, self.vehicle.pitch_rad, self.vehicle.yaw_rad)
        T[:3, 3] = self.vehicle.p_ned_m
        return T @ self.T_frd_rig @ self.depth.T_rig_rect


class Strategy(ABC):
    """A mission. Subclasses set `Parameters` and are found by name through the entry points."""

    Parameters: ClassVar[type[StrategyParameters]] = StrategyParameters

    def __init__(self, parameters: StrategyParameters, craft: Craft) -> None:
        self.parameters = parameters
        self.craft = craft

    def perceive(self, view: View) -> Any:
        """Return what `decide` needs of one frame; picklable and small. Called in the vision worker."""
        return None

    def track(self, percept: Any) -> Track | None:
        """Return the moving object that a percept tells of, for topic, log and autopilot; None when there is none."""
        return None

    @abstractmethod
    def decide(self, observation: Observation) -> MissionCommand:
        """Return what the vehicle should do until the next frame. Called in the event loop."""
