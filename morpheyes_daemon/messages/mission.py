"""What a mission strategy decides on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from morpheyes_daemon.messages.core import DepthSummary, VehicleState


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What `decide` gets: the newest percept and the vehicle now and at exposure.

    `braking_m` is the distance the vehicle needs to stop from its present speed, `reserve_m` the same with the
    governor's reaction time; `engaged` tells whether the mission has the vehicle, braking for a gap in the inputs
    included.
    """

    now_ns: int
    percept: Any
    summary: DepthSummary
    vehicle: VehicleState
    at_exposure: VehicleState
    baseline_m: float
    braking_m: float
    reserve_m: float
    engaged: bool
