"""Leases: the inputs without which no stick is deflected, each with its reason."""

from __future__ import annotations

from enum import StrEnum

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.reasons import Reason

LONGEST_LEASE_NS = 10 * S
"""A lease or an offer that claims to last longer carries a wrong stamp and is not believed."""


class Lease(StrEnum):
    """Inputs without which no stick is deflected, the gravest first; the reason of each is in `LEASE_REASONS`."""

    LINK = "link"
    SWITCH = "switch"
    SUPERVISOR = "supervisor"
    VEHICLE = "vehicle"
    FRAME = "frame"
    DEPTH = "depth"
    MISSION = "mission"


LEASE_REASONS: dict[Lease, Reason] = {
    Lease.LINK: Reason.LINK_LOST,
    Lease.SWITCH: Reason.SWITCH_STALE,
    Lease.SUPERVISOR: Reason.SUPERVISOR_STALE,
    Lease.VEHICLE: Reason.VEHICLE_STALE,
    Lease.FRAME: Reason.FRAME_STALE,
    Lease.DEPTH: Reason.DEPTH_STALE,
    Lease.MISSION: Reason.MISSION_STALE,
}
