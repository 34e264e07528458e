"""Seeded textures made on the spot, rich in detail at every scale, and their mip levels.

Stereo matching lives on texture: the spectra fall as 1/f, so contrast stays the same at every distance. Values are
the square root of linear reflectance times 255, which spends the 8 bits where they are seen. All textures are
square, a power of two wide, and repeat without a seam. Made with OpenCV's drawing and numpy's FFT.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Texels = NDArray[np.uint8]
Field = NDArray[np.float64]

BLOCK = 4
"""Texels lie in blocks of 4 x 4."""


@dataclass(frozen=True, eq=False)
class Texture:
    """texels (N, N, 4) uint8: square root of linear blue, green, red, and a fourth channel (share of sunlight)."""

    texels: Texels

    @cached_property
    def levels(self) -> tuple[NDArray[np.uint64], ...]:
        """Mip levels down to one block, colours averaged linearly, each laid out as `_blocks` says."""
        value = self.texels.astype(np.float32)
        value[..., :3] *= value[..., :3]
        chain = [_blocks(self.texels)]
        while value.shape[0] > BLOCK:
            halved = cv2.resize(value, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            value = np.asarray(halved, dtype=np.float32)
            encoded = value.copy()
            encoded[..., :3] = np.sqrt(encoded[..., :3])
            chain.append(_blocks(np.rint(encoded).astype(np.uint8)))
        return tuple(chain)


@dataclass(frozen=True, slots=True, eq=False)
class TextureAtlas:
    """All textures with their mip levels in one array as the kernels want them.

    texels (n,) uint64 hold blue, green, red and the fourth channel in 16-bit lanes, blue lowest; levels
    (textures, levels) say where each mip level starts.
    """

    names: tuple[str, ...]
    texels: NDArray[np.uint64]
    levels: NDArray[np.int64]
    log_sizes: NDArray[np.int64]


def pack(textures: Mapping[str, Texture]) -> TextureAtlas:
    """Lay out the mip levels of all textures."""
    chains = [texture.levels for texture in textures.values()]
    levels = np.zeros((len(chains), max(len(chain) for chain in chains)), np.int64)
    start = 0
    for i, chain in enumerate(chains):
        for k, level in enumerate(chain):
            levels[i, k] = start
            start += level.size
    flat = np.concatenate([level for chain in chains for level in chain])
    log_sizes = np.array([t.texels.shape[0].bit_length() - 1 for t in textures.values()], np.int64)
    return TextureAtlas(tuple(textures), flat, levels, log_sizes)


def _blocks(level: Texels) -> NDArray[np.uint64]:
    """Return texels as numbers, block by block, so that neighbours in both directions are near in memory.

    The four bytes of a texel are spread into 16-bit lanes, so that one multiplication weighs all channels.
    """
    n = level.shape[0] // BLOCK
    packed = level.astype("<u2").view("<u8").reshape(n, BLOCK, n, BLOCK)
    return packed.transpose(0, 2, 1, 3).reshape(-1).astype(np.uint64)


def noise(rng: np.random.Generator, size: int, stretch: tuple[float, float] = (1.0, 1.0), slope: float = 1.0) -> Field:
    """Return a periodic (size, size) field with mean 0, sigma 1 and amplitude 1/f**slope.

    `stretch` (u, v) lengthens its features along an axis, as bark does.
    """
    fu = np.fft.rfftfreq(size)[None, :] * stretch[0] * size
    fv = np.fft.fftfreq(size)[:, None] * stretch[1] * size
    f = np.hypot(fu, fv)
    f[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / f**slope
    field = np.fft.irfft2(spectrum, s=(size, size))
    return np.asarray((field - field.mean()) / field.std())


def coloured(value: Field, stops: list[tuple[float, tuple[int, int, int]]]) -> Field:
    """Map a field to BGR 0..255 through colour stops (value, (r, g, b))."""
    at = [stop for stop, _ in stops]
    return np.stack([np.interp(value, at, [rgb[k] for _, rgb in stops]) for k in (2, 1, 0)], axis=-1)


def finished(bgr: Field, alpha: Field | float = 255.0) -> Texture:
    """Round to a texture."""
    size = bgr.shape[0]
    texels = np.empty((size, size, 4), np.uint8)
    texels[..., :3] = np.clip(np.rint(bgr), 0, 255)
    texels[..., 3] = np.clip(np.rint(alpha), 0, 255)
    return Texture(texels)


@cache
def bark(seed: int, size: int = 1024) -> Texture:
    """Furrowed bark, one metre square, v along the trunk."""
    rng = np.random.default_rng([seed, 1])
    warp = noise(rng, size, slope=1.6)
    ridges = 1.0 - np.abs(noise(rng, size, (1.0, 5.0), 1.1) + 0.25 * warp)
    fine = noise(rng, size, (1.0, 1.7), 0.8)
    value = 0.75 * ridges + 0.42 * fine
    palette = [
        [(-1.6, (22, 17, 13)), (-0.3, (66, 51, 40)), (0.6, (124, 104, 86)), (1.6, (186, 168, 146))],
        [(-1.6, (28, 24, 21)), (-0.3, (74, 66, 58)), (0.6, (128, 119, 107)), (1.6, (196, 187, 172))],
        [(-1.6, (34, 20, 12)), (-0.3, (96, 62, 42)), (0.6, (148, 104, 74)), (1.6, (206, 164, 126))],
    ][seed % 3]
    bgr = coloured(value, palette)
    moss = np.clip(0.8 * noise(rng, size, slope=1.4) - 0.9, 0, 1)[..., None]
    bgr = bgr * (1 - moss) + moss * np.array([52, 118, 92]) * (0.8 + 0.25 * fine[..., None])
    return finished(bgr)


@cache
def leaves(seed: int, size: int = 512) -> Texture:
    """Foliage, one metre square: leaves of many greens over dark gaps."""
    rng = np.random.default_rng([seed, 2])
    canvas = coloured(noise(rng, size), [(-2.0, (14, 26, 10)), (2.0, (40, 62, 24))]).astype(np.uint8)
    for layer in range(3):
        for _ in range(900):
            shade = rng.normal(0.62 + 0.19 * layer, 0.16)
            colour = np.clip(shade * np.array([52, 150, 106]) + rng.normal(0, 9, 3), 0, 255)
            axes = (int(rng.integers(7, 17)), int(rng.integers(3, 7)))
            centre = rng.integers(0, size, 2)
            _wrapped_ellipse(canvas, centre, axes, float(rng.uniform(0, 180)), colour)
    light = 1.0 + 0.16 * noise(rng, size, slope=1.2)
    return finished(canvas * light[..., None])


def _wrapped_ellipse(canvas: Texels, centre: NDArray[np.int64], axes: tuple[int, int], angle: float, bgr: Field) -> None:
    size = canvas.shape[0]
    reach = max(axes)
    for dx in (-size, 0, size):
        for dy in (-size, 0, size):
            x, y = int(centre[0] + dx), int(centre[1] + dy)
            if -reach <= x < size + reach and -reach <= y < size + reach:
                cv2.ellipse(canvas, (x, y), axes, angle, 0, 360, bgr.tolist(), -1, cv2.LINE_AA)


@cache
def grass(seed: int, size: int = 1024) -> Texture:
    """Forest floor, three metres square: blades, dry leaves and bare earth."""
    rng = np.random.default_rng([seed, 3])
    earth = noise(rng, size, slope=0.9)
    canvas = coloured(earth, [(-2.0, (34, 30, 16)), (0.0, (74, 82, 36)), (2.0, (128, 120, 70))]).astype(np.uint8)
    density = noise(rng, size, slope=1.3)
    for layer in range(4):
        count = 4200
        xy = rng.uniform(0, size, (count, 2))
        angle, length = rng.normal(-np.pi / 2, 1.0, count), rng.uniform(9, 26, count)
        shade = rng.normal(0.55 + 0.16 * layer, 0.17, count)
        dry = rng.random(count) < 0.14
        keep = density[xy[:, 1].astype(int), xy[:, 0].astype(int)] + rng.normal(0, 0.7, count) > -0.6
        for k in np.flatnonzero(keep):
            base = np.array([62, 150, 178]) if dry[k] else np.array([46, 152, 104])
            tip = xy[k] + length[k] * np.array([np.cos(angle[k]), np.sin(angle[k])])
            _wrapped_line(canvas, xy[k], tip, np.clip(shade[k] * base + rng.normal(0, 8, 3), 0, 255))
    light = 1.0 + 0.2 * noise(rng, size, slope=1.1)
    return finished(canvas * light[..., None])


def _wrapped_line(canvas: Texels, start: Field, end: Field, bgr: Field) -> None:
    size = canvas.shape[0]
    for dx in (-size, 0, size):
        for dy in (-size, 0, size):
            a, b = start + np.array([dx, dy]), end + np.array([dx, dy])
            if min(a[0], b[0]) < size and max(a[0], b[0]) >= 0 and min(a[1], b[1]) < size and max(a[1], b[1]) >= 0:
                ends = [tuple(int(c) for c in np.rint(16 * p)) for p in (a, b)]
                cv2.line(canvas, ends[0], ends[1], bgr.tolist(), 1, cv2.LINE_AA, 4)


@cache
def dapple(seed: int, size: int = 256) -> Texture:
    """Blotches of colour and of sun through leaves, for modulation; eight metres square."""
    rng = np.random.default_rng([seed, 4])
    tone = 128.0 + 13.0 * np.stack([noise(rng, size, slope=1.3) for _ in range(3)], axis=-1)
    sun = np.clip(150 + 170 * noise(rng, size, (1.0, 0.6), 1.3), 25, 255)
    return finished(tone, sun)


SKY_LOWEST_DEG = -10.0
"""Elevation at the lower edge of the sky's texture."""

