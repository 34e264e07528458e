"""What is measured of a campaign's flights beside the summary, by the strategy that flies them."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol

from morpheyes_daemon.daemon.composition import Daemon
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.flights.sim_vehicle import SimVehicle

MEASURES = {
    "gap": "morpheyes_daemon.campaigns.gap_metrics:GapMeasures",
    "imo": "morpheyes_daemon.campaigns.imo_metrics:ImoMeasures",
}
"""Strategy to the class that looks on."""


class Measures(Protocol):
    """Looks on at one flight."""

    def attach(self, daemon: Daemon, stage: SimVehicle) -> None:
        """Tap what is needed."""

    def row(self) -> dict[str, Any]:
        """Return the further columns of the flight, once it is over."""


def measures_for(plan: FlightPlan) -> Measures | None:
    """Return what looks on at flights of a plan's strategy, None when the summary says it all."""
    place = MEASURES.get(plan.mission.strategy)
    if place is None:
        return None
    module, _, name = place.partition(":")
    make: Callable[[FlightPlan], Measures] = getattr(import_module(module), name)
    return make(plan)
