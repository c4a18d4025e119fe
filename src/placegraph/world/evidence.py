"""Evidence of a text and a location prior for each scene of a world, before any frame is looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import CityEstimate, Evidence, SceneMode
from placegraph.core.geo import Anchor, EarthPose
from placegraph.core.geometry import Floats, LocalPlane
from placegraph.indoor.language.likeness import room_kind, table
from placegraph.indoor.language.score import of_scenes, score, score_statements
from placegraph.indoor.language.sentence import Kind, Mention, Sentence, Statement
from placegraph.indoor.map.floor import find_storeys
from placegraph.outdoor.language.description import SPEAKER, WITHIN
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.search.ask import NO, YES
from placegraph.world.estimate import BUILDING, ROOM
from placegraph.world.sentence import FloorStatement, ParsedSentence, compare_floors, parse_sentence
from placegraph.world.towns import MISSING_NAME

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate, SceneMode
    from placegraph.indoor.language.index import Columns
    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.map.scene import Scene
    from placegraph.world.estimate import WorldQuery
    from placegraph.world.towns import BuildingMatch, TownMatch
    from placegraph.world.world import World

FIT_UNANCHORED = 0.1
"""Fit of a scene without an anchor to a location prior, relative to a scene at its mean."""
WRONG_FIX_SHARE = 1e-3
"""Share of location priors that are far off."""
WRONG_ROOM_SHARE = 0.05
"""Share of people who are not in such a room as they say: "in the kitchen"."""
NAME_RATIO = 3.0
"""Log-likelihood ratio of a scene whose name, or whose building's, is in the text, or in an answer."""


@dataclass(frozen=True, eq=False)
class AnchorHypothesis:
    """One candidate of the place of a scene, or of a part of a merged scene."""

    anchor: Anchor
    corners: Floats
    """(4, 2) longitude, latitude [deg] of the part's bounds."""
    anywhere: EarthPose
    """Pose of somebody anywhere in the part, with its probability among all of the scene."""
    part: str
    """Name of the merged scene."""

    @classmethod
    def of_scene(cls, scene: Scene) -> tuple[AnchorHypothesis, ...]:
        """List the candidates of a scene, best first; none where the scene is not anchored."""
        found, share = [], 1.0 / len(scene.scenes)
        for part, box in zip(scene.scenes, scene.scene_bounds, strict=True):
            (x0, y0, z), (x1, y1, _) = box.tolist()
            corners = [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]
            found += [
                cls(a, a.to_earth(corners)[:, :2], a.pose_in_box(box, probability=share), part)
                for a in scene.anchors_of(part)
            ]
        return tuple(sorted(found, key=lambda s: -s.anywhere.probability))


def fit_prior(
    lonlats: Floats, covariances: Floats, lonlat: Sequence[float], radius: float
) -> Floats:
    """Score how well (K,), `WRONG_FIX_SHARE` to 1, places fit a location prior.

    `lonlats`, `covariances`: (K, 2) longitude, latitude [deg] of the places; (K, 3) east, both,
        north [m^2].
    `lonlat`, `radius`: of the prior: a Gaussian of which half lies within the radius [m].
    """
    there = (float(lonlat[0]), float(lonlat[1]))
    spread = (radius / 1.1774) ** 2
    wide = np.sqrt(spread + covariances[:, 0] + covariances[:, 2])
    # of a hundred thousand places, planes are laid only through those that may matter
    middle = np.cos(np.radians((lonlats[:, 1] + there[1]) / 2.0))
    aside = (lonlats[:, 0] - there[0] + 180.0) % 360.0 - 180.0
    away = 111_000.0 * np.hypot(aside * middle, lonlats[:, 1] - there[1])
    rows = np.flatnonzero(away < 15.0 * wide + 1000.0)
    out = np.full(len(lonlats), WRONG_FIX_SHARE)
    off = [LocalPlane(*own).to_plane(there) for own in lonlats[rows].tolist()]
    x, y = np.reshape(off, (-1, 2)).T
    east, both, north = covariances[rows].T
    east, north = east + spread, north + spread
    squares = (north * x * x - 2.0 * both * x * y + east * y * y) / (east * north - both * both)
    out[rows] += (1.0 - WRONG_FIX_SHARE) * np.exp(-0.5 * squares)
    return out


