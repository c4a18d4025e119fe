"""Log prior over the positions and headings of a map: where a sentence says that somebody is.

Each statement s of a pose x is read as in the outdoor wing,

    P(s | x) / P(s) = (1 - WRONG) fit(s, x) / mean of fit over all poses + WRONG

so that what is true of few poses tells more, and a statement that is wrong costs its logarithm and no
more. The fits are soft, and are read off the panoramas of the visibility table: whether a thing is in
sight from a position, how near its surface comes, and in which direction. Of several things of a
name the one that fits best counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.estimate import Evidence, ObjectRef
from placegraph.indoor.language.appearance import COLUMNS, describe_objects, ratios, with_colours
from placegraph.indoor.language.index import triples
from placegraph.indoor.language.likeness import (
    EXACT,
    Floats,
    Floats32,
    kind_by_name,
    kinds_of,
    likenesses,
    match_labels,
    table,
)
from placegraph.indoor.language.score import TOLD, sayings
from placegraph.indoor.language.sentence import Kind, Sentence, Statement
from placegraph.indoor.language.sight_kernels import (
    dilate_profile,
    look_around_for,
    look_for,
    vote_rooms,
)
from placegraph.indoor.likelihood.visibility import VisibilityTable
from placegraph.indoor.map.free_space import MAX_ELEVATION, decode_ranges
from placegraph.indoor.map.map_kernels import AZIMUTHS, ELEVATIONS, STEP
from placegraph.indoor.map.scene import Scene, make_object_ref
from placegraph.language.text import IgnoredText

WRONG = 0.15
"""Share of statements that are wrong, or about another thing of that name."""
NEAR = {
    "": (1.2, 0.3),
    "on": (0.5, 0.15),
    "in": (0.5, 0.15),
    "in front of": (2.0, 0.4),
    "opposite": (3.0, 0.6),
}
"""Distance to a thing's surface up to which one is near it, and how softly that ends [m]."""
DISTANT = (2.5, 0.5)
"""Distance below which a thing is not far, and how softly [m]."""
SPOKEN = 6.0
"""Distance from which a thing is spoken of less than half as often [m]."""
AHEAD, ASIDE, IN_PICTURE = (np.deg2rad(20.0), np.deg2rad(40.0), np.deg2rad(32.0))
"""Half widths of "facing it", of "on my left" and of what is seen in the picture [rad]."""
_NOWHERE = 1e-6
"""Mean fit of a statement that is true of no pose."""
_KIN_TOO = 0.3
"""Fit of kin where the thing itself is there."""
_UNRELATED = 0.2
"""Fit of a thing that does not lie as was said: maps do not know all relations."""
_UNLIKE = 0.2
"""Least fit of a thing that looks otherwise than was said."""
_NO_ROOM = 0.1
"""A map has no such room where none is one with more than this probability."""
_EDGE = np.deg2rad(5.0)  # how softly directions end
_OPPOSITE = np.deg2rad(125.0)  # two things lie on both sides of somebody from this angle on
_BESIDE = np.deg2rad(4.0)  # what is left of a thing is so by this angle
_APART = 4.0  # things that somebody is between are as far apart [m]
_PAIRS = 64  # of things, the likeliest
_BELOW = 0.5  # how well a thing fits that may stand at one's feet, where no panorama looks
_AROUND = 3.5  # what is farther is not what makes a place a kitchen [m]
_LEANS = 2.0  # what is this near counts for a room more than what is twice as far [m]


def prior(sentence: Sentence, scene: Scene, table: VisibilityTable) -> Floats32:
    """Return a log prior (K, A) float32 over the table's positions and headings a * STEP [nat].

    Against the uniform: its exponential has the mean 1 for each statement, so it can be added
    to what images say. Zero where nothing was said that the map could serve (`find_unused`).
    """
    total = np.zeros((len(table), AZIMUTHS), np.float32)
    for _, ratio in _ratios(sentence, scene, table):
        if ratio is not None:
            total += ratio
    return total


def find_unused(sentence: Sentence, scene: Scene) -> tuple[IgnoredText, ...]:
    """Return the statements that say nothing on this map, with reasons."""
    things = Referents(sentence, scene)
    reasons = [(s, things.explain_missing(s)) for s in sentence.statements]
    return tuple(IgnoredText(s.text, reason) for s, reason in reasons if reason)


