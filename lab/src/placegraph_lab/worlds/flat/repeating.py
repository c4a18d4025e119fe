"""Flats that repeat themselves: a corridor of equal doors, two halls of equal carrels.

Few details tell one bay from the next: a picture here, a plant there, a chair that is missing. A
narrow camera, as of a telephone, walks through once, so that much remains unseen.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll, write_walk

CAMERA = Camera(320, 240, 265.0, 265.0, 160.0, 120.0)
"""Field of view of a telephone's camera: 62 x 49 degrees."""
FRAMES = 64
HEIGHT = 1.4  # of the camera above the floor [m]
BAYS = 9  # of the corridor
CARRELS = 5  # on each side of a hall
_SPEED = 100.0  # more than is needed from end to end [m/s]
_ACROSS = 8  # cells across the corridor
_BAY = 12  # cells from a door to the next
_CARREL = 7  # cells from a partition to the next
_DEEP = 6  # cells of a carrel from the wall to the aisle
_AISLE = 7  # cells of the aisle
_LEGEND = """
a spot:
b spot:
+ door: height=2.1 look=panel #8a6a4a trim=plain #d9d4c8
: doorway: height=2.2 trim=plain #d9d4c8
p picture:
* plant:
j pendant: label=ceiling lamp height=0.3 look=plain #f4f1e8
"""


def draw_corridor(rng: np.random.Generator) -> Flat:
    """Draw a corridor 2 m wide with two doors every 3 m, and little else."""
    page = np.full((_ACROSS + 2, BAYS * _BAY + 2), "#")
    page[1:-1, 1:-1] = " "
    for bay in range(BAYS):
        left = 1 + bay * _BAY
        page[[0, -1], left + 2 : left + 6] = "+"
        page[3:5, left + 8 : left + 10] = "j"
    for bay in rng.permutation(BAYS)[: BAYS // 2]:
        row = int(rng.choice([1, _ACROSS]))
        page[row, 9 + bay * _BAY : 12 + bay * _BAY] = "p"
    page[1:3, 1 + _BAY * int(rng.integers(2, BAYS - 2))] = "*"
    page[5, 2], page[5, -3], page[6, 3] = "a", "b", "1"
    return _parse(
        page, "corridor", "1 room: label=corridor walls=plaster #e2ddcf floor=carpet #7d8590"
    )


def draw_halls(rng: np.random.Generator) -> Flat:
    """Draw two halls in a row, each with an aisle between equal carrels: desk, chair, partitions."""
    wide = CARRELS * _CARREL + 1
    page = np.full((2 * _DEEP + _AISLE + 2, 2 * wide + 3), "#")
    aisle = slice(1 + _DEEP, 1 + _DEEP + _AISLE)
    for hall in range(2):
        left = 1 + hall * (wide + 1)
        page[1:-1, left : left + wide] = " "
        for carrel in range(CARRELS + 1):
            column = left + carrel * _CARREL
            page[1 : 1 + _DEEP, column] = page[-1 - _DEEP : -1, column] = "B"
        for carrel in range(CARRELS):
            columns = slice(left + 2 + carrel * _CARREL, left + 6 + carrel * _CARREL)
            page[1:3, columns] = page[-3:-1, columns] = "T"
            for row in (4, -6):
                if rng.random() < 0.7:
                    page[row : row + 2, columns.start + 1 : columns.stop - 1] = "c"
        for column in (left + wide // 4, left + 3 * wide // 4):
            page[aisle.start + 3, column] = "j"
        page[aisle.start, left + _CARREL * int(rng.integers(1, CARRELS))] = "*"
        page[aisle.stop - 1, left + 1] = str(hall + 1)
    page[aisle.start + 2 : aisle.stop - 2, 1 + wide] = ":"
    page[aisle.start + 4, 3], page[aisle.start + 4, -4] = "a", "b"
    legend = [
        "1 room: label=hall walls=plaster #dcd8cc floor=carpet #6d7a70",
        "2 room: label=hall walls=plaster #dcd8cc floor=carpet #6d7a70",
        "B block: label=partition height=1.5 look=fabric #5f6f86 trim=fabric #5f6f86",
        "T table: label=desk look=wood #c79a63 trim=metal dimgrey",
        "c chair: label=chair faces=T look=fabric #2b2d33 trim=metal grey",
    ]
    return _parse(page, "halls", "\n".join(legend))


def _parse(page: NDArray[np.str_], name: str, legend: str) -> Flat:
    rows = "\n".join("".join(row) for row in page)
    return Flat.parse(
        f"[flat]\nname = {name}\nheight = 2.6\n[drawing]\n{rows}\n[legend]{_LEGEND}{legend}\n",
        source=name,
    )


WORLDS: dict[str, Callable[[np.random.Generator], Flat]] = {
    "doors": draw_corridor,
    "carrels": draw_halls,
}
"""Drawn worlds that repeat themselves, by name."""


def record_world(name: str, folder: Path, *, frames: int = FRAMES, seed: int = 0) -> Path:
    """Write the capture folder of a walk through one of `WORLDS`, from end to end.

    Images and depth are noisy, odometry drifts, and there are no labels.
    """
    draw, walk, render = np.random.default_rng([seed, len(name)]).spawn(3)
    flat = WORLDS[name](draw)
    way = stroll(flat, walk, frames=frames, through="ab", height=HEIGHT, speed=_SPEED)
    interior = flat.furnish(draw)
    return write_walk(interior, way, folder, render, camera=CAMERA, daylight=0.2, labels=None)
