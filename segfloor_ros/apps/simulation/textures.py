"""Procedural grey textures, each from a seed. All repeat without a seam."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter1d

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.settings import suggestion

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Texture:
    """A square grey picture (S, S) uint8 that covers `side_m` metres, row 0 on top."""

    pixels: NDArray[np.uint8]
    side_m: float


def fractal_noise(size: int, roughness: float, rng: np.random.Generator, cells: int = 1) -> Image:
    """Return periodic noise (size, size) of mean 0 and deviation 1 with spectrum 1/f^roughness.

    cells: the coarsest structure repeats this often along a side.
    """
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * size
    amplitude = np.where(frequency >= cells, np.maximum(frequency, 1.0) ** -roughness, 0.0)
    white = np.fft.rfft2(rng.standard_normal((size, size)))
    noise = np.fft.irfft2(white * amplitude, s=(size, size))
    return (noise / noise.std()).astype(np.float32)


def plain(grey: int, size: int, rng: np.random.Generator) -> Image:
    """Paint without any structure."""
    return np.full((size, size), grey, np.float32)


def plaster(size: int, rng: np.random.Generator) -> Image:
    """Painted wall: hardly any texture."""
    return 178 + 2.2 * fractal_noise(size, 0.6, rng) + 4 * fractal_noise(size, 1.6, rng)


def rough_plaster(size: int, rng: np.random.Generator) -> Image:
    """Render or wallpaper: weak texture that a good camera still sees."""
    return 165 + 8 * fractal_noise(size, 0.5, rng, 40) + 6 * fractal_noise(size, 1.5, rng)


def concrete(size: int, rng: np.random.Generator) -> Image:
    """Stained grey concrete with pores."""
    pores = np.minimum(fractal_noise(size, 0.3, rng, 60) + 2.0, 0.0)
    return 128 + 16 * fractal_noise(size, 1.25, rng) + 30 * pores


def carpet(size: int, rng: np.random.Generator) -> Image:
    """Short pile: fine noise on a weak pattern."""
    return 96 + 16 * fractal_noise(size, 0.25, rng, 64) + 9 * fractal_noise(size, 1.3, rng, 3)


def marble(size: int, rng: np.random.Generator) -> Image:
    """Polished stone: clouds crossed by dark veins."""
    veins = np.exp(-np.abs(fractal_noise(size, 1.5, rng, 3)) * 14)
    veins += 0.6 * np.exp(-np.abs(fractal_noise(size, 1.4, rng, 6)) * 18)
    clouds = 14 * fractal_noise(size, 1.15, rng, 2) + 7 * fractal_noise(size, 0.5, rng, 80)
    return 150 + clouds - 62 * np.minimum(veins, 1.0)


def granite(size: int, rng: np.random.Generator) -> Image:
    """Speckled stone."""
    clouds, specks = fractal_noise(size, 1.1, rng, 4), fractal_noise(size, 1.0, rng, 50)
    return 122 + 10 * clouds + 26 * np.tanh(1.6 * specks) + 10 * fractal_noise(size, 0.2, rng, 200)


def wood(size: int, rng: np.random.Generator) -> Image:
    """Planks along the picture's width, with grain and knots."""
    planks = 8
    grain = uniform_filter1d(fractal_noise(size, 0.4, rng, 20), size // 12, axis=1, mode='wrap')
    shade = _per_cell(rng.normal(0, 14, (planks, 1)), size)
    seams = _grid_lines(size, planks, 1, size // 340 + 1)
    return 122 + shade + 17 * grain / grain.std() + 5 * fractal_noise(size, 1.2, rng) - 60 * seams


def parquet(size: int, rng: np.random.Generator) -> Image:
    """Sealed blocks, laid crosswise: faint grain, each block of its own shade, fine joints."""
    blocks = 8
    shade = _per_cell(rng.normal(0, 9, (blocks, blocks)), size)
    grain = fractal_noise(size, 0.4, rng, 20)
    along = uniform_filter1d(grain, size // 24, axis=1, mode='wrap')
    across = uniform_filter1d(grain, size // 24, axis=0, mode='wrap')
    turned = _per_cell(np.indices((blocks, blocks)).sum(axis=0) % 2 * 1.0, size)
    grain = np.where(turned > 0, along / along.std(), across / across.std())
    return 128 + shade + 9 * grain - 34 * _grid_lines(size, blocks, blocks, size // 500 + 1)


def asphalt(size: int, rng: np.random.Generator) -> Image:
    """A road: dark, with grit of all sizes, stains and a few cracks."""
    cracks = np.exp(-np.abs(fractal_noise(size, 1.5, rng, 2)) * 60)
    grit = 11 * fractal_noise(size, 0.2, rng, 60) + 5 * fractal_noise(size, 1.3, rng, 2)
    return 88 + grit - 34 * cracks


def grass(size: int, rng: np.random.Generator) -> Image:
    """A mown lawn: blades in all directions, lighter and darker patches."""
    first, second = (
        uniform_filter1d(fractal_noise(size, 0.1, rng, 80), 7, axis=axis, mode='wrap')
        for axis in (0, 1)
    )
    blades = first + second
    return 92 + 24 * blades / blades.std() + 10 * fractal_noise(size, 1.2, rng, 3)


def tiles(size: int, rng: np.random.Generator) -> Image:
    """Floor tiles of a quarter of the picture's side: stone with dark joints."""
    shade = _per_cell(rng.normal(0, 11, (4, 4)), size)
    stone = 13 * fractal_noise(size, 1.0, rng, 3) + 9 * fractal_noise(size, 0.4, rng, 60)
    return 132 + shade + stone - 66 * _grid_lines(size, 4, 4, size // 200 + 1)


def dark_tiles(size: int, rng: np.random.Generator) -> Image:
    """Dark polished tiles: little contrast, for glossy floors."""
    shade = _per_cell(rng.normal(0, 3, (4, 4)), size)
    return 46 + shade + 5 * fractal_noise(size, 0.8, rng, 10) - 18 * _grid_lines(size, 4, 4, 4)


def bricks(size: int, rng: np.random.Generator) -> Image:
    """A running bond of bricks with light mortar."""
    rows, columns = 16, 8
    picture = np.empty((size, size), np.float32)
    height = size // rows
    shades = rng.normal(0, 17, (rows, columns))
    for row in range(rows):
        line = np.repeat(shades[row], size // columns)
        picture[row * height : (row + 1) * height] = np.roll(line, (row % 2) * size // columns // 2)
    mortar = _grid_lines(size, rows, columns, size // 170 + 1)
    for row in range(1, rows, 2):
        part = slice(row * height, (row + 1) * height)
        mortar[part] = np.roll(mortar[part], size // columns // 2, axis=1)
    noise = 12 * fractal_noise(size, 0.7, rng, 8)
    return 105 + (picture + noise) * (1 - mortar) + 58 * mortar


def books(size: int, rng: np.random.Generator) -> Image:
    """Shelves full of book spines with titles."""
    return _shelves(size, rng, shelves=5, narrow=0.012, wide=0.035, gap=0.12)


def goods(size: int, rng: np.random.Generator) -> Image:
    """Market shelves with boxes and their labels."""
    return _shelves(size, rng, shelves=4, narrow=0.03, wide=0.09, gap=0.06)


def poster(size: int, rng: np.random.Generator) -> Image:
    """A printed sheet: pictures, headlines and lines of text on white."""
    picture = np.full((size, size), 225, np.float32)
    for _ in range(int(rng.integers(4, 8))):
        x, y = rng.integers(0, int(size * 0.75), 2)
        w, h = rng.integers(size // 8, size // 2, 2)
        patch = picture[y : y + h, x : x + w]
        noise = fractal_noise(size, 1.1, rng, 2)[: patch.shape[0], : patch.shape[1]]
        patch[:] = rng.uniform(50, 200) + rng.uniform(5, 35) * noise
    _print_lines(picture, rng, int(rng.integers(10, 22)))
    edge = size // 40
    picture[:edge] = picture[-edge:] = picture[:, :edge] = picture[:, -edge:] = 40
    return picture


def panels(size: int, rng: np.random.Generator) -> Image:
    """A suspended ceiling of four by four panels, one of them a lamp."""
    shade = rng.normal(0, 4, (4, 4))
    shade[1, 2] = 70
    noise = 5 * fractal_noise(size, 0.3, rng, 90)
    return 165 + _per_cell(shade, size) + noise - 45 * _grid_lines(size, 4, 4, size // 200 + 1)


def cloth(size: int, rng: np.random.Generator) -> Image:
    """Clothes: a woven pattern with folds."""
    checks = _per_cell(rng.normal(0, 18, (12, 12)), size)
    return 90 + checks + 16 * fractal_noise(size, 1.2, rng) + 8 * fractal_noise(size, 0.3, rng, 60)


def metal(size: int, rng: np.random.Generator) -> Image:
    """Brushed or scratched sheet metal with stains."""
    scratches = uniform_filter1d(fractal_noise(size, 0.1, rng, 50), size // 9, axis=0, mode='wrap')
    return 140 + 12 * scratches / scratches.std() + 12 * fractal_noise(size, 1.3, rng)


GENERATORS: dict[str, tuple[Callable[[int, np.random.Generator], Image], int, float]] = {
    'plain': (partial(plain, 175), 64, 1.0),
    'plain_dark': (partial(plain, 85), 64, 1.0),
    'plain_light': (partial(plain, 235), 64, 1.0),
    'plaster': (plaster, 1024, 3.0),
    'rough_plaster': (rough_plaster, 1024, 2.5),
    'concrete': (concrete, 1024, 3.0),
    'carpet': (carpet, 2048, 3.0),
    'marble': (marble, 2048, 4.0),
    'granite': (granite, 2048, 3.0),
    'wood': (wood, 1024, 1.2),
    'parquet': (parquet, 2048, 2.4),
    'asphalt': (asphalt, 2048, 3.0),
    'grass': (grass, 2048, 2.0),
    'tiles': (tiles, 2048, 3.2),
    'dark_tiles': (dark_tiles, 1024, 2.4),
    'bricks': (bricks, 1024, 1.6),
    'books': (books, 1024, 1.8),
    'goods': (goods, 1024, 2.0),
    'poster': (poster, 256, 1.0),
    'panels': (panels, 1024, 2.4),
    'cloth': (cloth, 512, 0.9),
    'metal': (metal, 512, 1.0),
    'glass': (partial(plain, 235), 64, 1.0),
}
"""Generator, size in pixels and side in metres of each texture."""


@lru_cache(maxsize=32)
def make_texture(name: str, seed: int) -> Texture:
    """Return a texture by name; the same seed gives the same pixels.

    Raises InputError for an unknown name.
    """
    if name not in GENERATORS:
        raise InputError(f'unknown texture {name}{suggestion(name, list(GENERATORS))}')
    generator, size, side_m = GENERATORS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    pixels = np.clip(np.round(generator(size, rng)), 0, 255).astype(np.uint8)
    return Texture(pixels, side_m)


def _per_cell(values: NDArray[np.float64], size: int) -> Image:
    """Return values (rows, columns) spread over a square picture."""
    rows = np.arange(size) * values.shape[0] // size
    columns = np.arange(size) * values.shape[1] // size
    return values[rows[:, None], columns[None]].astype(np.float32)


def _grid_lines(size: int, rows: int, columns: int, width: int) -> Image:
    """Return a picture that is 1 on the lines between cells, 0 elsewhere, softened a little."""
    position = np.arange(size)
    lines = np.zeros((size, size), np.float32)
    lines[position % (size // rows) < width] = 1
    if columns > 1:
        lines[:, position % (size // columns) < width] = 1
    return gaussian_filter(lines, 0.7, mode='wrap')


def _shelves(
    size: int, rng: np.random.Generator, shelves: int, narrow: float, wide: float, gap: float
) -> Image:
    """Return boards with upright things of random width, height and shade between them."""
    picture = np.full((size, size), 22, np.float32)
    pitch, board = size // shelves, size // 45
    for shelf in range(shelves):
        bottom, x = (shelf + 1) * pitch - board, 0
        while x < size - narrow * size:
            width = min(int(rng.uniform(narrow, wide) * size), size - x)
            top = bottom - int((pitch - board) * rng.uniform(0.62, 0.95))
            if rng.uniform() > gap:
                _item(picture[top:bottom, x : x + width - 1], rng)
            x += width
        picture[bottom : bottom + board] = 150
    return np.clip(picture, 8, 240) + 4 * fractal_noise(size, 0.5, rng, 30)


def _item(patch: Image, rng: np.random.Generator) -> None:
    """Paint one spine or box: a shade, rounded edges, one or two labels with print."""
    height, width = patch.shape
    across = np.linspace(-1, 1, width, dtype=np.float32)
    patch[:] = rng.uniform(40, 200) - 22 * across[None] ** 4
    for _ in range(int(rng.integers(1, 3))):
        top, tall = int(rng.uniform(0.05, 0.7) * height), int(rng.uniform(0.1, 0.28) * height)
        label = patch[top : top + tall, width // 6 : width - width // 6]
        if label.size:
            label[:] = rng.uniform(30, 230)
            marks = rng.uniform(size=label.shape) < 0.35
            label[cv2.erode(marks.astype(np.uint8), np.ones((2, 2), np.uint8)) > 0] = rng.uniform(
                10, 240
            )


def _print_lines(picture: Image, rng: np.random.Generator, lines: int) -> None:
    """Print lines of words as dashes of random length."""
    size = len(picture)
    thickness = max(2, size // 90)
    for y in np.linspace(size * 0.08, size * 0.9, lines).astype(int):
        words = rng.uniform(0.02, 0.1, 14) * size
        ends = np.cumsum(words + size * 0.02) + size * 0.06
        for end, length in zip(ends, words, strict=True):
            if end < size * 0.92:
                picture[y : y + thickness, int(end - length) : int(end)] = 45
