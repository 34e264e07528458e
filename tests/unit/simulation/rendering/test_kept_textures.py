"""Textures from the last time are the very same, and a file that is damaged or cannot be written does no harm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morpheyes_daemon.simulation.rendering.texture_cache import kept_texture
from morpheyes_daemon.simulation.rendering.textures import Texture


class Maker:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> Texture:
        self.calls += 1
        return Texture(np.random.default_rng(3).integers(0, 256, (16, 16, 4), dtype=np.uint8))


def test_the_second_time_it_is_read_and_the_same(tmp_path: Path) -> None:
    make = Maker()
    first, second = (kept_texture("bark", make, tmp_path) for _ in range(2))
    assert make.calls == 1
    assert np.array_equal(first.texels, second.texels)


def test_a_damaged_file_is_made_again(tmp_path: Path) -> None:
    make = Maker()
    first = kept_texture("bark", make, tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:40])
    assert np.array_equal(kept_texture("bark", make, tmp_path).texels, first.texels)
    assert make.calls == 2
    kept_texture("bark", make, tmp_path)
    assert make.calls == 2


def test_where_nothing_can_be_written_nothing_is_kept(tmp_path: Path) -> None:
    make = Maker()
    file = tmp_path / "file"
    file.write_text("")
    kept_texture("bark", make, file)
    assert kept_texture("bark", make, file).texels.shape == (16, 16, 4)
    assert make.calls == 2
