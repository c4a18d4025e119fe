"""A home months later: things moved and taken away, others brought in.

What is built in stays. What stood at a wall stands at a wall again, and what stood on a thing goes
with it; nothing comes to stand in another thing, or in a door.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_z
from placegraph.errors import OptionError
from placegraph_lab.worlds.flat.flat import read_material
from placegraph_lab.worlds.flat.furniture import MODELS, Body, join_parts
from placegraph_lab.worlds.flat.interior import FlatObject, Interior, Surface
from placegraph_lab.worlds.flat.textures import paint

Floats = NDArray[np.float64]


Range = tuple[float, float]


class Items(NamedTuple):
    """Number of things of a kind."""

    what: str
    chance: float  # probability of the first one
    most: int = 1  # each further one, up to this many, is as likely as not


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of thing."""

    model: str  # of `flat_furniture.MODELS`
    width: Range
    depth: Range
    height: Range
    material: str = "wood"
    trim: str = "metal"
    place: str = "wall"
    """``wall``: its back to one; ``middle``; ``hung`` on a wall; ``ceiling``; ``on`` another."""
    base: float | None = None  # height of its lower edge above the floor [m]; None: as the model's
    on: tuple[Items, ...] = ()  # what may stand on it, or hang over it
    front: tuple[Items, ...] = ()  # what may stand before it and look at it
    beside: tuple[Items, ...] = ()  # what may stand at either side of it
    around: tuple[Items, ...] = ()
    """Items that may stand on all sides and face the object, each with its number and probability."""


@dataclass(frozen=True, slots=True)
class RoomKind:
    """A kind of room."""

    side: Range  # shorter side [m]
    stretch: Range  # longer side as a multiple of the shorter one
    objects: tuple[Items, ...]
    wet: bool = False
    windows: int = 1  # at most


@dataclass(frozen=True, slots=True)
class Style:
    """Materials that the homes of a hotel or a housing estate share."""

    walls: tuple[str, ...]  # A room has one of them
    floor: str
    wet_walls: str
    wet_floor: str
    materials: dict[
        str, str
    ]  # of the slots ``wood``, ``front``, ``fabric``, ``second``, ``metal``, ``top``
    height: float  # of the rooms [m]
    window: tuple[float, float]  # sill and height [m]
    door: str


def _style(  # one line a style
    walls: str, floor: str, wet: str, materials: str, height: float, sill: float, door: str
) -> Style:
    """Build a style from materials written with commas."""
    wet_walls, wet_floor = wet.split(", ")
    slots = ("wood", "front", "fabric", "second", "metal", "top")
    return Style(
        walls=tuple(walls.split(", ")),
        floor=floor,
        wet_walls=wet_walls,
        wet_floor=wet_floor,
        materials=dict(zip(slots, materials.split(", "), strict=True)),
        height=height,
        window=(sill, 1.3 if sill > 0.5 else 1.8),
        door=door,
    )


STYLES: dict[str, Style] = {
    "hotel": _style(
        "wallpaper #d8c9a8, wallpaper #c9b79c", "carpet #7a3038", "tiles #e8e2d2, stone #9a8f80",
        "wood #5a3822, wood #6b4730, fabric #7d2f36, fabric #c8a860, metal #b49a55, stone #d9d2c4",
        2.6, 0.8, "panel #5a3822",
    ),
    "estate": _style(
        "plaster #eae6dc, plaster #f0efe9", "parquet #c39a63", "tiles #f2f3f2, tiles #8c979c",
        "wood #cfae7c, plain #f1f0ec, fabric #6d7b86, fabric #9aa5ab, metal #c3c8cb, stone #55585a",
        2.5, 0.9, "panel #f2f1ec",
    ),
    "altbau": _style(
        "wallpaper #d9cfa6, plaster #c3d0da, plaster #dfe6d8", "parquet #8a5c36",
        "tiles #cfe0e2, checker #c9bda6",
        "wood #8d5a33, wood #a5773f, fabric #3f6b5c, fabric #7d3b33, metal goldenrod, wood #6b4426",
        3.0, 0.75, "panel #7c4a2a",
    ),
    "loft": _style(
        "stone #b9b4ac, plaster #8f8b85", "stone #77736d", "tiles #3f464b, tiles #2f3437",
        "wood #3b3532, metal #4a4f54, fabric #2f3f55, fabric #b5622c, metal #2b2d30, wood #a9794a",
        3.2, 0.4, "metal #44484c",
    ),
    "cottage": _style(
        "wallpaper #cfd9bf, wallpaper #e3cfc4", "parquet #b07a45", "tiles #d9e6ef, tiles #a7826b",
        "wood #c28f56, plain #dce4d3, stripes #5b7ba6, fabric #b9596b, metal #c9ccce, wood #d3aa75",
        2.4, 0.85, "panel #a7bda0",
    ),
    "office": _style(
        "plaster #e4e7e9, plaster #d5dadd", "carpet #5f6c78", "tiles #ffffff, tiles #74808a",
        "plain #d9d5cb, plain #c9cdd0, fabric #2b2d33, fabric #2c5d8f, metal #9ba3a8, plain #eceae4",
        2.7, 0.9, "plain #9fb2bf",
    ),
}  # fmt: skip

