"""A furnished flat: named things with painted surfaces, in map coordinates, and its lamps.

`furnish` makes it from a drawing. It can be changed (a thing moved or taken away), written as a
binary glTF file, or turned into one mesh to render from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_z
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph_lab.worlds.drawing import Cell
from placegraph_lab.worlds.flat.flat import COMPASS, SOLID, Blot, Flat
from placegraph_lab.worlds.flat.furniture import MODELS, Body, Floats, Part, join_parts
from placegraph_lab.worlds.flat.textures import paint
from placegraph_lab.worlds.flat.walls import Piece, rectangles, shell

Rectangle = tuple[float, float, float, float]

GAP = 0.01  # distance of furniture from the edges of its cells, and so from walls [m]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one texture.

    `vertices`: (V, 3) float64 [m, map]; `triangles`: (T, 3) int32; `uv`: (V, 2) float64, v down,
    repeating; `texture`: (h, w, 3) uint8 sRGB.
    """

    vertices: Floats
    triangles: NDArray[np.int32]
    uv: Floats
    texture: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class FlatObject:
    """One object of the flat."""

    id: int
    name: str  # label, and a number where several have it: ``chair 2``
    label: str
    room: str
    surfaces: tuple[Surface, ...]
    emission: float = 0.0  # how brightly it shines of itself
    is_window: bool = False

    @property
    def bounds(self) -> Floats:
        """Lowest and highest corner (2, 3) [m]."""
        points = np.concatenate([surface.vertices for surface in self.surfaces])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def move(self, shift: tuple[float, float], yaw: float = 0.0) -> FlatObject:
        """Return the object turned by `yaw` [rad] about its middle and moved by `shift` x, y [m]."""
        rotation = rotation_z(yaw)
        middle = self.bounds.mean(axis=0)
        offset = middle - rotation @ middle + (*shift, 0.0)
        return replace(
            self,
            surfaces=tuple(
                replace(s, vertices=s.vertices @ rotation.T + offset) for s in self.surfaces
            ),
        )


@dataclass(frozen=True, slots=True)
class Lamp:
    """Source of light: a lamp in the evening, a window by day."""

    position: tuple[float, float, float]  # x, y, z [m]
    is_window: bool = False


@dataclass(frozen=True, eq=False)
class Interior:
    """Objects and lamps of a flat, in map coordinates: x right, y up the page, z up, floor z = 0."""

    objects: tuple[FlatObject, ...]
    lamps: tuple[Lamp, ...]  # every room has one or more

    def find_object(self, name: str) -> FlatObject:
        """Return the object of this name.

        Raises `OptionError`: there is none.
        """
        found = next((item for item in self.objects if item.name == name), None)
        if found is None:
            names = ", ".join(item.name for item in self.objects)
            raise OptionError(f"There is no {name!r} in the flat; there are {names}.")
        return found

    def without(self, name: str) -> Interior:
        """Return the flat without an object; the others keep their ids.

        Raises `OptionError`: there is no such object.
        """
        gone = self.find_object(name)
        return replace(self, objects=tuple(item for item in self.objects if item is not gone))

    def move_object(self, name: str, shift: tuple[float, float], yaw: float = 0.0) -> Interior:
        """Return the flat with an object moved by `shift` x, y [m] and turned by `yaw` [rad].

        What stands on it stays where it was.

        Raises `OptionError`: there is no such object.
        """
        old = self.find_object(name)
        new = old.move(shift, yaw)
        return replace(self, objects=tuple(new if t is old else t for t in self.objects))

    def write_glb(self, path: str | Path) -> Path:
        """Write a binary glTF 2.0 file; the same flat gives the same bytes."""
        from placegraph_lab.worlds.flat.glb_flat import write_glb

        return write_glb(self, path)

    def mesh(self) -> Mesh:
        """One mesh of all things; `object_of` are ids, not rows, so that changes keep them."""
        from placegraph_lab.worlds.flat.render import mesh_of

        return mesh_of(self)


def furnish(flat: Flat, rng: np.random.Generator) -> Interior:
    """Build, number and paint all things of a flat.

    Raises `InputError`: an opening leads through no wall, or what hangs has no wall behind it.
    """
    pieces = shell(flat) + [_furniture(flat, blot) for blot in flat.objects]
    labels = [piece.label for piece in pieces]
    counts: dict[str, int] = {}
    things = []
    for index, (piece, source) in enumerate(zip(pieces, rng.spawn(len(pieces)), strict=True)):
        counts[piece.label] = counts.get(piece.label, 0) + 1
        several = labels.count(piece.label) > 1
        name = f"{piece.label} {counts[piece.label]}" if several else piece.label
        surfaces = tuple(
            Surface(p.vertices, p.triangles, p.uv, paint(p.material, p.size, source))
            for p in join_parts(piece.parts)
        )
        things.append(
            FlatObject(
                index, name, piece.label, piece.room, surfaces, piece.emission, piece.is_window
            )
        )
    return Interior(tuple(things), _lamps(flat, pieces))


