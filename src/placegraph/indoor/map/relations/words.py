"""What relations are called: by us, by 3DSSG, and by people who ask for "the sofa beside the plant".

A *reading* of a name is one of few relations, and whether the two things change places: "under"
reads as "above", turned. An edge "lamp above desk" so answers "desk under lamp".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.indoor.map.floor import label_words
from placegraph.indoor.map.relations import (
    ABOVE,
    ATTACHED_TO,
    INSIDE,
    NEXT_TO,
    SAME_ROOM,
    STANDING_ON,
)

Reading = tuple[str, bool]
"""A relation, and whether subject and object change places."""

LEFT, FRONT, HIGHER, BIGGER = "left", "front", "higher than", "bigger than"
LEANING, PART, COVER = "leaning against", "part of", "cover"

CANONICAL: dict[str, Reading] = {
    # 3DSSG's, those of its subset; left, right, front, behind are as seen by who labelled the scan
    "supported by": (STANDING_ON, False), "left": (LEFT, False), "right": (LEFT, True),
    "front": (FRONT, False), "behind": (FRONT, True), "close by": (NEXT_TO, False),
    "inside": (INSIDE, False), "bigger than": (BIGGER, False), "smaller than": (BIGGER, True),
    "higher than": (HIGHER, False), "lower than": (HIGHER, True),
    "same symmetry as": ("same symmetry as", False), "same as": ("same as", False),
    "attached to": (ATTACHED_TO, False), "standing on": (STANDING_ON, False),
    "lying on": (STANDING_ON, False), "hanging on": (ATTACHED_TO, False),
    "connected to": (ATTACHED_TO, False), "leaning against": (LEANING, False),
    "part of": (PART, False), "belonging to": (PART, False), "build in": (ATTACHED_TO, False),
    "standing in": (INSIDE, False), "cover": (COVER, False), "lying in": (INSIDE, False),
    "hanging in": (INSIDE, False),
    # ours
    "above": (ABOVE, False), "next to": (NEXT_TO, False), "same room": (SAME_ROOM, False),
}  # fmt: skip
"""Relation that each name of an edge stands for; a name that is not here stands for itself."""

_ASKED: dict[str, tuple[Reading, ...]] = {
    "on, on top of, atop, upon, onto": (  # a picture is on a wall
        (STANDING_ON, False), (ATTACHED_TO, False), (COVER, False),
    ),
    "standing on, sitting on, lying on, resting on, placed on, stands on, sits on, lies on": (
        (STANDING_ON, False),
    ),
    "supporting, carrying, supports, carries": ((STANDING_ON, True),),
    "attached to, hanging on, hanging from, mounted on, fixed to, fastened to, connected to": (
        (ATTACHED_TO, False), (PART, False),
    ),
    "part of, belonging to": ((PART, False), (ATTACHED_TO, False)),
    "build in, built in, built into": ((ATTACHED_TO, False), (INSIDE, False)),
    "in, inside, inside of, within, contained in, stored in": ((INSIDE, False),),
    "containing, contains, holding, holds": ((INSIDE, True),),
    "above, over, hanging over, hanging above": ((ABOVE, False),),
    "under, underneath, below, beneath": ((ABOVE, True), (STANDING_ON, True)),
    "next to, right next to, beside, near, near to, nearby, close by, close to, by, at, alongside": (
        (NEXT_TO, False), (LEANING, False), (LEANING, True),
    ),
    "leaning against, leaning on, against": (
        (LEANING, False), (ATTACHED_TO, False), (NEXT_TO, False),
    ),
    "left of, to left of, on left of, on left side of": ((LEFT, False),),
    "right of, to right of, on right of, on right side of": ((LEFT, True),),
    "in front of": ((FRONT, False),),
    "in back of": ((FRONT, True),),
    "larger than": ((BIGGER, False),),
    "taller than": ((HIGHER, False),),
    "covering, covers": ((COVER, False),),
    "in same room as, same room as, in room with, in room of": ((SAME_ROOM, False),),
}  # fmt: skip
_READINGS = {name: readings for names, readings in _ASKED.items() for name in names.split(", ")}
_IDLE = frozenset({"is", "are", "that", "which", "the", "a", "an", "directly", "just"})


def canonical(relation: str) -> Reading:
    """What the name of an edge stands for; a name that nothing is known of stands for itself."""
    name = _phrase(relation)
    return _plain(*(CANONICAL.get(name) or _READINGS.get(name, ((name, False),))[0]))


def readings(asked: str) -> frozenset[Reading]:
    """What a relation that is asked for may mean: "under" is "above" turned, or "standing on"."""
    name = _phrase(asked)
    return frozenset(_plain(*r) for r in _READINGS.get(name, ())) or frozenset({canonical(name)})


def matches(asked: str, relation: str) -> bool:
    """Whether an edge "A `relation` B" says that A is `asked` B.

    "near" matches "close by" and "next to", "on" matches "lying on". "under" matches neither "above"
    nor "standing on", which say it of B: `find` turns such edges around.
    """
    return canonical(relation) in readings(asked)


def same_thing(asked: str, label: str) -> bool:
    """Whether a label may be what is asked for: "chairs" and "desk chair", "DeskChair" and "chair".

    The last words are the same but for the plural, and what comes before does not differ: a "desk
    chair" is a "chair", but no "kitchen chair". Nothing asked for is anything.
    """
    wanted, own = label_words(asked), label_words(label)
    if not wanted or not own:
        return not wanted
    if not forms(wanted[-1]) & forms(own[-1]):
        return False
    return set(wanted[:-1]) <= set(own[:-1]) or set(own[:-1]) <= set(wanted[:-1])


def find(graph: SceneGraph, subject: str, asked: str, target: str) -> NDArray[np.int64]:
    """Pairs of things between which a relation holds, under whichever name an edge says so.

    Parameters
    ----------
    graph
        Scene graph whose edges are relations by our names or 3DSSG's.
    subject, target
        Labels, "sofa" and "plant"; empty for anything.
    asked
        The relation of the subject to the target: "next to", "on top of", "under".

    Returns
    -------
    (K, 2) int64 rows of subject and target, sorted, none twice.

    """
    wanted = readings(asked)
    labels = dict.fromkeys(graph.labels)
    first, second = (
        np.array([fits[label] for label in graph.labels], np.bool_)
        for fits in (
            {label: same_thing(end, label) for label in labels} for end in (subject, target)
        )
    )
    of = {relation: canonical(relation) for relation in dict.fromkeys(graph.relations)}
    pairs: set[tuple[int, int]] = set()
    for a, relation, b in zip(
        graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True
    ):
        name, turned = of[relation]
        if (name, turned) in wanted and first[a] and second[b]:
            pairs.add((a, b))
        if _plain(name, not turned) in wanted and first[b] and second[a]:
            pairs.add((b, a))
    if (SAME_ROOM, False) in wanted:
        for room in _connected(graph, [of[r][0] == SAME_ROOM for r in graph.relations]):
            pairs.update((a, b) for a in room if first[a] for b in room if second[b] and a != b)
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def _phrase(name: str) -> str:
    """Words of a relation in lower case, but for those that change nothing."""
    words = [word for word in re.split(r"[\s_-]+", name.lower()) if word]
    return " ".join([word for word in words if word not in _IDLE] or words)


def _connected(graph: SceneGraph, chosen: Sequence[bool]) -> Iterable[list[int]]:
    """Groups of rows that the chosen edges connect."""
    group: dict[int, list[int]] = {}
    for a, b in zip(
        graph.sources[list(chosen)].tolist(), graph.targets[list(chosen)].tolist(), strict=True
    ):
        one, other = group.setdefault(a, [a]), group.setdefault(b, [b])
        if one is not other:
            small, large = sorted((one, other), key=len)
            large.extend(small)
            group.update(dict.fromkeys(small, large))
    return {id(rows): rows for rows in group.values()}.values()


def _plain(relation: str, turned: bool) -> Reading:
    """A reading; of what says the same when the things change places there is one."""
    return relation, turned and relation != NEXT_TO and not relation.startswith("same ")


def forms(word: str) -> set[str]:
    """A word, and what it may be the plural of."""
    forms = {word}
    if word.endswith("s") and not word.endswith("ss"):
        forms.add(word[:-1])
    if word.endswith("es"):
        forms.add(word[:-2])
    if word.endswith("ies"):
        forms.add(word[:-3] + "y")
    if word.endswith("ves"):
        forms |= {word[:-3] + "f", word[:-3] + "fe"}
    return forms