SYNONYMS: dict[str, tuple[str, ...]] = {
    "armchair": ("armchair", "chair", "easy chair"),
    "basket": ("basket", "laundry basket"),
    "bathroom cabinet": ("bathroom cabinet", "cabinet"),
    "bathtub": ("bathtub", "tub"),
    "bin": ("bin", "trash can"),
    "bookcase": ("bookcase", "bookshelf", "shelf"),
    "cabinet": ("cabinet", "cupboard"),
    "ceiling lamp": ("ceiling lamp", "ceiling light", "lamp"),
    "chair": ("chair", "dining chair"),
    "chest of drawers": ("chest of drawers", "dresser", "commode"),
    "coat rack": ("coat rack", "coats"),
    "coffee table": ("coffee table", "side table", "table"),
    "counter": ("counter", "kitchen counter"),
    "desk": ("desk", "table"),
    "dining table": ("dining table", "table"),
    "floor lamp": ("floor lamp", "lamp"),
    "fridge": ("fridge", "refrigerator"),
    "monitor": ("monitor", "screen"),
    "nightstand": ("nightstand", "bedside table"),
    "office chair": ("office chair", "desk chair", "chair"),
    "picture": ("picture", "painting"),
    "rug": ("rug", "carpet"),
    "shoe cabinet": ("shoe cabinet", "shoe rack"),
    "sideboard": ("sideboard", "cabinet", "tv stand"),
    "sofa": ("sofa", "couch"),
    "stool": ("stool", "ottoman"),
    "stove": ("stove", "oven", "cooker"),
    "table lamp": ("table lamp", "lamp"),
    "television": ("television", "tv"),
    "wall cupboard": ("wall cupboard", "kitchen cabinet", "cupboard"),
    "wardrobe": ("wardrobe", "closet"),
    "washbasin": ("washbasin", "sink"),
    "washing machine": ("washing machine", "washer"),
}
"""Synonyms of an object's label; a home uses one of them."""

_WHITE = "plain #eceff1"
_LAMP = Items("ceiling lamp", 0.9)
_VASE = Items("vase", 0.25)
_TABLE_LAMP = Items("table lamp", 0.5)