SKY_STOPS = [
    (-10.0, (150, 160, 140)), (2.0, (196, 208, 210)), (12.0, (172, 202, 230)),
    (40.0, (112, 165, 216)), (90.0, (74, 128, 196)),
]  # fmt: skip
"""Colour of the clear sky over elevation in degrees."""


@cache
def stains(seed: int, size: int = 256) -> Texture:
    """Blotches of colour, for modulation: no two tiles of a repeated texture look the same to a matcher."""
    rng = np.random.default_rng([seed, 11])
    return finished(128.0 + 15.0 * np.stack([noise(rng, size, slope=0.9) for _ in range(3)], axis=-1))


@cache
def sky(seed: int, size: int = 1024) -> Texture:
    """Half a panorama (u: 180 degrees of azimuth), v from the zenith (0) to below the horizon: clouds, far woods."""
    rng = np.random.default_rng([seed, 5])
    elevation = (90.0 - (np.arange(size) + 0.5) / size * (90.0 - SKY_LOWEST_DEG))[:, None]
    blue = coloured(np.broadcast_to(elevation, (size, size)), SKY_STOPS)
    cloud = np.clip(0.55 * noise(rng, size, (0.6, 2.2), 1.5) + 0.05, 0, 1)[..., None]
    bgr = blue * (1 - 0.8 * cloud) + 0.8 * cloud * np.array([248, 244, 240])
    for distance, height in ((0.9, 8.5), (0.55, 7.0), (0.25, 5.2)):
        bgr = _wood(rng, bgr, elevation, height, distance)
    return finished(bgr)


