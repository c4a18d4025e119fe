"""Procedural textures of drawn flats: wood, plaster, tiles, cloth, book spines, pictures.

A material is a kind and a colour, written ``wood saddlebrown`` or ``plaster #e8e0d0``. `paint` makes
its image for a surface of a given size; the same generator gives the same image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Shades = NDArray[np.float64]  # images (h, w, 3) sRGB from 0 to 1

PIXELS_PER_METRE = 96.0
LARGEST = 320  # most pixels along an edge of a texture


@dataclass(frozen=True, slots=True)
class Material:
    """Material and sRGB colour of a surface."""

    kind: str
    colour: tuple[int, int, int]


def paint(material: Material, size: tuple[float, float], rng: np.random.Generator) -> Image:
    """Image (h, w, 3) uint8 sRGB of a surface `size` = width, height [m]."""
    width, height = (int(np.clip(round(s * PIXELS_PER_METRE), 2, LARGEST)) for s in size)
    canvas = np.empty((height, width, 3))
    canvas[:] = np.array(material.colour) / 255.0
    PAINTERS[material.kind](canvas, size, rng)
    return np.round(np.clip(canvas, 0.0, 1.0) * 255.0).astype(np.uint8)


# ------------------------------------------------------------------------------------- noise


def cloud(shape: tuple[int, int], grain: tuple[float, float], rng: np.random.Generator) -> Shades:
    """Smooth noise (h, w) of mean 0 and about unit deviation that repeats at its edges.

    `grain`: pixels from one knot to the next, down and across.
    """
    h, w = shape
    knots = rng.standard_normal(
        tuple(max(1, round(n / g)) for n, g in zip(shape, grain, strict=True))
    )
    for axis, n in ((0, h), (1, w)):
        at = (np.arange(n) + 0.5) * knots.shape[axis] / n
        low = np.floor(at).astype(int)
        part = at - low
        part = part * part * (3.0 - 2.0 * part)
        part = part[:, None] if axis == 0 else part[None]
        left = np.take(knots, low % knots.shape[axis], axis)
        right = np.take(knots, (low + 1) % knots.shape[axis], axis)
        knots = left * (1.0 - part) + right * part
    return knots * 1.4  # blending knots shrinks the deviation


def _shade(canvas: Shades, factor: NDArray[np.float64]) -> None:
    canvas *= np.expand_dims(1.0 + factor, -1)


def _speckle(canvas: Shades, strength: float, rng: np.random.Generator) -> None:
    _shade(canvas, strength * rng.standard_normal(canvas.shape[:2]))


def _pixels(canvas: Shades, size: tuple[float, float], metres: float) -> tuple[float, float]:
    """Pixels down and across that `metres` cover."""
    return metres * canvas.shape[0] / size[1], metres * canvas.shape[1] / size[0]


def _cells(size: tuple[float, float], across: float, down: float) -> tuple[int, int]:
    """Whole number of rows and columns of cells of a given size [m]."""
    return max(1, round(size[1] / down)), max(1, round(size[0] / across))


def _grid(n: int, cells: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Cell of each of n pixels, and its place in the cell from 0 to 1."""
    at = (np.arange(n) + 0.5) * cells / n
    return np.floor(at).astype(np.int64), at % 1.0


# ----------------------------------------------------------------------------------- painters


def _plain(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    _shade(canvas, 0.02 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.2), rng))
    _speckle(canvas, 0.01, rng)


def _plaster(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    for metres, strength in ((1.2, 0.035), (0.35, 0.025), (0.06, 0.015)):
        grain = _pixels(canvas, size, metres)
        _shade(canvas, strength * cloud(canvas.shape[:2], grain, rng))
    canvas[-max(1, round(_pixels(canvas, size, 0.02)[0])) :] *= 0.93  # dust above the floor
    _speckle(canvas, 0.01, rng)


def _wallpaper(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    _, stripe = _grid(canvas.shape[1], max(1, round(size[0] / 0.4)))
    rows, dots = _grid(canvas.shape[0], max(1, round(size[1] / 0.3)))
    _shade(canvas, np.broadcast_to(np.where(stripe < 0.5, -0.09, 0.03), canvas.shape[:2]))
    row = np.abs(dots[:, None] - 0.5) * 0.3
    column = np.abs((stripe[None] + 0.5 * (rows[:, None] % 2)) % 1.0 - 0.5) * 0.4
    canvas[np.hypot(row, column) < 0.05] *= 0.86
    _shade(canvas, 0.03 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.9), rng))


