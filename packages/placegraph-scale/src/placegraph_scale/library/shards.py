"""Libraries too large to be read: shards that are mapped, and few scenes looked at closely.

An inverted index over labels and relations ranks all scenes by a text; what the labels of frames say
is summed over all scenes, and their looks over the mean vector of each. The best by either are
then compared with the frames in every direction, beside the same homes that no library has.
"""

from __future__ import annotations

import itertools
import json
import os
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import FileWatch, resolve_path
from placegraph.core.geo import EarthPose
from placegraph.core.mapfile import check_contents, read_header, read_map
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.indoor.encode import Encoder
from placegraph.indoor.language import Sentence, score
from placegraph.indoor.language.appearance import with_colours
from placegraph.indoor.language.index import Columns, Postings
from placegraph.indoor.language.score import of_scenes, score_statements
from placegraph.indoor.library.library import Entry, SceneLibrary, hash_file, match_encoders
from placegraph.indoor.library.search import (
    Query,
    SceneCollection,
    Scores,
    SearchOptions,
    explain_frames,
    score_scenes,
)
from placegraph.indoor.library.search_kernels import score_mixtures
from placegraph.indoor.library.signature import (
    BANDS,
    TURNS,
    Index,
    Signature,
    Vocabulary,
    compute_offsets,
    expand_runs,
)
from placegraph.indoor.map.scene import Scene, dequantize_vectors
from placegraph.indoor.scene_map import SceneMap

if TYPE_CHECKING:
    from placegraph.core.estimate import Evidence

KIND, VERSION = "shard", 1
"""Kind and version of the map file."""
HEAD, BESIDE = "usual.shard", "beside.shard"
"""Background model and list of shards, written last; the homes that no library has."""
MEND = "Create the shards again with `placegraph library shard`."
STRINGS = ("names", "paths", "digests", "earth", "buildings")
"""Columns of bytes, each beside one that says where those of a scene begin."""
FEW = 5_000
"""Vectors of a shard that all are compared with every word of a query: those of labels are so few."""
_OPEN = 64
"""Maps kept open."""


