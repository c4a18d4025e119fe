"""Parts that drawn things are made of: boxes, frustums and quads with texture coordinates.

Lengths are metres, z is up. Faces wind counter-clockwise seen from outside. Texture coordinates
(u, v) grow to the right and down as one looks at a face from outside, as in glTF.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph_lab.worlds.flat.textures import WHOLE, Material

Floats = NDArray[np.float64]
Size = tuple[float, float]

SQUARE: Size = (1.0, 1.0)  # extent of a texture that repeats [m]


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material.

    `vertices`: (V, 3) [m]; `triangles`: (T, 3) rows of vertices; `uv`: (V, 2), one unit is the
    texture's extent `size` [m].
    """

    vertices: Floats
    triangles: NDArray[np.int32]
    uv: Floats
    material: Material
    size: Size

    def transform(self, rotation: ArrayLike, translation: ArrayLike) -> Part:
        """Part turned by a rotation (3, 3), then moved by a translation (3,) [m]."""
        turned = self.vertices @ np.asarray(rotation, np.float64).T + np.asarray(translation)
        return replace(self, vertices=turned)


def quad(
    corner: ArrayLike, right: ArrayLike, up: ArrayLike, material: Material, size: Size | None
) -> Part:
    """Rectangle seen from the front: its lower left corner and its edges to the right and up.

    `size`: extent of the texture [m]; None: the whole face where the material asks for it, else a
    metre square. The texture's upper left corner is the face's.
    """
    c, r, u = (np.asarray(vector, np.float64) for vector in (corner, right, up))
    wide, high = float(np.linalg.norm(r)), float(np.linalg.norm(u))
    if size is None:
        size = (wide, high) if material.kind in WHOLE else SQUARE
    across, down = wide / size[0], high / size[1]
    return Part(
        np.array([c, c + r, c + r + u, c + u]),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.array([[0, down], [across, down], [across, 0], [0, 0]]),
        material,
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
    material: Material,
    *,
    front: Material | None = None,
    top: Material | None = None,
    without: Iterable[str] = (),
) -> list[Part]:
    """Box between two corners [m], with another material at its front or top, or without some faces."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    materials = {"front": front or material, "top": top or material}
    missing = set(without)
    return [
        quad(
            low + np.array(corner) * (high - low),
            np.array(right) * (high - low),
            np.array(up) * (high - low),
            materials.get(face, material),
            None,
        )
        for face, (corner, right, up) in FACES.items()
        if face not in missing
    ]


def frustum(
    middle: ArrayLike,
    radii: Size,
    heights: Size,
    material: Material,
    *,
    sides: int = 12,
    turn: float = 0.0,
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
        material,
        SQUARE,
    )


def join_parts(parts: Iterable[Part]) -> list[Part]:
    """Parts of the same material and texture size, joined to one each, in order of appearance."""
    groups: dict[tuple[Material, Size], list[Part]] = {}
    for part in parts:
        groups.setdefault((part.material, part.size), []).append(part)
    found = []
    for (material, size), members in groups.items():
        starts = np.cumsum([0, *(len(m.vertices) for m in members[:-1])])
        found.append(
            Part(
                np.concatenate([m.vertices for m in members]),
                np.concatenate([m.triangles + s for m, s in zip(members, starts, strict=True)]),
                np.concatenate([m.uv for m in members]),
                material,
                size,
            )
        )
    return found


@dataclass(frozen=True, slots=True)
class Body:
    """Extents [m] and materials of a model."""

    width: float
    depth: float
    height: float
    material: Material
    trim: Material


def _block(b: Body) -> list[Part]:
    return box((0, 0, 0), (b.width, b.depth, b.height), b.material, front=b.trim)


def _cabinet(b: Body) -> list[Part]:
    """Corpus with panelled fronts, a handle each, and a plinth if it is taller than 0.5 m."""
    plinth = 0.08 if b.height > 0.5 else 0.0
    parts = box((0, 0, plinth), (b.width, b.depth - 0.02, b.height), b.material)
    if plinth:
        parts += box((0.03, 0.03, 0), (b.width - 0.03, b.depth - 0.06, plinth), b.trim)
    doors = max(1, round(b.width / 0.5))
    front = Material("panel", b.material.colour)
    for k in range(doors):
        x0, x1 = b.width * k / doors + 0.004, b.width * (k + 1) / doors - 0.004
        y = b.depth - 0.02
        parts += box((x0, y, plinth), (x1, b.depth, b.height - 0.01), b.material, front=front)
        x, z = (x1 - 0.05 if k % 2 == 0 else x0 + 0.04), plinth + 0.5 * (b.height - plinth)
        parts += box((x, b.depth, z - 0.06), (x + 0.012, b.depth + 0.02, z + 0.06), b.trim)
    return parts


def _table(b: Body) -> list[Part]:
    parts = box((0, 0, b.height - 0.04), (b.width, b.depth, b.height), b.material)
    parts += box(
        (0.08, 0.08, b.height - 0.12), (b.width - 0.08, b.depth - 0.08, b.height - 0.04), b.trim
    )
    return parts + _legs(b, b.height - 0.04, 0.06, 0.03)


def _legs(b: Body, height: float, thick: float, inset: float) -> list[Part]:
    return [
        part
        for x in (inset, b.width - inset - thick)
        for y in (inset, b.depth - inset - thick)
        for part in box((x, y, 0), (x + thick, y + thick, height), b.trim)
    ]


def _round_table(b: Body) -> list[Part]:
    middle, radius = (b.width / 2, b.depth / 2), min(b.width, b.depth) / 2
    return [
        frustum(middle, (radius, radius), (b.height - 0.04, b.height), b.material, sides=16),
        frustum(middle, (0.05, 0.05), (0.03, b.height - 0.04), b.trim, sides=8),
        frustum(middle, (radius * 0.6, 0.06), (0, 0.04), b.trim, sides=12),
    ]


def _chair(b: Body) -> list[Part]:
    """Legs, a seat at 45 cm, and a back of two rails between two posts."""
    seat = min(0.45, 0.55 * b.height)
    parts = _legs(b, seat - 0.04, 0.04, 0.0)
    parts += box((0, 0, seat - 0.04), (b.width, b.depth, seat), b.material)
    for x in (0.0, b.width - 0.04):
        parts += box((x, 0, seat), (x + 0.04, 0.04, b.height), b.trim)
    for low, high in ((0.35, 0.55), (0.7, 0.98)):
        z0, z1 = (seat + share * (b.height - seat) for share in (low, high))
        parts += box((0.04, 0.005, z0), (b.width - 0.04, 0.035, z1), b.material)
    return parts


def _sofa(b: Body) -> list[Part]:
    """Base, back, arms and a cushion for every 0.7 m."""
    seat, arm, back = 0.42, 0.16, 0.22
    parts = box((0, 0, 0.06), (b.width, b.depth, seat - 0.12), b.material)
    parts += box((0, 0, seat - 0.12), (b.width, back, b.height), b.material)
    for x in (0.0, b.width - arm):
        parts += box((x, back, seat - 0.12), (x + arm, b.depth, seat + 0.2), b.material)
    cushions = max(1, round((b.width - 2 * arm) / 0.7))
    step = (b.width - 2 * arm) / cushions
    for k in range(cushions):
        x0, x1 = arm + k * step + 0.01, arm + (k + 1) * step - 0.01
        parts += box((x0, back, seat - 0.12), (x1, b.depth - 0.01, seat), b.trim)
        parts += box((x0, back, seat), (x1, back + 0.14, b.height - 0.06), b.trim)
    return parts + _legs(b, 0.06, 0.05, 0.04)


def _bed(b: Body) -> list[Part]:
    """Frame, mattress with a cover, headboard at the back, a pillow for every 0.8 m."""
    white = Material("fabric", (236, 234, 228))
    parts = box((0, 0, 0.1), (b.width, b.depth, 0.3), b.trim)
    parts += box((0, 0, 0.3), (b.width, 0.05, max(b.height, 0.6)), b.trim)
    parts += box((0.03, 0.05, 0.3), (b.width - 0.03, b.depth - 0.03, 0.48), white)
    parts += box((0.0, 0.65, 0.46), (b.width, b.depth, 0.53), b.material)
    pillows = max(1, round(b.width / 0.8))
    step = b.width / pillows
    for k in range(pillows):
        x0, x1 = k * step + 0.08, (k + 1) * step - 0.08
        parts += box((x0, 0.1, 0.48), (x1, 0.55, 0.6), Material("stripes", b.material.colour))
    return parts + _legs(b, 0.1, 0.06, 0.02)


def _shelf(b: Body) -> list[Part]:
    """Back, sides and boards every 0.35 m with a row of books on each."""
    parts = box((0, 0, 0), (b.width, 0.015, b.height), b.material)
    for x in (0.0, b.width - 0.025):
        parts += box((x, 0.015, 0), (x + 0.025, b.depth, b.height), b.material)
    rows = max(1, round(b.height / 0.35))
    step = (b.height - 0.025) / rows
    for k in range(rows + 1):
        parts += box(
            (0.025, 0.015, k * step), (b.width - 0.025, b.depth, k * step + 0.025), b.material
        )
    for k in range(rows):
        low, high = k * step + 0.025, (k + 1) * step - 0.03
        spines = Material("books", b.trim.colour)
        parts += box(
            (0.03, 0.02, low),
            (b.width - 0.03, b.depth - 0.06, high),
            Material("plain", (214, 205, 186)),
            front=spines,
            without=("back", "bottom"),
        )
    return parts


def _counter(b: Body) -> list[Part]:
    """Kitchen cupboards under a worktop that stands out."""
    below = _cabinet(Body(b.width, b.depth - 0.02, b.height - 0.04, b.material, b.trim))
    top = box((0, 0, b.height - 0.04), (b.width, b.depth, b.height), b.trim)
    return below + top


def _stove(b: Body) -> list[Part]:
    """Cooker: a dark oven window, knobs, four plates."""
    dark = Material("plain", (24, 24, 28))
    parts = box((0, 0, 0), (b.width, b.depth - 0.02, b.height), b.material)
    y = b.depth - 0.02
    parts += box((0.06, y, 0.2), (b.width - 0.06, y + 0.015, b.height - 0.2), dark)
    parts += box((0.06, y, b.height - 0.16), (b.width - 0.06, b.depth, b.height - 0.14), b.trim)
    for k in range(4):
        x = b.width * (0.2 + 0.2 * k)
        parts += box((x - 0.02, y, b.height - 0.1), (x + 0.02, b.depth, b.height - 0.06), dark)
        middle = (b.width * (0.28, 0.72)[k % 2], b.depth * (0.28, 0.7)[k // 2])
        parts.append(frustum(middle, (0.09, 0.085), (b.height, b.height + 0.012), dark))
    return parts


def _basin(b: Body) -> list[Part]:
    """Open tub: four walls and a bottom; with a tap at its back."""
    rim, floor = 0.06, max(0.05, b.height - 0.4)
    parts = box((0, 0, 0), (b.width, b.depth, floor), b.material)
    for low, high in (
        ((0, 0), (b.width, rim)),
        ((0, b.depth - rim), (b.width, b.depth)),
        ((0, rim), (rim, b.depth - rim)),
        ((b.width - rim, rim), (b.width, b.depth - rim)),
    ):
        parts += box((*low, floor), (*high, b.height), b.material)
    x = b.width / 2
    parts += box((x - 0.02, 0.01, b.height), (x + 0.02, 0.04, b.height + 0.2), b.trim)
    return parts + box((x - 0.02, 0.04, b.height + 0.17), (x + 0.02, 0.16, b.height + 0.2), b.trim)


def _washstand(b: Body) -> list[Part]:
    """Basin on a column."""
    bowl = Body(b.width, b.depth, 0.18, b.material, b.trim)
    raised = [p.transform(np.eye(3), (0, 0, b.height - 0.18)) for p in _basin(bowl)]
    x, y = b.width / 2, b.depth / 2
    return [*raised, frustum((x, y), (0.11, 0.08), (0, b.height - 0.18), b.material)]


def _toilet(b: Body) -> list[Part]:
    """Bowl with a seat before a cistern."""
    x, radius = b.width / 2, min(b.width, b.depth) * 0.42
    y = b.depth - radius
    parts = box((0.02, 0, 0.42), (b.width - 0.02, 0.16, b.height), b.material)
    parts += box((x - 0.12, 0.02, 0), (x + 0.12, y, 0.4), b.material)
    parts.append(frustum((x, y), (radius * 0.6, radius), (0, 0.4), b.material))
    parts.append(frustum((x, y), (radius, radius), (0.4, 0.43), b.trim))
    return parts


def _drum(b: Body) -> list[Part]:
    """Round thing: bin, stool, pot, boiler; the top wears the trim."""
    middle, radius = (b.width / 2, b.depth / 2), min(b.width, b.depth) / 2
    return [
        frustum(middle, (radius * 0.85, radius), (0, b.height - 0.02), b.material),
        frustum(middle, (radius, radius * 0.97), (b.height - 0.02, b.height), b.trim),
    ]


def _lamp(b: Body) -> list[Part]:
    """Foot, pole and shade; small ones stand on tables."""
    middle, radius = (b.width / 2, b.depth / 2), min(b.width, b.depth) / 2
    shade = min(0.35, 0.45 * b.height)
    return [
        frustum(middle, (radius * 0.7, radius * 0.65), (0, 0.03), b.trim),
        frustum(middle, (0.015, 0.015), (0.03, b.height - shade), b.trim, sides=6),
        frustum(middle, (radius, radius * 0.7), (b.height - shade, b.height), b.material),
    ]


def _pendant(b: Body) -> list[Part]:
    """Shade on a cord; its upper end is at the ceiling."""
    middle, radius = (b.width / 2, b.depth / 2), min(b.width, b.depth) / 2
    shade = min(0.25, 0.5 * b.height)
    return [
        frustum(middle, (radius, radius * 0.5), (0, shade), b.material),
        frustum(middle, (0.012, 0.012), (shade, b.height), b.trim, sides=6),
    ]


def _picture(b: Body) -> list[Part]:
    """Frame on the wall; the material is its picture, the trim its edge."""
    return box((0, 0, 0), (b.width, b.depth, b.height), b.trim, front=b.material)


def _screen(b: Body) -> list[Part]:
    """Screen on a foot, in the middle of its footprint."""
    y, x = b.depth / 2, b.width / 2
    parts = box((0, y - 0.02, 0.08), (b.width, y + 0.02, b.height), b.trim, front=b.material)
    parts += box((x - 0.03, y - 0.03, 0.02), (x + 0.03, y - 0.02, 0.2), b.trim)
    return parts + box((x - 0.15, y - 0.1, 0), (x + 0.15, y + 0.1, 0.02), b.trim)


def _rug(b: Body) -> list[Part]:
    return box((0, 0, 0), (b.width, b.depth, b.height), b.trim, top=b.material)


def _plant(b: Body) -> list[Part]:
    """Pot, stem and three crowns of leaves."""
    x, y, r = b.width / 2, b.depth / 2, min(b.width, b.depth) / 2
    pot = min(0.35, 0.35 * b.height)
    parts = [frustum((x, y), (r * 0.5, r * 0.7), (0, pot), b.trim)]
    parts.append(
        frustum(
            (x, y), (0.02, 0.015), (pot, b.height * 0.8), Material("wood", (92, 70, 44)), sides=5
        )
    )
    for k, (dx, dy, low) in enumerate(((0.3, 0.1, 0.45), (-0.25, 0.25, 0.55), (0.0, -0.25, 0.68))):
        z0 = max(pot, low * b.height)
        z1 = min(b.height, z0 + 0.35 * b.height)
        centre, mid, wide = (x + dx * r, y + dy * r), (z0 + z1) / 2, r * 0.7
        turn = 0.7 * k
        parts.append(frustum(centre, (wide * 0.2, wide), (z0, mid), b.material, sides=6, turn=turn))
        parts.append(
            frustum(centre, (wide, wide * 0.15), (mid, z1), b.material, sides=6, turn=turn)
        )
    return parts


def _coats(b: Body) -> list[Part]:
    """Rail on the wall with a coat for every 0.3 m."""
    parts = box((0, 0, b.height - 0.1), (b.width, 0.03, b.height), b.trim)
    coats = max(1, round(b.width / 0.3))
    for k in range(coats):
        x = b.width * (k + 0.5) / coats
        colour = tuple(int(c * (0.5, 1.0, 0.75)[k % 3]) for c in b.material.colour)
        coat = Material("fabric", (colour[0], colour[1], colour[2]))
        long = (0.05, 0.2, 0.0)[k % 3] * b.height
        parts += box((x - 0.11, 0.03, long), (x + 0.11, max(0.1, b.depth), b.height - 0.12), coat)
    return parts


@dataclass(frozen=True, slots=True)
class Model:
    """A kind of furniture: how it is built, and what it is by default."""

    build: Callable[[Body], list[Part]]
    height: float  # own height [m]
    material: str
    trim: str
    base: float | None = None
    """Height of its lower edge above the floor [m]; None: it stands on what carries it."""
    depth: float | None = None  # depth from its back [m]; None: as drawn
    emission: float = 0.0  # how brightly it shines of itself; a white wall in good light has 1
    hung: bool = False  # whether it hangs on the wall behind it and needs one
    above: float = 0.02  # how far something of it, such as a tap, reaches above its height [m]

    def make_parts(self, body: Body) -> list[Part]:
        """Parts of a piece of furniture, none of which sticks out of its footprint.

        Handles may stand out of its front by 3 cm. Where a footprint is smaller than the model can
        be, what sticks out is flattened.
        """
        high = (body.width, body.depth + 0.03, body.height + self.above)
        return [
            replace(part, vertices=np.clip(part.vertices, 0.0, high)) for part in self.build(body)
        ]


MODELS: dict[str, Model] = {
    "block": Model(_block, 0.8, "wood tan", "wood tan"),
    "cabinet": Model(_cabinet, 0.9, "wood peru", "metal silver"),
    "table": Model(_table, 0.75, "wood burlywood", "wood peru"),
    "roundtable": Model(_round_table, 0.75, "wood burlywood", "metal dimgrey"),
    "chair": Model(_chair, 0.9, "wood peru", "wood saddlebrown"),
    "sofa": Model(_sofa, 0.85, "fabric slategrey", "fabric lightslategrey"),
    "bed": Model(_bed, 0.95, "fabric steelblue", "wood burlywood"),
    "shelf": Model(_shelf, 2.0, "wood sienna", "plain dimgrey", depth=0.3),
    "counter": Model(_counter, 0.9, "plain whitesmoke", "stone darkgrey"),
    "stove": Model(_stove, 0.9, "plain white", "metal silver"),
    "basin": Model(_basin, 0.55, "plain white", "metal silver", above=0.2),
    "washstand": Model(_washstand, 0.85, "plain white", "metal silver", above=0.2),
    "toilet": Model(_toilet, 0.8, "plain white", "plain ivory"),
    "drum": Model(_drum, 0.4, "metal grey", "metal silver"),
    "lamp": Model(_lamp, 1.6, "fabric wheat", "metal dimgrey", emission=1.6),
    "pendant": Model(_pendant, 0.7, "fabric cornsilk", "metal dimgrey", emission=1.8),
    "picture": Model(
        _picture, 0.6, "picture saddlebrown", "wood saddlebrown", base=1.3, depth=0.03, hung=True
    ),
    "screen": Model(_screen, 0.65, "plain #14161a", "metal dimgrey"),
    "rug": Model(_rug, 0.012, "rug firebrick", "carpet firebrick"),
    "plant": Model(_plant, 1.3, "leaves seagreen", "stone chocolate"),
    "coats": Model(_coats, 1.2, "fabric indianred", "wood sienna", base=0.6, depth=0.15, hung=True),
}
"""Kinds of furniture that a legend may name."""