KINDS: dict[str, Kind] = {
    # sitting
    "sofa": Kind(
        "sofa", (1.5, 2.4), (0.8, 1.0), (0.75, 0.95), "fabric", "fabric",
        on=(Items("picture", 0.4),), front=(Items("coffee table", 0.7),),
        beside=(Items("floor lamp", 0.3), Items("plant", 0.2)),
    ),
    "armchair": Kind("sofa", (0.75, 0.9), (0.75, 0.9), (0.8, 1.0), "second", "second", "middle"),
    "chair": Kind("chair", (0.375, 0.5), (0.375, 0.5), (0.8, 0.95), "wood", "wood"),
    "office chair": Kind("chair", (0.5, 0.625), (0.5, 0.5), (0.9, 1.1), "second", "metal"),
    "stool": Kind("drum", (0.375, 0.5), (0.375, 0.5), (0.4, 0.5), "second", "wood", "middle"),
    "bench": Kind("table", (1.0, 1.5), (0.375, 0.375), (0.4, 0.5)),
    "bed": Kind(
        "bed", (0.9, 1.8), (1.9, 2.1), (0.7, 1.1), "fabric", "wood",
        on=(Items("picture", 0.4),), beside=(Items("nightstand", 0.8, 2),),
    ),
    # tables
    "coffee table": Kind(
        "table", (0.75, 1.125), (0.5, 0.625), (0.35, 0.5), "top", "wood", "middle", on=(_VASE,)
    ),
    "dining table": Kind(
        "table", (1.125, 1.75), (0.75, 0.875), (0.72, 0.78), "wood", "wood", "middle",
        on=(_LAMP, _VASE), around=(Items("chair", 0.6, 6),),
    ),
    "round table": Kind(
        "roundtable", (0.875, 1.125), (0.875, 1.125), (0.7, 0.76), "top", "metal", "middle",
        on=(_LAMP, _VASE), around=(Items("chair", 0.7, 4),),
    ),
    "desk": Kind(
        "table", (1.125, 1.75), (0.625, 0.75), (0.7, 0.78), "top", "metal",
        on=(Items("monitor", 0.85, 2), _TABLE_LAMP), front=(Items("office chair", 0.9),),
        beside=(Items("bin", 0.4),),
    ),
    "meeting table": Kind(
        "table", (1.75, 2.5), (0.875, 1.0), (0.72, 0.76), "top", "metal", "middle",
        on=(_LAMP, Items("monitor", 0.3)), around=(Items("office chair", 0.7, 6),),
    ),
    "nightstand": Kind(
        "cabinet", (0.375, 0.5), (0.375, 0.4), (0.4, 0.6), on=(Items("table lamp", 0.7),)
    ),
    # storage
    "bookcase": Kind("shelf", (0.75, 1.75), (0.28, 0.35), (1.4, 2.2)),
    "wardrobe": Kind("cabinet", (1.0, 2.2), (0.55, 0.62), (1.8, 2.3), "front"),
    "chest of drawers": Kind(
        "cabinet", (0.75, 1.25), (0.4, 0.5), (0.75, 1.05),
        on=(_TABLE_LAMP, _VASE, Items("mirror", 0.25)),
    ),
    "sideboard": Kind(
        "cabinet", (1.125, 2.0), (0.4, 0.5), (0.45, 0.85), "front",
        on=(Items("television", 0.6), _VASE, Items("speaker", 0.3, 2)),
    ),
    "cabinet": Kind("cabinet", (0.5, 1.0), (0.35, 0.5), (0.9, 1.6), "front", on=(_VASE,)),
    "filing cabinet": Kind(
        "cabinet", (0.5, 1.0), (0.5, 0.6), (0.7, 1.3), "metal", on=(Items("printer", 0.5),)
    ),
    "shoe cabinet": Kind(
        "cabinet", (0.75, 1.25), (0.25, 0.35), (0.5, 0.95), on=(Items("mirror", 0.5), _VASE)
    ),
    "shelf": Kind("shelf", (0.5, 1.0), (0.25, 0.25), (0.5, 0.8), place="hung", base=1.3),
    "box": Kind("block", (0.375, 0.625), (0.375, 0.5), (0.3, 0.5), "wood #b98f5e", "wood #a57c4d"),
    # kitchen
    "counter": Kind(
        "counter", (1.25, 2.5), (0.6, 0.625), (0.88, 0.94), "front", "top",
        on=(Items("sink", 0.95, 2), Items("wall cupboard", 0.7, 2), Items("microwave", 0.4),
            Items("kettle", 0.4), Items("coffee machine", 0.25)),
        beside=(Items("stove", 0.9), Items("fridge", 0.6), Items("dishwasher", 0.3)),
    ),
    "sink": Kind("basin", (0.5, 0.625), (0.375, 0.375), (0.12, 0.12), "metal", "metal", "on"),
    "wall cupboard": Kind(
        "cabinet", (0.625, 1.25), (0.33, 0.35), (0.6, 0.75), "front", place="on", base=1.45
    ),
    "stove": Kind("stove", (0.5, 0.625), (0.6, 0.625), (0.88, 0.92), _WHITE),
    "dishwasher": Kind("block", (0.5, 0.625), (0.6, 0.625), (0.84, 0.86), _WHITE, "metal"),
    "fridge": Kind("cabinet", (0.5, 0.75), (0.6, 0.7), (1.2, 1.95), "plain #dcdfe2"),
    "microwave": Kind(
        "block", (0.5, 0.5), (0.375, 0.375), (0.28, 0.32), "metal", "plain #222529", "on",
    ),
    "kettle": Kind(
        "drum", (0.25, 0.25), (0.25, 0.25), (0.22, 0.26), "metal", "plain #222529", "on",
    ),
    "coffee machine": Kind(
        "block", (0.25, 0.375), (0.375, 0.375), (0.35, 0.4), "plain #32281f", "metal", "on",
    ),
    # bath
    "bathtub": Kind("basin", (1.5, 1.75), (0.7, 0.8), (0.55, 0.6), "plain white"),
    "shower": Kind("block", (0.875, 1.0), (0.875, 1.0), (2.0, 2.1), "tiles #d4e4e8", "metal"),
    "toilet": Kind("toilet", (0.375, 0.5), (0.625, 0.7), (0.75, 0.85), "plain white"),
    "washbasin": Kind(
        "washstand", (0.5, 0.75), (0.45, 0.5), (0.82, 0.88), "plain white",
        on=(Items("mirror", 0.8),),
    ),
    "bathroom cabinet": Kind("cabinet", (0.375, 0.75), (0.3, 0.375), (0.8, 1.8), "front"),
    "washing machine": Kind("block", (0.625, 0.625), (0.6, 0.625), (0.84, 0.86), _WHITE, "metal"),
    "basket": Kind("drum", (0.375, 0.5), (0.375, 0.5), (0.45, 0.6), "wood #b9925f", "fabric"),
    "towel": Kind(
        "coats", (0.375, 0.75), (0.1, 0.1), (0.8, 1.0), "second", "metal", "hung", base=0.8,
    ),
    # light, walls, floor
    "ceiling lamp": Kind(
        "pendant", (0.375, 0.5), (0.375, 0.5), (0.3, 0.55), "fabric cornsilk", "metal", "ceiling",
    ),
    "floor lamp": Kind("lamp", (0.375, 0.45), (0.375, 0.45), (1.4, 1.75), "fabric wheat"),
    "table lamp": Kind(
        "lamp", (0.25, 0.25), (0.25, 0.25), (0.35, 0.5), "fabric wheat", "metal", "on",
    ),
    "picture": Kind(
        "picture", (0.5, 1.25), (0.03, 0.03), (0.4, 0.8), "picture #6b4a30", "wood", "hung", base=1.35,
    ),
    "mirror": Kind(
        "picture", (0.5, 0.75), (0.03, 0.03), (0.6, 0.9), "metal #c2cdd4", "metal", "hung", base=1.15,
    ),
    "clock": Kind(
        "picture", (0.25, 0.375), (0.03, 0.03), (0.3, 0.35), "plain #f4f1e8", "metal", "hung", base=1.8,
    ),
    "whiteboard": Kind(
        "picture", (1.25, 2.0), (0.03, 0.03), (0.9, 1.1), "plain #fafafa", "metal", "hung", base=1.0,
    ),
    "curtain": Kind(
        "picture", (0.375, 0.75), (0.05, 0.05), (2.0, 2.2), "second", "second", "hung", base=0.1,
    ),
    "radiator": Kind("block", (0.75, 1.25), (0.1, 0.12), (0.5, 0.65), _WHITE, _WHITE),
    "coat rack": Kind(
        "coats", (0.75, 1.5), (0.15, 0.2), (1.1, 1.3), "second", "wood", "hung", base=0.6,
    ),
    "rug": Kind("rug", (1.25, 2.0), (1.0, 1.5), (0.012, 0.012), "rug #8e2f2b", "carpet #6d2723", "middle",
                on=(Items("coffee table", 0.5),)),
    "plant": Kind(
        "plant", (0.375, 0.625), (0.375, 0.625), (0.8, 1.7), "leaves seagreen", "stone chocolate",
    ),
    # small things
    "television": Kind(
        "screen", (0.75, 1.125), (0.25, 0.25), (0.5, 0.7), "plain #14161a", "metal", "on",
    ),
    "monitor": Kind(
        "screen", (0.5, 0.625), (0.25, 0.25), (0.4, 0.5), "plain #14161a", "metal", "on",
    ),
    "speaker": Kind(
        "block", (0.25, 0.25), (0.25, 0.25), (0.25, 0.45), "wood #2c2622", "plain #1c1c1e", "on",
    ),
    "printer": Kind(
        "block", (0.375, 0.5), (0.375, 0.375), (0.25, 0.35), "plain #d8dadb", "plain #43474a", "on",
    ),
    "vase": Kind(
        "drum", (0.125, 0.25), (0.125, 0.25), (0.15, 0.35), "stone steelblue", "stone navy", "on",
    ),
    "bin": Kind("drum", (0.25, 0.375), (0.25, 0.375), (0.3, 0.6), "metal"),
    "piano": Kind("cabinet", (1.375, 1.5), (0.55, 0.625), (1.1, 1.25), "wood #241a14", on=(_VASE,)),
}  # fmt: skip
"""By plain name."""