def evidence(
    sentence: Sentence, scene: Scene, table: VisibilityTable, pose: ArrayLike
) -> tuple[Evidence, ...]:
    """Return the agreement of each statement with a pose (4,) x, y, z [m], yaw [rad] on a map."""
    if not len(table):
        return ()
    pose = np.asarray(pose, np.float64)
    row = int(np.square(table.positions - pose[:3]).sum(axis=1).argmin())
    heading = int(np.round(pose[3] / STEP)) % AZIMUTHS
    things = Referents(sentence, scene)
    out = []
    for s, ratio in _ratios(sentence, scene, table):
        if ratio is None:
            out.append(Evidence(s.text, "silent", 0.0, note=things.explain_missing(s)))
            continue
        weight = float(ratio[row, heading % ratio.shape[1]])
        verdict = "for" if weight > TOLD else "against" if weight < -TOLD else "silent"
        # the most probable objects, at most one of each thing
        rows = [int(things.weights[t].argmax()) for t in s.mentions if things.weights[t].any()]
        served: tuple[ObjectRef, ...] = tuple([make_object_ref(scene, r) for r in rows])
        out.append(Evidence(s.text, verdict, weight, served))
    return tuple(out)


def _ratios(
    sentence: Sentence, scene: Scene, table: VisibilityTable
) -> list[tuple[Statement, Floats32 | None]]:
    """Return the log-likelihood ratio (K, A) or (K, 1) of each statement; None where it is silent."""
    found: list[tuple[Statement, Floats32 | None]] = [(s, None) for s in sentence.statements]
    things = Referents(sentence, scene)
    useful = [
        i for i, s in enumerate(sentence.statements) if len(table) and not things.explain_missing(s)
    ]
    if not useful:
        return found
    fits_of = PoseFits(things, table)
    for i in useful:
        s = sentence.statements[i]
        fit = fits_of.fit(s)
        mean = float(fit.mean(dtype=np.float64))
        if mean >= _NOWHERE:
            wrong = 1.0 - (1.0 - WRONG) * s.certainty
            found[i] = s, np.log(fit * np.float32((1.0 - wrong) / mean) + np.float32(wrong))
    return found


