"""The camera twin: points land where lens and rig say, noise and exposure are as stated, and stereo works on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from morpheyes_daemon.config.vehicle import Mount
from morpheyes_daemon.messages.core import FloatMap, Image
from morpheyes_daemon.simulation.camera.stereo_camera import CameraTwin, Sensor
from morpheyes_daemon.simulation.camera.true_rig import RigErrors, RigTwin
from morpheyes_daemon.simulation.rendering.renderer import Renderer
from morpheyes_daemon.simulation.rendering.scene import Light, Material, Mesh, Scene
from morpheyes_daemon.simulation.rendering.textures import finished
from morpheyes_daemon.simulation.worlds.forest_world import ForestWorld
from morpheyes_daemon.simulation.worlds.loader import WorldFile, build_world
from morpheyes_daemon.transforms import Array, R_from_rpy, inverse, pose

STILL = pose(R_from_rpy(0.03, -0.05, 0.1), np.array([0.0, 0.0, -1.5]))
CLEAN = Sensor(read_noise_e=0.0, full_well_e=1e9, vignetting=0.0, auto_exposure=False, gain_mismatch=0.0)
DARK = Light(haze=(0.0, 0.0, 0.0))


def still(_: int) -> Array:
    return STILL


@pytest.fixture(scope="module")
def forest() -> Renderer:
    world = ForestWorld(kind="forest", course_m=20, run_in_m=4, run_out_m=15, half_width_m=15)
    return Renderer(build_world(WorldFile(world=world), seed=8).scene)


def spot(T_ned_rig: Array, place_rig: Array, size: float) -> Mesh:
    """A small bright square facing the rig."""
    # turned, so that the errors of its edges' smoothing average out
    turned = R_from_rpy(0, 0, 0.5)
    corners = place_rig + size * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ turned.T
    vertices = corners @ T_ned_rig[:3, :3].T + T_ned_rig[:3, 3]
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(vertices, np.zeros((4, 2)), np.ones(4), triangles, "glow", 1, two_sided=True)


@pytest.mark.parametrize("baseline_m", [0.1, 0.22, 0.3])
def test_points_land_where_lens_and_rig_project_them(baseline_m: float) -> None:
    rig = RigTwin(640, 480, seed=4)
    T_ned_rig = STILL @ CameraTwin(Renderer(empty([])), rig).T_ned_eye(0, np.eye(4), baseline_m)
    # the spots keep clear of the border, which would cut them and move their middle
    places = [np.array([x, y, 3.0]) for x in (-0.85, 0.1, 0.95) for y in (-0.7, 0.7)]
    for place in places:
        scene = empty([spot(T_ned_rig, place, 0.03)])
        twin = CameraTwin(Renderer(scene), rig, sensor=CLEAN)
        pair = twin.render_pair(0, 0, still, baseline_m)
        p_ned = T_ned_rig[:3, :3] @ place + T_ned_rig[:3, 3]
        for eye, (image, lens) in enumerate(((pair.left, rig.cam0), (pair.right, rig.cam1))):
            T_eye_ned = inverse(twin.T_ned_eye(eye, STILL, baseline_m))
            expected = lens.project(T_eye_ned[:3, :3] @ p_ned + T_eye_ned[:3, 3])
            light = (image[..., 1].astype(float) / 255) ** 2
            v, u = np.mgrid[0 : light.shape[0], 0 : light.shape[1]]
            found = np.array([(u * light).sum(), (v * light).sum()]) / light.sum()
            # the spot's edges fall on a grid of a fifth of a pixel: half of that at most
            assert np.abs(found - expected).max() < 0.1


def empty(meshes: list[Mesh]) -> Scene:
    white = {"white": finished(np.full((8, 8, 3), 255.0))}
    far = Mesh(np.full((3, 3), 1e3), np.zeros((3, 2)), np.ones(3), np.array([[0, 1, 2]], np.int32), "glow", 2)
    return Scene([*meshes, far], {"glow": Material("white", emissive=True)}, white, DARK)


def test_frames_repeat_bit_for_bit_and_differ_in_noise(forest: Renderer) -> None:
    rig = RigTwin(320, 240)
    one, two, threaded, other = (
        CameraTwin(forest, rig, seed=seed, workers=workers) for seed, workers in ((1, 1), (1, 1), (1, 2), (2, 1))
    )
    a, b, c, d = (twin.render_pair(5, 3, still, 0.2) for twin in (one, two, threaded, other))
    assert a.left.tobytes() == b.left.tobytes() == c.left.tobytes()
    assert a.right.tobytes() == b.right.tobytes() == c.right.tobytes()
    assert not np.array_equal(a.left, d.left)
    assert not np.array_equal(a.left, one.render_pair(5, 4, still, 0.2).left)
    assert not a.left.flags.writeable
    threaded.close()


def test_noise_grows_as_stated(forest: Renderer) -> None:
    sensor = Sensor(full_well_e=4000.0, read_noise_e=12.0, auto_exposure=False, vignetting=0.0, gain_mismatch=0.0)
    twin = CameraTwin(forest, RigTwin(160, 120), sensor=sensor)
    frames = np.array([(twin.render_pair(0, seq, still, 0.2).left / 255.0) ** 2 for seq in range(40)])
    mean, variance = frames.mean(axis=0), frames.var(axis=0)
    for level in (0.1, 0.3, 0.6):
        near = np.abs(mean - level) < 0.02
        stated = level / 4000.0 + (12.0 / 4000.0) ** 2
        rounding = 4 * level / 255**2 / 12
        assert variance[near].mean() == pytest.approx(stated + rounding, rel=0.1)


def test_exposure_follows_the_light_and_the_corners_are_darker(forest: Renderer) -> None:
    rig = RigTwin(160, 120)
    plain = CameraTwin(forest, rig, sensor=CLEAN).render_pair(0, 0, still, 0.2).left
    auto = CameraTwin(forest, rig, sensor=Sensor(target_mean=0.1)).render_pair(0, 0, still, 0.2).left
    assert ((auto / 255.0) ** 2).mean() == pytest.approx(0.1, rel=0.25)
    shaded = CameraTwin(forest, rig, sensor=Sensor(**{**sensor_fields(CLEAN), "vignetting": 0.5}))
    ratio = (shaded.render_pair(0, 0, still, 0.2).left.astype(float) + 1) / (plain.astype(float) + 1)
    assert ratio[55:65, 75:85].mean() > 0.98
    assert ratio[:6, :6].mean() == pytest.approx(math.sqrt(0.5), abs=0.06)


def sensor_fields(sensor: Sensor) -> dict[str, Any]:
    return {name: getattr(sensor, name) for name in Sensor.__slots__}


def test_the_right_eye_sees_from_where_the_vehicle_is_by_then(forest: Renderer) -> None:
    """Flying at 50 m/s for 2 ms is standing still 0.1 m farther on."""
    rig = RigTwin(160, 120)
    twin = CameraTwin(forest, rig, sensor=CLEAN)

    def flying(t_ns: int) -> Array:
        return pose(STILL[:3, :3], STILL[:3, 3] + (50.0 * t_ns / 1e9, 0, 0))

    def there(_: int) -> Array:
        return flying(2_000_000)

    moving = twin.render_pair(0, 0, flying, 0.2)
    assert np.array_equal(moving.left, twin.render_pair(0, 0, still, 0.2).left)
    assert np.array_equal(moving.right, twin.render_pair(0, 0, there, 0.2).right)


def test_motion_blurs_along_the_motion_only_when_asked(forest: Renderer) -> None:
    def turning(t_ns: int) -> Array:
        return pose(R_from_rpy(0, 0, 4.0 * t_ns / 1e9), STILL[:3, 3])

    def sharpness(sensor: Sensor) -> float:
        left = CameraTwin(forest, RigTwin(320, 240), sensor=sensor).render_pair(0, 0, turning, 0.2).left
        return float(np.abs(np.diff(left[..., 1].astype(float), axis=1)).mean())

    blurred = Sensor(**{**sensor_fields(CLEAN), "exposure_time_s": 0.008, "sub_exposures": 3})
    assert sharpness(blurred) < 0.8 * sharpness(CLEAN)


def ideal_pair(forest: Renderer, pose_at: Callable[[int], Array]) -> tuple[Image, Image, FloatMap, FloatMap]:
    """A rectified pair with noise, and the true depth of both eyes."""
    rig = RigTwin(320, 240, errors=RigErrors.none())
    twin = CameraTwin(forest, rig, Mount(tilt_up_deg=0), Sensor(sync_offset_s=0.0))
    pair = twin.render_pair(0, 0, pose_at, 0.12)
    mirrored = pose(np.eye(3), np.array([0.12, 0, 0]))

    def right(t_ns: int) -> Array:
        T_frd_left = inverse(pose_at(t_ns)) @ twin.T_ned_eye(0, pose_at(t_ns), 0.12)
        return np.asarray(pose_at(t_ns) @ T_frd_left @ mirrored @ inverse(T_frd_left))

    return pair.left, pair.right, twin.true_depth(0, pose_at, 0.12), twin.true_depth(0, right, 0.12)


@pytest.mark.parametrize("x", [0.0, 6.0, 12.0])
def test_semi_global_matching_works_on_it(forest: Renderer, x: float) -> None:
    def here(_: int) -> Array:
        return pose(R_from_rpy(0, 0, 0.1 * x), np.array([x, 0.0, -1.5]))

    left, right, depth, depth_right = ideal_pair(forest, here)
    f, b, disparities = 370.0, 0.12, 64
    matcher = cv2.StereoSGBM.create(0, disparities, 5, 200, 800, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    gray = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (left, right)]
    found = matcher.compute(*gray).astype(np.float32) / 16
    true = f * b / depth
    v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
    there = np.rint(u - true).astype(int)
    visible = np.isfinite(depth) & (u >= disparities) & (true < disparities - 1) & (there >= 0)
    seen_right = depth_right[v, np.clip(there, 0, None)]
    visible[visible] = np.abs(seen_right[visible] / depth[visible] - 1) < 0.02
    matched = visible & (found > 0)
    right_within_1px = np.abs(found - true)[matched] < 1.0
    assert right_within_1px.mean() >= 0.95
    assert np.count_nonzero(matched) / np.count_nonzero(visible) > 0.85
    assert np.median(np.abs(found - true)[matched]) < 0.3
