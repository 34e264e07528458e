"""The interface of a mission strategy: perception (`perceive`) and decision (`decide`).

`perceive` runs in the vision worker and gets the images; `decide` runs in the event loop and gets the percept.
The two run in different processes: state kept on `self` by one is not visible to the other. Neither may read a clock
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
    """Properties of the vehicle that a strategy may use.

    `T_frd_rig` (4, 4) is the pose of the stereo bar on the body, metres. `baseline_range_m` is the smallest and largest
    baseline of the rig.
    """

    footprint: Footprint
    T_frd_rig: Vector
    baseline_range_m: tuple[float, float]
    frame_period_s: float
    depth_sigmas: float
    max_relative_depth_error: float


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One rectified stereo frame, as a strategy gets it in the vision worker.

    `left` is the rectified left image (H, W) uint8 grey, `right` its partner; `vehicle` is the state at exposure.
    """

    depth: DepthMap
    left: Image
    right: Image
    vehicle: VehicleState
    T_frd_rig: Vector

    @property
    def T_ned_rect(self) -> Vector:
        """Pose (4, 4) of the rectified left camera in ned at exposure, metres."""
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
        """Return the percept of one frame for `decide`; picklable and small. Called in the vision worker."""
        return None

    def track(self, percept: Any) -> Track | None:
        """Return the track of a percept, for topic, log and autopilot; None when there is none."""
        return None

    @abstractmethod
    def decide(self, observation: Observation) -> MissionCommand:
        """Return the mission command until the next frame. Called in the event loop."""