@dataclass(frozen=True, eq=False)
class Referents:
    """Objects that the things of a sentence may be, on a map of N of them."""

    sentence: Sentence
    scene: Scene

    @cached_property
    def weights(self) -> list[Floats32]:
        """Fit (N,) of the objects to each mention, narrowed by the statements of two things."""
        labels = list(dict.fromkeys(self.scene.graph.labels))
        row = np.array([labels.index(label) for label in self.scene.graph.labels])
        out = []
        for mention in self.sentence.mentions:
            own = match_labels(mention.label, labels)[row]
            exact = own >= EXACT
            out.append(np.where(exact, own, _KIN_TOO * own) if exact.any() else own)
        for i, mention in enumerate(self.sentence.mentions):
            if mention.room and not (out[i] >= EXACT).any():
                out[i] = self._in_room(mention.room)
            elif mention.attributes:
                out[i] = self._looking(mention.attributes, out[i])
        for s in self.sentence.statements:
            if s.kind is Kind.RELATED and not s.negated:
                self._narrow(s, out)
        return out

    def _looking(self, attributes: tuple[str, ...], weights: Floats32) -> Floats32:
        """Return weights (N,) of things that look as was said: the red one of two chairs."""
        spoken = weights > 0.0
        if not spoken.any():
            return weights
        ratio = ratios(attributes, self._appearance, self._appearance, weights.astype(np.float64))
        ratio /= ratio[spoken].max()
        return (weights * np.maximum(ratio, _UNLIKE)).astype(np.float32)

    @cached_property
    def _appearance(self) -> Floats:
        """(N, C) what the objects look like, and where in their rooms they stand."""
        out = np.empty((len(self.scene), len(COLUMNS)))
        attributes = with_colours(self.scene)
        of = self.rooms[0]
        for room in np.unique(of):
            rows = np.flatnonzero(of == room)
            out[rows] = describe_objects(self.scene.graph, rows.tolist(), attributes)
        return out

    def _narrow(self, s: Statement, weights: list[Floats32]) -> None:
        """Weaken objects that do not lie as a statement of two things says."""
        a, b = s.mentions
        pairs = self.pairs(s.relation, weights[a], weights[b])
        for mention, rows in ((a, pairs[:, 0]), (b, pairs[:, 1])):
            if len(rows):
                there = np.zeros(len(weights[mention]), np.bool_)
                there[rows] = True
                weights[mention] = np.where(
                    there, weights[mention], _UNRELATED * weights[mention]
                ).astype(np.float32)

    def pairs(self, relation: str, first: Floats32, second: Floats32) -> NDArray[np.int64]:
        """Return objects (P, 2) that may be the two things, where edges of the map say the relation."""
        straight, other_way = sayings(relation)
        found = set()
        for s, name, t in triples(self.scene.graph):
            if name in straight and first[s] > 0 and second[t] > 0:
                found.add((s, t))
            if name in other_way and first[t] > 0 and second[s] > 0:
                found.add((t, s))
        return np.array(sorted(found), np.int64).reshape(-1, 2)

    # rooms
    @cached_property
    def rooms(self) -> tuple[NDArray[np.int32], list[str], Floats]:
        """Room (N,) of each object, -1 none; names of the G rooms; their kinds (G, R)."""
        named = [
            f"{scene} {room}" if (room := a.get("room", "")) else ""
            for scene, a in zip(self.scene.scene_of.tolist(), self.scene.attributes, strict=True)
        ]
        names = list(dict.fromkeys(name for name in named if name))
        number = {name: i for i, name in enumerate(names)}
        of = np.array([number.get(name, -1) for name in named], np.int32)
        held = np.zeros((len(names), self.room_clues.shape[1]), np.float32)
        np.maximum.at(held, of[of >= 0], self.room_clues[of >= 0])
        kinds = kinds_of(held, np.False_)
        names = [name.partition(" ")[2] for name in names]
        for row, name in enumerate(names):
            kinds[row] = kind_by_name(name, kinds[row])
        return of, names, kinds

    @cached_property
    def room_clues(self) -> Floats32:
        """(N, T) how well objects are the things by which rooms are told (`likeness.table`)."""
        labels = list(dict.fromkeys(self.scene.graph.labels))
        row = [labels.index(label) for label in self.scene.graph.labels]
        return likenesses(labels)[row]

    def _in_room(self, kind: str) -> Floats32:
        """Return the weight (N,) of objects as evidence of a room of a kind: they are in it."""
        of, _, kinds = self.rooms
        share = np.append(kinds[:, table().kinds.index(kind)], 0.0)
        return np.where(share > _NO_ROOM, share, 0.0)[of].astype(np.float32)

    def explain_missing(self, s: Statement) -> str:
        """Return why a statement says nothing on this map, or an empty string."""
        if s.kind is Kind.ROOM:
            mention = self.sentence.mentions[s.mentions[0]]
            if not mention.room:
                return "does not say where you are"
            kinds = self.rooms[2]
            if not len(kinds):
                return "the map has no rooms"
            if kinds[:, table().kinds.index(mention.room)].max() <= _NO_ROOM:
                return f"the map has no {mention.label}"
            return ""
        for t in s.mentions:
            if not self.weights[t].any():
                return f"the map has no {self.sentence.mentions[t].label}"
        if s.kind is Kind.RELATED and s.negated:
            return "does not say where you are"
        return ""