def _furniture(flat: Flat, blot: Blot) -> Piece:
    """Build a thing from every rectangle of its blot."""
    symbol, model, base = blot.symbol, MODELS[blot.symbol.kind], flat.base(blot)
    if base + symbol.height > flat.height + 1e-9:
        raise InputError(
            f"{flat.where(blot.own)}: this {symbol.label} ends {base + symbol.height:g} m above "
            f"the floor of a room {flat.height:g} m high; make its height or base less."
        )
    parts: list[Part] = []
    lamp = None
    for rectangle in rectangles(flat, blot.cells):
        facing = _facing(flat, blot, rectangle)
        width, depth = _extent(rectangle, facing)
        depth = min(depth, symbol.depth or depth)
        body = Body(
            width - 2 * GAP,
            depth - GAP,
            symbol.height,
            symbol.materials["look"],
            symbol.materials["trim"],
        )
        parts += _stand(model.make_parts(body), rectangle, facing, base)
        if model.emission > 0.0:  # what hangs shines from under its shade, others from over it
            x, y = (rectangle[0] + rectangle[2]) / 2, (rectangle[1] + rectangle[3]) / 2
            hangs = symbol.kind == "pendant"
            lamp = np.array([x, y, base - 0.05 if hangs else base + symbol.height + 0.05])
    return Piece(symbol.label, flat.rooms[flat.room_of[blot.own]].name, parts, model.emission, lamp)


def _extent(rectangle: Rectangle, facing: tuple[int, int]) -> tuple[float, float]:
    """Width along the back and depth [m] of a footprint."""
    x, y = rectangle[2] - rectangle[0], rectangle[3] - rectangle[1]
    return (x, y) if facing[0] == 0 else (y, x)


def _stand(
    parts: list[Part], rectangle: Rectangle, facing: tuple[int, int], base: float
) -> list[Part]:
    """From a model's frame (back at y = 0) to the page, its back at the footprint's back."""
    x0, y0, x1, y1 = rectangle
    fx, fy = facing
    rotation = np.array([[fy, fx, 0], [-fx, fy, 0], [0, 0, 1]])  # y of the frame faces the front
    origin = {(0, 1): (x0, y0), (0, -1): (x1, y1), (1, 0): (x0, y1), (-1, 0): (x1, y0)}[facing]
    shift = rotation @ (GAP, GAP / 2, 0) + np.array([*origin, base])
    return [part.transform(rotation, shift) for part in parts]


def _facing(flat: Flat, blot: Blot, rectangle: Rectangle) -> tuple[int, int]:
    """Direction that a thing looks in: as told, or away from the longest wall behind it."""
    x0, y0, x1, y1 = rectangle
    wish = blot.symbol.faces
    hung = MODELS[blot.symbol.kind].hung
    if wish in COMPASS and not hung:
        return COMPASS[wish]
    if wish in flat.legend:
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        seen = [np.array(flat.corner(r + 0.5, c + 0.5)) for r, c in flat.cells(wish)]
        if seen:
            dx, dy = min((at - middle for at in seen), key=lambda d: float(np.hypot(*d)))
            return (int(np.sign(dx)), 0) if abs(dx) > abs(dy) else (0, int(np.sign(dy)) or -1)
    walls = _walls_behind(flat, rectangle)
    if hung and wish in COMPASS:
        walls = {COMPASS[wish]: walls[COMPASS[wish]]}
    best = max(walls, key=lambda facing: walls[facing])
    if walls[best] > 0.0:
        return best
    if hung:
        raise InputError(
            f"{flat.where(blot.own)}: this {blot.symbol.label} hangs on no wall; "
            "draw it beside one (#)."
        )
    return COMPASS["south"]


def _walls_behind(flat: Flat, rectangle: Rectangle) -> dict[tuple[int, int], float]:
    """Length [m] of wall at the back of a footprint, for each direction it may look in."""
    wide, high = flat.metres
    bottom, left = flat.cell(rectangle[0] + wide / 2, rectangle[1] + high / 2)
    top, right = flat.cell(rectangle[2] - wide / 2, rectangle[3] - high / 2)
    columns, rows = range(left, right + 1), range(top, bottom + 1)

    def solid(cells: list[Cell]) -> int:
        return sum(int(flat.room_of[cell] == SOLID) for cell in cells)

    return {
        COMPASS["south"]: solid([(top - 1, c) for c in columns]) * wide,
        COMPASS["east"]: solid([(r, left - 1) for r in rows]) * high,
        COMPASS["west"]: solid([(r, right + 1) for r in rows]) * high,
        COMPASS["north"]: solid([(bottom + 1, c) for c in columns]) * wide,
    }


def _lamps(flat: Flat, pieces: list[Piece]) -> tuple[Lamp, ...]:
    """Light sources: windows, what glows, and one below the ceiling of rooms without a lamp."""
    found = [
        Lamp((*piece.lamp.tolist(),), piece.is_window) for piece in pieces if piece.lamp is not None
    ]
    lit = {piece.room for piece in pieces if piece.lamp is not None and not piece.is_window}
    for room in flat.rooms:
        if room.name not in lit:
            middle = np.mean(sorted(room.cells), axis=0)
            row, column = min(room.cells, key=lambda c: float(np.hypot(*(np.array(c) - middle))))
            found.append(Lamp((*flat.corner(row + 0.5, column + 0.5), flat.height - 0.1)))
    return tuple(found)
