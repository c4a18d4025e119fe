"""Candidate scenes: of a world with more scenes than can be opened, those that a question may be about.

The text, the frames and a location prior weigh all scenes of all shards by their columns. Maps are
opened of scenes that the text names and, where somebody may be indoors, of the likeliest ones and of those
that stand at a town's best places. What the other scenes hold of the probability is `RemainingScenes`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import LocalPlane
from placegraph.errors import MapError, PlacegraphError
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.library.search import SearchOptions, infer_from_frames
from placegraph.outdoor.language.words import tokens
from placegraph.world.evidence import FIT_UNANCHORED, OutdoorSearch, RemainingScenes, fit_prior
from placegraph.world.world import World
from placegraph_scale.library.shards import SceneShards, Shard
from placegraph_scale.library.write import NamedEntry, pack_shard

if TYPE_CHECKING:
    from placegraph.indoor.library.library import Entry
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.world.estimate import WorldQuery


LIKELIEST, NAMED, BESIDE = 16, 8, 8
"""Candidates by all evidence, by their names, and by the best places of towns."""
AROUND = 150.0
"""Distance of candidates from a town's best place [m]."""
LONGEST = 6
"""Words of the longest name that is looked for in a text."""


@dataclass(frozen=True, eq=False)
class CandidateScenes(SceneShards):
    """All scenes of a world: those of shards, and of maps beside them as one shard more, the first."""

    library: SceneLibrary = field(default_factory=SceneLibrary)
    """Library of the maps beside the shards."""

    @classmethod
    def of(cls, shards: Iterable[SceneShards], library: SceneLibrary) -> CandidateScenes:
        """Join shards and a library; raises `MapError` where their encoders differ."""
        every = list(shards)
        first = every[0]
        keys = [e.key for e in first.encoders]
        made = [(str(s), s.encoders) for s in every]
        made += [(str(library), library.encoders)] if len(library) else []
        for name, encoders in made:
            if [e.key for e in encoders] != keys:
                raise MapError(
                    f"{name} and {first} were made by different encoders; use the same "
                    "encoders for both."
                )
        found = [shard for s in every for shard in s.shards]
        if len(library):
            listed = [NamedEntry(name, library.entry(name)) for name in library]
            found.insert(0, Shard(*pack_shard(listed, keys), first.background))
        return cls(
            first.encoders, first.background, tuple(found), first.beside,
            sum(s.missing for s in every), tuple(note for s in every for note in s.notes),
            library=library,
        )  # fmt: skip

    def _entry(self, row: int) -> tuple[Entry, SceneMap]:
        if row >= len(self.library):
            return super()._entry(row)
        return self.library.entry(self.name(row)), self.library.scene(self.name(row))

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Labels of all objects, and names of their rooms."""
        every = (x for s in self.shards for x in (*s.meta["labels"], *s.meta["rooms"]))
        return tuple(dict.fromkeys(map(str, every)))

    @cached_property
    def called(self) -> dict[str, list[int]]:
        """Rows by the words of a scene's name, or of its building's."""
        out: dict[str, list[int]] = {}
        for first, shard in zip(self.starts.tolist(), self.shards, strict=False):
            pairs = zip(shard.strings("names"), shard.strings("buildings"), strict=True)
            for row, (name, buildings) in enumerate(pairs, first):
                for called in {name, *buildings.split("\n")}:
                    out.setdefault(" ".join(tokens(called)), []).append(row)
        return out

    def find_named(self, text: str | None) -> list[int]:
        """Return the rows of scenes whose name, or whose building's, stands in a text."""
        words = tokens(text or "")
        parts = {
            " ".join(words[i : i + n]) for n in range(1, LONGEST + 1) for i in range(len(words))
        }
        return sorted({row for part in parts for row in self.called.get(part, ()) if part})

    def find_names(self, text: str) -> set[str]:
        """Return the names of scenes and buildings that a text mentions."""
        names = {""}
        for row in self.find_named(text):
            names |= {self._string(row, "names"), *self._string(row, "buildings").split("\n")}
        return names - {""}

    @cached_property
    def stands(self) -> NDArray[np.float64]:
        """(K, 7) row of the scene, and the columns `stands` of a shard, of each anchor hypothesis."""
        rows = [
            np.column_stack([np.repeat(np.arange(len(s)), np.diff(s.arrays["stand_starts"])) + first,
                             s.arrays["stands"]])
            for first, s in zip(self.starts.tolist(), self.shards, strict=False)
        ]  # fmt: skip
        return np.concatenate(rows)

    def fit_prior(self, query: WorldQuery) -> NDArray[np.float64]:
        """Return `SceneEvidence.near` (n,) of scenes: agreement with the location prior, 0 to 1."""
        rows, priors = self.stands[:, 0].astype(np.int64), self.stands[:, 6]
        stand = np.bincount(rows, priors, len(self))
        held = stand
        if query.near is not None:
            fits = fit_prior(self.stands[:, 1:3], self.stands[:, 3:6], query.near, query.radius)
            held = np.bincount(rows, priors * fits, len(self))
        out = held + np.maximum(0.0, 1.0 - stand) * FIT_UNANCHORED
        return np.asarray(out if query.near is not None else np.where(stand > 0.0, out, 1.0))

    def find_beside(self, places: Sequence[tuple[float, float]]) -> list[int]:
        """Return rows of the scenes that stand near places (longitude, latitude), nearest first."""
        away: dict[int, float] = {}
        for place in places:
            off = np.linalg.norm(LocalPlane(*place).to_plane(self.stands[:, 1:3]), axis=1)
            for k in np.flatnonzero(off < AROUND).tolist():
                row = int(self.stands[k, 0])
                away[row] = min(away.get(row, np.inf), float(off[k]))
        return sorted(away, key=lambda row: away[row])

    def select(self, world: World, query: WorldQuery, text: OutdoorSearch) -> World:
        """Return a world of the scenes that a question may be about."""
        near = self.fit_prior(query)
        inside = text.parsed.inside if text.parsed else None
        weights = np.log(near) + (0.0 if inside is None else self.score_text(inside))
        weighed, missing = None, self.missing * (1.0 if query.near is None else FIT_UNANCHORED)
        if query.capture is not None:
            weighed = infer_from_frames(self, query.capture, query.frames, SearchOptions())
            weights += np.log(weighed.shares + 1e-12)
            missing = 0.0  # `weighed.elsewhere` holds them
        places, likely = [], np.zeros(0, np.int64)
        if text.parsed is None or query.capture is not None or text.parsed.indoors:
            places = [
                (m.longitude, m.latitude) for t in text.towns.values() for m in t.estimate.modes
            ]
            likely = np.argsort(-weights, kind="stable")[:LIKELIEST]
        named = sorted(self.find_named(query.spoken), key=lambda row: -weights[row])[:NAMED]
        names: dict[int, str] = {}
        notes = list(self.notes)
        for row in sorted({*likely.tolist(), *named, *self.find_beside(places)[:BESIDE]}):
            try:
                self.open_map(row)
            except PlacegraphError as error:
                notes.append(str(error))
            else:
                name = self.name(row)
                names[row] = name if name not in names.values() else f"{name} (scene {row})"
        rest = np.append(np.delete(weights, list(names)), np.log(missing) if missing else -np.inf)
        out = World(world.cities, planets=world.planets, ignored=world.ignored)
        out.library = self.open_scenes(list(names), list(names.values()))
        out.scenes = {name: out.library.scene(name) for name in names.values()}
        modes = () if weighed is None else tuple(
            replace(weighed.mode(self, row), scene=name) for row, name in names.items()
        )  # fmt: skip
        out.remaining = RemainingScenes(
            len(self), float(near.sum()) + missing, float(np.logaddexp.reduce(rest)), modes,
            weighed.elsewhere if weighed else 0.0, {"seconds": weighed.seconds if weighed else {}},
            tuple(notes),
        )  # fmt: skip
        return out
