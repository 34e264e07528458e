"""The same scene description through Mitsuba's path tracer, for pictures of a quality that a flight cannot wait for.

As the paper used Cycles for its figures. Real shadows and inter-reflection take the place of the fast renderer's light
map, haze and modulation; geometry, textures and lens-free pinhole are the same, so that depth can be compared. Needs
the `figures` extra (Mitsuba 3).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import FloatMap, Pinhole
from morpheyes_daemon.simulation.rendering.scene import Light, Material, Mesh, Scene
from morpheyes_daemon.simulation.rendering.textures import Texture
from morpheyes_daemon.transforms import Array

VARIANT = "scalar_rgb"
MAX_DEPTH = 8
LAMP_M, LAMP_RADIANCE = 1.5, 10.0
"""Edge and radiance of a lamp, a square that shines downwards."""

TINT_STEP = 0.25
"""Tints are rounded to this, so that many trees share few bitmaps."""

_CAM_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's camera looks along z with x to the left and y up."""


def trace(scene: Scene, T_ned_cam: Array, pinhole: Pinhole, samples: int = 16, t_s: float = 0.0) -> FloatMap:
    """Return radiance (H, W, 3) float32 linear BGR of what a camera at `T_ned_cam` (4, 4) sees at world time `t_s`."""
    import mitsuba

    mitsuba.set_variant(VARIANT)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)  # it warns on standard output
    loaded = mitsuba.load_dict(scene_dict(scene, T_ned_cam, pinhole, samples, t_s))
    rgb = np.asarray(mitsuba.render(loaded, seed=mitsuba.UInt32(0)), dtype=np.float32)
    return np.ascontiguousarray(rgb[..., 2::-1])


def scene_dict(scene: Scene, T_ned_cam: Array, pinhole: Pinhole, samples: int, t_s: float) -> dict[str, Any]:
    """Return Mitsuba's own description of the scene."""
    import mitsuba

    found: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": False},
        "sensor": _sensor(T_ned_cam, pinhole, samples),
        **_emitters(scene.light),
    }
    surfaces: dict[tuple[str, tuple[float, ...]], Any] = {}
    for number, (mesh, T_ned_mesh) in enumerate(_in_range(scene, T_ned_cam[:3, 3], t_s)):
        tint = tuple(round(c / TINT_STEP) * TINT_STEP for c in mesh.tint)
        if (mesh.material, tint) not in surfaces:
            material = scene.materials[mesh.material]
            surfaces[mesh.material, tint] = _surface(material, scene.textures[material.texture], tint)
        shape = _shape(mitsuba, f"mesh{number}", mesh, T_ned_mesh, scene.materials[mesh.material])
        shape.set_bsdf(mitsuba.load_dict(surfaces[mesh.material, tint]))
        found[f"mesh{number}"] = shape
    return found


def _emitters(light: Light) -> dict[str, Any]:
    """Return sun and sky, or the lamps of a closed room."""
    if light.lamps_ned_m:
        return {f"lamp{number}": _lamp(place) for number, place in enumerate(light.lamps_ned_m)}
    return {
        "sun": {
            "type": "directional",
            "direction": (-light.direction).tolist(),
            "irradiance": _rgb(np.array(light.sun) * math.pi),
        },
        "sky": {"type": "constant", "radiance": _rgb(np.array(light.sky))},
    }


def _lamp(place_ned_m: tuple[float, float, float]) -> dict[str, Any]:
    import mitsuba

    T_ned_lamp = mitsuba.ScalarTransform4f().translate(list(place_ned_m)).scale(LAMP_M / 2)
    shine = {"type": "area", "radiance": {"type": "rgb", "value": LAMP_RADIANCE}}
    return {"type": "rectangle", "to_world": T_ned_lamp, "emitter": shine}


def _in_range(scene: Scene, eye: Array, t_s: float) -> Iterator[tuple[Mesh, Array]]:
    """Yield the parts at the level of detail that is drawn from here, with their poses."""
    for mesh in scene.meshes:
        middle = 0.5 * (mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0))
        low, high = mesh.draw_range_m
        if low <= math.hypot(middle[0] - eye[0], middle[1] - eye[1]) < high:
            yield mesh, np.eye(4)
    for body in scene.moving:
        T_ned_body = body.T_ned_object(t_s)
        for mesh in body.meshes:
            yield mesh, T_ned_body


def _sensor(T_ned_cam: Array, pinhole: Pinhole, samples: int) -> dict[str, Any]:
    import mitsuba

    width, height = pinhole.width, pinhole.height
    return {
        "type": "perspective",
        "fov": math.degrees(2.0 * math.atan(0.5 * width / pinhole.f_px)),
        "fov_axis": "x",
        # our pixel centres are whole numbers, Mitsuba's lie half a pixel further
        "principal_point_offset_x": (pinhole.cx_px + 0.5) / width - 0.5,
        "principal_point_offset_y": (pinhole.cy_px + 0.5) / height - 0.5,
        "near_clip": 0.05,
        "to_world": mitsuba.ScalarTransform4f((T_ned_cam @ _CAM_FROM_MITSUBA).tolist()),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": {"type": "multijitter", "sample_count": samples},
    }


def _surface(material: Material, texture: Texture, tint: tuple[float, ...]) -> dict[str, Any]:
    """Return a matt surface, lit from both sides; texels hold the square root of linear blue, green, red."""
    import mitsuba

    linear = (texture.texels[..., 2::-1].astype(np.float32) / np.float32(255.0)) ** 2
    coloured = np.clip(linear * np.array(tint[::-1], dtype=np.float32), 0.0, 0.95)
    bitmap = {"type": "bitmap", "bitmap": mitsuba.Bitmap(np.ascontiguousarray(coloured)), "raw": True}
    return {"type": "twosided", "matt": {"type": "diffuse", "reflectance": bitmap}}


def _shape(mitsuba: Any, name: str, mesh: Mesh, T_ned_mesh: Array, material: Material) -> Any:
    vertices = mesh.vertices_m @ T_ned_mesh[:3, :3].T + T_ned_mesh[:3, 3]
    tiles: NDArray[np.float64] = mesh.uv_m * material.tiles_per_m
    # Mitsuba's rows of a bitmap count from the top of v
    tiles = np.column_stack([tiles[:, 0], 1.0 - tiles[:, 1]])
    shape = mitsuba.Mesh(name, len(vertices), len(mesh.triangles), has_vertex_texcoords=True)
    values = mitsuba.traverse(shape)
    values["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    values["faces"] = np.ascontiguousarray(mesh.triangles, dtype=np.uint32).ravel()
    values["vertex_texcoords"] = np.ascontiguousarray(tiles, dtype=np.float32).ravel()
    values.update()
    return shape


def _rgb(bgr: Array) -> dict[str, Any]:
    return {"type": "rgb", "value": bgr[::-1].tolist()}
