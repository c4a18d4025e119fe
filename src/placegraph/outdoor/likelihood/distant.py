"""Objects out of sight: rare ones that people mention from afar, crossings, and houses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.language.description import Relation, Statement, ends, find_speaker_nodes
from placegraph.outdoor.map.objects import POINT

if TYPE_CHECKING:
    from placegraph.outdoor.likelihood.query import Lexicon

KIND_WEIGHT = 0.03
"""Weight of objects of the right kind where a text has a name: the map may lack the name."""
MAX_DISTANT_ON_WAY = 400
"""Largest number of objects of a mention from out of sight, where a text tells a way ..."""
MAX_DISTANT = 12
"""... and where it does not."""
NEAR_SCALE, FAR_SCALE = 80.0, 350.0
"""Scale of distances to objects out of sight, and where the text tells a way or names a quarter [m]."""
SITE_SCALE = 35.0
"""Scale of distances to a crossing or a house [m]."""
QUARTERS = frozenset(f"place={kind}" for kind in ("suburb", "neighbourhood", "quarter", "borough"))
NUM_SALIENT = 20.0
"""Number of objects out of sight that come to a speaker's mind."""


class DistantObjects(NamedTuple):
    """Objects that are rare enough to be mentioned from out of sight."""

    starts: NDArray[np.int64]
    """(M + 1,) objects of a mention; none where there are too many."""
    objects: NDArray[np.int64]
    """Rows of the map's objects; beyond these, rows of `sites`."""
    weights: NDArray[np.float32]
    sites: NDArray[np.float32]
    """(V, 2) crossings and houses that are no objects, east and north [m]."""
    scale: NDArray[np.float32]
    """(S,) scale of the distance to the object of a statement [m]."""
    share: NDArray[np.float32]
    """(S,) probability that a statement is about one particular object out of sight."""
    anchors: NDArray[np.int64]
    """Objects around which candidates are sought, those of the rarest mention first."""


def find_distant(
    used: list[Statement],
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
    city: Lexicon,
    sites: Mapping[int, Floats],
    *,
    tells_way: bool,
) -> DistantObjects | None:
    """Find objects of rare mentions, and `sites`, where a statement may be about what is out of sight."""
    here = find_speaker_nodes(used)
    tells_way = any(s.far for s in used) or tells_way
    few = {m + 2 for m, mention in enumerate(mentions) if _is_rare(*mention, city)}.union(sites)
    reaches = [
        s.far
        or s.distance is not None
        or not here.union(sites).isdisjoint(ends(s))
        or few.issuperset(ends(s))
        for s in used
    ]
    spoken = {
        n - 2
        for s, r in zip(used, reaches, strict=True)
        if r
        for n in ends(s)
        if n in sites or n not in here
    }
    nothing = (np.zeros(0, np.int64), np.zeros(0, np.float32))
    away = {
        n - 2 for s in used if (s.distance or 0.0) > NEAR_SCALE for n in ends(s) if n not in here
    }
    members = [
        _find_objects(
            *mention, city, most=MAX_DISTANT_ON_WAY if tells_way or m in away else MAX_DISTANT
        )
        if m in spoken
        else nothing
        for m, mention in enumerate(mentions)
    ]
    if not tells_way:  # of many, no particular one comes to mind
        members = [(o, f * min(1.0, MAX_DISTANT / max(1, len(o)))) for o, f in members]
    rows = len(city.objects.kind)
    for node, places in sites.items():
        if node - 2 in spoken:
            at = np.arange(rows, rows + len(places), dtype=np.int64)
            members[node - 2] = (at, np.full(len(at), 1.0 / len(at) ** 0.5, np.float32))
            rows += len(at)
    if not any(len(o) for o, _ in members):
        return None
    bearers = {m + 2: rows for m, (rows, _) in enumerate(members) if m + 2 not in sites}
    quarters = {node for node, rows in bearers.items() if _are_quarters(rows, city)}

    def scale(s: Statement) -> float:
        inside = s.relation is Relation.INSIDE and s.target in quarters
        if not s.far and not sites.keys().isdisjoint(ends(s)):
            return SITE_SCALE
        return FAR_SCALE if s.far or inside else NEAR_SCALE

    rarest: list[NDArray[np.int64]] = sorted(
        (o for o, _ in members if 0 < len(o) <= MAX_DISTANT), key=len
    )
    return DistantObjects(
        starts=np.concatenate(([0], np.cumsum([len(o) for o, _ in members]))).astype(np.int64),
        objects=np.concatenate([o for o, _ in members]),
        weights=np.concatenate([f for _, f in members]).astype(np.float32),
        sites=np.concatenate(
            [np.zeros((0, 2)), *(at for node, at in sites.items() if node - 2 in spoken)]
        ).astype(np.float32),
        scale=np.array([max(scale(s), s.distance or 0.0) for s in used], np.float32),
        share=np.array(
            [
                (0.5 if s.far else 0.15) / NUM_SALIENT * r
                for s, r in zip(used, reaches, strict=True)
            ],
            np.float32,
        ),
        anchors=np.concatenate(rarest or [nothing[0]]),
    )


def _is_rare(tokens: NDArray[np.int32], weights: NDArray[np.float32], city: Lexicon) -> bool:
    """Return whether at most `MAX_DISTANT` objects surely bear some of tokens (k,)."""
    certain = tokens[weights > KIND_WEIGHT]
    return bool(len(certain) and city.count_bearers(certain).sum() <= MAX_DISTANT)


def _are_quarters(rows: NDArray[np.int64], city: Lexicon) -> bool:
    """Return whether objects are quarters that a map draws as points, and people are "in"."""
    o = city.objects
    return len(rows) > 0 and all(o.kind[i] == POINT and o.label(i) in QUARTERS for i in rows)


def _find_objects(
    tokens: NDArray[np.int32], weights: NDArray[np.float32], city: Lexicon, *, most: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Find the objects of a mention and their weights; none where there are more than `most`."""
    tokens, weights = tokens[weights > KIND_WEIGHT], weights[weights > KIND_WEIGHT]
    sizes = city.count_bearers(tokens)
    if not 0 < sizes.sum() <= most:
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    bearers = city.bearers(tokens)
    found = np.concatenate(bearers)
    fits = np.repeat(weights, [len(rows) for rows in bearers]).astype(np.float32)
    order = np.lexsort((-fits, found))
    first = np.diff(found[order], prepend=-1) > 0
    return found[order][first], fits[order][first]
