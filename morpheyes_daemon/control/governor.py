"""The speed governor: never faster than the vehicle can stop in within what it has seen and can trust.

Run at every stick period, on the present age of the depth: the distance flown since the image was taken is taken
off what was seen to be free. The reserve includes the time the autopilot would fly on with the last stick if the
daemon died this instant. It bounds; it never asks for more than the mission wants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from morpheyes_daemon.messages.core import DepthSummary, Governed, MissionCommand, VehicleState
from morpheyes_daemon.theory.sync import sync_speed_bound_m_s


class Stopping(Protocol):
    """What the governor needs of the vehicle's own braking (control.loiter)."""

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Distance to standstill with neutral sticks after flying on for `reaction_s`."""

    def time_constant_s(self, height_m: float) -> float:
        """Time constant with which the speed of a held stick is approached."""

    def speed_for_distance_m(self, distance_m: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Largest speed whose stopping distance fits into `distance_m`."""


@dataclass(frozen=True, slots=True)
class GovernorLimits:
    """See SafetyConfig and CameraBase for where each comes from; `sync_tolerance_px` is k of the sync law."""

    dead_daemon_s: float
    depth_sigmas: float
    max_relative_depth_error: float
    max_speed_m_s: float
    sync_error_s: float
    image_width_px: int
    sync_tolerance_px: float = 1.0
    standoff_m: float = 0.15


def trust_range_m(summary: DepthSummary, sigmas: float, max_relative_error: float) -> float:
    """Return the depth up to which `sigmas` sigmas of depth stay within a share of it.

    eps_z = z^2 eps_d / (b f) (paper, section II) and z sigma_b / b added in squares, solved for z.
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
        height_m: float,
        now_ns: int,
    ) -> Governed:
        """Return the speed allowed now and the name of the bound that set it.

        Raises nothing; any input that is not finite gives a limit of zero.
        """
        limits = self._limits
        trust_m = trust_range_m(summary, limits.depth_sigmas, limits.max_relative_depth_error)
        wanted = math.hypot(command.v_ned_m_s[0], command.v_ned_m_s[1])
        flown_m = math.hypot(
            vehicle.p_ned_m[0] - command.p_measured_ned_m[0], vehicle.p_ned_m[1] - command.p_measured_ned_m[1]
        )
        seen = {"clear": command.clear_m - flown_m, "trust": trust_m - flown_m}
        bounds = {
            name: stopping.speed_for_distance_m(max(0.0, distance - limits.standoff_m), height_m, limits.dead_daemon_s)
            for name, distance in seen.items()
        }
        if limits.sync_error_s > 0.0:
            bounds["sync"] = self._sync_bound(summary, command)
        bounds["cap"] = limits.max_speed_m_s
        bounds = {name: value if math.isfinite(value) else 0.0 for name, value in bounds.items()}
        name = min(bounds, key=lambda key: bounds[key])
        speed = math.hypot(vehicle.v_ned_m_s[0], vehicle.v_ned_m_s[1])
        available_m = max(0.0, min(seen.values()) - limits.standoff_m)
        stick = self._stick_limit(speed, available_m, bounds[name], stopping, height_m)
        return Governed(now_ns, bounds[name], name, seen["clear"], trust_m, speed, wanted, stick)

    def _stick_limit(
        self, speed_m_s: float, available_m: float, limit_m_s: float, stopping: Stopping, height_m: float
    ) -> float:
        """Steady speed of the strongest stick that could be held for `dead_daemon_s` and still be stopped after.

        With the stick of steady speed u, v(t) = u + (v - u) e^(-t/tau); found by bisection, since v(T) and the way
        to it both grow with u.
        """
        t_s, tau_s = self._limits.dead_daemon_s, stopping.time_constant_s(height_m)
        kept = math.exp(-t_s / tau_s)
        low, high = 0.0, max(speed_m_s, limit_m_s) / max(1.0 - kept, 0.1)
        for _ in range(10):
            u = (low + high) / 2
            after = u + (speed_m_s - u) * kept
            way = u * t_s + (speed_m_s - u) * tau_s * (1.0 - kept)
            fits = way + stopping.stopping_distance_m(after, height_m) <= available_m and after <= limit_m_s
            low, high = (u, high) if fits else (low, u)
        return low

    def _sync_bound(self, summary: DepthSummary, command: MissionCommand) -> float:
        """Speed at which the time between the eyes costs `sync_tolerance_px` on the nearest obstacle ahead."""
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