_ALWAYS = (
    _LAMP, Items("radiator", 0.4), Items("picture", 0.5, 3), Items("plant", 0.3), Items("curtain", 0.25, 2),
)  # fmt: skip

ROOMS: dict[str, RoomKind] = {
    "kitchen": RoomKind(
        (2.5, 3.5), (1.0, 1.5),
        (Items("counter", 1.0, 2), Items("fridge", 0.5), Items("dining table", 0.35),
         Items("round table", 0.3), Items("cabinet", 0.3), Items("bin", 0.6), _LAMP,
         Items("clock", 0.3), Items("shelf", 0.3), Items("radiator", 0.3), Items("box", 0.1)),
        wet=True,
    ),
    "living room": RoomKind(
        (3.5, 4.75), (1.0, 1.4),
        (Items("sofa", 0.95, 2), Items("sideboard", 0.75), Items("bookcase", 0.6, 2), Items("rug", 0.35),
         Items("armchair", 0.5, 2), Items("floor lamp", 0.3), Items("piano", 0.12), Items("stool", 0.15),
         Items("cabinet", 0.25), *_ALWAYS),
        windows=2,
    ),
    "bedroom": RoomKind(
        (2.9, 3.9), (1.0, 1.4),
        (Items("bed", 1.0, 2), Items("wardrobe", 0.85, 2), Items("chest of drawers", 0.5),
         Items("desk", 0.2), Items("chair", 0.25), Items("rug", 0.3), Items("mirror", 0.25),
         Items("bookcase", 0.15), Items("armchair", 0.15), *_ALWAYS),
    ),
    "bathroom": RoomKind(
        (1.9, 2.6), (1.1, 1.6),
        (Items("washbasin", 0.95, 2), Items("toilet", 0.85), Items("bathtub", 0.55), Items("shower", 0.4),
         Items("washing machine", 0.35), Items("bathroom cabinet", 0.4), Items("basket", 0.3),
         Items("towel", 0.4, 2), Items("stool", 0.2), _LAMP, Items("radiator", 0.3)),
        wet=True,
    ),
    "study": RoomKind(
        (2.5, 3.4), (1.0, 1.4),
        (Items("desk", 1.0), Items("bookcase", 0.85, 3), Items("armchair", 0.3), Items("cabinet", 0.3),
         Items("rug", 0.2), Items("floor lamp", 0.3), Items("sofa", 0.2), Items("clock", 0.15), *_ALWAYS),
    ),
    "office": RoomKind(
        (3.4, 4.75), (1.0, 1.5),
        (Items("desk", 1.0, 4), Items("meeting table", 0.25), Items("filing cabinet", 0.6, 3),
         Items("bookcase", 0.5, 2), Items("whiteboard", 0.45), Items("bin", 0.4), Items("box", 0.2),
         Items("clock", 0.2), Items("coat rack", 0.15), *_ALWAYS),
        windows=2,
    ),
    "dining room": RoomKind(
        (3.0, 4.0), (1.0, 1.5),
        (Items("dining table", 0.75), Items("round table", 0.3), Items("sideboard", 0.6),
         Items("cabinet", 0.5, 2), Items("bench", 0.2), Items("clock", 0.2), *_ALWAYS),
    ),
    "hall": RoomKind(
        (1.75, 2.4), (1.4, 2.4),
        (Items("coat rack", 0.7), Items("shoe cabinet", 0.7), Items("mirror", 0.4), Items("bench", 0.3),
         Items("chest of drawers", 0.3), Items("rug", 0.2), _LAMP, Items("picture", 0.5, 3),
         Items("box", 0.2), Items("plant", 0.2)),
        windows=0,
    ),
}  # fmt: skip
"""By name. Things are placed in this order, as far as there is room."""