def _wood(rng: np.random.Generator, bgr: Field, elevation: Field, height_deg: float, distance: float) -> Field:
    """Put a row of trees before a panorama; `distance` 0..1 turns them to haze."""
    size = bgr.shape[0]
    crowns = height_deg + 1.1 * noise(rng, size, slope=0.8)[:1]
    grain = noise(rng, size, (1.0, 2.5), 0.8)
    trees = coloured(grain, [(-2, (58, 84, 50)), (0, (92, 122, 76)), (2, (138, 160, 108))])
    trees = trees * (1 - distance) + distance * np.array([168, 182, 172])
    edge = np.clip((crowns - elevation) / 0.15, 0, 1)[..., None]
    return np.asarray(bgr * (1 - edge) + trees * edge)


MURAL_BGR = np.array(
    [(84, 64, 38), (150, 142, 42), (106, 157, 42), (105, 196, 233), (97, 162, 244), (81, 111, 231), (184, 206, 222),
     (138, 96, 74)], dtype=np.float64,
)  # fmt: skip
"""Night blue, teal, green, sand, orange, coral, cream, slate."""


@cache
def mural(seed: int, size: int = 1024) -> Texture:
    """A painted wall, four metres square: patches of all sizes and colours under grain."""
    rng = np.random.default_rng([seed, 6])
    canvas = np.full((size, size, 3), MURAL_BGR[0]).astype(np.uint8)
    for k in range(1100):
        reach = 420.0 * (k + 4) ** -0.6
        axes = (int(rng.uniform(0.5, 1.6) * reach) + 2, int(rng.uniform(0.3, 1.0) * reach) + 2)
        colour = np.clip(MURAL_BGR[rng.integers(0, len(MURAL_BGR))] + rng.normal(0, 14, 3), 0, 255)
        _wrapped_ellipse(canvas, rng.integers(0, size, 2), axes, float(rng.uniform(0, 180)), colour)
    return finished(canvas * (1.0 + 0.13 * noise(rng, size, slope=0.9))[..., None])