@dataclass(frozen=True, eq=False)
class IndoorMatch:
    """Statements about rooms, compared with all scenes."""

    library: SceneLibrary
    sentence: Sentence
    scenes: Mapping[str, float]
    """Log-likelihood ratio of each scene against their average."""
    rooms: Mapping[str, Mapping[str, float]]
    """Probability of each room of each scene, by name."""

    @classmethod
    def of_sentence(cls, library: SceneLibrary, sentence: Sentence) -> IndoorMatch:
        """Compare a sentence with the rooms of all scenes."""
        columns = library.texts.columns
        usual = columns if library.usual is None else library.usual
        totals = score_statements(sentence, columns, usual).sum(axis=0)
        best, _ = of_scenes(sentence, columns, totals)
        kinds = _score_room_kinds(sentence, columns)
        rooms: dict[str, dict[str, float]] = {}
        for row, name in enumerate(library.names):
            units = np.flatnonzero((columns.scene == row) & ~columns.is_scene)
            share = np.exp(totals[units] - totals[units].max()) * kinds[units]
            rooms[name] = {}
            names = [u.name for u in library.texts.units(row) if not u.is_scene]
            for room, p in zip(names, (share / share.sum()).tolist(), strict=True):
                rooms[name][room] = rooms[name].get(room, 0.0) + p
        return cls(library, sentence, dict(zip(library.names, best.tolist(), strict=True)), rooms)

    def explain(self, name: str) -> tuple[Evidence, ...]:
        """Compute the evidence of each statement for a scene."""
        signature = self.library.entry(name).signature
        rooms = [a.get("room", "") for a in signature.attributes]
        return score(
            self.sentence, signature.graph, rooms, self.library.texts, signature.attributes
        ).evidence


def _score_room_kinds(sentence: Sentence, columns: Columns) -> Floats:
    """Score how well units (U,) fit the kind of room that the speaker is in."""
    out = np.ones(len(columns.scene))
    for s in sentence.statements:
        named = sentence.mentions[s.mentions[0]].room
        if s.kind is Kind.ROOM and named and not s.negated:
            fits = np.minimum(columns.rooms[:, table().kinds.index(named)], 1.0)
            out *= WRONG_ROOM_SHARE + (1.0 - WRONG_ROOM_SHARE) * fits
    return out


def list_rooms(library: SceneLibrary, name: str) -> tuple[str, ...]:
    """List the names of a scene's rooms; one empty name where the scene has none."""
    units = library.texts.units(library.names.index(name))
    return tuple(dict.fromkeys(u.name for u in units if not u.is_scene))


@dataclass(frozen=True, eq=False)
class RemainingScenes:
    """Weight of the scenes in shards that were not proposed for a query."""

    count: int
    """Number of all scenes."""
    near: float
    """Sum over all scenes of how well they fit the location prior."""
    weight: float
    """Log weight of all scenes that are no candidates, by frames, text and prior."""
    modes: tuple[SceneMode, ...]
    """Candidates, with their share by frames among all scenes."""
    elsewhere: float
    """Probability of being in no scene, by frames."""
    stats: dict[str, Any]
    notes: tuple[str, ...]
    """Shards that are not searched, and maps that cannot be opened."""


@dataclass(frozen=True, eq=False)
class SceneEvidence:
    """Evidence for being in one scene."""

    name: str
    anchors: tuple[AnchorHypothesis, ...] = ()
    """Candidates of its place, likeliest first, given the text."""
    shares: Floats = field(default_factory=lambda: np.zeros(0))
    """(K,) probability of each."""
    outside: float = 0.0
    """Log-likelihood ratio of the statements about the outside, against anywhere."""
    inside: float = 0.0
    """The same of the inside."""
    near: float = 1.0
    """Fit of the scene to the location prior, 0 to 1."""
    is_meant: bool = False
    """Whether the text mentions the building, or the scene itself, by name or kind."""
    building_match: BuildingMatch | None = None
    """Score of its building in the city around, by statements about the outside."""
    answers: tuple[Evidence, ...] = ()
    """Answers to questions about its building."""
    floors: tuple[FloorStatement, ...] = ()
    above: int = 0
    """Storeys above the level of the anchor."""

    @property
    def ratio(self) -> float:
        """Log-likelihood ratio of the text."""
        return self.outside + self.inside

    @property
    def building(self) -> str:
        """Name of its building; empty where the name is not known."""
        return self.anchors[0].anchor.building if self.anchors else ""

    @property
    def where(self) -> str:
        """Building, else the scene, and floor."""
        level = self.anchors[0].anchor.level if self.anchors else ""
        return (self.building or self.name) + (f", floor {level}" if level else "")


@dataclass(frozen=True)
class OutdoorSearch:
    """A text, and what the towns find for its statements about the outside."""

    parsed: ParsedSentence | None = None
    towns: dict[str, TownMatch] = field(default_factory=dict)
    obstacle: str = ""
    """Sentence that says why no town can search for it."""


