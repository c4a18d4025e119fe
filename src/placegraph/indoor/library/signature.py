"""Signatures of scenes: what a library stores of each, in kilobytes, and the index of all of them.

A signature is the graph of a scene without geometry, a vector an object and encoder, and *panoramas*: which
object lies in which direction, seen from some places of its floor. They tell how much of what is seen an
object takes up, what is seen together, and how that changes along a way.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.core.mapfile import MapFile, pack_strings, read_map
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, encode_objects
from placegraph.indoor.language.appearance import with_colours
from placegraph.indoor.language.index import DescriptionUnit, units
from placegraph.indoor.library.search_kernels import hash_rows
from placegraph.indoor.likelihood.visibility import build_table
from placegraph.indoor.map.free_space import MAX_ELEVATION
from placegraph.indoor.map.map_kernels import AZIMUTHS, ELEVATIONS
from placegraph.indoor.map.scene import Scene, dequantize_vectors, quantize_vectors
from placegraph.indoor.options import STANDING, PoseSearchOptions
from placegraph.io.capture.capture import Capture
from placegraph.vectors import EmbeddedStore

MAX_PLACES = 160  # Panoramas of a scene, or of a merged map's part, at most,
MIN_PLACE_DISTANCE = 0.75  # and how far they are from each other at least [m]
TURNS = 24  # Bins of azimuth of a panorama: 15 degrees
BANDS = 4  # Bins of elevation, from `REACH` below the horizon to as much above it: 25 degrees
REACH = MAX_ELEVATION  # Elevation at which panoramas end [rad]
MAX_OBJECTS = 20_000  # Objects of a scene at most
_SPACING = 0.5  # of the grid that places are chosen from [m]


@dataclass(frozen=True, eq=False)
class Signature:
    """Summary of one scene of N objects that needs no map: graph, vectors and panoramas."""

    graph: SceneGraph  # Without embeddings
    attributes: tuple[dict[str, str], ...]
    """(N,) as of the map, and the colours of the objects (`language.colours`)."""
    vectors: Mapping[str, NDArray[np.float32]]
    """(N, d) unit vectors, or zero, by the key of their encoder."""
    share: NDArray[np.float32]  # (N,) of what is seen from its places, adding up to 1
    places: NDArray[np.float32]  # (P, 2) x, y [m, map] of the panoramas
    panoramas: NDArray[np.uint16]
    """(P, BANDS, TURNS) row of the object, N where the map ends; azimuth bins are centred on
    multiples of 2 pi / TURNS."""
    part: NDArray[np.int32]
    """(N,) merged scene of each object, from 0 on: a camera is in one of them."""
    place_part: NDArray[np.int32]  # (P,) merged scene of each place

    def __len__(self) -> int:
        return len(self.graph)

    @property
    def rooms(self) -> tuple[str, ...]:
        """Names of its rooms, as far as the map names them."""
        named = dict.fromkeys(a.get("room", "") for a in self.attributes)
        return tuple(name for name in named if name)

    @cached_property
    def described(self) -> list[DescriptionUnit]:
        """Rooms and objects as texts describe them; computed once."""
        rooms = [a.get("room", "") for a in self.attributes]
        return units(self.graph, rooms, self.attributes)


def compute_signature(
    scene: Scene,
    encoders: Sequence[Encoder],
    captures: Sequence[Capture] = (),
    height: float | None = None,
) -> Signature:
    """Compute the signature of a map.

    Raises `OptionError`: no object says anything to any encoder; no place of it is free; it has too
    many objects; `MapError`: its vectors are of another encoder.

    `encoders`: whose vectors are kept: the map's own where they are of this encoder, else made
        anew.
    `captures`: images of the map, for encoders that need some; their odometry is map_from_camera.
    `height`: of the camera above the floor [m]; as `FilterOptions` has it if not given.
    """
    if len(scene) > MAX_OBJECTS:
        raise OptionError(
            f"{scene.source or 'The map'} has {len(scene):,} objects, but a scene of a "
            f"library has at most {MAX_OBJECTS:,}; split it into rooms."
        )
    vectors = {e.key: encode_objects(e, scene, captures) for e in encoders}
    if not any(v.any() for v in vectors.values()):
        raise OptionError(
            f"{scene.source or 'The map'}: {', '.join(e.name for e in encoders)} can use none of its "
            f"{len(scene)} objects; give the objects labels or colours."
        )
    heights = STANDING if height is None else (height,)
    table = build_table(
        scene, PoseSearchOptions(heights=(float(np.mean(heights)),), spacing=_SPACING)
    )
    if not len(table):
        raise OptionError(
            f"{scene.source or 'The map'} has no free viewpoint {np.mean(heights):.1f} m "
            "above its floor; give the camera's height."
        )
    at = np.array([scene.scene_at(p[:2]) for p in table.positions], np.int32)
    parts = [np.flatnonzero(at == part) for part in np.unique(at)]
    chosen = np.concatenate([r[choose_distant(table.positions[r, :2], MAX_PLACES)] for r in parts])
    panoramas = coarsen_panoramas(table.panoramas.objects[chosen], len(scene))
    seen = table.panoramas.objects.ravel()
    counts = np.bincount(seen, minlength=len(scene) + 1)[: len(scene)] + 0.5
    return Signature(
        graph=replace(scene.graph, embeddings=None),
        attributes=with_colours(scene),
        vectors=vectors,
        share=(counts / counts.sum()).astype(np.float32),
        places=table.positions[chosen, :2].astype(np.float32),
        panoramas=panoramas,
        part=scene.scene_of,
        place_part=at[chosen],
    )


def choose_distant(points: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Return rows of at most `most` of points (K, 2): the most central first, then ever the farthest.

    None nearer to another than `MIN_PLACE_DISTANCE`.
    """
    first = int(np.linalg.norm(points - np.median(points, axis=0), axis=1).argmin())
    rows = [first]
    away = np.linalg.norm(points - points[first], axis=1)
    while len(rows) < min(most, len(points)):
        row = int(away.argmax())
        if away[row] < MIN_PLACE_DISTANCE:
            break
        rows.append(row)
        away = np.minimum(away, np.linalg.norm(points - points[row], axis=1))
    return np.array(rows)


