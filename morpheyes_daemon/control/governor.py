"""Speed governor: never faster than the vehicle can stop within the depth that is seen free and within trusted range.

Run at every stick period with the present age of the depth: the distance flown since exposure is subtracted from the
free distance. The reserve includes the time for which the autopilot would fly on with the last stick if the daemon
died now. It bounds the speed and never raises it above what the mission wants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from morpheyes_daemon.control.velocity import height_above_ground_m
from morpheyes_daemon.messages.core import DepthSummary, Governed, MissionCommand, VehicleState
from morpheyes_daemon.theory.sync import sync_speed_bound_m_s

BISECTION_STEPS = 10
"""Halvings in the search for the largest stick. Unit: steps.

Chosen: resolves the stick to 0.1 % of the range searched, at ten look-ups per stick period."""

MIN_RESPONSE = 0.1
"""Least share of its steady speed that a held stick is assumed to reach within `dead_daemon_s`. Unit: none.

Chosen: bounds the search to ten times the allowed speed for vehicles that respond slowly."""


class Stopping(Protocol):
    """The model of the vehicle's own braking that the governor needs (control.loiter implements it)."""

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the distance to standstill with neutral sticks after flying on for `reaction_s`."""

    def time_constant_s(self, height_m: float) -> float:
        """Return the time constant with which the speed of a held stick is approached."""

    def speed_for_distance_m(self, distance_m: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the largest speed whose stopping distance is at most `distance_m`."""


@dataclass(frozen=True, slots=True)
class GovernorLimits:
    """Bounds from SafetyConfig and CameraBase; `sync_tolerance_px` is k of the synchronization law (paper)."""

    dead_daemon_s: float
    depth_sigmas: float
    max_relative_depth_error: float
    max_speed_m_s: float
    sync_error_s: float
    image_width_px: int
    sync_tolerance_px: float = 1.0
    standoff_m: float = 0.15


def trust_range_m(summary: DepthSummary, sigmas: float, max_relative_error: float) -> float:
    """Return the trusted range, metres: the depth up to which `sigmas` sigmas of depth stay within a share of it.

    eps_z = z^2 eps_d / (b f) (paper, section II) and z sigma_b / b added in squares, solved for z; 0 when the baseline's
    own sigma exceeds the share.
    """
    share = max_relative_error / sigmas
    scale = summary.baseline_sigma_m / summary.baseline_m
    left = share * share - scale * scale
    if left <= 0.0:
        return 0.0
    return summary.baseline_m * summary.f_px / summary.sigma_disparity_px * math.sqrt(left)


class Governor:
    """Bounds the speed; `limit` is cheap enough for every stick period."""

    def __init__(self, limits: GovernorLimits) -> None:
        self._limits = limits

    def limit(
        self,
        command: MissionCommand,
        summary: DepthSummary,
        vehicle: VehicleState,
        stopping: Stopping,
        now_ns: int,
    ) -> Governed:
        """Return the speed allowed now and the name of the smallest bound.

        Raises nothing; any input that is not finite gives a limit of zero.
        """
        limits, height_m = self._limits, height_above_ground_m(vehicle, now_ns)
        trust_m = trust_range_m(summary, limits.depth_sigmas, limits.max_relative_depth_error)
        wanted = math.hypot(command.v_ned_m_s[0], command.v_ned_m_s[1])
        flown_m = math.hypot(
            vehicle.p_ned_m[0] - command.p_measured_ned_m[0], vehicle.p_ned_m[1] - command.p_measured_ned_m[1]
        )
        free_m = {"clear": command.clear_m - flown_m, "trust": trust_m - flown_m}
        bounds = {
            name: stopping.speed_for_distance_m(max(0.0, distance - limits.standoff_m), height_m, limits.dead_daemon_s)
            for name, distance in free_m.items()
        }
        if limits.sync_error_s > 0.0:
            bounds["sync"] = self._sync_bound(summary, command)
        bounds["cap"] = limits.max_speed_m_s
        bounds = {name: value if math.isfinite(value) else 0.0 for name, value in bounds.items()}
        name = min(bounds, key=lambda key: bounds[key])
        speed = math.hypot(vehicle.v_ned_m_s[0], vehicle.v_ned_m_s[1])
        available_m = max(0.0, min(free_m.values()) - limits.standoff_m)
        stick = self._stick_limit(speed, available_m, bounds[name], stopping, height_m)
        return Governed(now_ns, bounds[name], name, free_m["clear"], trust_m, speed, wanted, stick)

    def _stick_limit(
        self, speed_m_s: float, available_m: float, limit_m_s: float, stopping: Stopping, height_m: float
    ) -> float:
        """Return the steady speed of the largest stick that can be held for `dead_daemon_s` and still be stopped.

        With a stick of steady speed u, v(t) = u + (v - u) e^(-t/tau); found by bisection, since v(T) and the distance
        flown until T both grow with u.
        """
        t_s, tau_s = self._limits.dead_daemon_s, stopping.time_constant_s(height_m)
        kept = math.exp(-t_s / tau_s)
        low, high = 0.0, max(speed_m_s, limit_m_s) / max(1.0 - kept, MIN_RESPONSE)
        for _ in range(BISECTION_STEPS):
            u = (low + high) / 2
            after = u + (speed_m_s - u) * kept
            flown_m = u * t_s + (speed_m_s - u) * tau_s * (1.0 - kept)
            fits = flown_m + stopping.stopping_distance_m(after, height_m) <= available_m and after <= limit_m_s
            low, high = (u, high) if fits else (low, u)
        return low

    def _sync_bound(self, summary: DepthSummary, command: MissionCommand) -> float:
        """Return the speed at which the exposure offset costs `sync_tolerance_px` at the nearest obstacle."""
        z_m = command.z_close_m if math.isfinite(command.z_close_m) else summary.nearest_m
        if not math.isfinite(z_m) or z_m <= 0.0:
            return self._limits.max_speed_m_s
        return sync_speed_bound_m_s(
            dt_s=self._limits.sync_error_s,
            baseline_m=summary.baseline_m,
            z_m=z_m,
            f_px=summary.f_px,
            k_px=self._limits.sync_tolerance_px,
            half_width_px=self._limits.image_width_px / 2,
        )