def _wood(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    down, across = _pixels(canvas, size, 0.012)
    grain = cloud(canvas.shape[:2], (max(1.0, down), across * 40.0), rng)
    broad = cloud(canvas.shape[:2], (down * 8.0, across * 60.0), rng)
    _shade(canvas, 0.07 * grain + 0.06 * broad)


def _parquet(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    rows, columns = _cells(size, 0.9, 0.14)
    row, down = _grid(canvas.shape[0], rows)
    across = (np.arange(canvas.shape[1]) + 0.5) * columns / canvas.shape[1]
    offset = rng.random(rows)
    at = (across[None] + offset[row][:, None]) % columns
    tone = 0.14 * rng.standard_normal((rows, columns))
    _wood(canvas, size, rng)
    _shade(canvas, tone[row[:, None], at.astype(int)])
    canvas[(down[:, None] < 0.07) | (at % 1.0 < 0.012)] *= 0.6


def _tiles(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    rows, columns = _cells(size, 0.2, 0.2)
    (row, down), (column, across) = _grid(canvas.shape[0], rows), _grid(canvas.shape[1], columns)
    _shade(canvas, (0.05 * rng.standard_normal((rows, columns)))[row[:, None], column[None]])
    _shade(canvas, 0.02 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.1), rng))
    canvas[(down[:, None] < 0.06) | (across[None] < 0.06)] *= 0.72


def _checker(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    rows, columns = (2 * max(1, n // 2) for n in _cells(size, 0.25, 0.25))
    (row, _), (column, _) = _grid(canvas.shape[0], rows), _grid(canvas.shape[1], columns)
    canvas[(row[:, None] + column[None]) % 2 == 1] *= 0.45
    _tiles(canvas, size, rng)


def _carpet(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    _shade(canvas, 0.05 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.25), rng))
    _speckle(canvas, 0.08, rng)


def _rug(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    """Border, diamonds and a medallion, by distances from the middle."""
    h, w = canvas.shape[:2]
    x = (np.arange(w)[None] + 0.5) / w * size[0]
    y = (np.arange(h)[:, None] + 0.5) / h * size[1]
    edge = np.minimum(np.minimum(x, size[0] - x), np.minimum(y, size[1] - y))
    diamonds = (np.abs(x % 0.3 - 0.15) + np.abs(y % 0.3 - 0.15)) < 0.07
    second = canvas[0, 0][[1, 2, 0]] * 0.5 + 0.35
    middle = np.abs(x - size[0] / 2) / size[0] + np.abs(y - size[1] / 2) / size[1]
    canvas[diamonds & (edge > 0.15)] = second
    canvas[middle < 0.22] = second * 0.7
    canvas[middle < 0.12] = canvas[0, 0] * 1.2
    canvas[(edge > 0.05) & (edge < 0.13)] = second
    _carpet(canvas, size, rng)


def _fabric(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    _shade(canvas, 0.05 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.3), rng))
    h, w = canvas.shape[:2]
    _shade(canvas, 0.04 * np.where((np.arange(h)[:, None] + np.arange(w)[None]) % 4 < 2, 1, -1))
    _speckle(canvas, 0.04, rng)


def _stripes(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    _, across = _grid(canvas.shape[1], max(1, round(size[0] / 0.18)))
    canvas[:, across < 0.35] = canvas[:, across < 0.35] * 0.35 + 0.6
    _fabric(canvas, size, rng)


def _metal(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    down, across = _pixels(canvas, size, 0.01)
    _shade(canvas, 0.03 * cloud(canvas.shape[:2], (down, across * 50.0), rng))
    _shade(canvas, np.linspace(0.08, -0.08, canvas.shape[0])[:, None])


def _stone(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    veins = np.abs(cloud(canvas.shape[:2], _pixels(canvas, size, 0.25), rng))
    _shade(canvas, -0.25 * np.exp(-((veins / 0.12) ** 2)))
    _speckle(canvas, 0.05, rng)


def _leaves(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    _shade(canvas, 0.25 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.06), rng))
    _shade(canvas, 0.15 * cloud(canvas.shape[:2], _pixels(canvas, size, 0.02), rng))


def _books(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    """Spines side by side before a dark back, one row."""
    h, w = canvas.shape[:2]
    down, across = _pixels(canvas, size, 0.01)
    canvas *= 0.25
    x = 0.0
    while x < w:
        thick, tall = across * rng.uniform(2.0, 6.0), rng.uniform(0.62, 0.95)
        left = min(round(x), w - 1)
        spine = slice(left, max(left + 1, round(x + thick)))
        x += thick
        if rng.random() < 0.06:  # a gap
            continue
        top = round(h * (1.0 - tall))
        canvas[top:, spine] = _ink(rng)
        for band in rng.uniform(0.1, 0.9, 2):  # title and publisher
            y = round(top + band * (h - top))
            canvas[y : y + max(1, round(2 * down)), spine] = _ink(rng)
        canvas[top:, left] *= 0.5


def _ink(rng: np.random.Generator) -> Shades:
    """Some colour: any hue, not too grey, light or dark."""
    wheel = np.cos(2 * np.pi * (rng.random() + np.array([0, 1, 2]) / 3)) * 0.5 + 0.5
    mixed: Shades = (0.3 + rng.uniform(0.15, 0.5) * (wheel - 0.3)) * rng.uniform(0.6, 1.5)
    return mixed


def _picture(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    """A landscape or a composition of blocks in a frame of the material's colour."""
    h, w = canvas.shape[:2]
    border = max(1, round(_pixels(canvas, size, 0.04)[0]))
    inner = canvas[border : h - border, border : w - border]
    if inner.size == 0:
        return
    rows, columns = inner.shape[:2]
    inner[:] = np.linspace(0, 1, rows)[:, None, None] * (_ink(rng) - (sky := _ink(rng) + 0.3)) + sky
    if rng.random() < 0.5:
        for horizon in np.sort(rng.uniform(0.3, 0.9, 3)):
            hills = horizon + 0.08 * cloud((1, columns), (1, columns / 3), rng)[0]
            inner[np.arange(rows)[:, None] / rows > hills[None]] = _ink(rng)
    else:
        for _ in range(7):
            y, x = rng.integers(rows), rng.integers(columns)
            inner[y : y + rows // 3 + 1, x : x + columns // 3 + 1] = _ink(rng)


def _panel(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    """A door's leaf or a cupboard's front: wood with sunk panels."""
    _wood(canvas, size, rng)
    rows = max(1, round(size[1] / 0.8))
    columns = max(1, round(size[0] / 0.5))
    (_, down), (_, across) = _grid(canvas.shape[0], rows), _grid(canvas.shape[1], columns)
    edge = np.minimum(
        np.minimum(down, 1 - down)[:, None] * size[1] / rows,
        np.minimum(across, 1 - across)[None] * size[0] / columns,
    )
    canvas[(edge > 0.07) & (edge < 0.09)] *= 0.6
    canvas[edge > 0.09] *= 0.93
    canvas[edge < 0.008] *= 0.5


def _window(canvas: Shades, size: tuple[float, float], rng: np.random.Generator) -> None:
    """Sky over roofs or trees behind two wings in a frame of the material's colour."""
    h, w = canvas.shape[:2]
    frame = canvas.copy()
    canvas[:] = np.linspace(0, 1, h)[:, None, None] * np.array([0.15, 0.1, 0.03])
    canvas += (0.72, 0.82, 0.93)
    clouds = np.maximum(0.0, cloud((h, w), (h / 5, w / 2.5), rng))[..., None]
    canvas += 0.12 * clouds
    for horizon, ink in ((0.62, (0.45, 0.5, 0.56)), (0.74, (0.25, 0.38, 0.22))):
        line = horizon + 0.06 * cloud((1, w), (1, w / 7), rng)[0]
        canvas[np.arange(h)[:, None] / h > line[None]] = np.array(ink) * rng.uniform(0.8, 1.2)
    (down, across), mid = _pixels(canvas, size, 0.06), _grid(w, max(1, round(size[0] / 0.7)))[1]
    y = np.minimum(np.arange(h) + 0.5, h - np.arange(h) - 0.5)[:, None] < down
    x = np.minimum(mid, 1 - mid)[None] * w / max(1, round(size[0] / 0.7)) < across * 0.8
    bars = y | x | (np.abs(np.arange(h)[:, None] / h - 0.3) * h < down * 0.4)
    canvas[bars] = frame[bars]


PAINTERS: dict[str, Callable[[Shades, tuple[float, float], np.random.Generator], None]] = {
    "plain": _plain,
    "plaster": _plaster,
    "wallpaper": _wallpaper,
    "wood": _wood,
    "parquet": _parquet,
    "tiles": _tiles,
    "checker": _checker,
    "carpet": _carpet,
    "rug": _rug,
    "fabric": _fabric,
    "stripes": _stripes,
    "metal": _metal,
    "stone": _stone,
    "leaves": _leaves,
    "books": _books,
    "picture": _picture,
    "panel": _panel,
    "window": _window,
}
"""Kinds of materials: each paints on a canvas that already has the material's colour."""

WHOLE = frozenset({"rug", "books", "picture", "panel", "window", "wallpaper", "plaster"})
"""Kinds painted for the whole surface; the others are a metre square that repeats."""