@dataclass(frozen=True, eq=False)
class Background:
    """Background model of homes, the same for all shards: looks and names of objects, and texts."""

    meta: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    keys: Sequence[str]

    def common_vectors(self, i: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return vectors (B, d) that are seen anywhere, and the share (B,) of each, to encoder i."""
        return self.arrays[f"vectors_{i}"], self.arrays[f"common_{i}"]

    @cached_property
    def columns(self) -> Columns:
        """Scenes that say what is usual in a text."""
        return read_columns(self.meta, self.arrays)

    def vocabulary(self, i: int, own: NDArray[np.float32], code: NDArray[np.int32]) -> Vocabulary:
        """Return the vocabulary of objects with rows (M,) of vectors (U, d); what is usual comes last."""
        vectors, common = self.common_vectors(i)
        every = np.concatenate([own, vectors])
        unknown = np.flatnonzero(~every.any(axis=1))
        return Vocabulary(every, unknown, code, np.arange(len(own), len(every)), common)

    def check(self) -> None:
        """Raise LookupError, TypeError or ValueError where columns do not fit each other."""
        if not self.keys:
            raise ValueError("no encoders")
        for i in range(len(self.keys)):
            vectors, common = self.common_vectors(i)
            shape = (len(vectors),)
            if vectors.ndim != 2 or common.shape != shape or not np.isfinite(vectors).all():
                raise ValueError(f"vectors_{i}")
        _check_texts(self.columns)


@dataclass(frozen=True, eq=False)
class Shard:
    """Mapped columns of S scenes; all that is derived of them is on disk.

    A shard is mapped from a file (`write`), or made in memory of scenes that are read.
    """

    meta: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    background: Background
    folder: Path = Path()
    """To which paths of maps are relative."""
    watch: FileWatch | None = None
    """Watch on the file that the columns are read from."""
    _vocabularies: dict[int, Vocabulary] = field(default_factory=dict)
    """Vocabularies of encoders with few vectors, unpacked."""

    @classmethod
    def open(cls, path: Path, background: Background) -> Shard:
        """Map a shard; its checksum is compared, and what its columns point to.

        Raises `InputError` where it is not there, `MapError` where it is damaged, newer or none.
        """
        file = read_map(path, KIND, VERSION, [b.name for b in read_header(path).blocks])
        with check_contents(path, MEND):
            # compiled code takes what is written to as any array; these are small
            own = ("share", "starts", *(f"code_{i}" for i in range(len(background.keys))))
            arrays = file.arrays | {n: np.array(file.arrays[n]) for n in own}
            shard = cls(file.meta, arrays, background, path.parent, file.watch)
            _check_shard(shard)
        return shard

    def check(self) -> None:
        """Raise `MapError` where the file was changed since, instead of replaced."""
        if self.watch is not None:
            self.watch.check()

    def __len__(self) -> int:
        return len(self.arrays["unit_starts"]) - 1

    def string(self, column: str, row: int) -> str:
        """Return the text of a scene in a column of strings."""
        starts = self.arrays[f"{column}_starts"]
        part = self.arrays[column][starts[row] : starts[row + 1]]
        return bytes(part).decode("utf-8", "replace")

    def strings(self, column: str) -> list[str]:
        """Return the texts of all scenes."""
        blob = self.arrays[column].tobytes()
        ends = self.arrays[f"{column}_starts"].tolist()
        return [blob[a:b].decode("utf-8", "replace") for a, b in itertools.pairwise(ends)]

    def signature(self, row: int, scene: Scene) -> Signature:
        """Return the signature of a scene, with what only its map says of it."""
        a = self.arrays
        first, last = a["unit_starts"][row : row + 2]
        objects = np.arange(a["starts"][first], a["starts"][last])
        views = slice(*a["place_starts"][[first, last]])
        order = a["order"][objects].astype(np.int64)
        if not np.array_equal(np.sort(order), np.arange(len(scene))):
            raise MapError(
                f"{scene.source} has other objects than its shard; create the shards again."
            )
        part, panoramas = np.zeros(len(order), np.int32), []
        for number, unit_ in enumerate(range(first, last)):
            own = a["order"][a["starts"][unit_] : a["starts"][unit_ + 1]]
            part[own] = number
            rows = a["panoramas"][a["place_starts"][unit_] : a["place_starts"][unit_ + 1]]
            panoramas.append(np.append(own, len(order))[rows].astype(np.uint16))
        back = np.argsort(order)
        share = np.square(a["share"][objects])[back]
        counts = np.diff(a["place_starts"])[first:last]
        return Signature(
            graph=replace(scene.graph, embeddings=None),
            attributes=with_colours(scene),
            vectors={k: self.vectors(i, objects)[back] for i, k in enumerate(self.background.keys)},
            share=share / share.sum(),
            places=np.array(a["places"][views]),
            panoramas=np.concatenate(panoramas),
            part=part,
            place_part=np.repeat(np.arange(len(counts), dtype=np.int32), counts),
        )

    @cached_property
    def columns(self) -> Columns:
        """Columns that texts are compared with."""
        return read_columns(self.meta, self.arrays)

    def bound_scores(
        self, query: Query, options: SearchOptions
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
        """Score each scene (S,) quickly by encoders of few vectors, and by those of many.

        By the first it is what the frames say of all that it holds: no finalist of an exhaustive
        search is missing among the best. By the others, how like its mean is to what was seen.
        """
        a = self.arrays
        few: NDArray[Any] | None = None
        many: NDArray[Any] | None = None
        for i, key in enumerate(self.background.keys):
            for words in (s for s in query.parts if s.key == key):
                code = a[f"code_{i}"]
                if len(a[f"vectors_{i}"]) <= FEW:
                    if i not in self._vocabularies:
                        own = unit(dequantize_vectors(a[f"vectors_{i}"], a[f"scales_{i}"]))
                        self._vocabularies[i] = self.background.vocabulary(i, own, code)
                    ratios = words.ratios(self._vocabularies[i], options)
                    weight = words.word_weights(len(query), options)
                    units = score_mixtures(
                        ratios, code, a["share"], a["starts"], weight, options.wrong
                    )
                    few = units if few is None else few + units
                else:
                    counts = np.bincount(words.word, minlength=len(words.words))
                    vectors, common = self.background.common_vectors(i)
                    excess = counts @ words.words / len(words.word) - np.asarray(common @ vectors)
                    near = a[f"means_{i}"] @ excess.astype(np.float32)
                    many = near if many is None else many + near
        first = a["unit_starts"][:-1]
        best = [w if w is None else np.maximum.reduceat(w, first) for w in (few, many)]
        return best[0], best[1]

    def vectors(self, i: int, objects: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return vectors (M, d) of some objects."""
        rows = self.arrays[f"code_{i}"][objects]
        return unit(
            dequantize_vectors(self.arrays[f"vectors_{i}"][rows], self.arrays[f"scales_{i}"][rows])
        )


def join_scenes(picks: Sequence[tuple[Shard, NDArray[np.int64]]]) -> Index:
    """Return the index of some scenes (rows ascending) of several shards, in this order."""
    background = picks[0][0].background
    parts: list[dict[str, NDArray[Any]]] = []
    vectors: list[list[NDArray[np.float32]]] = []
    for shard, rows in picks:
        a = shard.arrays
        units = expand_runs(a["unit_starts"], rows)
        objects, places = expand_runs(a["starts"], units), expand_runs(a["place_starts"], units)
        parts.append({
            "owner": np.diff(a["unit_starts"])[rows],
            "objects": np.diff(a["starts"])[units],
            "share": a["share"][objects],
            "views": np.diff(a["place_starts"])[units],
            "places": a["places"][places],
            "panoramas": a["panoramas"][places],
        })  # fmt: skip
        vectors.append([shard.vectors(i, objects) for i in range(len(background.keys))])
    whole = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    every = [np.concatenate(own) for own in zip(*vectors, strict=True)]
    return Index(
        owner=np.repeat(np.arange(len(whole["owner"])), whole["owner"]),
        starts=compute_offsets(whole["objects"]),
        share=whole["share"],
        vocabularies={
            key: background.vocabulary(i, every[i], np.arange(len(every[i]), dtype=np.int32))
            for i, key in enumerate(background.keys)
        },
        place_starts=compute_offsets(whole["views"]),
        places=whole["places"],
        panoramas=whole["panoramas"],
    )


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scale vectors (N, d) to length 1; zero ones stay."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 1e-6, lengths, np.inf), np.float32)


def read_columns(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Columns:
    """Return columns of texts as `write.pack_texts` wrote them."""
    a = {name.removeprefix("text_"): v for name, v in arrays.items() if name.startswith("text_")}
    return Columns(
        labels=tuple(map(str, meta["labels"])),
        relations=tuple(map(str, meta["relations"])),
        of_labels=Postings(a["label_starts"], a["label_units"], a["label_counts"]),
        of_triples=Postings(a["triple_starts"], a["triple_units"], a["triple_counts"]),
        triples=a["triples"], appearance=a["looks"], room_looks=a["room_looks"], much=a["much"],
        rooms=a["rooms"], is_scene=a["whole"], scene=a["scene"], scenes=int(meta["scenes"]),
    )  # fmt: skip


# Compiled code believes columns. Checksums tell damage; these checks tell a file that was forged.


def _check_shard(shard: Shard) -> None:
    """Raise LookupError, TypeError or ValueError where columns of a shard do not fit each other."""
    a, count = shard.arrays, len(shard)
    units, objects, views = len(a["starts"]) - 1, len(a["share"]), len(a["places"])
    _check_runs(a["unit_starts"], units, least=1)
    _check_runs(a["starts"], objects, least=1)
    _check_runs(a["place_starts"], views)
    shapes = {"panoramas": (views, BANDS, TURNS), "places": (views, 2), "share": (objects,)}
    for i in range(len(shard.background.keys)):
        known, d = len(a[f"scales_{i}"]), shard.background.common_vectors(i)[0].shape[1]
        shapes |= {f"vectors_{i}": (known, d), f"means_{i}": (units, d), f"code_{i}": (objects,)}
        _check_rows(f"code_{i}", a[f"code_{i}"], known)
    if "order" in a:  # scenes, not the homes beside them
        shapes |= {"order": (objects,), "stands": (len(a["stands"]), 6)}
        _check_runs(a["stand_starts"], len(a["stands"]))
        for name in STRINGS:
            starts = a[f"{name}_starts"]
            _check_runs(starts, int(starts[-1]))
            if int(starts[-1]) > a[name].size or len(starts) != count + 1:
                raise ValueError(name)
        if len(a["stand_starts"]) != count + 1 or not np.isfinite(a["stands"]).all():
            raise ValueError("stands")
        _check_texts(shard.columns)
        if shard.columns.scenes != count:
            raise ValueError("texts belong to other scenes")
    for name, shape in shapes.items():
        if a[name].shape != shape:
            raise ValueError(f"{name} is {a[name].shape}, not {shape}")
    many = np.repeat(np.diff(a["starts"]), np.diff(a["place_starts"]))
    if views and (a["panoramas"].reshape(views, -1).max(axis=1) > many).any():
        raise ValueError("panoramas refer to missing objects")


def _check_runs(starts: NDArray[Any], total: int, least: int = 0) -> None:
    """Raise `ValueError` where runs do not begin at 0, shrink, or end elsewhere."""
    ends = (int(starts[0]), int(starts[-1])) if starts.ndim == 1 and len(starts) > 1 else None
    if starts.dtype != np.int64 or ends != (0, total) or (np.diff(starts) < least).any():
        raise ValueError("runs do not match their entries")


def _check_rows(name: str, rows: NDArray[Any], count: int) -> None:
    """Raise `ValueError` where integers are no rows of so many."""
    if rows.size and not (rows.dtype.kind == "i" and rows.min() >= 0 and rows.max() < count):
        raise ValueError(f"{name} is out of range")


def _check_texts(c: Columns) -> None:
    """Raise `ValueError` where columns of texts do not fit each other."""
    count = len(c.scene)
    for of, words in ((c.of_labels, len(c.labels)), (c.of_triples, len(c.triples))):
        _check_runs(of.starts, len(of.units))
        if len(of.starts) - 1 != words or len(of.counts) != len(of.units):
            raise ValueError("postings of texts")
        _check_rows("postings", of.units, count)
    rows = len(c.appearance) - len(c.of_labels.units), len(c.room_looks) - count
    lengths = {len(c.much) - count, len(c.rooms) - count, len(c.is_scene) - count, *rows}
    ascending = np.array_equal(np.unique(c.scene), np.arange(c.scenes))
    if lengths != {0} or not ascending or (np.diff(c.scene) < 0).any():
        raise ValueError("columns of texts have different lengths")
    numbers = (c.of_labels.counts, 0), (c.of_triples.counts, 0), (c.much, 1), (c.rooms, 0)
    if not all(((n >= least) & (n < np.inf)).all() for n, least in numbers):
        raise ValueError("numbers of texts")
    for name, column, many in zip(
        ("subjects", "relations", "targets"), c.triples.T,
        (len(c.labels), len(c.relations), len(c.labels)), strict=True,
    ):  # fmt: skip
        _check_rows(name, column, many)


@dataclass(frozen=True, eq=False)
class SceneShards(SceneCollection):
    """Scenes in shards, asked as a library is; `write.write_shards` makes them.

    By rows. Of more scenes than `SearchOptions.shortlist` half as many by labels, and as many by
    looks, are compared with what lies in every direction.
    """

    encoders: tuple[Encoder, ...]
    background: Background
    shards: tuple[Shard, ...]
    beside: Shard
    """Homes that no library has."""
    missing: int = 0
    """Scenes of shards that are not there, damaged, or of another version."""
    notes: tuple[str, ...] = ()
    """Which these are, and how to mend it."""
    _scene_cache: OrderedDict[int, tuple[Entry, SceneMap]] = field(default_factory=OrderedDict)

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

        Raises `InputError`: the folder is none of shards; `MapError`: no shard is sound, or the
        background model is not; the encoders are others.
        """
        folder = Path(folder)
        if not (folder / HEAD).is_file():
            raise InputError(
                f"{folder} contains no shards of a library, because it has no {HEAD}. {MEND}"
            )
        head = read_map(folder / HEAD, KIND, VERSION)
        made = tuple(match_encoders(head, encoders))
        with check_contents(folder / HEAD, MEND):
            background = Background(head.meta, head.arrays, [e.key for e in made])
            background.check()
            listed = [(str(s["file"]), int(s["scenes"])) for s in head.meta["shards"]]
            if not listed or any(Path(name).name != name or count < 1 for name, count in listed):
                raise ValueError("no shards")
        found: list[Shard] = []
        notes, missing = [], 0

        def open_shard(name: str, count: int) -> Shard | str:
            try:
                shard = Shard.open(folder / name, background)
            except PlacegraphError as error:
                return str(error)
            other = f"{folder / name} contains {len(shard):,} scenes, not {count:,}. {MEND}"
            return shard if len(shard) == count else other

        with ThreadPoolExecutor(2) as pool:
            every = pool.map(lambda s: open_shard(*s), listed)
            for (_, count), shard in zip(listed, every, strict=True):
                if isinstance(shard, Shard):
                    found.append(shard)
                else:
                    notes.append(shard)
                    missing += count
        if not found:
            raise MapError(f"{folder}: no shard can be read. {' '.join(notes)}")
        beside = Shard.open(folder / BESIDE, background)
        return cls(made, background, tuple(found), beside, missing, tuple(notes))

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
        """Return the name of a scene."""
        return self._string(row, "names")

    def path(self, row: int) -> Path | None:
        """Return the map file of a scene, None where there is none."""
        place, (shard, _) = self._string(row, "paths"), self._find(row)
        return resolve_path(shard.folder / place) if place else None

    def earth(self, row: int) -> tuple[EarthPose, ...]:
        """Return the anchors of a scene on Earth: one a candidate, likeliest first."""
        with check_contents(self._find(row)[0].folder, MEND):
            poses = json.loads(self._string(row, "earth") or "[]")
            return tuple(EarthPose.from_dict(p) for p in poses)

    def open_map(self, row: int) -> SceneMap:
        """Return the map of a scene; raises as `SceneLibrary.scene`."""
        return self._entry(row)[1]

    def open_scenes(self, rows: Sequence[int], names: Sequence[str] | None = None) -> SceneLibrary:
        """Return a library, with their maps, of some scenes, called by other names where these are given.

        Raises `InputError` where a map is not there, `MapError` where it is another than was added.
        """
        out = SceneLibrary(self.encoders)
        out.usual = self.background.columns
        for row, name in zip(rows, names or map(self.name, rows), strict=True):
            out.insert(name, *self._entry(row))
        return out

    def _entry(self, row: int) -> tuple[Entry, SceneMap]:
        if row in self._scene_cache:
            self._scene_cache.move_to_end(row)
            return self._scene_cache[row]
        path, (shard, own) = self.path(row), self._find(row)
        if path is None:
            raise InputError(f"{self.name(row)}: the shards have no map file for this scene.")
        digest = self._string(row, "digests")
        if hash_file(path) != digest:
            raise MapError(f"{path} is not the map that was added. {MEND}")
        scene = SceneMap.open(path)
        entry = Entry(shard.signature(own, scene), path, digest, self.earth(row))
        self._scene_cache[row] = entry, scene
        while len(self._scene_cache) > _OPEN:
            self._scene_cache.popitem(last=False)
        return entry, scene

    def score_frames(self, query: Query, options: SearchOptions) -> Scores:
        """Score all scenes, and the homes beside them, by frames.

        Scenes that are not looked at closely are as the worst of those that are.
        """
        if options.method == "cosines":
            raise OptionError(
                "method is 'cosines', but shards are compared only by 'likelihood'; remove it."
            )
        self.check()
        start = perf_counter()
        rows = self._choose_candidates(query, options)
        found_in = perf_counter() - start
        at = np.searchsorted(rows, self.starts).tolist()
        picks = [
            (shard, rows[first:last] - self.starts[i])
            for i, (shard, (first, last)) in enumerate(
                zip(self.shards, itertools.pairwise(at), strict=True)
            )
            if last > first
        ]
        index = join_scenes([*picks, (self.beside, np.arange(len(self.beside)))])
        near = score_scenes(index, query, replace(options, shortlist=len(index)))
        total = np.full(len(self) + len(self.beside), near.total.min())
        total[np.append(rows, np.arange(len(self), len(total)))] = near.total
        return Scores(total, near.temperature, {"candidates": found_in} | near.seconds)

    def _choose_candidates(self, query: Query, options: SearchOptions) -> NDArray[np.int64]:
        """Return rows of the scenes that are looked at: the best by labels, and the best by looks."""
        if len(self) <= options.shortlist:
            return np.arange(len(self))
        ways = [
            np.concatenate(found)
            for found in zip(*(s.bound_scores(query, options) for s in self.shards), strict=True)
            if found[0] is not None
        ]
        most = max(1, options.shortlist // 2)
        return np.unique(np.concatenate([np.argpartition(-w, most - 1)[:most] for w in ways]))

    def score_text(self, sentence: Sentence) -> NDArray[np.float64]:
        """Return the log-likelihood ratio of a text for each scene (n,), against what is usual."""
        self.check()
        background = self.background.columns
        parts = [
            of_scenes(
                sentence, s.columns, score_statements(sentence, s.columns, background).sum(axis=0)
            )[0]
            for s in self.shards
        ]
        return np.concatenate(parts)

    def explain(
        self, row: int, query: Query | Sentence, options: SearchOptions
    ) -> tuple[Evidence, ...]:
        """Return the evidence for a scene, by its map, where that is there."""
        path = self.path(row)
        if path is None or not path.exists():
            return ()
        if isinstance(query, Query):
            library = self.open_scenes([row])
            signature = self._entry(row)[0].signature
            return explain_frames(library.index, 0, signature, query, options)
        return score(query, self.open_map(row)).evidence

    def _find(self, row: int) -> tuple[Shard, int]:
        if not 0 <= row < len(self):
            raise OptionError(f"row is {row}; there are {len(self)} scenes.")
        shard = int(np.searchsorted(self.starts, row, "right")) - 1
        self.shards[shard].check()
        return self.shards[shard], row - int(self.starts[shard])

    def _string(self, row: int, column: str) -> str:
        shard, own = self._find(row)
        return shard.string(column, own)
