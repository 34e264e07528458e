"""What the page shows of one moment, as plain JSON values; whatever is missing is null.

Pure: asks the topics for their newest values and computes nothing that others rely on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Event, Perception, VehicleState
from morpheyes_daemon.messages.reasons import Reason

STRIPS = ("t_s", "z_close_m", "trust_m", "near_m", "baseline_mm", "target_mm", "speed_m_s", "limit_m_s", "wanted_m_s")
"""The columns of the live strips, in the order in which a row carries them."""
FAULTS_FROM = 40
"""Reasons with this number or more are things that went wrong."""


def number(value: float | None, digits: int = 3) -> float | None:
    """Return a rounded float, None for what is not finite: JSON has no NaN."""
    return round(float(value), digits) if value is not None and math.isfinite(value) else None


def numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    """`number` of every value."""
    return {key: number(value) for key, value in values.items()}


def reason_row(reason: Reason | None) -> dict[str, Any] | None:
    """Return code, text and whether it is a fault."""
    if reason is None:
        return None
    return {"code": reason.value, "text": reason.text, "fault": reason.number >= FAULTS_FROM}


def event_row(event: Event, start_ns: int) -> dict[str, Any]:
    """Return one line of the event list."""
    row = reason_row(event.reason) or {}
    return {"t_s": number((event.t_ns - start_ns) / S, 2), "source": event.source, "detail": event.text, **row}


def snapshot(topics: Topics, now_ns: int, start_ns: int) -> dict[str, Any]:
    """Return everything the page shows but images and events."""
    return {
        "t_s": number((now_ns - start_ns) / S, 2),
        **_state(topics),
        "vehicle": _vehicle(topics.vehicle.get()),
        "depth": _depth(topics.perception.get()),
        "command": _command(topics),
        "baseline": _baseline(topics),
        "speed": _speed(topics),
        "health": _health(topics),
    }


def strip_row(shown: Mapping[str, Any]) -> list[float | None]:
    """Return the row of the live strips that belongs to a snapshot, in the order of `STRIPS`."""
    command, depth = shown["command"] or {}, shown["depth"] or {}
    speed, baseline = shown["speed"] or {}, shown["baseline"] or {}
    return [
        shown["t_s"],
        command.get("z_close_m"),
        speed.get("trust_m"),
        depth.get("near_m"),
        baseline.get("baseline_mm"),
        baseline.get("target_mm"),
        (shown["vehicle"] or {}).get("speed_m_s"),
        speed.get("limit_m_s"),
        speed.get("wanted_m_s"),
    ]


def _state(topics: Topics) -> dict[str, Any]:
    """Health knows the state from the start, the gate's output only once sticks are handled."""
    gate, health = topics.gate.get(), topics.health.get()
    newest = gate if gate is not None else health
    return {
        "state": str(newest.state) if newest is not None else None,
        "reason": reason_row(newest.reason) if newest is not None else None,
        "missing": reason_row(health.missing) if health is not None else None,
        "action": str(gate.action) if gate is not None else None,
        "sticks_us": list(gate.widths_us) if gate is not None else None,
    }


def _vehicle(vehicle: VehicleState | None) -> dict[str, Any] | None:
    if vehicle is None:
        return None
    return {
        "armed": vehicle.armed,
        "mode": vehicle.custom_mode,
        "north_m": number(vehicle.p_ned_m[0]),
        "east_m": number(vehicle.p_ned_m[1]),
        "height_m": number(vehicle.height_m if math.isfinite(vehicle.height_m) else -vehicle.p_ned_m[2]),
        "yaw_rad": number(vehicle.yaw_rad, 4),
        "v_north_m_s": number(vehicle.v_ned_m_s[0]),
        "v_east_m_s": number(vehicle.v_ned_m_s[1]),
        "speed_m_s": number(math.hypot(vehicle.v_ned_m_s[0], vehicle.v_ned_m_s[1])),
        "battery_v": number(vehicle.battery_v, 2),
        "battery_fraction": number(vehicle.battery_fraction, 3),
    }


def _depth(perception: Perception | None) -> dict[str, Any] | None:
    if perception is None:
        return None
    summary = perception.summary
    return {
        "seq": summary.seq,
        "near_m": number(summary.near_limit_m),
        "nearest_m": number(summary.nearest_m),
        "valid_pct": number(100 * summary.valid_fraction, 1),
        "ceiling_pct": number(100 * summary.ceiling_fraction, 1),
        "compute_ms": number(1e3 * summary.compute_s, 1),
        "h_fov_rad": number(summary.h_fov_rad, 4),
        "calibration_hash": summary.calibration_hash,
        "sectors_m": [number(z, 2) for z in perception.sectors_m.tolist()],
        "image_faults": [reason_row(reason) for reason in perception.image_faults],
    }


def _command(topics: Topics) -> dict[str, Any] | None:
    command = topics.command.get()
    if command is None:
        return None
    return {
        "intent": str(command.intent),
        "reason": reason_row(command.reason),
        "z_close_m": number(command.z_close_m),
        "clear_m": number(command.clear_m),
        "v_north_m_s": number(command.v_ned_m_s[0]),
        "v_east_m_s": number(command.v_ned_m_s[1]),
    }


def _baseline(topics: Topics) -> dict[str, Any] | None:
    baseline = topics.baseline.get()
    if baseline is None:
        return None
    return {
        "baseline_mm": number(1e3 * baseline.baseline_m, 1),
        "target_mm": number(1e3 * baseline.target_m, 1),
        "sigma_mm": number(1e3 * baseline.sigma_m, 2),
        "moving": baseline.moving,
    }


def _speed(topics: Topics) -> dict[str, Any] | None:
    governed = topics.governed.get()
    if governed is None:
        return None
    return {
        "limit_m_s": number(governed.limit_m_s),
        "wanted_m_s": number(governed.wanted_m_s),
        "bound": governed.bound,
        "trust_m": number(governed.trust_m),
        "clear_m": number(governed.clear_m),
    }


def _health(topics: Topics) -> dict[str, Any] | None:
    health = topics.health.get()
    if health is None:
        return None
    return {
        "ages_s": numbers(health.ages_s),
        "rates_hz": numbers(health.rates_hz),
        "restarts": dict(health.restarts),
        "lateness_ms": number(health.lateness_ms, 2),
        "worst_lateness_ms": number(health.worst_lateness_ms, 2),
    }