def coarsen_panoramas(objects: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    """Return panoramas (P, BANDS, TURNS) by the object that most rays (P, E, A) of a bin hit."""
    places = len(objects)
    wide, high = AZIMUTHS // TURNS, ELEVATIONS // BANDS
    # bins are centred on multiples of their width, of the fine as of the coarse
    turned = np.roll(objects, wide // 2, axis=2)
    rays = turned.reshape(places, BANDS, high, TURNS, wide).swapaxes(2, 3)
    rays = rays.reshape(places * BANDS * TURNS, high * wide)
    ordered = np.sort(rays, axis=1)
    # the longest run of equal numbers
    best, most = ordered[:, 0].copy(), np.zeros(len(ordered), np.int64)
    run = np.ones(len(ordered), np.int64)
    for k in range(1, ordered.shape[1] + 1):
        ends = np.ones(len(ordered), np.bool_)
        if k < ordered.shape[1]:
            ends = ordered[:, k] != ordered[:, k - 1]
        longer = ends & (run > most)
        best[longer], most[longer] = ordered[longer, k - 1], run[longer]
        run = np.where(ends, 1, run + 1)
    return np.minimum(best, count).astype(np.uint16).reshape(places, BANDS, TURNS)


SAMPLE = 1024  # Vectors that stand for all of a library's


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """Vectors of the objects of a library by one encoder, each once."""

    vectors: NDArray[np.float32]  # (U, d) unit, or zero: nothing is known
    unknown: NDArray[np.int64]  # Rows of these that are zero
    code: NDArray[np.int32]  # (M,) vector of each object
    background: NDArray[np.int64]  # (B,) rows of `vectors` that are seen anywhere, `SAMPLE` at most
    common: NDArray[np.float32]
    """(B,) share of what is seen that looks like this, all scenes counting alike; adds up to 1."""

    @classmethod
    def of(cls, vectors: NDArray[np.float32], weight: NDArray[np.floating]) -> Vocabulary:
        """Return the vocabulary of objects with vectors (M, d), seen with these weights (M,)."""
        first, code = find_distinct(vectors)
        own = np.ascontiguousarray(vectors[first])
        share = np.bincount(code, weight, len(first))
        known = np.flatnonzero(own.any(axis=1))
        rows = known[np.unique(np.linspace(0, max(0, len(known) - 1), SAMPLE).astype(np.int64))]
        common = share[rows] / max(1e-12, share[rows].sum())
        unknown = np.flatnonzero(~own.any(axis=1))
        return cls(own, unknown, code.astype(np.int32), rows, common.astype(np.float32))

    @property
    def mean(self) -> NDArray[np.float32]:
        """(d,) of what is seen anywhere."""
        return np.asarray(self.common @ self.vectors[self.background])

    def of_objects(self, rows: NDArray[np.int64]) -> Vocabulary:
        """Return the vocabulary of some objects, with the same background model."""
        used = np.concatenate([self.code[rows], self.background])
        numbers = np.arange(len(used))
        return replace(
            self,
            vectors=self.vectors[used],
            unknown=np.flatnonzero(np.isin(used, self.unknown)),
            code=numbers[: len(rows)].astype(np.int32),
            background=numbers[len(rows) :],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """Part of a scene that is compared with a capture: all of it, or one of those that it was merged of."""

    scene: int  # Row of the signature
    objects: NDArray[np.int64]  # (N,) rows in the signature
    panoramas: NDArray[np.uint16]  # (P, bands, turns) rows of `objects`, N where the unit ends
    places: NDArray[np.float32]  # (P, 2) [m]


def split_into_units(signatures: Sequence[Signature]) -> Iterator[Unit]:
    """Yield the units of scenes, in their order."""
    for row, s in enumerate(signatures):
        for part in np.unique(s.part):
            objects = np.flatnonzero(s.part == part)
            number = np.full(len(s) + 1, len(objects), np.uint16)
            number[objects] = np.arange(len(objects))
            own = s.place_part == part
            yield Unit(row, objects, number[s.panoramas[own]], s.places[own])


@dataclass(frozen=True, eq=False)
class Index:
    """S units of M objects and K panoramas in all; made anew when scenes come or go."""

    owner: NDArray[np.int64]  # (S,) scene of each unit, ascending
    starts: NDArray[np.int64]  # (S + 1,) first object of each unit
    share: NDArray[np.float32]
    """(M,) of what is seen in its unit, by the square root: who stands before a thing sees more of
    it than who looks around."""
    vocabularies: dict[str, Vocabulary]  # By the key of the encoder
    place_starts: NDArray[np.int64]  # (S + 1,) first panorama of each unit
    places: NDArray[np.float32]  # (K, 2) [m]
    panoramas: NDArray[np.uint16]  # (K, bands, turns)

    @classmethod
    def of(cls, signatures: Sequence[Signature], keys: Sequence[str]) -> Index:
        """Return the index of scenes that all have vectors under these keys."""
        parts = list(split_into_units(signatures))
        seen = [signatures[u.scene].share[u.objects] for u in parts]
        roots = [np.sqrt(share) for share in seen]
        return cls(
            owner=np.array([u.scene for u in parts]),
            starts=compute_offsets([len(u.objects) for u in parts]),
            share=np.concatenate([r / r.sum() for r in roots]).astype(np.float32),
            vocabularies={
                key: Vocabulary.of(
                    np.concatenate([signatures[u.scene].vectors[key][u.objects] for u in parts]),
                    np.concatenate([share / share.sum() for share in seen]),
                )
                for key in keys
            },
            place_starts=compute_offsets([len(u.places) for u in parts]),
            places=np.concatenate([u.places for u in parts]),
            panoramas=np.concatenate([u.panoramas for u in parts]),
        )

    def __len__(self) -> int:
        return len(self.starts) - 1

    @cached_property
    def is_visible(self) -> NDArray[np.bool_]:
        """(M,) whether any panorama shows an object."""
        first = np.repeat(self.starts[:-1], np.diff(self.place_starts))[:, None, None]
        last = np.repeat(self.starts[1:], np.diff(self.place_starts))[:, None, None]
        seen = first + self.panoramas.astype(np.int64)
        out = np.zeros(int(self.starts[-1]), np.bool_)
        out[seen[seen < last]] = True
        return out

    @cached_property
    def store(self) -> EmbeddedStore:
        """Vectors of whole scenes, for `nearest`; made on first use."""
        rows = np.zeros((len(self), sum(v.vectors.shape[1] for v in self.vocabularies.values())))
        first = 0
        for v in self.vocabularies.values():
            last = first + v.vectors.shape[1]
            parts = (v.vectors - v.mean)[v.code] * self.share[:, None]
            rows[:, first:last] = np.add.reduceat(parts, self.starts[:-1], axis=0)
            first = last
        rows += 1e-9  # a scene that is like all others has no direction
        return EmbeddedStore.of(np.arange(len(self)), rows, bits=32)

    def nearest(self, words: Mapping[str, NDArray[np.floating]], most: int) -> NDArray[np.int64]:
        """Return rows of the scenes most like what was said: the mean vector (d,) by encoder's key."""
        parts = [
            words[key] - v.mean if key in words else np.zeros(v.vectors.shape[1])
            for key, v in self.vocabularies.items()
        ]
        found = self.store.search(np.concatenate(parts)[None].astype(np.float32) + 1e-9, most)
        return np.sort(found.ids[0])

    def subset(self, rows: NDArray[np.int64]) -> Index:
        """Return the index of some scenes, with the same notion of what is usual."""
        objects = expand_runs(self.starts, rows)
        places = expand_runs(self.place_starts, rows)
        return Index(
            owner=np.unique(self.owner[rows], return_inverse=True)[1].ravel(),
            starts=compute_offsets(np.diff(self.starts)[rows]),
            share=self.share[objects],
            vocabularies={key: v.of_objects(objects) for key, v in self.vocabularies.items()},
            place_starts=compute_offsets(np.diff(self.place_starts)[rows]),
            places=self.places[places],
            panoramas=self.panoramas[places],
        )


def find_distinct(rows: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first rows (U,) of those that differ of rows (P, d), and which of them each is (P,).

    By a 64-bit hash: sorting the rows themselves would take a hundred times as long.
    """
    hashes = hash_rows(np.ascontiguousarray(rows, np.float32).view(np.uint32))
    _, first, code = np.unique(hashes, return_index=True, return_inverse=True)
    return first, code.ravel()


def compute_offsets(counts: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first row (S + 1,) of each of S runs of these lengths, and where the last ends."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def expand_runs(starts: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all numbers from starts[r] to starts[r + 1], for each of some rows."""
    counts = np.diff(starts)[rows]
    first = np.repeat(starts[rows] - compute_offsets(counts)[:-1], counts)
    return np.asarray(first + np.arange(int(counts.sum())))


KIND = "library"
VERSION = 1
GRAIN = 0.01  # Of positions and extents [m]
DECOYS = "data/decoys.library"


def pack_signatures(
    signatures: Sequence[Signature], keys: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Return signatures as columns of a file, with their vectors of the encoders of these keys."""
    graphs = [s.graph for s in signatures]
    labels = sorted({label for g in graphs for label in g.labels})
    kinds = sorted({kind for g in graphs for kind in g.relations})
    code, kind_code = ({w: i for i, w in enumerate(words)} for words in (labels, kinds))
    extents = [np.zeros_like(g.positions) if g.extents is None else g.extents for g in graphs]
    attributes = (a for s in signatures for a in s.attributes)

    def join(column: str) -> NDArray[Any]:
        return np.concatenate([getattr(s, column) for s in signatures])

    arrays: dict[str, NDArray[Any]] = {
        "objects": np.array([len(g) for g in graphs], np.int32),
        "edges": np.array([len(g.relations) for g in graphs], np.int32),
        "ids": pack_strings([i for g in graphs for i in g.ids]),
        "labels": pack_strings(labels),
        "label_of": np.array([code[x] for g in graphs for x in g.labels], np.int32),
        "object_names": pack_strings([n for g in graphs for n in g.names]),
        "attributes": pack_strings(
            [json.dumps(a, ensure_ascii=False, sort_keys=True) if a else "" for a in attributes]
        ),
        "positions": _quantize_lengths(np.concatenate([g.positions for g in graphs])),
        "extents": _quantize_lengths(np.concatenate(extents)),
        "sources": np.concatenate([g.sources for g in graphs]).astype(np.int32),
        "targets": np.concatenate([g.targets for g in graphs]).astype(np.int32),
        "relations": pack_strings(kinds),
        "relation_of": np.array([kind_code[r] for g in graphs for r in g.relations], np.int32),
        "share": join("share").astype(np.float16),
        "part": join("part").astype(np.int32),
        "place_part": join("place_part").astype(np.int32),
        "place_counts": np.array([len(s.places) for s in signatures], np.int32),
        "places": _quantize_lengths(join("places")),
        "panoramas": join("panoramas").reshape(-1, TURNS),
    }
    for i, key in enumerate(keys):
        vectors = np.concatenate([s.vectors[key] for s in signatures])
        first, rows = find_distinct(vectors)
        numbers, scales = quantize_vectors(vectors[first])
        arrays |= {
            f"vectors_{i}": numbers,
            f"scales_{i}": scales,
            f"code_{i}": rows.astype(np.int32),
        }
    return arrays


def _quantize_lengths(metres: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.rint(metres / GRAIN).astype(np.int32)


def read_signatures(file: MapFile, keys: list[str]) -> list[Signature]:
    """Read the signatures of a file; raises any error where columns do not fit."""
    grain = float(file.meta["grain"])
    objects, edges, places = (
        _check_counts(file.array(name, "<i4")) for name in ("objects", "edges", "place_counts")
    )
    labels, kinds = file.strings("labels"), file.strings("relations")
    label_of, kind_of = file.array("label_of", "<i4"), file.array("relation_of", "<i4")
    ids, names = file.strings("ids"), file.strings("object_names")
    attributes = [json.loads(a) if a else {} for a in file.strings("attributes")]
    positions, extents = (file.array(name, "<i4", 2) * grain for name in ("positions", "extents"))
    sources, targets = file.array("sources", "<i4"), file.array("targets", "<i4")
    share = file.array("share", "<f2").astype(np.float32)
    points = (file.array("places", "<i4", 2) * grain).astype(np.float32)
    panoramas = file.array("panoramas", "<u2", 2).reshape(-1, BANDS, TURNS)
    part, place_part = file.array("part", "<i4"), file.array("place_part", "<i4")
    vectors = {key: _unpack_vectors(file, i, int(objects[-1])) for i, key in enumerate(keys)}
    lengths = {len(x) for x in (ids, names, attributes, positions, extents, label_of, share, part)}
    of_places = {len(x) for x in (points, panoramas, place_part)}
    if lengths != {int(objects[-1])} or of_places != {int(places[-1])}:
        raise ValueError("columns are of different lengths")
    if (
        not (np.isfinite(share).all() and (share >= 0).all())
        or (np.diff(places) < 1).any()
        or (np.diff(objects) < 1).any()
    ):
        raise ValueError("share, place_counts")
    out = []
    for s in range(len(objects) - 1):
        own, edge = slice(*objects[s : s + 2]), slice(*edges[s : s + 2])
        place = slice(*places[s : s + 2])
        graph = SceneGraph(
            ids=ids[own],
            labels=tuple(labels[i] for i in label_of[own].tolist()),
            names=names[own],
            positions=positions[own],
            extents=extents[own],
            sources=sources[edge].astype(np.int64),
            relations=tuple(kinds[i] for i in kind_of[edge].tolist()),
            targets=targets[edge].astype(np.int64),
        )
        if int(panoramas[place].max()) > len(graph):
            raise ValueError("panoramas refer to missing objects")
        out.append(
            Signature(
                graph=graph,
                attributes=tuple(
                    {str(k): str(v) for k, v in dict(a).items()} for a in attributes[own]
                ),
                vectors={key: v[own] for key, v in vectors.items()},
                share=share[own],
                places=points[place],
                panoramas=panoramas[place],
                part=part[own],
                place_part=place_part[place],
            )
        )
    return out


def _unpack_vectors(file: MapFile, i: int, count: int) -> NDArray[np.float32]:
    numbers, scales = file.array(f"vectors_{i}", "|i1", 2), file.array(f"scales_{i}", "<f4")
    code = file.array(f"code_{i}", "<i4")
    if len(scales) != len(numbers) or not np.isfinite(scales).all() or len(code) != count:
        raise ValueError(f"vectors_{i} have wrong shapes")
    if count and not 0 <= int(code.min()) <= int(code.max()) < len(numbers):
        raise ValueError(f"code_{i} refers to missing vectors")
    vectors = dequantize_vectors(numbers, scales)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray((vectors / np.where(lengths > 1e-6, lengths, np.inf))[code], np.float32)


def _check_counts(counts: NDArray[np.int32]) -> NDArray[np.int64]:
    if not counts.size or int(counts.min()) < 0:
        raise ValueError("a count is negative, or there is no scene")
    return np.concatenate([[0], np.cumsum(counts.astype(np.int64))])


def load_decoys(encoders: Sequence[Encoder]) -> list[Signature]:
    """Return signatures of homes that are in no library, with vectors of these encoders.

    A library of one scene could say nothing of what is rare, and every capture would be of the best of
    its scenes. So drawn homes of many styles stand beside it (`placegraph-lab decoys` makes them, of homes
    that no figure is taken on): they tell what is usual in homes, and a capture that fits some of them
    as well as any scene was taken elsewhere. Speaker verification calls such a set a cohort.

    Vectors of labels are made of the labels; of encoders that the file has no vectors of, they are
    zero: to these, the homes say neither yes nor no.
    """

    def vectors(signature: Signature, encoder: Encoder) -> NDArray[np.float32]:
        if encoder.name == "labels":
            from placegraph.indoor.encode.labels import LabelsEncoder

            assert isinstance(encoder, LabelsEncoder)  # noqa: S101
            return np.stack([encoder.vector(label) for label in signature.graph.labels])
        zeros = np.zeros((len(signature), encoder.dimension), np.float32)
        return signature.vectors.get(encoder.key, zeros)

    return [replace(s, vectors={e.key: vectors(s, e) for e in encoders}) for s in _read_decoys()]


@lru_cache(maxsize=1)
def _read_decoys() -> tuple[Signature, ...]:
    with as_file(files("placegraph.indoor.library").joinpath(DECOYS)) as path:
        file = read_map(path, KIND, VERSION)
        return tuple(read_signatures(file, [str(e["key"]) for e in file.meta["encoders"]]))