class PoseFits:
    """Fits of statements at the K positions and A headings of a table.

    `referents`: objects that are spoken of.
    `views`: panoramas at the positions.
    """

    def __init__(self, referents: Referents, views: VisibilityTable) -> None:
        self._referents, self._views = referents, views
        spoken = [weights > 0 for weights in referents.weights]
        self._rows = np.flatnonzero(np.any(spoken, axis=0))

    @cached_property
    def _nearest_views(self) -> tuple[Floats32, NDArray[np.int16], NDArray[np.bool_]]:
        """Distance (J, K) at which each object is seen, azimuth bin, and whether the panorama cuts it off."""
        slot = np.full(len(self._referents.scene) + 1, -1, np.int32)
        slot[self._rows] = np.arange(len(self._rows))
        pano = self._views.panoramas
        near, at, cut = look_for(pano.objects, pano.ranges, slot, _LEVEL, len(self._rows))
        return near, at, cut

    @property
    def _near(self) -> Floats32:
        return self._nearest_views[0]

    def fit(self, s: Statement) -> Floats32:
        """Return the agreement (K, A), or (K, 1) of all headings, with a statement; in [0, 1]."""
        match s.kind:
            case Kind.TOWARDS:
                fit = self._towards(s)
            case Kind.ROOM:
                fit = self._room(s)
            case Kind.NEAR:
                fit = self._close(s.mentions[0], NEAR.get(s.relation, NEAR[""]), s.distance)
            case Kind.FAR:
                fit = 1.0 - self._close(s.mentions[0], DISTANT, None)
            case Kind.BETWEEN:
                fit = self._between(*s.mentions)
            case Kind.RELATED:
                fit = self._related(s)
            case _:
                fit = self._presence(s.mentions[0])
        fit = np.asarray(1.0 - fit if s.negated else fit, np.float32)
        return fit if fit.ndim == 2 else fit[:, None]

    # one thing
    def _weights(self, t: int) -> Floats32:
        """Return the agreement (J,) of mapped objects with the mention."""
        return self._referents.weights[t][self._rows]

    def _in_sight(self, t: int) -> Floats32:
        """Return the agreement (K,) of an object in sight with the mention, times its weight."""
        return np.asarray((self._weights(t)[:, None] * self._readily).max(axis=0), np.float32)

    @cached_property
    def _readily(self) -> Floats32:
        """Chance (J, K) that objects are mentioned: 0 for those out of sight."""
        return np.asarray(1.0 / (1.0 + np.square(self._near / SPOKEN)), np.float32)

    def _presence(self, t: int) -> Floats32:
        mention = self._referents.sentence.mentions[t]
        least = mention.count or (2 if mention.several else 1)
        seen = self._in_sight(t)
        if mention.negated:
            exact = self._near[self._weights(t) >= EXACT]
            return np.asarray(np.isfinite(exact).any(axis=0), np.float32)
        if least == 1:
            return seen
        count = np.isfinite(self._near[self._weights(t) > 0]).sum(axis=0)
        return np.asarray(seen * np.minimum(count / least, 1.0), np.float32)

    @cached_property
    def _distance(self) -> tuple[Floats32, Floats32]:
        """Distance (J, K) of things [m], and how surely it is that: they go on below the panorama.

        The bottom row of the panoramas shows what is nearer only in part; the box says the rest.
        """
        graph = self._referents.scene.graph
        half = graph.extents[self._rows, None, :2] / 2.0 if graph.extents is not None else 0.0
        away = np.abs(self._views.positions[None, :, :2] - graph.positions[self._rows, None, :2])
        box = np.linalg.norm(np.maximum(away - half, 0.0), axis=2).astype(np.float32)
        unseen = ~np.isfinite(self._near)
        sure = np.where(unseen, np.float32(_BELOW), np.float32(1.0))
        below = unseen & (box < 1.0)
        return np.where(
            self._nearest_views[2] | below, np.minimum(box, self._near), self._near
        ), sure

    def _close(self, t: int, edge: tuple[float, float], stated: float | None) -> Floats32:
        distance, sure = self._distance
        if stated is None:
            with np.errstate(over="ignore"):
                close = 1.0 / (1.0 + np.exp((distance - edge[0]) / edge[1]))
        else:
            close = np.exp(-0.5 * np.square((distance - stated) / (0.25 * stated + 0.3)))
        return np.asarray((self._weights(t)[:, None] * sure * close).max(axis=0), np.float32)

    def _towards(self, s: Statement) -> Floats32:
        weight = np.append(self._referents.weights[s.mentions[0]], 0.0).astype(np.float32)
        if s.distance is None:
            fit = 1.0 / (1.0 + np.square(_LEVEL / SPOKEN))
        else:
            fit = np.exp(-0.5 * np.square((_LEVEL - s.distance) / (0.25 * s.distance + 0.3)))
        half = IN_PICTURE if s.wide else AHEAD if s.bearing == 0.0 else ASIDE
        bins = np.arange(-int((half + 3 * _EDGE) / STEP), int((half + 3 * _EDGE) / STEP) + 1)
        window = 1.0 / (1.0 + np.exp((np.abs(bins) * STEP - half) / _EDGE))
        pano = self._views.panoramas
        profile = look_around_for(pano.objects, pano.ranges, weight, fit.astype(np.float32))
        return np.asarray(
            dilate_profile(profile, round(s.bearing / STEP), window.astype(np.float32))
        )

    # two things
    def _pairs(self, a: int, b: int) -> NDArray[np.int64]:
        """Return slots (P, 2) of the likeliest pairs of two things."""
        both = np.outer(self._weights(a), self._weights(b))
        np.fill_diagonal(both, 0.0)
        best = np.argsort(-both, axis=None, kind="stable")[:_PAIRS]
        best = best[both.flat[best] > 0.0]
        return np.stack(np.unravel_index(best, both.shape), axis=1)

    def _angle(self, pairs: NDArray[np.int64]) -> Floats:
        """Return the angle (P, K) from the second to the first thing of pairs, to the left [rad, +-pi]."""
        at = self._nearest_views[1]
        turn = (at[pairs[:, 0]] - at[pairs[:, 1]]) * STEP
        return np.asarray((turn + np.pi) % (2.0 * np.pi) - np.pi)

    def _best(
        self, a: int, b: int, pairs: NDArray[np.int64], fit: NDArray[np.floating]
    ) -> Floats32:
        weight = self._weights(a)[pairs[:, 0]] * self._weights(b)[pairs[:, 1]]
        fit = fit * self._readily[pairs].prod(axis=1)
        best = (weight[:, None] * np.nan_to_num(fit)).max(axis=0, initial=0.0)
        return np.broadcast_to(best, self._near.shape[1]).astype(np.float32)

    def _between(self, a: int, b: int) -> Floats32:
        pairs = self._pairs(a, b)
        apart = np.abs(self._angle(pairs))
        near = self._distance[0][pairs].sum(axis=1)
        fit = np.exp(-np.square(near / _APART)) / (1.0 + np.exp((_OPPOSITE - apart) / 0.25))
        return self._best(a, b, pairs, fit)

    def _related(self, s: Statement) -> Floats32:
        """Return the agreement (K,) with an object beside another, or with both in sight."""
        a, b = s.mentions
        if s.relation not in ("left of", "right of", "in front of", "behind"):
            return np.minimum(self._presence(a), self._in_sight(b))
        pairs = self._pairs(a, b)
        left = self._angle(pairs)
        if s.relation in ("left of", "right of"):
            left = left if s.relation == "left of" else -left
            fit = np.where(left > _BESIDE, np.exp(-np.square(left / 1.0)), 0.0)
        else:
            with np.errstate(invalid="ignore"):
                nearer = self._near[pairs[:, 1]] - self._near[pairs[:, 0]]
            nearer = nearer if s.relation == "in front of" else -nearer
            fit = np.where(nearer > 0.0, np.exp(-np.square(left / 0.5)), 0.0)
        return self._best(a, b, pairs, fit)

    # rooms
    def _room(self, s: Statement) -> Floats32:
        """Return the probability (K,) of a room of a kind at a position: by its room, and by objects near."""
        of, names, kinds = self._referents.rooms
        kind = table().kinds.index(self._referents.sentence.mentions[s.mentions[0]].room)
        share = vote_rooms(*self._thinned, np.append(of, np.int32(-1)), _LEANING, len(names))
        chance = share @ kinds[:, kind].astype(np.float32)
        if all(name.isdigit() for name in names):  # numbers, as `rooms_of` gives them
            chance = (chance + self._place[:, kind]) / 2.0
        return np.asarray(chance, np.float32)

    @property
    def _thinned(self) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Objects and ranges of every sixth direction: enough for what is all around."""
        pano = self._views.panoramas
        return pano.objects[:, 1::3, ::2], pano.ranges[:, 1::3, ::2]

    @cached_property
    def _place(self) -> Floats:
        """Probability (K, R) that a position is in each kind of room, by the objects in sight near it."""
        room_clues = self._referents.room_clues
        rows = np.flatnonzero(room_clues.any(axis=1))
        slot = np.full(len(room_clues) + 1, -1, np.int32)
        slot[rows] = np.arange(len(rows))
        near = look_for(*self._thinned, slot, _LEVEL[1::3], len(rows))[0] < _AROUND
        held = np.zeros((near.shape[1], room_clues.shape[1]), np.float32)
        for j, t in zip(*np.nonzero(room_clues[rows]), strict=True):
            np.maximum(held[:, t], room_clues[rows[j], t] * near[j], out=held[:, t])
        return kinds_of(held, np.False_)


_RANGES = decode_ranges(np.arange(256, dtype=np.uint8))
_LEANING = np.exp(-_RANGES / np.float32(_LEANS))
"""Weight (256,) of what is seen at each stored range, for the room that one is in."""
_ELEVATION = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * 2.0 - 1.0) * MAX_ELEVATION
_LEVEL = np.asarray(_RANGES * np.cos(_ELEVATION)[:, None], np.float32)
"""Horizontal distance (E, 256) of stored ranges [m]."""
