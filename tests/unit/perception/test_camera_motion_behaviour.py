"""The camera's motion and the rates of points in the right image, against a vehicle moved by a small step."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from morpheyes_daemon.config.vehicle import (
    Footprint,
    MissionFile,
    Mount,
    NoServoConfig,
    SafetyConfig,
    SimCameraConfig,
    VehicleConfig,
)  # fmt: skip
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.core import Pinhole, VehicleState
from morpheyes_daemon.perception.camera_motion import CameraMotion, camera_motion, right_camera_rates, row_rates
from morpheyes_daemon.perception.craft import build_craft, build_strategy
from morpheyes_daemon.strategies.forest.strategy import Forest
from morpheyes_daemon.transforms import R_FRD_CAM, R_from_rotvec, R_from_rpy, pose, rpy_from_R

PINHOLE = Pinhole(320, 240, 370.0, 150.0, 125.0)
BASELINE_M = 0.2
T_FRD_RIG = pose(R_from_rpy(0.0, 0.14, 0.0) @ R_FRD_CAM, np.array([0.09, 0.02, -0.03]))
T_RIG_RECT = pose(R_from_rotvec(np.array([0.01, -0.02, 0.03])), np.array([-0.1, 0.01, 0.0]))
MOVING = VehicleState(
    roll_rad=0.1, pitch_rad=-0.2, yaw_rad=0.7, rates_frd_rad_s=(0.3, -0.4, 0.5), p_ned_m=(3.0, -2.0, -1.5),
    v_ned_m_s=(2.0, -1.0, 0.4),
)  # fmt: skip
DT_S = 1e-5


def later(state: VehicleState) -> VehicleState:
    """The vehicle after a small step."""
    R = R_from_rpy(state.roll_rad, state.pitch_rad, state.yaw_rad) @ R_from_rotvec(
        DT_S * np.array(state.rates_frd_rad_s)
    )
    p = np.array(state.p_ned_m) + DT_S * np.array(state.v_ned_m_s)
    roll, pitch, yaw = rpy_from_R(R)
    return replace(state, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, p_ned_m=tuple(p))


def motion(state: VehicleState = MOVING) -> CameraMotion:
    return camera_motion(state, T_FRD_RIG, T_RIG_RECT)


def test_the_pose_is_where_the_mount_puts_it() -> None:
    expected = pose(R_from_rpy(0.1, -0.2, 0.7), np.array([3.0, -2.0, -1.5])) @ T_FRD_RIG @ T_RIG_RECT
    assert motion().T_ned_rect == pytest.approx(expected)


def test_velocity_and_turn_are_those_of_the_camera_on_its_lever() -> None:
    first, second = motion().T_ned_rect, motion(later(MOVING)).T_ned_rect
    v = first[:3, :3].T @ (second[:3, 3] - first[:3, 3]) / DT_S
    assert motion().v_rect_m_s == pytest.approx(v, abs=1e-4)
    turn = (first[:3, :3].T @ second[:3, :3] - np.eye(3)) / DT_S
    assert motion().w_rect_rad_s == pytest.approx([turn[2, 1], turn[0, 2], turn[1, 0]], abs=1e-4)


def test_on_the_ground_nothing_moves() -> None:
    still = CameraMotion.still(np.eye(4))
    assert not still.v_rect_m_s.any()
    assert not still.w_rect_rad_s.any()
    assert not right_camera_rates(np.array([[10.0, 20.0]]), np.array([5.0]), PINHOLE, BASELINE_M, still).any()


def seen_by_the_right(point_ned: np.ndarray, T_ned_rect: np.ndarray) -> np.ndarray:
    p = np.linalg.inv(T_ned_rect @ pose(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))) @ np.append(point_ned, 1.0)
    return np.array([PINHOLE.f_px * p[0] / p[2] + PINHOLE.cx_px, PINHOLE.f_px * p[1] / p[2] + PINHOLE.cy_px])


def numeric_rates(uv: np.ndarray, d_px: np.ndarray, state: VehicleState) -> np.ndarray:
    rates = []
    first, second = motion(state).T_ned_rect, motion(later(state)).T_ned_rect
    for (u, v), d in zip(uv, d_px, strict=True):
        z = BASELINE_M * PINHOLE.f_px / d
        p = np.array([(u - PINHOLE.cx_px) / PINHOLE.f_px * z, (v - PINHOLE.cy_px) / PINHOLE.f_px * z, z, 1.0])
        point = (first @ p)[:3]
        rates.append((seen_by_the_right(point, second) - seen_by_the_right(point, first)) / DT_S)
    return np.array(rates)


UV = np.array([[20.0, 30.0], [300.0, 40.0], [150.0, 125.0], [80.0, 220.0], [250.0, 200.0]])
D_PX = np.array([30.0, 12.0, 8.0, 4.0, 20.0])


def test_points_move_in_the_right_image_as_the_moved_vehicle_sees_them() -> None:
    assert right_camera_rates(UV, D_PX, PINHOLE, BASELINE_M, motion()) == pytest.approx(
        numeric_rates(UV, D_PX, MOVING), rel=1e-3, abs=0.05
    )


def test_row_rates_are_split_into_travel_and_turning() -> None:
    by_travel, by_turning = row_rates(UV, D_PX, PINHOLE, BASELINE_M, motion())
    assert by_travel + by_turning == pytest.approx(numeric_rates(UV, D_PX, MOVING)[:, 1], rel=1e-3, abs=0.05)
    # the travel of the left camera alone: it has the lever's part of the turning in it
    v, w = motion().v_rect_m_s, np.zeros(3)
    alone = right_camera_rates(UV, D_PX, PINHOLE, BASELINE_M, CameraMotion(np.eye(4), v, w))
    assert by_travel == pytest.approx(alone[:, 1])
    assert np.abs(by_turning).min() > 1.0


def test_a_point_without_disparity_is_far_and_moves_by_turning_alone() -> None:
    far = right_camera_rates(
        UV, np.full(5, -3.0), PINHOLE, BASELINE_M, motion(replace(MOVING, rates_frd_rad_s=(0, 0, 0)))
    )
    assert np.abs(far).max() < 1e-9


def config(**changes: object) -> VehicleConfig:
    return VehicleConfig(
        camera=SimCameraConfig(rate_hz=8.0, mount=Mount(forward_mm=80, right_mm=10, down_mm=-30, tilt_up_deg=10)),
        servo=NoServoConfig(backend="none", baseline_mm=150),
        safety=SafetyConfig(depth_sigmas=2.5, max_relative_depth_error=0.15),
        footprint=Footprint(hull_width_mm=400), **changes,
    )  # fmt: skip


def test_the_craft_is_that_of_the_configuration() -> None:
    craft = build_craft(config())
    assert craft.T_frd_rig[:3, 3] == pytest.approx([0.08, 0.01, -0.03])
    # the axis of a camera tilted up points up: down is negative
    assert craft.T_frd_rig[:3, 2] == pytest.approx([math.cos(math.radians(10)), 0.0, -math.sin(math.radians(10))])
    assert craft.T_frd_rig[:3, 0] == pytest.approx([0.0, 1.0, 0.0])
    assert craft.frame_period_s == 0.125
    assert (craft.depth_sigmas, craft.max_relative_depth_error) == (2.5, 0.15)
    assert craft.baseline_range_m == (0.15, 0.15)
    assert craft.footprint.hull_width_mm == 400


def test_a_strategy_is_built_with_its_checked_parameters() -> None:
    built = build_strategy(MissionFile(strategy="forest", parameters={"speed_m_s": 2.0}), config())
    assert isinstance(built, Forest)
    assert built.parameters.speed_m_s == 2.0
    assert built.craft.frame_period_s == 0.125
    with pytest.raises(ConfigError, match=r"-2\.0.*greater than 0\.1"):
        build_strategy(MissionFile(strategy="forest", parameters={"speed_m_s": -2.0}), config())
