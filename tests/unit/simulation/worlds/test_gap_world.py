"""Walls with openings: the pieces make up the plate, the vehicle just fits, and motion keeps its bounds."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morpheyes_daemon.config.vehicle import Footprint, Mount
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.flights.artifacts import wall_plan
from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.simulation.rendering.renderer import Renderer
from morpheyes_daemon.simulation.worlds.collision import VehicleShape
from morpheyes_daemon.simulation.worlds.gap_world import GapWorld, Opening
from morpheyes_daemon.simulation.worlds.loader import WorldFile, build_world
from morpheyes_daemon.simulation.worlds.openings import Shape, outline
from morpheyes_daemon.simulation.worlds.trajectories import Motion, along_waypoints, swaying
from morpheyes_daemon.simulation.worlds.wall_geometry import Wall
from morpheyes_daemon.transforms import R_FRD_CAM, Array, R_from_rpy, inverse, pose

SHAPES: tuple[Shape, ...] = ("rectangle", "infinity", "goku", "blob")
SMALL = Pinhole(160, 120, 185.0, 79.5, 59.5)
VEHICLE = VehicleShape(Footprint(), Mount(down_mm=0, tilt_up_deg=0))


def area(polygon: Array) -> float:
    x, y = polygon.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


@pytest.mark.parametrize("shape", SHAPES)
def test_pieces_of_a_wall_fill_it_but_for_the_opening(shape: Shape) -> None:
    hole = outline(shape, np.random.default_rng(3), 0.417, 0.267) + np.array([0.3, -1.5])
    wall = Wall(np.array([-4.0, -3.0]), np.array([4.0, 0.5]), (hole,), 0.03)
    pieces = sum(area(quad) for quad in wall.quads())
    assert all(area(quad) > 0 for quad in wall.quads())
    assert pieces == pytest.approx(8.0 * 3.5 - abs(area(hole)), abs=1e-7)


@settings(max_examples=3)
@given(seed=st.integers(0, 1000))
def test_any_blob_is_cut_without_remainder(seed: int) -> None:
    rng = np.random.default_rng(seed)
    holes = [outline("blob", rng, 0.4, 0.25) + np.array(place) for place in ((-1.5, -1.5), (1.2, -1.2))]
    wall = Wall(np.array([-4.0, -3.0]), np.array([4.0, 0.5]), tuple(holes), 0.03)
    pieces = sum(area(quad) for quad in wall.quads())
    assert pieces == pytest.approx(28.0 - sum(abs(area(hole)) for hole in holes), abs=1e-7)


def contains(polygon_m: Array, points: Array) -> bool:
    polygon = polygon_m.astype(np.float32)
    return all(cv2.pointPolygonTest(polygon, (float(x), float(y)), False) >= 0 for x, y in points)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_smallest_opening_lets_just_the_asked_rectangle_through(shape: Shape) -> None:
    hole = outline(shape, np.random.default_rng(1), 0.417, 0.267)
    s = np.linspace(-1, 1, 41)
    one = np.ones_like(s)
    sides = [np.stack(pair, axis=-1) for k in (-1, 1) for pair in ((s, k * one), (k * one, s))]
    rim = np.concatenate(sides)
    # within the raster it was found on: two millimetres
    assert contains(hole, rim * (0.5 * 0.413, 0.5 * 0.263))
    shift = np.array([(x, y) for x in np.linspace(-0.05, 0.05, 11) for y in np.linspace(-0.05, 0.05, 11)])
    assert not any(contains(hole, rim * (0.5 * 0.425, 0.5 * 0.275) + d) for d in shift)


def test_the_vehicle_passes_the_default_opening_with_forty_millimetres() -> None:
    """Level, at the smallest baseline, through the middle: the sides decide, and 40 mm are left on each."""
    world = GapWorld(kind="gap", openings=(Opening(shape="rectangle", across_m=0.0, height_m=1.5),))
    built = build_world(WorldFile(world=world), seed=0)
    passing = [built.clearance_m(np.array([x, 0.0, -1.5]), np.eye(3), VEHICLE, 0.1) for x in np.linspace(6.5, 7.5, 21)]
    assert min(passing) == pytest.approx(0.040, abs=0.002)
    beside = [built.clearance_m(np.array([x, 0.06, -1.5]), np.eye(3), VEHICLE, 0.1) for x in np.linspace(6.5, 7.5, 21)]
    assert min(beside) == pytest.approx(-0.02, abs=0.004)


def test_an_opening_looks_as_it_is_judged() -> None:
    """What the renderer shows as hole is what the outline, seen through the camera, encloses."""
    world = GapWorld(
        kind="gap", openings=(Opening(shape="goku", slack=2.0),), motion=Motion(kind="periodic", turn_deg=15)
    )
    built = build_world(WorldFile(world=world), seed=4)
    T_ned_cam = pose(R_FRD_CAM, np.array([4.5, 0.0, -1.5]))
    shown = Renderer(built.scene).render(T_ned_cam, SMALL, t_s=2.0)
    gap = built.gaps[0]
    corners = np.column_stack(
        [np.full(len(gap.outlines[0]), -0.5 * gap.thickness_m), gap.outlines[0], np.ones(len(gap.outlines[0]))]
    )
    seen = corners @ (inverse(T_ned_cam) @ gap.T_ned_wall(2.0)).T
    uv = SMALL.f_px * seen[:, :2] / seen[:, 2:3] + (SMALL.cx_px, SMALL.cy_px)
    inside = np.zeros((SMALL.height, SMALL.width), np.uint8)
    cv2.fillPoly(inside, [np.rint(16 * uv).astype(np.int32)], 1, cv2.LINE_8, 4)
    hole = shown.depth_m > 4.0
    union = np.count_nonzero(hole | (inside > 0))
    # the far rim and the pixels along the outline differ
    assert np.count_nonzero(hole & (inside > 0)) / union > 0.9


@pytest.mark.parametrize("shape", SHAPES)
def test_on_the_map_the_wall_is_open_where_the_vehicle_passes(shape: Shape) -> None:
    world = build_world(WorldFile(description="", world=GapWorld(kind="gap", openings=(Opening(shape=shape),))), 3)
    pieces = [np.array(corners) for corners in wall_plan(world.gaps[0], 0.0)]
    left, *_, right = sorted(pieces, key=lambda corners: float(corners[:, 1].min()))
    assert left[:, 0] == pytest.approx([6.985, 6.985, 7.015, 7.015])
    # 40 mm on both sides of a hull 337 mm wide; only at half the height of the opening, which may be elsewhere
    assert right[:, 1].min() - left[:, 1].max() > 0.337
    assert right[:, 1].max() - left[:, 1].min() == pytest.approx(8.0)


@pytest.mark.parametrize("kind", ["periodic", "irregular"])
def test_a_swaying_wall_keeps_amplitude_and_speed(kind: str) -> None:
    motion = Motion(kind=kind, sideways_m=0.5, vertical_m=0.2, peak_speed_m_s=0.5, turn_deg=15)
    at = swaying(motion, np.array([7.0, 0.3, 0.0]), seed=3)
    t = np.arange(0, 120, 0.02)
    T = np.array([at(float(s)) for s in t])
    shift = T[:, :3, 3] - (7.0, 0.3, 0.0)
    speed = np.linalg.norm(np.diff(shift, axis=0), axis=1) / 0.02
    assert np.abs(shift[:, 1]).max() <= 0.5 + 1e-6
    assert np.abs(shift[:, 2]).max() <= 0.2 + 1e-6
    assert 0.35 < speed.max() <= 0.5 * 1.02
    yaw = np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    assert np.abs(yaw).max() == pytest.approx(15, abs=0.1)


def test_a_wall_that_does_not_move_stands_still() -> None:
    at = swaying(Motion(), np.array([7.0, 0.0, 0.0]), seed=1)
    assert np.array_equal(at(0.0), at(100.0))


def test_waypoints_are_passed_smoothly() -> None:
    waypoints = np.array([[0, 1, 0, 1.5], [4, 3, 1, 1.5], [9, 8, -1, 2.0], [12, 9, 0, 1.0]])
    at = along_waypoints(waypoints, 0.4)
    for t, x, y, height in waypoints:
        assert np.allclose(at(float(t))[:3, 3], [x, y, -height])
    assert np.array_equal(at(-5.0), at(0.0))
    assert np.array_equal(at(50.0), at(12.0))
    track = np.array([at(float(t))[:3, 3] for t in np.arange(0, 12, 0.01)])
    acceleration = np.diff(track, 2, axis=0) / 0.01**2
    assert np.linalg.norm(acceleration, axis=1).max() < 6.0


def test_waypoints_out_of_order_are_refused() -> None:
    from morpheyes_daemon.config.yaml_errors import parse_model

    text = "world:\n  kind: room\n  cube:\n    waypoints: [[0, 1, 0, 1], [0, 2, 0, 1]]\n"
    with pytest.raises(ConfigError, match="times of the waypoints"):
        parse_model(text, WorldFile, "room.yaml")


def test_leaning_needs_a_higher_opening() -> None:
    """The silhouette's height grows as h cos + l sin: a level crossing fits where a leaning one touches."""
    world = GapWorld(
        kind="gap", fit_height_mm=200.0, openings=(Opening(shape="rectangle", slack=1.0, across_m=0.0, height_m=1.5),)
    )
    built = build_world(WorldFile(world=world), seed=0)

    def smallest(pitch_deg: float) -> float:
        R = R_from_rpy(0.0, math.radians(pitch_deg), 0.0)
        return min(built.clearance_m(np.array([x, 0.0, -1.5]), R, VEHICLE, 0.1) for x in np.linspace(6.6, 7.4, 33))

    assert smallest(0.0) == pytest.approx(0.040, abs=0.002)
    assert smallest(-12.0) < 0.025
    assert smallest(-25.0) < 0.0