SHELL = frozenset({"floor", "ceiling", "wall", "window", "door", "doorway"})
"""Labels of what is no furniture."""
BUILT_IN = SHELL.union(
    *(
        {plain, *SYNONYMS.get(plain, ())}
        for plain in ("bathtub", "ceiling lamp", "counter", "radiator", "shower", "sink", "toilet",
                      "wall cupboard", "washbasin")
    )
)  # fmt: skip
"""Labels of what stays where it is."""
BROUGHT = ("box", "plant", "stool", "basket", "floor lamp", "bin", "chair", "armchair")
TRIES = 50
STANDS = 0.03  # what begins this near to a thing's top, or to the floor, stands on it [m]
AT_WALL = 0.12  # [m]
DOORSTEP = 0.6  # stays free before doors [m]
SILL = 0.85  # higher things do not stand before windows [m]
_TURNS = np.pi / 2 * np.array([0, 0, 0, 1, 2, 3])


def change_home(
    interior: Interior,
    rng: np.random.Generator,
    *,
    moved: float = 0.3,
    removed: float = 0.1,
    added: int = 2,
) -> Interior:
    """Home as it is after months; what is still there keeps its id.

    `interior`: the home as it was; `rng`: draws what happens; `moved`, `removed`: probability of a
    piece of furniture to be moved, or taken away; `added`: most things that are brought in.

    Raises `OptionError`: A probability is none, or `added` is less than 0.
    """
    if not (0 <= moved <= 1 and 0 <= removed <= 1 and added >= 0):
        raise OptionError(
            f"moved={moved}, removed={removed}, added={added}: the first two are probabilities, "
            "the last a number of things."
        )
    later = interior
    for item in interior.objects:
        if item.label in BUILT_IN or item.id not in {t.id for t in later.objects}:
            continue
        fate = rng.random()
        if fate < removed:
            later = _without(later, item)
        elif fate < removed + moved:
            later = _moved(later, item, rng)
    for _ in range(int(rng.integers(added + 1))):
        later = _with_another(later, interior, rng)
    return later


