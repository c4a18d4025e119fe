"""One shard: what all its scenes hold, ranked, and some of them taken out.

It is mapped from a file (`shard_write`), or made in memory of scenes that are read.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import Watch
from placegraph.core.mapfile import read_header, read_map, sound
from placegraph.errors import MapError
from placegraph.indoor.language.appearance import with_colours
from placegraph.indoor.language.index import Columns, Postings
from placegraph.indoor.library.index import Index, Vocabulary, runs, starts_of
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.query import Query
from placegraph.indoor.library.search import patch_weights, ratio
from placegraph.indoor.library.search_kernels import held
from placegraph.indoor.library.signature import Signature
from placegraph.indoor.map.scene import Scene, from_8_bits
from placegraph_scale.library.shard_check import check_scenes

KIND, VERSION = "shard", 1
"""Of map files."""
HEAD, BESIDE = "usual.shard", "beside.shard"
"""What is usual and which shards there are, written last; the homes that no library has."""
MEND = "Make the shards again with `placegraph library shard`."
FEW = 5_000
"""Vectors of a shard that all are compared with every word of a query: those of labels are so few."""


@dataclass(frozen=True, eq=False)
class Usual:
    """What is usual in homes, the same for all shards: looks and names of things, and texts."""

    meta: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    keys: Sequence[str]

    def seen(self, i: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Vectors (B, d) that are seen anywhere, and the share (B,) of each, to encoder i."""
        return self.arrays[f"vectors_{i}"], self.arrays[f"common_{i}"]

    def mean(self, i: int) -> NDArray[np.float32]:
        """(d,) of these."""
        vectors, common = self.seen(i)
        return np.asarray(common @ vectors)

    @cached_property
    def columns(self) -> Columns:
        """Scenes that say what is usual in a text."""
        return columns_in(self.meta, self.arrays)

    def vocabulary(self, i: int, own: NDArray[np.float32], code: NDArray[np.int32]) -> Vocabulary:
        """Vocabulary of objects with rows (M,) of vectors (U, d), in which what is usual comes last."""
        vectors, common = self.seen(i)
        every = np.concatenate([own, vectors])
        unknown = np.flatnonzero(~every.any(axis=1))
        return Vocabulary(every, unknown, code, np.arange(len(own), len(every)), common)


