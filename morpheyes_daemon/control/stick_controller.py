"""Stick controller, one stick period: the mission's command through governor and velocity loop to stick positions.

Pure composition of `path_following`, `governor`, `velocity` and `loiter`; the gate still decides what is sent. It
exists from the start and is configured when the autopilot's parameters have been read; before that it returns no
sticks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from morpheyes_daemon.control.governor import Governor
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.path_following import PathFollower
from morpheyes_daemon.control.velocity import (
    VelocityController,
    VelocitySetpoint,
    VelocityTuning,
    height_above_ground_m,
)
from morpheyes_daemon.messages.core import DepthSummary, Governed, MissionCommand, Sticks, VehicleState

SLOW_M_S = 0.2
"""Below this speed the stick itself, not the measured velocity, gives the direction of motion.

Chosen: four times the noise of the measured velocity; higher ignores a real drift across the stick."""


class StickController:
    """The flight control of one vehicle; its loops are made anew when the Loiter model changes.

    `tuning_for` returns the velocity loop's bounds for a Loiter model.
    """

    def __init__(self, governor: Governor, tuning_for: Callable[[LoiterModel], VelocityTuning]) -> None:
        self._governor = governor
        self._tuning_for = tuning_for
        self._loop: _Loop | None = None

    @property
    def model(self) -> LoiterModel | None:
        """The Loiter model, None before the autopilot's parameters are known."""
        return self._loop.model if self._loop else None

    def configure(self, model: LoiterModel) -> None:
        """Set the vehicle's Loiter model; an equal one keeps the state of the loops."""
        if self.model != model:
            self._loop = _Loop(model, self._governor, self._tuning_for(model))

    def reset(self) -> None:
        """Clear the integrals of the loops; call while the daemon does not hold the sticks."""
        if self._loop is not None:
            self._loop.reset()

    def step(
        self, command: MissionCommand, summary: DepthSummary, vehicle: VehicleState, now_ns: int
    ) -> tuple[Sticks, Governed] | None:
        """Return the sticks for a command, and the bound that the governor put on its speed; None before `configure`."""
        return self._loop.step(command, summary, vehicle, now_ns) if self._loop else None

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the distance to standstill after `reaction_s` at the same speed; inf before `configure`."""
        return self._loop.model.stopping_distance_m(speed_m_s, height_m, reaction_s) if self._loop else math.inf


class _Loop:
    """Path following, governor and velocity loop on one Loiter model."""

    def __init__(self, model: LoiterModel, governor: Governor, tuning: VelocityTuning) -> None:
        self.model = model
        self._governor = governor
        self._velocity = VelocityController(model, tuning)
        self._path = PathFollower()

    def reset(self) -> None:
        """Clear the integrals of both loops."""
        self._velocity.reset()
        self._path.reset()

    def step(
        self, command: MissionCommand, summary: DepthSummary, vehicle: VehicleState, now_ns: int
    ) -> tuple[Sticks, Governed]:
        fast_response = command.line is not None and command.line.fast_response
        filtered = self._velocity.filtered_state(vehicle, now_ns)
        state = filtered if fast_response else vehicle
        command = replace(command, v_ned_m_s=self._path.wanted_velocity(command, state, now_ns))
        governed = self._governor.limit(command, summary, vehicle, self.model, now_ns)
        north, east, down = command.v_ned_m_s
        scale = min(1.0, governed.limit_m_s / governed.wanted_m_s) if governed.wanted_m_s > 0.0 else 0.0
        velocity = north * scale, east * scale, down
        setpoint = VelocitySetpoint(velocity, command.yaw_rad, command.height_m, command.coast, fast_response)
        sticks = self._velocity.step(setpoint, state, now_ns)
        return self._bounded(sticks, governed, vehicle, height_above_ground_m(vehicle, now_ns)), governed

    def _bounded(self, sticks: Sticks, governed: Governed, vehicle: VehicleState, height_m: float) -> Sticks:
        """Reduce the stick's steady speed along the motion to what the governor allows for a held stick."""
        forward, right = self.model.speed_for_sticks(sticks.roll_us, sticks.pitch_us, height_m)
        size = math.hypot(forward, right)
        if size <= governed.stick_limit_m_s:
            return sticks
        if governed.speed_m_s < SLOW_M_S:
            along = (forward / size, right / size)
        else:
            cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
            vx, vy, _ = vehicle.v_ned_m_s
            along = ((cos * vx + sin * vy) / governed.speed_m_s, (cos * vy - sin * vx) / governed.speed_m_s)
        speed_along = forward * along[0] + right * along[1]
        excess = speed_along - governed.stick_limit_m_s
        if excess <= 0.0:
            return sticks
        roll_us, pitch_us = self.model.sticks_for_speed(forward - excess * along[0], right - excess * along[1], height_m)
        return replace(sticks, roll_us=roll_us, pitch_us=pitch_us)