def find_cargo(objects: Iterable[FlatObject], host: FlatObject) -> list[FlatObject]:
    """Return the objects that stand on an object, directly or not."""
    low, high = host.bounds
    found = []
    for item in objects:
        at, top = item.bounds
        within = (at[:2] > low[:2] - STANDS).all() and (top[:2] < high[:2] + STANDS).all()
        # taps reach over the top that something else stands on, legs of tables stand in rugs
        if item.id != host.id and within and low[2] + 0.005 < at[2] <= high[2] + STANDS:
            found.append(item)
    return found


def _without(interior: Interior, item: FlatObject) -> Interior:
    gone = {item.id, *(t.id for t in find_cargo(interior.objects, item))}
    lamps = tuple(
        lamp
        for lamp in interior.lamps
        if lamp.is_window or item.emission == 0.0 or not _over(lamp.position, item.bounds)
    )
    return Interior(tuple(t for t in interior.objects if t.id not in gone), lamps)


def _moved(interior: Interior, item: FlatObject, rng: np.random.Generator) -> Interior:
    """Interior with an object, and its cargo, elsewhere; as it was, if there is no room."""
    floor = _floor(interior, item.room)
    if floor is None or item.bounds[0, 2] > STANDS:  # hangs, or stands on something
        return interior
    cargo = find_cargo(interior.objects, item)
    away = {item.id, *(t.id for t in cargo)}
    others = [t for t in interior.objects if t.id not in away]
    middle = item.bounds.mean(axis=0)
    for _ in range(TRIES):
        shift, yaw = _somewhere(item.bounds, floor, rng)
        there = item.move((float(shift[0]), float(shift[1])), yaw)
        if _has_space(there, others, floor):
            carried = {item.id: there}
            for load in cargo:
                arm = load.bounds.mean(axis=0) - middle
                step = (rotation_z(yaw) @ arm - arm)[:2] + shift
                carried[load.id] = load.move((float(step[0]), float(step[1])), yaw)
            lamps = tuple(
                replace(lamp, position=(*(np.array(lamp.position[:2]) + shift).tolist(),
                                        lamp.position[2]))
                if not lamp.is_window and any(t.emission > 0.0 and _over(lamp.position, t.bounds)
                                              for t in (item, *cargo))
                else lamp
                for lamp in interior.lamps
            )  # fmt: skip
            return Interior(tuple(carried.get(t.id, t) for t in interior.objects), lamps)
    return interior


