"""Clearance against slow references: points spread over the surfaces, and cases one can do by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morpheyes_daemon.config.vehicle import Footprint, Mount
from morpheyes_daemon.simulation.worlds.collision import (
    CollisionWorld,
    MovingObstacles,
    Obstacles,
    Solid,
    VehicleShape,
    box_solid,
    ellipsoid_solid,
    frustum_solid,
    prism_solid,
)
from morpheyes_daemon.simulation.worlds.gjk import BOX, ELLIPSOID, FRUSTUM, PRISM
from morpheyes_daemon.transforms import Array, R_from_rotvec, R_from_rpy, pose

LEVEL = np.eye(3)
SHAPE = VehicleShape(Footprint(), Mount(forward_mm=90, down_mm=-20, tilt_up_deg=0))


def surface_points(solid: Solid, n: int = 60) -> Array:
    """Points (m, 3) densely over the surface of a solid."""
    size = solid.size
    if solid.kind in (BOX, PRISM):
        local = flat_points(solid, n)
    elif solid.kind == ELLIPSOID:
        theta, phi = np.meshgrid(np.linspace(0, math.pi, n), np.linspace(0, 2 * math.pi, 2 * n))
        unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
        local = unit.reshape(-1, 3) * size[:3]
    else:
        local = round_points(solid, n)
    return np.asarray(local @ solid.T[:3, :3].T + solid.T[:3, 3])


def flat_points(solid: Solid, n: int) -> Array:
    s = np.linspace(-1, 1, n)
    if solid.kind == BOX:
        a, b = (c.ravel() for c in np.meshgrid(s, s))
        one = np.ones_like(a)
        faces = [np.roll(np.column_stack([sign * one, a, b]), k, axis=1) for k in range(3) for sign in (-1, 1)]
        return np.concatenate(faces) * solid.size[:3]
    corners = np.array(solid.size[:8]).reshape(4, 2)
    w = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
    inside = np.concatenate([w @ corners[[0, 1, 2]], w @ corners[[0, 2, 3]]])
    rim = np.concatenate([(1 - t) * corners + t * np.roll(corners, 1, axis=0) for t in np.linspace(0, 1, 2 * n)])
    caps = [np.column_stack([inside, np.full(len(inside), z)]) for z in (-solid.size[8], solid.size[8])]
    walls = [np.column_stack([rim, np.full(len(rim), z * solid.size[8])]) for z in s]
    return np.concatenate([*caps, *walls])


def round_points(solid: Solid, n: int) -> Array:
    size = solid.size
    angle, z = (c.ravel() for c in np.meshgrid(np.linspace(0, 2 * math.pi, 3 * n), np.linspace(-1, 1, n)))
    if solid.kind == FRUSTUM:
        radius = size[0] + (z + 1) / 2 * (size[1] - size[0])
        ax, ay = radius, radius
    else:
        ax, ay = np.full_like(z, size[0]), np.full_like(z, size[1])
    side = np.column_stack([ax * np.cos(angle), ay * np.sin(angle), z * size[2]])
    share = np.linspace(0, 1, n)[:, None, None]
    rims = [side[z == end] for end in (-1, 1)]
    caps = [
        (np.concatenate([share * rim[:, :2], np.broadcast_to(rim[:, 2:], (n, len(rim), 1))], axis=2)) for rim in rims
    ]
    return np.concatenate([side, *(cap.reshape(-1, 3) for cap in caps)])


def random_solid(rng: np.random.Generator, kind: int, where: Array) -> Solid:
    T = pose(R_from_rotvec(rng.uniform(-2, 2, 3)), where)
    if kind == PRISM:
        angle = np.sort(rng.uniform(0, 2 * math.pi, int(rng.integers(3, 5))))
        return prism_solid(T, 0.5 * np.column_stack([np.cos(angle), np.sin(angle)]), 0.05)
    return Solid(kind, T, tuple(rng.uniform(0.1, 0.5, 3).tolist()))


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), kinds=st.tuples(st.integers(0, 4), st.integers(0, 4)))
def test_distance_equals_that_of_dense_surface_points(seed: int, kinds: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    a = random_solid(rng, kinds[0], np.zeros(3))
    b = random_solid(rng, kinds[1], rng.uniform(0.9, 1.6) * unit(rng))
    found = Obstacles([a]).nearest_m(b)
    p, q = surface_points(a, 24), surface_points(b, 24)
    gaps = np.linalg.norm(p[:, None, ::] - q[None, ::7], axis=2)
    nearest = p[np.argmin(gaps.min(axis=1))]
    sampled = float(np.linalg.norm(q - nearest, axis=1).min())
    if found > 0:
        # the sampled distance is never smaller, and larger by the spacing of the points at most
        assert found <= sampled + 1e-4
        assert sampled - found < 0.08
    else:
        assert sampled < 0.08 or found < 0


def unit(rng: np.random.Generator) -> Array:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def test_spheres_have_the_textbook_distance() -> None:
    ball = ellipsoid_solid(np.zeros(3), np.full(3, 0.3))
    for d in (0.7, 1.0, 5.0):
        other = ellipsoid_solid(np.array([d, 0, 0]), np.full(3, 0.2))
        assert Obstacles([ball]).nearest_m(other) == pytest.approx(d - 0.5, abs=1e-4)
    assert Obstacles([ball]).nearest_m(ellipsoid_solid(np.array([0.4, 0, 0]), np.full(3, 0.2))) == pytest.approx(
        -0.1, abs=0.005
    )


def test_hull_and_bar_beside_a_trunk() -> None:
    trunk = frustum_solid(np.array([0, 2.0, 0]), np.array([0, 2.0, -10.0]), 0.3, 0.1)
    world = CollisionWorld([trunk])
    slant = math.cos(math.atan2(0.2, 10.0))
    found = world.clearance_m(np.array([0, 0, -1.5]), LEVEL, SHAPE, 0.1)
    # the hull's lower rim, 60 mm below its middle, is the nearest
    lower = 0.3 - 0.2 * 0.144
    assert found == pytest.approx((2.0 - 0.1685 - lower) * slant, abs=1e-3)
    # the bar, 330 mm long at the largest baseline, is what comes nearest to a trunk a little ahead
    ahead = CollisionWorld([frustum_solid(np.array([0.25, 2.0, 0]), np.array([0.25, 2.0, -10.0]), 0.3, 0.1)])
    wide = ahead.clearance_m(np.array([0, 0, -1.5]), LEVEL, SHAPE, 0.30)
    corner = math.hypot(0.25 - 0.11, 2.0 - 0.165)
    assert wide == pytest.approx((corner - (0.3 - 0.02 * 1.505)) * slant, abs=1e-3)
    assert ahead.clearance_m(np.array([0, 0, -1.5]), LEVEL, SHAPE, 0.10) > wide + 0.003


def test_passing_an_opening_by_forty_millimetres_is_judged_right() -> None:
    """A slot between two plates: the level hull fits with 40 mm to spare, the leaning one hits."""
    half = 0.060 + 0.040
    plates = [box_solid(pose(LEVEL, np.array([0, 0, z])), (0.05, 4.0, 1.0)) for z in (-half - 0.5, half + 0.5)]
    world = CollisionWorld(plates)
    level = world.clearance_m(np.zeros(3), LEVEL, SHAPE, 0.1)
    assert level == pytest.approx(0.040, abs=2e-4)
    assert world.clearance_m(np.zeros(3), R_from_rpy(0, math.radians(-30), 0), SHAPE, 0.1) < level - 0.005
    # far more lean and the rim of the hull meets the plate
    assert world.clearance_m(np.zeros(3), R_from_rpy(0, math.radians(-80), 0), SHAPE, 0.1) < 0


def test_a_moving_obstacle_is_where_its_pose_says() -> None:
    def at(t_s: float) -> Array:
        return pose(R_from_rpy(0, 0, 0.3 * t_s), np.array([3.0 - t_s, 0, 0]))

    cube = box_solid(np.eye(4), (0.3, 0.3, 0.3))
    world = CollisionWorld([], [MovingObstacles(Obstacles([cube]), at)])
    for t_s in (0.0, 1.0, 2.0):
        still = CollisionWorld([box_solid(at(t_s), (0.3, 0.3, 0.3))])
        p = np.array([0.1, 0.05, 0.02])
        moving = world.clearance_m(p, LEVEL, SHAPE, 0.2, t_s)
        assert moving == pytest.approx(still.clearance_m(p, LEVEL, SHAPE, 0.2), abs=1e-4)


def test_the_nearest_of_many_is_found() -> None:
    rng = np.random.default_rng(2)
    trunks = []
    for x, y in rng.uniform(-15, 15, (150, 2)):
        radius = rng.uniform(0.1, 0.4)
        trunks.append(frustum_solid(np.array([x, y, 0]), np.array([x, y, -12.0]), radius, 0.05))
    world = CollisionWorld(trunks)
    for p in rng.uniform(-10, 10, (20, 3)) * (1, 1, 0) + (0, 0, -1.5):
        one_by_one = min(CollisionWorld([trunk]).clearance_m(p, LEVEL, SHAPE, 0.2) for trunk in trunks)
        assert world.clearance_m(p, LEVEL, SHAPE, 0.2) == pytest.approx(one_by_one, abs=1e-4)


def test_nothing_around_is_infinitely_far() -> None:
    assert CollisionWorld([]).clearance_m(np.zeros(3), LEVEL, SHAPE, 0.2) == math.inf
