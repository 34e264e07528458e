"""What there is to be seen, as plain data: meshes, materials, light. Knows neither cameras nor how to draw.

Meshes are in a frame with ned axes (x north, y east, z down); normals point outwards by the right-hand rule
(b - a) x (c - a). Texture coordinates are metres along the surface; materials say how many tiles fit a metre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.simulation.rendering.textures import Texture

Array = NDArray[np.float64]
Bgr = tuple[float, float, float]

SKY_OBJECT = -1
GROUND_OBJECT = 0


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """One part: vertices_m (V, 3), uv_m (V, 2), sun (V,) share of sunlight, triangles (T, 3) int32.

    The triangles of a `loose` part are smoothed against each other, too. It is drawn where the viewer's distance to
    its centre along x and y is in `draw_range_m`. Parts of one tree share `object_id`.
    """

    vertices_m: Array
    uv_m: Array
    sun: Array
    triangles: NDArray[np.int32]
    material: str
    object_id: int
    tint: Bgr = (1.0, 1.0, 1.0)
    ambient: float = 1.0
    two_sided: bool = False
    loose: bool = False
    draw_range_m: tuple[float, float] = (0.0, 1e9)


@dataclass(frozen=True, slots=True)
class Material:
    """A texture repeated so many times per metre, and a second, coarser one that modulates colour and sunlight.

    The modulating texture multiplies the colour by twice its value and the sun by its fourth channel.
    """

    texture: str
    tiles_per_m: tuple[float, float] = (1.0, 1.0)
    modulation: str | None = None
    modulation_tiles_per_m: tuple[float, float] = (0.05, 0.05)
    emissive: bool = False
    sky: bool = False


@dataclass(frozen=True, slots=True)
class Light:
    """Sun (unit vector towards it, ned), radiances as linear BGR, and the range at which haze takes half.

    `lamps_ned_m` are the places of lamps in a closed room, for a renderer that follows light: no other gets in.
    """

    towards_sun: tuple[float, float, float] = (-0.45, -0.55, -0.70)
    sun: Bgr = (1.9, 2.3, 2.6)
    sky: Bgr = (0.62, 0.55, 0.50)
    haze: Bgr = (0.46, 0.50, 0.43)
    haze_range_m: float = 90.0
    lamps_ned_m: tuple[tuple[float, float, float], ...] = ()

    @property
    def direction(self) -> Array:
        """Unit vector towards the sun."""
        d = np.array(self.towards_sun)
        return np.asarray(d / np.linalg.norm(d))


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """Meshes whose pose is a pure function of time: `T_ned_object(t_s)` (4, 4)."""

    meshes: tuple[Mesh, ...]
    T_ned_object: Callable[[float], Array]
    name: str = "object"


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything the renderer needs; `sky` follows the eye."""

    meshes: Sequence[Mesh]
    materials: Mapping[str, Material]
    textures: Mapping[str, Texture]
    light: Light = Light()
    sky: Mesh | None = None
    moving: tuple[MovingObject, ...] = field(default=())