@cache
def newsprint(seed: int, size: int = 1024) -> Texture:
    """A wall pasted with sheets of print, four metres square: strong contrast down to small letters."""
    rng = np.random.default_rng([seed, 7])
    canvas = np.full((size, size, 3), (128, 140, 148), np.uint8)
    for _ in range(260):
        _sheet(rng, canvas, rng.integers(0, size, 2), rng.integers(120, 260, 2))
    return finished(canvas * (1.0 + 0.08 * noise(rng, size, slope=1.0))[..., None])


def _sheet(rng: np.random.Generator, canvas: Texels, corner: NDArray[np.int64], edges: NDArray[np.int64]) -> None:
    """Paste one sheet of lines of words, wrapping around the canvas."""
    h, w = int(edges[0]), int(edges[1])
    paper = np.full((h, w, 3), rng.uniform(110, 215) * np.array([0.88, 0.96, 1.0]), np.uint8)
    y, ink = 8, rng.uniform(25, 80) + rng.normal(0, 8, 3)
    while y < h - 12:
        letter = int(rng.choice([4, 5, 7, 16], p=[0.4, 0.3, 0.2, 0.1]))
        x = 6
        while x < w - 10:
            length = int(rng.integers(2, 8)) * letter // 2
            paper[y : y + letter, x : min(x + length, w - 6)] = np.clip(ink + rng.normal(0, 22), 0, 255)
            x += length + letter // 2 + 1
        y += letter + 3
    rows, columns = (corner[0] + np.arange(h)) % canvas.shape[0], (corner[1] + np.arange(w)) % canvas.shape[1]
    canvas[np.ix_(rows, columns)] = paper


@cache
def planks(seed: int, size: int = 1024) -> Texture:
    """Floor boards, two metres square, grain along u."""
    rng = np.random.default_rng([seed, 8])
    grain = 0.8 * noise(rng, size, (5.0, 1.0), 1.0) + 0.5 * noise(rng, size, slope=0.8)
    boards = 12
    row = np.arange(size) * boards // size
    tone = rng.normal(0, 0.5, boards)[row][:, None]
    bgr = coloured(grain + tone, [(-2.5, (62, 40, 24)), (0.0, (140, 98, 62)), (2.5, (206, 164, 116))])
    joint = (np.arange(size) % (size / boards) < 5)[:, None, None]
    return finished(np.where(joint, 0.4 * bgr, bgr))


@cache
def wallpaper(seed: int, size: int = 1024) -> Texture:
    """Rough plaster with stains, three metres square."""
    rng = np.random.default_rng([seed, 9])
    value = noise(rng, size, slope=0.8) + 0.6 * noise(rng, size, slope=1.5)
    stops = [
        [(-2.5, (92, 104, 112)), (0.0, (172, 178, 176)), (2.5, (228, 226, 214))],
        [(-2.5, (120, 84, 58)), (0.0, (196, 162, 124)), (2.5, (238, 216, 184))],
    ][seed % 2]
    bgr = coloured(value, stops).astype(np.uint8)
    for _ in range(160):
        colour = rng.uniform(50, 200, 3)
        axes = (int(rng.integers(3, 22)), int(rng.integers(3, 22)))
        _wrapped_ellipse(bgr, rng.integers(0, size, 2), axes, float(rng.uniform(0, 180)), colour)
    return finished(bgr.astype(np.float64))


@cache
def patchwork(seed: int, size: int = 256) -> Texture:
    """Small bright squares, for a cube; one tile covers 0.3 m."""
    rng = np.random.default_rng([seed, 10])
    coarse = rng.uniform(25, 245, (8, 8, 3))
    fine = rng.uniform(-60, 60, (32, 32, 3))
    bgr = np.kron(coarse, np.ones((size // 8, size // 8, 1))) + np.kron(fine, np.ones((size // 32, size // 32, 1)))
    return finished(bgr)