@dataclass(frozen=True, eq=False)
class WorldEvidence:
    """Evidence of a text and a location prior for all scenes and towns."""

    parsed: ParsedSentence | None
    towns: dict[str, TownMatch]
    inside: IndoorMatch | None
    scenes: dict[str, SceneEvidence]
    near: tuple[float, float] | None = None
    remaining: RemainingScenes | None = None
    obstacle: str = ""
    """Sentence that says why no town can search for the text."""

    @property
    def parts(self) -> dict[str, CityEstimate]:
        """Estimates of each town, by part."""
        return {name: part for town in self.towns.values() for name, part in town.parts.items()}

    @property
    def is_indoors(self) -> bool:
        """Whether the speaker seems to be inside a mapped scene."""
        return (
            self.inside is not None
            or any(w.is_meant for w in self.scenes.values())
            or (self.parsed is not None and bool(self.parsed.floors))
        )

    @property
    def total_near(self) -> float:
        """Number of scenes, each counted as far as it fits the location prior."""
        total = self.remaining.near if self.remaining else sum(w.near for w in self.scenes.values())
        return total if self.near is None else max(1.0, total)

    def prior(self, name: str) -> float:
        """Return the prior share of a scene among all; together at most 1."""
        return self.scenes[name].near / self.total_near

    def explain(self, name: str) -> tuple[Evidence, ...]:
        """Compute the evidence of each statement, and of the location prior, for a scene."""
        w = self.scenes[name]
        out: list[Evidence] = []
        if w.building_match is not None:
            out += w.building_match.evidence
        out += w.answers
        if self.inside is not None:
            out += self.inside.explain(name)
        if w.anchors:
            out += [floor.explain(w.anchors[0].anchor.level, w.above) for floor in w.floors]
        if self.near is not None and w.anchors:
            weight = float(np.log(w.near / 0.5))
            verdict = "for" if weight > 0 else "against"
            out.append(Evidence("the fix is near", verdict, weight))
        return tuple(out)


def match_outdoors(world: World, query: WorldQuery) -> OutdoorSearch:
    """Parse the text of a query, and search all towns for it; raises as `World.locate`."""
    if query.text is None:
        return OutdoorSearch()
    labels: tuple[str, ...] = ()
    if world.candidates is not None:
        labels, names = world.candidates.labels, world.candidates.find_names(query.spoken)
    else:
        anchors = (s for scene in world.scenes.values() for s in AnchorHypothesis.of_scene(scene))
        names = {*world.scenes, *(s.anchor.building for s in anchors)} - {""}
        if world.scenes:
            every: dict[str, None] = {}
            for entry in map(world.library.entry, world.library):
                every |= dict.fromkeys(entry.signature.graph.labels)
                every |= dict.fromkeys(entry.signature.rooms)
            labels = tuple(every)
    towns = world.towns
    parsed = parse_sentence(query.text, towns, labels, query.heading, names, query.language)
    query = replace(query, answers=query.answers_about(""))
    found: dict[str, TownMatch] = {}
    obstacles: dict[str, None] = {}
    for name, outside in parsed.outside.items():
        match = towns[name].match(outside, query)
        if isinstance(match, str):
            obstacles[match] = None
        else:
            found[name] = match
    names = {m.name for d in parsed.outside.values() for m in d.mentions if m.name}
    known = {t: {n for n in names if towns[t].words.name_index.find_rows(n)} for t in found}
    for town, match in found.items():
        missing = len(set().union(*known.values()) - known[town])
        found[town] = replace(match, missing=missing)
    return OutdoorSearch(parsed, found, " ".join(filter(None, obstacles)))


def collect_evidence(world: World, query: WorldQuery, text: OutdoorSearch) -> WorldEvidence:
    """Weigh all scenes and towns by all but the frames; raises as `World.locate`."""
    scenes = {name: AnchorHypothesis.of_scene(world.scenes[name]) for name in world.scenes}
    towns, inside = text.towns, None
    parsed = add_room_answers(text.parsed, query)
    if parsed is not None and parsed.inside is not None and scenes:
        inside = IndoorMatch.of_sentence(world.library, parsed.inside)
    floors = parsed.floors if parsed else ()
    above = {n: len(find_storeys(world.scenes[n], 0)) - 1 if floors else 0 for n in scenes}
    spoken = f" {' '.join(tokens(query.text or ''))} "
    denied = [f" {' '.join(tokens(name))} " for name in _find_denied(parsed)]
    if " not in " in spoken:  # no grammar knows the names of maps
        names = {n for s, all_ in scenes.items() for n in (s, *(a.anchor.building for a in all_))}
        named = {f" {' '.join(tokens(name))} " for name in names if name}
        denied += sorted(n for n in named if f" not in{n}" in spoken and n not in denied)
    for name in denied:
        spoken = spoken.replace(name, " | ")
    every = [s for anchors in scenes.values() for s in anchors]
    buildings: list[BuildingMatch | None] = [None] * len(every)
    for town in towns.values():
        left = [k for k, match in enumerate(buildings) if match is None]
        for k, match in zip(
            left, town.match_buildings([every[k].corners for k in left]), strict=True
        ):
            buildings[k] = match and match.add_ratio(MISSING_NAME * town.missing)
    rest = iter(buildings)
    scorer = _SceneScorer(query, floors, inside, spoken, "|".join(denied))
    found = {n: scorer.score(n, s, [next(rest) for _ in s], above[n]) for n, s in scenes.items()}
    near = None if query.near is None else (float(query.near[0]), float(query.near[1]))
    return WorldEvidence(parsed, towns, inside, found, near, world.remaining, text.obstacle)