def _somewhere(bounds: Floats, floor: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
    """Shift (2,) [m] and turn [rad]: along the walls, if it stands at one, or to and fro."""
    middle, half = bounds.mean(axis=0)[:2], (bounds[1] - bounds[0])[:2] / 2
    gaps = np.concatenate([bounds[0, :2] - floor[0], floor[1] - bounds[1, :2]])
    wall = int(gaps.argmin())  # west, south, east, north
    if gaps[wall] > AT_WALL:
        small = float(rng.uniform(-0.5, 0.5))
        return rng.normal(0.0, 0.7, 2), float(rng.choice([0.0, small, np.pi / 2]))
    turn = int(rng.choice([0, 0, 0, 1, 2, 3]))
    there = (wall + turn) % 4
    half = half[::-1] if turn % 2 else half
    room = floor + np.stack([half, -half])
    if (room[1] < room[0]).any():
        return np.zeros(2), 0.0
    target = rng.uniform(room[0], room[1])
    axis = there % 2
    target[axis] = room[0, axis] + gaps[wall] if there < 2 else room[1, axis] - gaps[wall]
    return target - middle, turn * np.pi / 2


def _has_space(there: FlatObject, obstacles: list[FlatObject], floor: Floats) -> bool:
    low, high = there.bounds
    if (low[:2] < floor[0] - 1e-6).any() or (high[:2] > floor[1] + 1e-6).any():
        return False
    return all(_apart(other, low, high) for other in obstacles)


def _apart(other: FlatObject, low: Floats, high: Floats) -> bool:
    at, top = other.bounds
    margin = 0.0
    if other.label in {"floor", "ceiling", "wall"} or top[2] < STANDS:  # or a rug
        return True
    if other.label in {"door", "doorway"}:
        margin = DOORSTEP
    elif other.label == "window" and high[2] <= SILL:
        return True
    overlap = np.minimum(top + margin, high) - np.maximum(at - margin, low)
    return bool((overlap <= 1e-6).any())


def _with_another(interior: Interior, before: Interior, rng: np.random.Generator) -> Interior:
    """Interior with one thing more; as it was, if there is no room."""
    plain = str(rng.choice(BROUGHT))
    rooms = [item.room for item in interior.objects if item.label == "floor"]
    room = str(rng.choice(rooms))
    floor = _floor(interior, room)
    here = {item.label for item in interior.objects}
    words = [word for word in SYNONYMS.get(plain, (plain,)) if word in here] or [plain]
    number = max(item.id for item in (*interior.objects, *before.objects)) + 1
    label = words[0]
    kind, model = KINDS[plain], MODELS[KINDS[plain].model]
    width, depth, height = (
        float(rng.uniform(*sizes)) for sizes in (kind.width, kind.depth, kind.height)
    )
    materials = STYLES[str(rng.choice(list(STYLES)))].materials
    body = Body(
        width,
        depth,
        height,
        read_material(materials.get(kind.material, kind.material), plain),
        read_material(materials.get(kind.trim, kind.trim), plain),
    )
    surfaces = tuple(
        Surface(part.vertices, part.triangles, part.uv, paint(part.material, part.size, rng))
        for part in join_parts(model.make_parts(body))
    )
    fresh = FlatObject(number, f"{label} {number}", label, room, surfaces, model.emission)
    others = [t for t in interior.objects if t.label != words[0]] + [
        t for t in interior.objects if t.label == words[0]
    ]
    for _ in range(TRIES):
        if floor is None:
            break
        half = (fresh.bounds[1] - fresh.bounds[0])[:2] / 2
        to = rng.uniform(floor[0] + half, np.maximum(floor[1] - half, floor[0] + half))
        shift = to - fresh.bounds.mean(axis=0)[:2]
        there = fresh.move((float(shift[0]), float(shift[1])), float(rng.choice(_TURNS)))
        if _has_space(there, others, floor):
            return replace(interior, objects=(*interior.objects, there))
    return interior


def _floor(interior: Interior, room: str) -> Floats | None:
    """Lowest and highest corner (2, 2) of a room's floor [m]; None: no such room."""
    for item in interior.objects:
        if item.label == "floor" and item.room == room:
            return item.bounds[:, :2]
    return None


def _over(position: tuple[float, float, float], bounds: Floats) -> bool:
    at = np.array(position[:2])
    return bool((at >= bounds[0, :2]).all() and (at <= bounds[1, :2]).all())
