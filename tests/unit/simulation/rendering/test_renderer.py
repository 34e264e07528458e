"""The renderer against slow, independent references: ray casting, exact coverage, the texture itself."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from morpheyes_daemon.messages.core import Pinhole
from morpheyes_daemon.simulation.rendering import meshes
from morpheyes_daemon.simulation.rendering.renderer import Rendered, Renderer
from morpheyes_daemon.simulation.rendering.scene import Material, Mesh, MovingObject, Scene
from morpheyes_daemon.simulation.rendering.textures import Texture, finished
from morpheyes_daemon.simulation.worlds.forest_world import ForestWorld
from morpheyes_daemon.simulation.worlds.loader import WorldFile, build_world
from morpheyes_daemon.transforms import R_FRD_CAM, Array, R_from_rotvec, R_from_rpy, inverse, pose

SMALL = Pinhole(96, 72, 111.0, 47.5, 35.5)
THIN_FOREST = ForestWorld(kind="forest", course_m=20, run_in_m=4, run_out_m=10, half_width_m=10)


def looking(x: float, y: float, height: float, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Array:
    R = R_from_rpy(0.1, math.radians(pitch_deg), math.radians(yaw_deg))
    return pose(R @ R_FRD_CAM, np.array([x, y, -height]))


def plain(colour: float = 1.0) -> Texture:
    return finished(np.full((8, 8, 3), 255.0 * colour))


def glowing(mesh: meshes.Surface, material: str = "glow", object_id: int = 1, two_sided: bool = True) -> Mesh:
    vertices, uv, _, triangles = mesh
    return Mesh(vertices, uv, np.ones(len(vertices)), triangles, material, object_id, two_sided=two_sided)


def scene_of(*parts: Mesh, moving: tuple[MovingObject, ...] = ()) -> Scene:
    return Scene(parts, {"glow": Material("white", emissive=True)}, {"white": plain()}, moving=moving)


def cast_rays(scene: Scene, T_ned_cam: Array, pinhole: Pinhole, pixels: Array) -> Array:
    """Depth along z at pixels (n, 2) by Moeller and Trumbore's test against every triangle in drawing range."""
    eye = T_ned_cam[:3, 3]
    rays = np.column_stack([(pixels - (pinhole.cx_px, pinhole.cy_px)) / pinhole.f_px, np.ones(len(pixels))])
    depth = np.full(len(pixels), np.inf)
    for mesh in scene.meshes:
        middle = 0.5 * (mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0))
        beside = math.hypot(*(middle - eye)[:2])
        if not mesh.draw_range_m[0] <= beside < mesh.draw_range_m[1]:
            continue
        corners = ((mesh.vertices_m - eye) @ T_ned_cam[:3, :3])[mesh.triangles]
        depth = np.minimum(depth, nearest_hit(corners, rays, mesh.two_sided))
    return depth


def nearest_hit(corners: Array, rays: Array, two_sided: bool) -> Array:
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.cross(rays[:, None], e2[None])
        determinant = np.einsum("rti,ti->rt", p, e1)
        u = np.einsum("rti,ti->rt", p, -a) / determinant
        q = np.cross(-a, e1)
        v = np.einsum("ri,ti->rt", rays, q) / determinant
        z = np.einsum("ti,ti->t", q, e2) / determinant
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (z > 0.05)
    # a triangle whose outward side faces the eye has a positive determinant here
    hit &= two_sided | (determinant > 0)
    return np.where(hit, z, np.inf).min(axis=1)


@pytest.fixture(scope="module")
def forest() -> tuple[Scene, Renderer]:
    scene = build_world(WorldFile(world=THIN_FOREST), seed=5).scene
    return scene, Renderer(scene)


