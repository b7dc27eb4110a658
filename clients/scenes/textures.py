"""Textures drawn with NumPy and Pillow, as linear images (h, w, 3) from 0 to 1."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from clients.scenes.geometry import (
    Array,
    linear_from_hex,
    linear_from_srgb,
    srgb_from_linear,
)


def noise(height: int, width: int, *, cells: int, seed: int, octaves: int = 4) -> Array:
    """Return smooth noise (h, w) that tiles, with mean 0 and a range of about -1..1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for octave in range(octaves):
        n = cells * 2**octave
        grid = np.pad(rng.uniform(-1, 1, (n, n)), 2, mode="wrap")
        image = Image.fromarray(grid.astype(np.float32))
        # The padding makes the cubic filter wrap around, and is cropped afterward.
        step_x, step_y = width / n, height / n
        size = (round(width + 4 * step_x), round(height + 4 * step_y))
        big = np.asarray(image.resize(size, Image.Resampling.BICUBIC))
        top, left = round(2 * step_y), round(2 * step_x)
        total += big[top : top + height, left : left + width] / 1.8**octave
    return total / 1.6


def tinted(value: Array, dark: str, light: str) -> Array:
    """Blend two colors by value (h, w), from -1 (dark) to 1 (light)."""
    t = np.clip(value / 2 + 0.5, 0, 1)[..., None]
    return (1 - t) * linear_from_hex(dark) + t * linear_from_hex(light)


def plaster(dark: str, light: str, *, size: int = 512, seed: int = 1) -> Array:
    """Return weathered plaster (size, size, 3)."""
    value = noise(size, size, cells=4, seed=seed)
    fine = noise(size, size, cells=64, seed=seed + 1, octaves=2)
    return tinted(0.8 * value + 0.25 * fine, dark, light)


def wood(dark: str, light: str, *, size: int = 512, planks: int = 5) -> Array:
    """Return planks (size, size, 3) whose grain runs along u."""
    grain = noise(size, size, cells=4, seed=7)
    fine = noise(size, size, cells=8, seed=8, octaves=6)
    v = np.arange(size)[:, None] / size * planks
    rings = np.sin(26 * v + 3.0 * noise(size, size, cells=2, seed=3, octaves=2))
    tone = np.random.default_rng(5).uniform(-0.35, 0.35, planks)
    board = tone[np.minimum(v.astype(int), planks - 1)]
    image = tinted(0.35 * rings + 0.3 * grain + 0.3 * fine + board, dark, light)
    edge = np.minimum(v % 1, 1 - v % 1) * size / planks
    return image * np.clip(0.25 + edge / 4, 0.25, 1)[..., None]


def stone_tiles(*, size: int = 1024, tiles: int = 8) -> Array:
    """Return a floor of squares in two colors with small dark corner stones."""
    y, x = np.mgrid[0:size, 0:size] / size * tiles
    column, row = x.astype(int), y.astype(int)
    tone = np.random.default_rng(2).uniform(-0.35, 0.35, (tiles, tiles))[row, column]
    marble = noise(size, size, cells=6, seed=4, octaves=5)
    cream = tinted(0.7 * marble + tone, "#b9a283", "#e6d5b8")
    terracotta = tinted(0.7 * marble + tone, "#8c4f38", "#c07a58")
    image = np.where(((column + row) % 2 == 0)[..., None], cream, terracotta)
    fx, fy = np.abs(x - np.round(x)), np.abs(y - np.round(y))
    image = np.where((fx + fy < 0.17)[..., None], linear_from_hex("#3d4a52"), image)
    joint = np.minimum(np.minimum(fx, fy), np.abs(fx + fy - 0.17))
    return image * np.clip(0.45 + joint / 0.025, 0.45, 1)[..., None]


def stripes(first: str, second: str, *, count: int, size: int = 256) -> Array:
    """Return vertical stripes in two colors (size, size, 3)."""
    x = np.arange(size) / size * 2 * count
    edge = np.clip((np.abs((x + 0.5) % 2 - 1) - 0.5) * size / count, -1, 1)
    cloth = noise(size, size, cells=32, seed=9, octaves=2)
    return (
        tinted(edge[None, :] + 0 * cloth, first, second)
        * (0.94 + 0.06 * cloth)[..., None]
    )


