"""The software renderer: a `Scene` seen by an ideal pinhole, as linear radiance, exact depth and object ids.

Needs numba only, runs on any CPU, gives the same bits on every run and in every thread, and releases the
interpreter lock. A `Renderer` owns its buffers, so each thread has its own. Lens, noise and exposure are the camera
twin's business.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.simulation.rendering.raster import COUNT, PLANES, SAMPLES, TILE, rasterise, visible_parts
from morpheyes_daemon.simulation.rendering.scene import SKY_OBJECT, Material, Mesh, Scene
from morpheyes_daemon.simulation.rendering.shading import shade_image
from morpheyes_daemon.simulation.rendering.textures import TextureAtlas, pack
from morpheyes_daemon.transforms import Array, inverse, pose


@dataclass(frozen=True, eq=False)
class Rendered:
    """radiance (H, W, 3) float32 linear BGR, depth_m (H, W) float32 along z (inf: sky), objects (H, W) int32."""

    radiance: FloatMap
    depth_m: FloatMap
    objects: NDArray[np.int32]

    @cached_property
    def image(self) -> Image:
        """BGR uint8 (H, W, 3) at unit exposure, encoded by the square root."""
        return encode(self.radiance)


def encode(radiance: FloatMap) -> Image:
    """Return 255 times the square root of radiance, clipped, as uint8."""
    value = np.sqrt(np.clip(radiance, 0.0, 1.0), dtype=np.float32) * np.float32(255.0) + np.float32(0.5)
    return np.asarray(value, dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Batch:
    """Meshes of one frame laid out for `rasterise`."""

    vertices: Array
    attributes: Array
    triangles: NDArray[np.int32]
    bounds: Array
    ranges: NDArray[np.int64]
    flags: NDArray[np.bool_]
    first_part: int


def _batch(meshes: Sequence[Mesh], materials: Mapping[str, Material], first_part: int) -> _Batch:
    sizes = np.array([[len(m.vertices_m), len(m.triangles)] for m in meshes], np.int64).reshape(-1, 2)
    ends = np.cumsum(sizes, axis=0)
    starts = ends - sizes
    vertices = np.concatenate([m.vertices_m for m in meshes]).astype(np.float64)
    tiles = [m.uv_m * materials[m.material].tiles_per_m for m in meshes]
    attributes = np.column_stack([np.concatenate(tiles), np.concatenate([m.sun for m in meshes])])
    triangles = np.concatenate([m.triangles + s for m, s in zip(meshes, starts[:, 0], strict=True)])
    bounds = np.array([(*_sphere(m.vertices_m), *m.draw_range_m) for m in meshes], np.float64)
    ranges = np.column_stack([starts[:, 0], ends[:, 0], starts[:, 1], ends[:, 1]])
    flags = np.array([(m.two_sided, m.loose) for m in meshes])
    return _Batch(vertices, attributes, triangles.astype(np.int32), bounds, ranges, flags, first_part)


def _sphere(vertices: Array) -> tuple[float, float, float, float]:
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    return float(centre[0]), float(centre[1]), float(centre[2]), radius


class _Workspace:
    """Scratch memory of one renderer: set-up records, transformed vertices, and a buffer per image size."""

    def __init__(self, triangles: int, vertices: int) -> None:
        self.records = np.empty((1 + triangles, PLANES))
        self.parts = np.empty(1 + triangles, np.int32)
        self.groups = np.full(1 + triangles, -1, np.int32)
        self.transformed = np.empty((vertices, 3))
        self.polygon = np.empty((4, 2))
        self.edges = np.empty((2, COUNT))
        self.start = np.empty(COUNT, np.float32)
        self.sample_groups = np.empty(COUNT, np.int64)
        self._buffers: dict[tuple[int, int], tuple[NDArray[np.uint64], FloatMap]] = {}

    def cleared(self, shape: tuple[int, int]) -> tuple[NDArray[np.uint64], FloatMap]:
        """Return an empty visibility buffer and its tiles."""
        if shape not in self._buffers:
            tiles = (-(-shape[0] // TILE), -(-shape[1] // TILE))
            self._buffers[shape] = np.empty((*shape, COUNT), np.uint64), np.empty(tiles, np.float32)
        buffer, farthest = self._buffers[shape]
        buffer.fill(0)
        farthest.fill(0.0)
        return buffer, farthest


class Renderer:
    """Draws one scene; not to be shared between threads."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._atlas: TextureAtlas = pack(scene.textures)
        names = {name: i for i, name in enumerate(scene.materials)}
        rows = [self._material_rows(m) for m in scene.materials.values()]
        self._materials = np.array([row for row, _ in rows], np.int64)
        self._ratios = np.array([ratios for _, ratios in rows])
        sky = (scene.sky,) if scene.sky is not None else ()
        groups = [*(body.meshes for body in scene.moving), tuple(scene.meshes), sky]
        meshes = [mesh for group in groups for mesh in group]
        starts = np.cumsum([0, *(len(group) for group in groups)])[:-1].tolist()
        pairs = zip(groups, starts, strict=True)
        self._batches = [_batch(group, scene.materials, start) if group else None for group, start in pairs]
        self._looks = np.array([(*m.tint, m.ambient) for m in meshes], np.float32)
        self._part_materials = np.array([names[m.material] for m in meshes], np.int64)
        self._part_objects = np.array([m.object_id for m in meshes], np.int32)
        light = scene.light
        self._light = np.array([light.sun, light.sky, light.haze, (1.0 / light.haze_range_m, 0.0, 0.0)], np.float32)
        self._work = _Workspace(
            triangles=sum(len(mesh.triangles) for mesh in meshes),
            vertices=max(len(mesh.vertices_m) for mesh in meshes),
        )

    def sibling(self) -> Renderer:
        """Return a renderer of the same scene with buffers of its own, for another thread."""
        other = copy.copy(self)
        other._work = _Workspace(len(self._work.records) - 1, len(self._work.transformed))
        return other

    def _material_rows(self, m: Material) -> tuple[tuple[int, ...], tuple[float, ...]]:
        """Return a material's rows for `shade_image`: textures and kind, and how the two textures relate."""
        index, sizes = self._atlas.names.index, self._atlas.log_sizes
        kind = 2 if m.sky else 1 if m.emissive else 0
        detail = index(m.texture)
        if m.modulation is None:
            return (detail, int(sizes[detail]), -1, 0, kind), (0.0, 0.0, 0.0)
        coarse = index(m.modulation)
        ratio = np.divide(m.modulation_tiles_per_m, m.tiles_per_m)
        levels = float(np.log2(ratio).mean() + sizes[coarse] - sizes[detail])
        return (detail, int(sizes[detail]), coarse, int(sizes[coarse]), kind), (*ratio, levels)

    def render(self, T_ned_cam: Array, pinhole: Pinhole, t_s: float = 0.0, eye_ned: Array | None = None) -> Rendered:
        """Render what a camera at `T_ned_cam` (4, 4; x right, y down, z forward) sees at world time `t_s`.

        `eye_ned` (3,) is what drawing ranges are measured from; pass the same for both eyes of a pair.
        """
        shape = (pinhole.height, pinhole.width)
        eye = T_ned_cam[:3, 3] if eye_ned is None else eye_ned
        buffer = self._visible(T_ned_cam, pinhole, self._frames(T_ned_cam, t_s), eye)
        shape = (pinhole.height, pinhole.width)
        rendered = Rendered(
            np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), np.full(shape, SKY_OBJECT, np.int32)
        )
        work, atlas = self._work, self._atlas
        shade_image(
            buffer, SAMPLES, work.sample_groups, work.records, work.parts, work.groups, self._looks,
            self._part_materials, self._part_objects, self._materials, self._ratios, atlas.texels, atlas.levels,
            self._light, rendered.radiance, rendered.depth_m, rendered.objects,
        )  # fmt: skip
        return rendered

    def _visible(self, T_ned_cam: Array, pinhole: Pinhole, frames: list[Array], eye: Array) -> NDArray[np.uint64]:
        """Rasterise all batches and return the visibility buffer."""
        work, size = self._work, (pinhole.width, pinhole.height)
        buffer, farthest = work.cleared((pinhole.height, pinhole.width))
        intrinsics = (pinhole.f_px, pinhole.cx_px, pinhole.cy_px)
        count = 1  # record 0 stands for nothing
        for batch, T_ned_batch in zip(self._batches, frames, strict=True):
            if batch is None:
                continue
            T_cam_batch = inverse(T_ned_cam) @ T_ned_batch
            R, t = T_cam_batch[:3, :3].copy(), T_cam_batch[:3, 3].copy()
            eye_batch = T_ned_batch[:3, :3].T @ (eye - T_ned_batch[:3, 3])
            order = visible_parts(batch.bounds, R, t, eye_batch, intrinsics, size)
            count = rasterise(
                order, batch.vertices, batch.attributes, batch.triangles, batch.ranges, batch.flags, batch.first_part,
                R, t, intrinsics, SAMPLES, buffer, farthest, work.transformed, work.polygon,
                work.edges, work.start, work.records, work.parts, work.groups, count,
            )  # fmt: skip
        return buffer

    def _frames(self, T_ned_cam: Array, t_s: float) -> list[Array]:
        """Where each batch is: moving objects, what stands, and the sky around the eye; the nearest things first."""
        moving = [body.T_ned_object(t_s) for body in self.scene.moving]
        return [*moving, np.eye(4), pose(np.eye(3), T_ned_cam[:3, 3])]
