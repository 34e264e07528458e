"""What surfaces look like, by name: the table of materials and of the textures they are made of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache

from morpheyes_daemon.simulation.rendering import textures
from morpheyes_daemon.simulation.rendering.scene import Material, Mesh
from morpheyes_daemon.simulation.rendering.texture_cache import kept_texture
from morpheyes_daemon.simulation.rendering.textures import Texture

TEXTURES: Mapping[str, Callable[[], Texture]] = {
    "bark0": lambda: textures.bark(0),
    "bark1": lambda: textures.bark(1),
    "bark2": lambda: textures.bark(2),
    "leaves0": lambda: textures.leaves(0),
    "leaves1": lambda: textures.leaves(1),
    "grass": lambda: textures.grass(0),
    "dapple": lambda: textures.dapple(0),
    "stains": lambda: textures.stains(0),
    "sky": lambda: textures.sky(0),
    "newsprint": lambda: textures.newsprint(0),
    "mural": lambda: textures.mural(0),
    "planks": lambda: textures.planks(0),
    "plaster0": lambda: textures.wallpaper(0),
    "plaster1": lambda: textures.wallpaper(1),
    "patchwork": lambda: textures.patchwork(0),
}

MATERIALS: Mapping[str, Material] = {
    **{f"bark{k}": Material(f"bark{k}", (1.0, 1.0), "dapple", (0.31, 0.13)) for k in range(3)},
    **{f"leaves{k}": Material(f"leaves{k}", (0.9, 0.9)) for k in range(2)},
    "meadow": Material("grass", (0.4, 0.4), "dapple", (0.043, 0.043)),
    "sky": Material("sky", (2.0, 1.0), sky=True),
    "newsprint": Material("newsprint", (0.27, 0.27), "stains", (0.073, 0.073)),
    "mural": Material("mural", (0.23, 0.23), "stains", (0.073, 0.073)),
    "planks": Material("planks", (0.5, 0.5), "stains", (0.073, 0.073)),
    "plaster0": Material("plaster0", (0.34, 0.34), "stains", (0.073, 0.073)),
    "plaster1": Material("plaster1", (0.34, 0.34), "stains", (0.073, 0.073)),
    "patchwork": Material("patchwork", (1 / 0.3, 1 / 0.3)),
}


def materials_of(meshes: Iterable[Mesh], own: Mapping[str, Material]) -> dict[str, Material]:
    """Return the materials that meshes ask for, from the world's `own` first."""
    names = dict.fromkeys(mesh.material for mesh in meshes)
    return {name: own[name] if name in own else MATERIALS[name] for name in names}


def textures_of(materials: Iterable[Material], own: Mapping[str, Texture]) -> dict[str, Texture]:
    """Return the textures that materials are made of, from the world's `own` first."""
    names = dict.fromkeys(n for m in materials for n in (m.texture, m.modulation) if n is not None)
    return {name: own[name] if name in own else _texture(name) for name in names}


@cache
def _texture(name: str) -> Texture:
    return kept_texture(name, TEXTURES[name])
