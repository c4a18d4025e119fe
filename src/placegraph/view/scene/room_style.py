"""How things in rooms look on a plan: one table from the words of labels to paints.

As outdoors the style is quiet: furniture is pastel, walls are dark, and only what the estimate says
is in full colour. To change the looks, change the tables here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache


@dataclass(frozen=True, slots=True)
class RoomPaint:
    """How one class of things in rooms is drawn."""

    role: str
    """``thing``, ``floor`` (lies below all), ``structure`` (cut as on an architect's plan), or
    ``ceiling`` (left out)."""
    light: str
    dark: str
    """Colours on a light and on a dark page."""


ROOM_PAINTS: dict[str, RoomPaint] = {
    "floor": RoomPaint("floor", "#fdfbf6", "#20252c"),
    "ceiling": RoomPaint("ceiling", "", ""),
    "wall": RoomPaint("structure", "#4d4943", "#aeb4bd"),
    "window": RoomPaint("structure", "#8fc1d6", "#4d8aa5"),
    "door": RoomPaint("structure", "#c08a52", "#a87b4c"),
    "curtain": RoomPaint("structure", "#c9b8a6", "#776c61"),
    "carpet": RoomPaint("thing", "#f1e3d8", "#2b2a2d"),
    "seat": RoomPaint("thing", "#b7c9e2", "#3a4d68"),
    "table": RoomPaint("thing", "#e8d2ab", "#5c4e37"),
    "bed": RoomPaint("thing", "#d9c6e0", "#51445b"),
    "storage": RoomPaint("thing", "#d8bc98", "#5d4a37"),
    "appliance": RoomPaint("thing", "#c5cfd6", "#46525c"),
    "bath": RoomPaint("thing", "#bfe1df", "#30514f"),
    "plant": RoomPaint("thing", "#b5d49f", "#35522f"),
    "sport": RoomPaint("thing", "#d3c3bb", "#4c4440"),
    "thing": RoomPaint("thing", "#ddd7cc", "#444a52"),
}
"""Paints by name; structure is laid in this order, the later on top."""

WORDS = {
    "floor": "floor ground parquet tile",
    "ceiling": "ceiling roof beam",
    "wall": "wall pillar column partition",
    "window": "window windowpane glass skylight",
    "door": "door doorframe doorway gate",
    "curtain": "curtain blind shutter drape",
    "carpet": "carpet rug mat doormat runner",
    "seat": "chair armchair sofa couch stool ottoman bench pouf seat beanbag sofachair cushion",
    "table": "table desk coffeetable nightstand nighttable counter countertop island stand",
    "bed": "bed mattress crib cot pillow blanket duvet",
    "storage": "cabinet cupboard wardrobe shelf bookshelf bookcase shelves rack dresser commode "
    "drawer drawers chest closet sideboard locker credenza box basket crate",
    "appliance": "refrigerator fridge freezer oven stove cooker microwave dishwasher machine washer "
    "dryer tv television monitor screen computer laptop printer airconditioner conditioner radiator "
    "heater heating hood rangehood extractor speaker piano boiler projector fireplace cookingbench",
    "bath": "sink basin washbasin washstand bath bathtub tub toilet shower bidet urinal",
    "plant": "plant flower flowers tree bush pot flowerpot",
    "sport": "dumbbell equipment treadmill bicycle bike trainer",
}
"""By paint: words of labels."""

_PAINT_OF_WORD = {word: paint for paint, words in WORDS.items() for word in words.split()}


def plain_words(label: str) -> str:
    """Words of a label as one says them: ``CoffeeTable_01`` is a coffee table."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", label)
    return " ".join(word for word in re.split(r"[\W_\d]+", apart.lower()) if word)


@cache
def room_paint(label: str) -> str:
    """Paint of a thing with this label: its last word says what it is; a floor lamp is no floor."""
    words = plain_words(re.split(r"[/(,]", label)[0]).split()
    for word in ("".join(words), *words[-1:]):
        for form in (word, word.removesuffix("s"), word.removesuffix("es")):
            if paint := _PAINT_OF_WORD.get(form):
                return paint
    return "thing"
