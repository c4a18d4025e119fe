"""What kind of item a thing or a place is, and which of its neighbours it belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from placegraph.outdoor.language.parse import Items, Place, Thing


def placed(places: Items, after: Items) -> Items:
    """Put places before a verb behind the things after it: "south of me are a school and a park"."""
    n = next((i for i, item in enumerate(after) if isinstance(item, Place)), len(after))
    return (*after[:n], *places, *after[n:])


def joins(last: Place, thing: Thing, heads: Sequence[int], following: Thing | Place | None) -> bool:
    """Tell whether a thing after a place is one more of its targets."""
    mine = isinstance(following, Place) and (
        following.owner == "MY" or any(thing.kind == "ME" for thing in following.targets)
    )
    listed = not mine and (bool(heads) or not isinstance(following, Place))
    things = bool(last.targets) and last.targets[-1].kind == thing.kind == "thing"
    return listed and things and last.how != "between"


def shared(item: Place, last: Place | None, following: Thing | Place | None) -> Thing | None:
    """Target of the direction beside one that names none, or of "..., across the street"."""
    if item.how == "across" and len(item.targets) < 2 and isinstance(last, Place) and last.targets:
        return last.targets[-1] if last.how in ("towards", "prep") else None
    if item.how != "towards" or item.targets:
        return None
    for other in (following, last):
        if isinstance(other, Place) and other.targets and other.how in ("towards", "start"):
            return other.targets[0]
        if isinstance(other, Place) and other.how == "across" and len(other.targets) == 2:
            return other.targets[1]
    return None


def is_person(item: Thing | Place) -> bool:
    """Tell whether an item is no thing of the map: somebody, "it", "here"."""
    return isinstance(item, Thing) and item.kind != "thing"


def is_leg(item: Thing | Place) -> bool:
    """Tell whether a place may be a further leg of a way: "then 500 m north"."""
    if not isinstance(item, Place) or item.distance is None:
        return False
    return item.how in ("towards", "away") and not item.targets


def has_no(item: Thing | Place) -> bool:
    """Tell whether a thing is said not to be there: "no trees"."""
    return isinstance(item, Thing) and item.determiner == "NO"


def is_bare_word(items: Items) -> bool:
    """Tell whether a clause is one word with a capital that nothing is known of."""
    thing = items[0]
    return (
        len(items) == 1
        and isinstance(thing, Thing)
        and bool(thing.name)
        and not thing.senses
        and " " not in thing.name
    )


def arrived(item: Thing | Place) -> Thing | Place:
    """Take "come to the garden" as meeting at the garden."""
    return replace(item, word="AT") if isinstance(item, Place) and item.word == "TO" else item