@pytest.mark.parametrize(
    "place", [(0, 0, 1.5, 0, 8), (5, 2, 1.0, 50, -10), (9, -3, 2.0, 200, 20), (3, 0, 0.15, 90, -60)]
)
def test_depth_equals_a_ray_caster(forest: tuple[Scene, Renderer], place: tuple[float, ...]) -> None:
    scene, renderer = forest
    T_ned_cam = looking(*place)
    depth = renderer.render(T_ned_cam, SMALL).depth_m
    v, u = np.mgrid[0 : SMALL.height : 5, 0 : SMALL.width : 5]
    expected = cast_rays(scene, T_ned_cam, SMALL, np.column_stack([u.ravel(), v.ravel()]).astype(float))
    found = depth[v.ravel(), u.ravel()].astype(float)
    # float32 output; a ray that grazes an edge may fall to either side
    agree = np.isclose(found, expected, rtol=1e-5) | (np.isinf(found) & np.isinf(expected))
    assert agree.mean() > 0.995


def test_depth_is_right_when_the_eye_touches_a_trunk() -> None:
    trunk = glowing(meshes.frustum(np.array([0.4, 0, 0]), np.array([0.4, 0, -8.0]), 0.3, 0.2, 24))
    T_ned_cam = looking(0.0, 0.05, 1.5)
    scene = scene_of(trunk)
    depth = Renderer(scene).render(T_ned_cam, SMALL).depth_m
    v, u = np.mgrid[0 : SMALL.height : 3, 0 : SMALL.width : 3]
    expected = cast_rays(scene, T_ned_cam, SMALL, np.column_stack([u.ravel(), v.ravel()]).astype(float))
    assert np.isclose(depth[v.ravel(), u.ravel()], expected, rtol=1e-5).mean() > 0.995


def test_a_closed_surface_has_no_cracks() -> None:
    vertices, triangles = meshes.icosphere(3)
    rng = np.random.default_rng(0)
    ball = Mesh(3 * vertices, vertices[:, :2], np.ones(len(vertices)), triangles, "glow", 1, two_sided=True)
    renderer = Renderer(scene_of(ball))
    for _ in range(8):
        T = pose(R_from_rotvec(rng.standard_normal(3)), rng.uniform(-1, 1, 3))
        rendered = renderer.render(T, SMALL)
        assert np.isfinite(rendered.depth_m).all()
        assert np.all(rendered.radiance == np.float32(1.0))


def test_the_same_bits_on_every_run_and_in_every_thread(forest: tuple[Scene, Renderer]) -> None:
    _, renderer = forest
    places = [looking(k, 0.3 * k, 1.5, 10 * k) for k in range(6)]
    first = [renderer.render(T, SMALL) for T in places]
    with ThreadPoolExecutor(2) as pool:
        siblings = [renderer.sibling() for _ in places]
        second = list(pool.map(lambda pair: pair[0].render(pair[1], SMALL), zip(siblings, places, strict=True)))
    for a, b in zip(first, second, strict=True):
        assert a.radiance.tobytes() == b.radiance.tobytes()
        assert a.depth_m.tobytes() == b.depth_m.tobytes()
        assert a.objects.tobytes() == b.objects.tobytes()


def test_edges_are_smoothed_by_their_coverage() -> None:
    corners = np.array([[5.0, -1.1, -0.8], [5.0, 1.3, -0.4], [5.0, 0.2, 1.2]])
    surface = (corners, corners[:, :2], corners, np.array([[0, 1, 2]], np.int32))
    pinhole = Pinhole(64, 48, 80.0, 31.5, 23.5)
    shown = Renderer(scene_of(glowing(surface))).render(looking(0, 0, 0), pinhole)
    fine = Pinhole(64 * 8, 48 * 8, 640.0, 8 * 31.5 + 3.5, 8 * 23.5 + 3.5)
    covered = np.isfinite(Renderer(scene_of(glowing(surface))).render(looking(0, 0, 0), fine).depth_m)
    coverage = covered.reshape(48, 8, 64, 8).mean(axis=(1, 3))
    background = float(shown.radiance[0, 0, 0])
    share = (shown.radiance[..., 0] - background) / (1.0 - background)
    # five samples of a pixel: off by a fifth at most, unbiased over the outline
    assert np.abs(share - coverage).max() < 0.25
    assert abs((share - coverage).sum()) / np.count_nonzero((coverage > 0) & (coverage < 1)) < 0.03