@dataclass(frozen=True, eq=False)
class _SceneScorer:
    """Statements that weigh single scenes."""

    query: WorldQuery
    floors: tuple[FloorStatement, ...]
    inside: IndoorMatch | None
    spoken: str
    """All words of the text, but for denied names."""
    denied: str
    """Names of places that the speaker is not in."""

    def score(
        self, name: str, anchors: tuple[AnchorHypothesis, ...],
        buildings: Sequence[BuildingMatch | None], above: int,
    ) -> SceneEvidence:  # fmt: skip
        """Weigh one scene, and the candidates of its place."""
        names = {name, *(s.anchor.building for s in anchors)}
        is_named = any(_contains_name(self.spoken, n) for n in names)
        penalty = NAME_RATIO * any(_contains_name(self.denied, n) for n in names)
        answers = tuple(
            Evidence(f"{a.question.text} {a.option}", "for" if a.option == YES else "against",
                     NAME_RATIO if a.option == YES else -NAME_RATIO)
            for a in self.query.answers_about(BUILDING) if a.question.subjects[0].words in names
        )  # fmt: skip
        answered = sum(e.weight for e in answers)
        inside = self.inside.scenes[name] if self.inside else 0.0
        near = self.query.near
        if not anchors:
            fits = 1.0 if near is None else FIT_UNANCHORED
            ratio = NAME_RATIO * is_named - penalty + answered
            is_meant = is_named or answered > 0.0
            return SceneEvidence(
                name, outside=ratio, inside=inside, near=fits, is_meant=is_meant, answers=answers
            )
        priors = np.array([s.anywhere.probability for s in anchors])
        ratios = np.array([b.score.ratio if b else 0.0 for b in buildings])
        ratios += [compare_floors(self.floors, s.anchor.level, above) for s in anchors]
        nears = np.ones(len(anchors))
        if near is not None:
            poses = [s.anywhere for s in anchors]
            places = np.array([(pose.longitude, pose.latitude) for pose in poses])
            spreads = np.array([pose.covariance[[0, 0, 1], [0, 1, 1]] for pose in poses])
            nears = fit_prior(places, spreads, near, self.query.radius)
        logs = np.log(priors) + ratios + np.log(nears)
        shares = np.exp(logs - logs.max())
        shares /= shares.sum()
        order = np.argsort(-shares, kind="stable")
        best = buildings[int(order[0])]
        unknown = max(0.0, 1.0 - float(priors.sum()))
        outside = float(np.log(priors @ np.exp(ratios) + unknown))
        return SceneEvidence(
            name, tuple(anchors[i] for i in order), shares[order],
            outside + NAME_RATIO * (is_named and best is None) - penalty + answered, inside,
            float(priors @ nears + unknown * FIT_UNANCHORED),
            is_named or answered > 0.0 or any(b is not None and b.score.is_meant for b in buildings),
            best, answers, self.floors, above,
        )  # fmt: skip


def add_room_answers(parsed: ParsedSentence | None, query: WorldQuery) -> ParsedSentence | None:
    """Return a parsed text with the answers about rooms as statements."""
    if not (answers := query.answers_about(ROOM)):
        return parsed
    parsed = parsed or ParsedSentence("", {}, None)
    sentence = parsed.inside or Sentence(query.text or "")
    for answer in answers:
        name = answer.question.subjects[0].words
        room = Mention(f"the {name}", name, room=room_kind(name))
        text = f"{answer.question.text} {answer.option}"
        row = (len(sentence.mentions),)
        added = Statement(Kind.ROOM, row, negated=answer.option == NO, text=text)
        sentence = replace(
            sentence,
            mentions=(*sentence.mentions, room), statements=(*sentence.statements, added),
        )  # fmt: skip
    return replace(parsed, inside=sentence)


def _find_denied(parsed: ParsedSentence | None) -> tuple[str, ...]:
    """Find names of places that the speaker is not in: "I am not in the Grand Hotel"."""
    outside = parsed.outside.values() if parsed else ()
    return tuple(dict.fromkeys(
        d.mentions[s.target].name
        for d in outside for s in d.statements
        if d.mentions[s.target].name and s.negated and s.source == SPEAKER
        and s.relation in WITHIN
    ))  # fmt: skip


def _contains_name(text: str, name: str) -> bool:
    words = " ".join(tokens(name))
    return len(words) > 3 and f" {words} " in text
