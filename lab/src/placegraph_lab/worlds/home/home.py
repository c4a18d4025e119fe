"""Procedural homes: any number of small worlds that look alike, as flats of a housing estate do.

`home` draws a floor plan of one to three rooms, furnishes it in one of a few styles and returns it
as a `Flat`, as if somebody had drawn it in ASCII; `Flat.furnish` makes it an `Interior`. `change_home`
is the same home months later, `record` a capture of a walk through it, in memory, and `scene_of`
its scene map::

    rng = np.random.default_rng(7)
    flat = home(rng)
    interior = flat.furnish(rng)
    scene = scene_of(interior)
    later = changed(interior, rng)
    capture = record(later, visit(flat, later, rng), rng)
"""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.errors import OptionError
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.home.change import STYLES, change_home
from placegraph_lab.worlds.home.plan import CELL, Furnisher, plan, rooms_of
from placegraph_lab.worlds.home.visit import CAMERA, record, visit

__all__ = ["CAMERA", "STYLES", "change_home", "home", "record", "scene_of", "visit"]

QUALITY = 85  # of the textures' JPEG images


def home(rng: np.random.Generator, *, style: str | None = None) -> Flat:
    """Draw a home; the same state of the generator draws the same home.

    `rng`: draws everything; `style`: one of `STYLES`, whose homes share walls, floors, wood and
    fabrics; any if not given.

    Raises `OptionError`: there is no such style.
    """
    name = str(rng.choice(list(STYLES))) if style is None else style
    if name not in STYLES:
        raise OptionError(f"There is no style {name!r}; there are {', '.join(STYLES)}.")
    return Flat.parse(draw_home(rng, name), source=f"a home of style {name}")


def draw_home(rng: np.random.Generator, style: str) -> str:
    """Text of a home as `Flat.parse` reads it."""
    of = STYLES[style]
    layout = plan(rooms_of(style, rng), rng)
    furnisher = Furnisher(layout, of, rng)
    for area in layout.areas:
        furnisher.furnish(area)
    sill, high = of.window
    legend = [
        f"= window: base={sill:g} height={high:g} trim={of.materials['top']}",
        f": doorway: trim={of.materials['wood']}",
        f"+ door: look={of.door} trim={of.materials['wood']}",
    ]
    for number, area in enumerate(layout.areas, 1):
        inside = np.argwhere(furnisher.page[area.floor.rows, area.floor.columns] == " ")
        row, column = inside[len(inside) // 2] + (area.floor.top, area.floor.left)
        furnisher.page[row, column] = str(number)
        walls = of.wet_walls if area.of.wet else str(rng.choice(of.walls))
        floor = of.wet_floor if area.of.wet else of.floor
        legend.append(f"{number} room: label={area.kind} walls={walls} floor={floor}")
    rows = ["".join(row).rstrip() for row in furnisher.page]
    head = ["[flat]", f"name = {style}", f"metres = {CELL}", f"height = {of.height}"]
    return "\n".join([*head, "[drawing]", *rows, "[legend]", *legend, *furnisher.legend, ""])


def scene_of(interior: Interior, *, name: str = "home") -> SceneMap:
    """Scene map of an interior: ids, labels, names and rooms of its things, relations, textures.

    Triangles are as they were built, textures half as fine as painted, so that this takes a
    fraction of a second; `write_glb` and `build_scene` make the map as of any other source.
    """
    from placegraph.indoor.map.relations import find_relations
    from placegraph.indoor.scene_map import SceneMap

    things = interior.objects
    mesh = interior.mesh()  # whose objects are ids
    row = np.zeros(max(thing.id for thing in things) + 1, np.int32)
    row[[thing.id for thing in things]] = np.arange(len(things))
    mesh = replace(mesh, object_of=row[mesh.object_of])
    labels = [thing.label for thing in things]
    rooms = {room: i for i, room in enumerate(dict.fromkeys(t.room for t in things if t.room))}
    room_of = np.array([rooms.get(thing.room, -1) for thing in things])
    return SceneMap.create(
        mesh,
        [str(thing.id) for thing in things],
        labels,
        floor=0.0,
        names=[thing.name for thing in things],
        attributes=[{"room": thing.room} if thing.room else {} for thing in things],
        relations=find_relations(mesh, labels, room_of),
        scene=name,
        source=name,
        encoded=tuple(_jpeg(texture) for texture in mesh.textures),
    )


def _jpeg(texture: NDArray[np.uint8]) -> bytes:
    """Texture half as fine, but not smaller than 8 texels."""
    image = Image.fromarray(texture)
    encoded = io.BytesIO()
    small = image.reduce(2) if min(image.size) >= 16 else image
    small.save(encoded, "JPEG", quality=QUALITY)
    return encoded.getvalue()
