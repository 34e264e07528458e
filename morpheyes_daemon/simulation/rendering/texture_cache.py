"""Things that take seconds to make and come out the same every time, kept in the user's cache.

A damaged file is made again; where nothing can be written, nothing is kept.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.simulation.rendering import textures
from morpheyes_daemon.simulation.rendering.textures import Texture


def cache_folder(name: str) -> Path:
    """Return a folder in the user's cache (XDG_CACHE_HOME); it need not exist."""
    root = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(root) / "morpheyes" / name


def kept_texture(name: str, make: Callable[[], Texture], folder: Path | None = None) -> Texture:
    """Return the texture that `make` makes, from the last time if the code that made it was the same."""
    path = (cache_folder("textures") if folder is None else folder) / f"{name}-{_recipe()}.png"
    texels = _read(path)
    if texels is not None:
        return Texture(texels)
    texture = make()
    _write(path, texture.texels)
    return texture


@cache
def _recipe() -> str:
    """Name everything a texture depends on: our code, and the libraries that draw."""
    source = Path(textures.__file__).read_bytes()
    return hashlib.sha256(source + f"{np.__version__} {cv2.__version__}".encode()).hexdigest()[:12]


def _read(path: Path) -> NDArray[np.uint8] | None:
    try:
        stored = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError:
        return None
    image = cv2.imdecode(stored, cv2.IMREAD_UNCHANGED) if stored.size else None
    is_texture = image is not None and image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 4
    return np.asarray(image, dtype=np.uint8) if is_texture else None


def _write(path: Path, texels: NDArray[np.uint8]) -> None:
    """Write beside and rename, so that no other process ever reads half a file."""
    _, data = cv2.imencode(".png", texels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(data.tobytes())
        Path(name).replace(path)
    except OSError:
        return