@dataclass(frozen=True, eq=False)
class Shard:
    """Mapped columns of S scenes; everything that is derived of all of them is on disk."""

    meta: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    usual: Usual
    folder: Path = Path()
    """To which paths of maps are relative."""
    watch: Watch | None = None
    """Of the file that columns are windows on."""

    @classmethod
    def open(cls, path: Path, usual: Usual) -> Shard:
        """Map a shard; its checksum is compared, and what its columns point to.

        Raises `InputError` where it is not there, `MapError` where it is damaged, newer or none.
        """
        file = read_map(path, KIND, VERSION, [b.name for b in read_header(path).blocks])
        with sound(path, MEND):
            # compiled code takes what is written to as any array; these are small
            own = ("share", "starts", *(f"code_{i}" for i in range(len(usual.keys))))
            arrays = file.arrays | {n: np.array(file.arrays[n]) for n in own}
            shard = cls(file.meta, arrays, usual, path.parent, file.watch)
            check_scenes(shard)
        return shard

    def check(self) -> None:
        """Raise `MapError` where the file was changed since, instead of replaced."""
        if self.watch is not None:
            self.watch.check()

    def __len__(self) -> int:
        return len(self.arrays["unit_starts"]) - 1

    def string(self, column: str, row: int) -> str:
        """What a column of strings says of a scene."""
        starts = self.arrays[f"{column}_starts"]
        part = self.arrays[column][starts[row] : starts[row + 1]]
        return bytes(part).decode("utf-8", "replace")

    def strings(self, column: str) -> list[str]:
        """What it says of all scenes."""
        blob = self.arrays[column].tobytes()
        ends = self.arrays[f"{column}_starts"].tolist()
        return [blob[a:b].decode("utf-8", "replace") for a, b in itertools.pairwise(ends)]

    def signature(self, row: int, scene: Scene) -> Signature:
        """Signature of a scene, with what only its map says of it."""
        a = self.arrays
        first, last = a["unit_starts"][row : row + 2]
        objects = np.arange(a["starts"][first], a["starts"][last])
        views = slice(*a["place_starts"][[first, last]])
        order = a["order"][objects].astype(np.int64)
        if not np.array_equal(np.sort(order), np.arange(len(scene))):
            raise MapError(
                f"{scene.source} has other objects than its shard; make the shards again."
            )
        at, part, panoramas = len(order), np.zeros(len(order), np.int32), []
        numbers = {}
        for number, unit_ in enumerate(range(first, last)):
            own = a["order"][a["starts"][unit_] : a["starts"][unit_ + 1]]
            part[own], numbers[unit_] = number, np.append(own, at)
            seen = a["panoramas"][a["place_starts"][unit_] : a["place_starts"][unit_ + 1]]
            panoramas.append(numbers[unit_][seen].astype(np.uint16))
        back = np.argsort(order)
        share = np.square(a["share"][objects])[back]
        counts = np.diff(a["place_starts"])[first:last]
        return Signature(
            graph=replace(scene.graph, embeddings=None),
            attributes=with_colours(scene),
            vectors={k: self.vectors(i, objects)[back] for i, k in enumerate(self.usual.keys)},
            share=share / share.sum(),
            places=np.array(a["places"][views]),
            panoramas=np.concatenate(panoramas),
            part=part,
            place_part=np.repeat(np.arange(len(counts), dtype=np.int32), counts),
        )

    @cached_property
    def columns(self) -> Columns:
        """As texts ask for them."""
        return columns_in(self.meta, self.arrays)

    def promising(
        self, query: Query, options: SearchOptions
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
        """How promising (S,) each scene is by encoders of few vectors, and by those of many.

        By the first it is what the frames say of all that it holds: no finalist of an exhaustive
        search is missing among the best. By the others, how like its mean is to what was seen.
        """
        a = self.arrays
        few: NDArray[Any] | None = None
        many: NDArray[Any] | None = None
        for i, key in enumerate(self.usual.keys):
            for said in (s for s in query.said if s.key == key):
                if len(a[f"vectors_{i}"]) <= FEW:
                    told = ratio(said, self._all(i), options)
                    patches = patch_weights(said, len(query), options)
                    weight = np.bincount(said.word, patches, len(said.words))
                    units = held(
                        told, a[f"code_{i}"], a["share"], a["starts"], weight, options.wrong
                    )
                    few = units if few is None else few + units
                else:
                    counts = np.bincount(said.word, minlength=len(said.words))
                    seen = counts @ said.words / len(said.word) - self.usual.mean(i)
                    near = a[f"means_{i}"] @ seen.astype(np.float32)
                    many = near if many is None else many + near
        first = a["unit_starts"][:-1]
        best = [w if w is None else np.maximum.reduceat(w, first) for w in (few, many)]
        return best[0], best[1]

    def _all(self, i: int) -> Vocabulary:
        if i not in self._kept:
            own = from_8_bits(self.arrays[f"vectors_{i}"], self.arrays[f"scales_{i}"])
            self._kept[i] = self.usual.vocabulary(i, unit(own), self.arrays[f"code_{i}"])
        return self._kept[i]

    @cached_property
    def _kept(self) -> dict[int, Vocabulary]:
        """Few vectors, unpacked."""
        return {}

    def vectors(self, i: int, objects: NDArray[np.int64]) -> NDArray[np.float32]:
        """Vectors (M, d) of some objects."""
        rows = self.arrays[f"code_{i}"][objects]
        return unit(
            from_8_bits(self.arrays[f"vectors_{i}"][rows], self.arrays[f"scales_{i}"][rows])
        )


def together(picks: Sequence[tuple[Shard, NDArray[np.int64]]]) -> Index:
    """Index of some scenes (rows ascending) of several shards, in this order."""
    usual = picks[0][0].usual
    parts: list[dict[str, NDArray[Any]]] = []
    vectors: list[list[NDArray[np.float32]]] = []
    for shard, rows in picks:
        a = shard.arrays
        units = runs(a["unit_starts"], rows)
        objects, places = runs(a["starts"], units), runs(a["place_starts"], units)
        parts.append({
            "owner": np.diff(a["unit_starts"])[rows],
            "objects": np.diff(a["starts"])[units],
            "share": a["share"][objects],
            "views": np.diff(a["place_starts"])[units],
            "places": a["places"][places],
            "panoramas": a["panoramas"][places],
        })  # fmt: skip
        vectors.append([shard.vectors(i, objects) for i in range(len(usual.keys))])
    whole = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    every = [np.concatenate(own) for own in zip(*vectors, strict=True)]
    return Index(
        owner=np.repeat(np.arange(len(whole["owner"])), whole["owner"]),
        starts=starts_of(whole["objects"]),
        share=whole["share"],
        vocabularies={
            key: usual.vocabulary(i, every[i], np.arange(len(every[i]), dtype=np.int32))
            for i, key in enumerate(usual.keys)
        },
        place_starts=starts_of(whole["views"]),
        places=whole["places"],
        panoramas=whole["panoramas"],
    )


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit vectors (N, d) of these, zero ones as they are."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 1e-6, lengths, np.inf), np.float32)


def columns_in(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Columns:
    """Columns of texts as `shard_write.of_texts` wrote them."""
    a = {name.removeprefix("text_"): v for name, v in arrays.items() if name.startswith("text_")}
    return Columns(
        labels=tuple(map(str, meta["labels"])),
        relations=tuple(map(str, meta["relations"])),
        of_labels=Postings(a["label_starts"], a["label_units"], a["label_counts"]),
        of_triples=Postings(a["triple_starts"], a["triple_units"], a["triple_counts"]),
        triples=a["triples"], looks=a["looks"], room_looks=a["room_looks"], much=a["much"],
        rooms=a["rooms"], whole=a["whole"], scene=a["scene"], scenes=int(meta["scenes"]),
    )  # fmt: skip
