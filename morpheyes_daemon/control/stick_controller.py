"""One stick period: the mission's command through the governor and the velocity loop to stick positions.

Pure composition of `governor`, `velocity` and `loiter`; what it returns still has the gate before it. It exists from
the start and is configured when the autopilot's parameters have been read; before that it offers no sticks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from morpheyes_daemon.control.governor import Governor
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.path_following import PathFollower
from morpheyes_daemon.control.velocity import VelocityController, VelocityTuning, height_above_ground_m
from morpheyes_daemon.messages.core import DepthSummary, Governed, MissionCommand, Sticks, VehicleState


class StickController:
    """The flight control of one vehicle, whose velocity loop is made anew when its Loiter model changes.

    `tuning_for` gives the velocity loop's bounds for a Loiter model.
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
        """Take the vehicle's Loiter model; the same one again keeps what the velocity loop has learned."""
        if self.model != model:
            self._loop = _Loop(model, self._governor, self._tuning_for(model))

    def reset(self) -> None:
        """Forget what the velocity loop has learned; call while the sticks are not ours."""
        if self._loop is not None:
            self._loop.reset()

    def step(
        self, command: MissionCommand, summary: DepthSummary, vehicle: VehicleState, now_ns: int
    ) -> tuple[Sticks, Governed] | None:
        """Return the sticks for a command and what the governor made of its speed; None before `configure`."""
        return self._loop.step(command, summary, vehicle, now_ns) if self._loop else None

    def stopping_distance_m(self, speed_m_s: float, height_m: float, reaction_s: float = 0.0) -> float:
        """Return the distance to a stop from a speed, `reaction_s` of flying on included; inf before `configure`."""
        return self._loop.model.stopping_distance_m(speed_m_s, height_m, reaction_s) if self._loop else math.inf


class _Loop:
    """Governor, path following and velocity loop on one Loiter model."""

    def __init__(self, model: LoiterModel, governor: Governor, tuning: VelocityTuning) -> None:
        self.model = model
        self._governor = governor
        self._velocity = VelocityController(model, tuning)
        self._line = PathFollower()

    def reset(self) -> None:
        """Forget what the loop has learned."""
        self._velocity.reset()
        self._line.reset()

    def step(
        self, command: MissionCommand, summary: DepthSummary, vehicle: VehicleState, now_ns: int
    ) -> tuple[Sticks, Governed]:
        height_m = height_above_ground_m(vehicle, now_ns)
        quick = command.line is not None and command.line.integral_1_s2 > 0.0
        steadied = self._velocity.steadied(vehicle, now_ns)
        felt = steadied if quick else vehicle
        command = replace(command, v_ned_m_s=self._line.wanted_velocity(command, felt, now_ns))
        governed = self._governor.limit(command, summary, vehicle, self.model, height_m, now_ns)
        north, east, down = command.v_ned_m_s
        scale = min(1.0, governed.limit_m_s / governed.wanted_m_s) if governed.wanted_m_s > 0.0 else 0.0
        sticks = self._velocity.step(
            now_ns,
            (north * scale, east * scale, down),
            command.yaw_rad,
            command.height_m,
            felt,
            command.coast,
            quick=quick,
        )
        return self._reined(sticks, governed, vehicle, height_m), governed

    def _reined(self, sticks: Sticks, governed: Governed, vehicle: VehicleState, height_m: float) -> Sticks:
        """Take from the stick what would push further along the motion than the governor allows a held stick."""
        forward, right = self.model.speed_for_sticks(sticks.roll_us, sticks.pitch_us, height_m)
        size = math.hypot(forward, right)
        if size <= governed.stick_limit_m_s:
            return sticks
        if governed.speed_m_s < 0.2:
            along = (forward / size, right / size)
        else:
            cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
            vx, vy, _ = vehicle.v_ned_m_s
            along = ((cos * vx + sin * vy) / governed.speed_m_s, (cos * vy - sin * vx) / governed.speed_m_s)
        push = forward * along[0] + right * along[1]
        excess = push - governed.stick_limit_m_s
        if excess <= 0.0:
            return sticks
        roll_us, pitch_us = self.model.sticks_for_speed(forward - excess * along[0], right - excess * along[1], height_m)
        return replace(sticks, roll_us=roll_us, pitch_us=pitch_us)