def test_texture_is_mapped_in_perspective() -> None:
    ramp = np.linspace(0, 255, 256)[None, :, None] * np.ones((256, 1, 3))
    floor = meshes.terrain(np.array([0.0, 40.0]), np.array([-20.0, 20.0]), np.zeros((2, 2)))
    material = Material("ramp", (1 / 40, 1 / 40), emissive=True)
    scene = Scene((glowing(floor, "ramp"),), {"ramp": material}, {"ramp": finished(ramp)})
    T_ned_cam = looking(0.0, 0.0, 1.5, pitch_deg=-20)
    shown = Renderer(scene).render(T_ned_cam, SMALL)
    for v, u in ((30, 40), (45, 20), (60, 80)):
        ray = np.array([(u - SMALL.cx_px) / SMALL.f_px, (v - SMALL.cy_px) / SMALL.f_px, 1.0])
        north = (T_ned_cam[:3, :3] @ ray * shown.depth_m[v, u])[0]
        # texel centres are at half steps; half a level of rounding and of bilinear weights
        expected = (north / 40 * 256 - 0.5) / 255
        assert abs(math.sqrt(shown.radiance[v, u, 0]) - expected) < 0.006


def test_far_texture_neither_flickers_nor_fades() -> None:
    """Mip-mapping: moving by a fraction of a pixel changes a distant, finely textured floor only a little."""
    rng = np.random.default_rng(1)
    noise = finished(rng.uniform(0, 255, (256, 256, 3)))
    floor = meshes.terrain(np.array([0.0, 80.0]), np.array([-40.0, 40.0]), np.zeros((2, 2)))
    scene = Scene((glowing(floor, "n"),), {"n": Material("n", (2.0, 2.0), emissive=True)}, {"n": noise})
    renderer = Renderer(scene)

    def far(x: float) -> Array:
        return np.asarray(renderer.render(looking(x, 0, 1.5), SMALL).radiance[44:50].astype(float))

    mean = float(far(0.0).mean())
    assert abs(mean - 1 / 3) < 0.03  # the mean of squares of uniform values
    assert np.abs(far(0.0) - far(0.02)).mean() < 0.03


def test_objects_are_named_and_the_sky_is_infinitely_far(forest: tuple[Scene, Renderer]) -> None:
    shown = forest[1].render(looking(0, 0, 1.5, pitch_deg=25), SMALL)
    assert (np.isinf(shown.depth_m) == (shown.objects == -1)).all()
    assert (shown.objects == -1).any()
    assert len(np.unique(shown.objects)) > 3


def test_a_moving_object_is_where_its_pose_says() -> None:
    def at(t_s: float) -> Array:
        return pose(R_from_rpy(0, 0, t_s), np.array([4.0 + t_s, 0.5 * t_s, -1.5]))

    vertices, triangles = meshes.icosphere(2)
    ball = Mesh(0.3 * vertices, vertices[:, :2], np.ones(len(vertices)), triangles, "glow", 7)
    renderer = Renderer(scene_of(moving=(MovingObject((ball,), at),)))
    for t_s in (0.0, 1.0, 2.5):
        T_ned_cam = looking(0, 0, 1.5)
        shown: Rendered = renderer.render(T_ned_cam, SMALL, t_s)
        v, u = np.nonzero(shown.objects == 7)
        centre = inverse(T_ned_cam) @ at(t_s)[:, 3]
        expected = SMALL.f_px * centre[:2] / centre[2] + (SMALL.cx_px, SMALL.cy_px)
        assert np.allclose([u.mean(), v.mean()], expected, atol=0.5)
        assert abs(float(shown.depth_m[v, u].min()) - (centre[2] - 0.3)) < 0.02
