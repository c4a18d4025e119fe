"""Signatures as the columns of a library's file (`docs/formats.md`), and those that ship: decoys."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.core.mapfile import MapFile, pack_strings, read_map
from placegraph.indoor.encode import Encoder
from placegraph.indoor.library.index import distinct
from placegraph.indoor.library.signature import BANDS, TURNS, Signature
from placegraph.indoor.map.scene import from_8_bits, in_8_bits

KIND = "library"
VERSION = 1
GRAIN = 0.01
"""Of positions and extents [m]."""
DECOYS = "data/decoys.library"


def columns(signatures: Sequence[Signature], keys: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of signatures, with their vectors of the encoders of these keys."""
    arrays = _graphs(signatures) | _panoramas(signatures)
    for i, key in enumerate(keys):
        arrays |= _vectors(i, np.concatenate([s.vectors[key] for s in signatures]))
    return arrays


def _graphs(signatures: Sequence[Signature]) -> dict[str, NDArray[Any]]:
    graphs = [s.graph for s in signatures]
    labels = sorted({label for g in graphs for label in g.labels})
    kinds = sorted({kind for g in graphs for kind in g.relations})
    code, kind_code = ({w: i for i, w in enumerate(words)} for words in (labels, kinds))
    extents = [np.zeros_like(g.positions) if g.extents is None else g.extents for g in graphs]
    attributes = (a for s in signatures for a in s.attributes)
    return {
        "objects": np.array([len(g) for g in graphs], np.int32),
        "edges": np.array([len(g.relations) for g in graphs], np.int32),
        "ids": pack_strings([i for g in graphs for i in g.ids]),
        "labels": pack_strings(labels),
        "label_of": np.array([code[x] for g in graphs for x in g.labels], np.int32),
        "object_names": pack_strings([n for g in graphs for n in g.names]),
        "attributes": pack_strings(
            [json.dumps(a, ensure_ascii=False, sort_keys=True) if a else "" for a in attributes]
        ),
        "positions": _in_steps(np.concatenate([g.positions for g in graphs])),
        "extents": _in_steps(np.concatenate(extents)),
        "sources": np.concatenate([g.sources for g in graphs]).astype(np.int32),
        "targets": np.concatenate([g.targets for g in graphs]).astype(np.int32),
        "relations": pack_strings(kinds),
        "relation_of": np.array([kind_code[r] for g in graphs for r in g.relations], np.int32),
    }


def _panoramas(signatures: Sequence[Signature]) -> dict[str, NDArray[Any]]:
    return {
        "share": np.concatenate([s.share for s in signatures]).astype(np.float16),
        "part": np.concatenate([s.part for s in signatures]).astype(np.int32),
        "place_part": np.concatenate([s.place_part for s in signatures]).astype(np.int32),
        "place_counts": np.array([len(s.places) for s in signatures], np.int32),
        "places": _in_steps(np.concatenate([s.places for s in signatures])),
        "panoramas": np.concatenate([s.panoramas for s in signatures]).reshape(-1, TURNS),
    }


def _vectors(i: int, vectors: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    first, code = distinct(vectors)
    numbers, scales = in_8_bits(vectors[first])
    return {f"vectors_{i}": numbers, f"scales_{i}": scales, f"code_{i}": code.astype(np.int32)}


def _in_steps(metres: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.rint(metres / GRAIN).astype(np.int32)


def signatures_in(file: MapFile, keys: list[str]) -> list[Signature]:
    """Signatures of a file; raises any error where columns do not fit."""
    grain = float(file.meta["grain"])
    objects, edges, places = (
        _ends(file.array(name, "<i4")) for name in ("objects", "edges", "place_counts")
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
    vectors = {key: _unpacked(file, i, int(objects[-1])) for i, key in enumerate(keys)}
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
            raise ValueError("panoramas point outside the objects")
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


def _unpacked(file: MapFile, i: int, count: int) -> NDArray[np.float32]:
    numbers, scales = file.array(f"vectors_{i}", "|i1", 2), file.array(f"scales_{i}", "<f4")
    code = file.array(f"code_{i}", "<i4")
    if len(scales) != len(numbers) or not np.isfinite(scales).all() or len(code) != count:
        raise ValueError(f"vectors_{i} do not fit")
    if count and not 0 <= int(code.min()) <= int(code.max()) < len(numbers):
        raise ValueError(f"code_{i} points outside the vectors")
    vectors = from_8_bits(numbers, scales)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray((vectors / np.where(lengths > 1e-6, lengths, np.inf))[code], np.float32)


def _ends(counts: NDArray[np.int32]) -> NDArray[np.int64]:
    if not counts.size or int(counts.min()) < 0:
        raise ValueError("a count is negative, or there is no scene")
    return np.concatenate([[0], np.cumsum(counts.astype(np.int64))])


def decoys(encoders: Sequence[Encoder]) -> list[Signature]:
    """Signatures of homes that are in no library, with vectors of these encoders.

    A library of one scene could say nothing of what is rare, and every capture would be of the best of
    its scenes. So drawn homes of many styles stand beside it (`placegraph-lab decoys` makes them, of homes
    that no figure is taken on): they tell what is usual in homes, and a capture that fits some of them
    as well as any scene was taken elsewhere. Speaker verification calls such a set a cohort.

    Vectors of labels are made of the labels; of encoders that the file has no vectors of, they are
    zero: to these, the homes say neither yes nor no.
    """
    return [replace(s, vectors={e.key: _decoy_vectors(s, e) for e in encoders}) for s in _decoys()]


@lru_cache(maxsize=1)
def _decoys() -> tuple[Signature, ...]:
    with as_file(files("placegraph.indoor.library").joinpath(DECOYS)) as path:
        file = read_map(path, KIND, VERSION)
        return tuple(signatures_in(file, [str(e["key"]) for e in file.meta["encoders"]]))


def _decoy_vectors(signature: Signature, encoder: Encoder) -> NDArray[np.float32]:
    if encoder.name == "labels":
        from placegraph.indoor.encode.labels import LabelsEncoder

        assert isinstance(encoder, LabelsEncoder)  # noqa: S101
        return np.stack([encoder.vector(label) for label in signature.graph.labels])
    zeros = np.zeros((len(signature), encoder.dimension), np.float32)
    return signature.vectors.get(encoder.key, zeros)
