"""Sentences that could be said on a map, for pages to offer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.objects import POINT
from placegraph.view.city.items import common_name

if TYPE_CHECKING:
    from placegraph.outdoor.map.city import City

KEYS = ("shop", "amenity", "leisure", "tourism", "railway", "highway")
"""Things of these kinds are spoken of."""
DULL = frozenset(
    ("parking", "bicycle parking", "parking entrance", "vending machine", "waste basket", "crossing",
     "street lamp", "give way", "turning circle", "motorway junction", "shop", "switch", "level crossing",
     "signal", "buffer stop", "vacant")
)  # fmt: skip
NEAR, FAR = 12.0, 120.0
"""What is spoken of is so far away [m]."""
WINDS = ("north", "east", "south", "west")


def examples(city: City, paints: Sequence[str], most: int = 3) -> list[str]:
    """Sentences that are true somewhere in a city, of two or three things in as many directions."""
    objects = city.objects
    rows = np.flatnonzero(objects.kind == POINT)
    rows = np.array([row for row in rows.tolist() if _worth(objects.label(row), paints[row])])
    found: list[str] = []
    if not len(rows):
        return found
    spoken = Vocabulary.default().spoken
    names = [spoken(objects.label(row)) for row in rows.tolist()]
    at = objects.center[rows].astype(np.float64)
    # from all over the city, the same each time
    for start in range(0, len(rows), max(1, len(rows) // 40)):
        here = at[start] - (0.0, 20.0)
        sentence = _said(here, at, names)
        if sentence and sentence not in found:
            found.append(sentence)
        if len(found) == most:
            break
    return found


def _worth(label: str, paint: str) -> bool:
    plain = not label.endswith(("s", "water"))  # a toilets, a drinking water
    spoken = label.partition("=")[0] in KEYS and common_name(label) not in DULL
    return plain and bool(paint) and spoken


def _said(here: Floats, at: Floats, names: Sequence[str]) -> str:
    """What is seen from a place to the four winds; empty where there is too little."""
    delta = at - here
    distance = np.hypot(*delta.T)
    things: dict[str, str] = {}
    for k in np.argsort(distance, kind="stable"):
        if distance[k] > FAR:
            break
        turn = np.degrees(np.arctan2(delta[k, 0], delta[k, 1])) % 360.0
        wind = round(turn / 90.0)
        name = names[k]
        if distance[k] < NEAR or abs(turn - 90.0 * wind) > 25.0 or name in things.values():
            continue
        things.setdefault(WINDS[wind % 4], name)
    if len(things) < 2:
        return ""
    (wind, name), *others = list(things.items())[:3]
    told = [f"{_a(name).capitalize()} is {wind} of me"]
    told += [f"{_a(name)} is to the {wind}" for wind, name in others]
    return f"{', '.join(told[:-1])} and {told[-1]}."


def _a(name: str) -> str:
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
