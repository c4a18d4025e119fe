"""Parts that drawn things are made of: boxes, frustums and quads with texture coordinates.

Lengths are metres, z is up. Faces wind counter-clockwise seen from outside. Texture coordinates
(u, v) grow to the right and down as one looks at a face from outside, as in glTF.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph_lab.worlds.flat.textures import WHOLE, Look

Floats = NDArray[np.float64]
Size = tuple[float, float]

SQUARE: Size = (1.0, 1.0)
"""Extent of a texture that repeats [m]."""


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one look.

    `vertices`: (V, 3) [m]; `triangles`: (T, 3) rows of vertices; `uv`: (V, 2), one unit is the
    texture's extent `size` [m].
    """

    vertices: Floats
    triangles: NDArray[np.int32]
    uv: Floats
    look: Look
    size: Size

    def transformed(self, rotation: ArrayLike, translation: ArrayLike) -> Part:
        """Part turned by a rotation (3, 3), then moved by a translation (3,) [m]."""
        turned = self.vertices @ np.asarray(rotation, np.float64).T + np.asarray(translation)
        return replace(self, vertices=turned)


def quad(corner: ArrayLike, right: ArrayLike, up: ArrayLike, look: Look, size: Size | None) -> Part:
    """Rectangle seen from the front: its lower left corner and its edges to the right and up.

    `size`: extent of the texture [m]; None: the whole face where the look asks for it, else a
    metre square. The texture's upper left corner is the face's.
    """
    c, r, u = (np.asarray(vector, np.float64) for vector in (corner, right, up))
    wide, high = float(np.linalg.norm(r)), float(np.linalg.norm(u))
    if size is None:
        size = (wide, high) if look.kind in WHOLE else SQUARE
    across, down = wide / size[0], high / size[1]
    return Part(
        np.array([c, c + r, c + r + u, c + u]),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.array([[0, down], [across, down], [across, 0], [0, 0]]),
        look,
        size,
    )


FACES = {
    "front": ((1, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "back": ((0, 0, 0), (1, 0, 0), (0, 0, 1)),
    "right": ((0, 1, 0), (0, -1, 0), (0, 0, 1)),
    "left": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "top": ((1, 1, 1), (-1, 0, 0), (0, -1, 0)),
    "bottom": ((1, 0, 0), (-1, 0, 0), (0, 1, 0)),
}
"""Faces of a unit box: corner, right, up. The front looks along +y, right is the viewer's."""


def box(
    low: ArrayLike,
    high: ArrayLike,
    look: Look,
    *,
    front: Look | None = None,
    top: Look | None = None,
    without: Iterable[str] = (),
) -> list[Part]:
    """Box between two corners [m], with another look at its front or top, or without some faces."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    looks = {"front": front or look, "top": top or look}
    missing = set(without)
    return [
        quad(
            low + np.array(corner) * (high - low),
            np.array(right) * (high - low),
            np.array(up) * (high - low),
            looks.get(face, look),
            None,
        )
        for face, (corner, right, up) in FACES.items()
        if face not in missing
    ]


def frustum(
    middle: ArrayLike, radii: Size, heights: Size, look: Look, *, sides: int = 12, turn: float = 0.0
) -> Part:
    """Closed cone stump about a vertical axis: radii and heights [m] of its lower and upper end."""
    x, y = np.asarray(middle, np.float64)
    angle = 2 * np.pi * np.arange(sides + 1) / sides + turn
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = [
        np.column_stack([circle * r + (x, y), np.full(sides + 1, z)])
        for r, z in zip(radii, heights, strict=True)
    ]
    around = angle * max(radii)
    walls_uv = [np.column_stack([around, np.full(sides + 1, -z)]) for z in heights]
    caps_uv = [circle * r for r in radii]
    centres = np.array([[x, y, heights[0]], [x, y, heights[1]]])
    k = np.arange(sides, dtype=np.int32)
    n = sides + 1
    triangles = [
        np.column_stack([k, k + 1, k + n + 1]),
        np.column_stack([k, k + n + 1, k + n]),
        np.column_stack([np.full(sides, 4 * n), k + 2 * n + 1, k + 2 * n]),
        np.column_stack([np.full(sides, 4 * n + 1), k + 3 * n, k + 3 * n + 1]),
    ]
    return Part(
        np.concatenate([*rings, *rings, centres]),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate([*walls_uv, *caps_uv, np.zeros((2, 2))]),
        look,
        SQUARE,
    )


def joined(parts: Iterable[Part]) -> list[Part]:
    """Parts of the same look and texture size, joined to one each, in order of appearance."""
    groups: dict[tuple[Look, Size], list[Part]] = {}
    for part in parts:
        groups.setdefault((part.look, part.size), []).append(part)
    found = []
    for (look, size), members in groups.items():
        starts = np.cumsum([0, *(len(m.vertices) for m in members[:-1])])
        found.append(
            Part(
                np.concatenate([m.vertices for m in members]),
                np.concatenate([m.triangles + s for m, s in zip(members, starts, strict=True)]),
                np.concatenate([m.uv for m in members]),
                look,
                size,
            )
        )
    return found
