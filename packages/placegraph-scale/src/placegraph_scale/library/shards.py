"""A library too large to be read: shards that are mapped, and few scenes looked at closely.

An inverted index over labels and relations ranks all scenes by a text; what the labels of frames say
is summed over all scenes, and their looks over the mean vector of each. The best by either are
then compared with the frames in every direction, beside the same homes that no library has.
"""

from __future__ import annotations

import itertools
import json
import os
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.files import real_path
from placegraph.core.geo import EarthPose
from placegraph.core.mapfile import read_map, sound
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.indoor.encode import Encoder
from placegraph.indoor.language import Sentence, score
from placegraph.indoor.language.score import compared, of_scenes
from placegraph.indoor.library.answer import evidence
from placegraph.indoor.library.library import Asked, SceneLibrary, encoders_of
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.query import Query
from placegraph.indoor.library.scenes import Entry, digest_of
from placegraph.indoor.library.search import Scores, scores
from placegraph.indoor.scene_map import SceneMap
from placegraph_scale.library.shard import (
    BESIDE,
    HEAD,
    KIND,
    MEND,
    VERSION,
    Shard,
    Usual,
    together,
)
from placegraph_scale.library.shard_check import check_usual

_OPEN = 64
"""Maps kept open."""


@dataclass(frozen=True, eq=False)
class SceneShards(Asked):
    """Scenes in shards, asked as a library is; `shard_write.write_shards` makes them.

    By rows. Of more scenes than `SearchOptions.shortlist` half as many by labels, and as many by
    looks, are compared with what lies in every direction.
    """

    encoders: tuple[Encoder, ...]
    usual: Usual
    shards: tuple[Shard, ...]
    beside: Shard
    """Homes that no library has."""
    missing: int = 0
    """Scenes of shards that are not there, damaged, or of another version."""
    notes: tuple[str, ...] = ()
    """Which these are, and how to mend it."""
    _opened: OrderedDict[int, tuple[Entry, SceneMap]] = field(default_factory=OrderedDict)

    @classmethod
    def open(
        cls,
        folder: str | os.PathLike[str],
        *,
        encoders: str | Encoder | Sequence[str | Encoder] | None = None,
    ) -> SceneShards:
        """Map the shards of a folder; they are read once, to compare their checksums.

        A shard that is missing, damaged or of another version is left out, and named in `notes`.
        `encoders`: those that cannot be made by name alone.

        Raises
        ------
        InputError
            The folder is none of shards.
        MapError
            No shard is sound, or what is usual is not; the encoders are others.

        """
        folder = Path(folder)
        if not (folder / HEAD).is_file():
            raise InputError(f"{folder} holds no shards of a library: it has no {HEAD}. {MEND}")
        head = read_map(folder / HEAD, KIND, VERSION)
        made = tuple(encoders_of(head, encoders))
        with sound(folder / HEAD, MEND):
            usual = Usual(head.meta, head.arrays, [e.key for e in made])
            check_usual(usual)
            told = [(str(s["file"]), int(s["scenes"])) for s in head.meta["shards"]]
            if not told or any(Path(name).name != name or count < 1 for name, count in told):
                raise ValueError("no shards")
        found: list[Shard] = []
        notes, missing = [], 0

        def opened(name: str, count: int) -> Shard | str:
            try:
                shard = Shard.open(folder / name, usual)
            except PlacegraphError as error:
                return str(error)
            other = f"{folder / name} holds {len(shard):,} scenes, not {count:,}. {MEND}"
            return shard if len(shard) == count else other

        with ThreadPoolExecutor(2) as pool:
            for (_, count), shard in zip(told, pool.map(lambda s: opened(*s), told), strict=True):
                if isinstance(shard, Shard):
                    found.append(shard)
                else:
                    notes.append(shard)
                    missing += count
        if not found:
            raise MapError(f"{folder}: no shard can be read. {' '.join(notes)}")
        beside = Shard.open(folder / BESIDE, usual)
        return cls(made, usual, tuple(found), beside, missing, tuple(notes))

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(H + 1,) first scene of each shard."""
        return np.concatenate([[0], np.cumsum([len(s) for s in self.shards])])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def check(self) -> None:
        """Raise `MapError` where a shard's file was changed in place since it was opened."""
        for shard in (*self.shards, self.beside):
            shard.check()

    def __repr__(self) -> str:
        return f"SceneShards({len(self):,} scenes in {len(self.shards)} shards)"

    def name(self, row: int) -> str:
        """Name of a scene."""
        return self._string(row, "names")

    def path(self, row: int) -> Path | None:
        """Map file of a scene, None where there is none."""
        told, (shard, _) = self._string(row, "paths"), self._at(row)
        return real_path(shard.folder / told) if told else None

    def earth(self, row: int) -> tuple[EarthPose, ...]:
        """Where a scene stands: one a candidate, likeliest first."""
        with sound(self._at(row)[0].folder, MEND):
            told = json.loads(self._string(row, "earth") or "[]")
            return tuple(EarthPose.from_dict(p) for p in told)

    def map(self, row: int) -> SceneMap:
        """Map of a scene; raises as `Scenes.scene`."""
        return self._entry(row)[1]

    def holding(self, rows: Sequence[int], names: Sequence[str] | None = None) -> SceneLibrary:
        """Library, with their maps, of some scenes, called by other names where these are given.

        Raises `InputError` where a map is not there, `MapError` where it is another than was added.
        """
        out = SceneLibrary(self.encoders)
        out.usual = self.usual.columns
        for row, name in zip(rows, names or map(self.name, rows), strict=True):
            out.insert(name, *self._entry(row))
        return out

    def _entry(self, row: int) -> tuple[Entry, SceneMap]:
        if row in self._opened:
            self._opened.move_to_end(row)
            return self._opened[row]
        path, (shard, own) = self.path(row), self._at(row)
        if path is None:
            raise InputError(f"{self.name(row)}: the shards know no map file of it.")
        digest = self._string(row, "digests")
        if digest_of(path) != digest:
            raise MapError(f"{path} is another map than was added. {MEND}")
        scene = SceneMap.open(path)
        entry = Entry(shard.signature(own, scene), path, digest, self.earth(row))
        self._opened[row] = entry, scene
        while len(self._opened) > _OPEN:
            self._opened.popitem(last=False)
        return entry, scene

    def compared(self, query: Query, options: SearchOptions) -> Scores:
        """What frames say of all scenes, and of the homes beside them.

        Scenes that are not looked at closely are as the worst of those that are.
        """
        if options.method == "cosines":
            raise OptionError("method is 'cosines': shards are compared by 'likelihood' alone.")
        self.check()
        start = perf_counter()
        rows = self._candidates(query, options)
        found_in = perf_counter() - start
        index = together([*self._picked(rows), (self.beside, np.arange(len(self.beside)))])
        near = scores(index, query, replace(options, shortlist=len(index)))
        total = np.full(len(self) + len(self.beside), near.total.min())
        total[np.append(rows, np.arange(len(self), len(total)))] = near.total
        return Scores(total, near.heat, {"candidates": found_in} | near.seconds)

    def _candidates(self, query: Query, options: SearchOptions) -> NDArray[np.int64]:
        """Rows of the scenes that are looked at: the best by labels, and the best by looks."""
        if len(self) <= options.shortlist:
            return np.arange(len(self))
        ways = [
            np.concatenate(found)
            for found in zip(*(s.promising(query, options) for s in self.shards), strict=True)
            if found[0] is not None
        ]
        most = max(1, options.shortlist // 2)
        return np.unique(np.concatenate([np.argpartition(-w, most - 1)[:most] for w in ways]))

    def _picked(self, rows: NDArray[np.int64]) -> list[tuple[Shard, NDArray[np.int64]]]:
        at = np.searchsorted(rows, self.starts)
        return [
            (shard, rows[first:last] - self.starts[i])
            for i, (shard, (first, last)) in enumerate(
                zip(self.shards, itertools.pairwise(at.tolist()), strict=True)
            )
            if last > first
        ]

    def said(self, sentence: Sentence) -> NDArray[np.float64]:
        """What a text says of each scene (n,) against what is usual [nat]."""
        self.check()
        usual = self.usual.columns
        parts = [
            of_scenes(sentence, s.columns, compared(sentence, s.columns, usual).sum(axis=0))[0]
            for s in self.shards
        ]
        return np.concatenate(parts)

    def evidence(
        self, row: int, asked: Query | Sentence, options: SearchOptions
    ) -> tuple[Evidence, ...]:
        """What speaks for a scene, by its map, where that is there."""
        path = self.path(row)
        if path is None or not path.exists():
            return ()
        if isinstance(asked, Query):
            return evidence(self.holding([row]), self.name(row), asked, options)
        return score(asked, self.map(row)).evidence

    def _at(self, row: int) -> tuple[Shard, int]:
        if not 0 <= row < len(self):
            raise OptionError(f"row is {row}; there are {len(self)} scenes.")
        shard = int(np.searchsorted(self.starts, row, "right")) - 1
        self.shards[shard].check()
        return self.shards[shard], row - int(self.starts[shard])

    def _string(self, row: int, column: str) -> str:
        shard, own = self._at(row)
        return shard.string(column, own)