def board(
    size_px: tuple[int, int],
    lines: Iterable[tuple[str, float, float, str]],
    *,
    paper: str,
    ink: str,
    grain: float = 0.1,
) -> Array:
    """Draw centered lines of text on a board.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of the image.
    lines : iterable of (text, center, font size, color)
        Lines, with the center as a fraction of the height from the top and the font
        size in px.  An empty color selects `ink`.
    paper, ink : str
        Colors as "#rrggbb".
    grain : float
        Strength of the paper's texture.
    """
    width, height = size_px
    image = Image.new("RGB", size_px, paper)
    draw = ImageDraw.Draw(image)
    for text, center, font_px, color in lines:
        draw.text(
            (width / 2, center * height),
            text,
            fill=color or ink,
            font=ImageFont.load_default(size=font_px),
            anchor="mm",
        )
    linear = linear_from_srgb(np.asarray(image) / 255.0)
    value = noise(height, width, cells=8, seed=11)
    return np.clip(linear * (1 + grain * value[..., None]), 0, 1)


def framed(image: Array, *, color: str, border_px: int, inset_px: int = 0) -> Array:
    """Draw a frame of `color` around an image, inset from its edge."""
    result = image.copy()
    h, w = image.shape[:2]
    a, b = inset_px, inset_px + border_px
    mask = np.zeros((h, w), bool)
    mask[a : h - a, a : w - a] = True
    mask[b : h - b, b : w - b] = False
    result[mask] = linear_from_hex(color)
    return result


def optotype_e(*, size: int = 640) -> Array:
    """Return a black E on white, five units high, with bars of one unit."""
    unit = size // 8
    image = np.full((size, size, 3), 0.9)
    low, high = round(1.5 * unit), round(6.5 * unit)
    image[low:high, low : low + unit] = 0.008
    for bar in range(3):
        top = low + 2 * bar * unit
        image[top : top + unit, low:high] = 0.008
    return image


def squares(*, size: int = 256) -> Array:
    """Return a gray frame and a gray square on white, to be tinted by vertex colors."""
    y, x = np.abs(np.mgrid[0:size, 0:size] / (size - 1) * 2 - 1)
    ring = np.maximum(x, y)
    value = np.where((ring > 0.9) | (ring < 0.4), 0.35, 1.0)
    return np.repeat(value[..., None], 3, axis=-1)


def checks(
    first: str, second: str, *, columns: int, rows: int, size: int = 512
) -> Array:
    """Return a checkerboard of two colors (size, size, 3)."""
    y, x = np.mgrid[0:size, 0:size] / size
    odd = ((x * columns).astype(int) + (y * rows).astype(int)) % 2 == 0
    return np.where(odd[..., None], linear_from_hex(first), linear_from_hex(second))


def evening_sky(sine: Array) -> Array:
    """Return the sky's linear color (..., 3) at the sine of an elevation (...)."""
    t = np.clip(sine / 0.5, 0, 1)[..., None] ** 0.75
    return (1 - t) * linear_from_hex("#fbe3bf") + t * linear_from_hex("#74aee6")


def hills(
    bottom_m: float,
    height_m: float,
    distance_m: float,
    *,
    width: int = 1024,
    height: int = 512,
) -> Array:
    """Return an evening view: sky, ridges of hills and fields.

    The sky blends into `evening_sky` behind the image.

    Parameters
    ----------
    bottom_m, height_m, distance_m : float
        Lower edge above the eye, height, and distance of the image in the scene.
    width, height : int
        Size of the texture, px.
    """
    x = np.linspace(0, 1, width)
    y = np.linspace(1, 0, height)[:, None]
    above_m = bottom_m + y * height_m
    sky = evening_sky(above_m / np.hypot(above_m, distance_m))
    image = np.broadcast_to(sky, (height, width, 3)).copy()
    ridges = (
        (0.44, 0.05, 2.3, 0.4, "#8fa3b5", "#a9b4bd"),
        (0.36, 0.06, 3.1, 1.9, "#6c8a77", "#8aa184"),
        (0.24, 0.04, 4.7, 3.0, "#5d7d45", "#9aa35a"),
        (0.14, 0.02, 2.9, 5.0, "#8a8a45", "#c7b266"),
    )
    field = noise(height, width, cells=12, seed=21)
    for base, swing, frequency, phase, dark, light in ridges:
        line = base + swing * np.sin(2 * np.pi * frequency * x + phase)
        line = line + 0.4 * swing * np.sin(2 * np.pi * 2.7 * frequency * x + 2 * phase)
        image = np.where((y < line)[..., None], tinted(field, dark, light), image)
    return image


def uint8_srgb(linear: Array) -> NDArray[np.uint8]:
    """Encode linear light as sRGB bytes."""
    return np.round(255 * srgb_from_linear(linear)).astype(np.uint8)
