"""What is written of the scenes of a shard: everything that a search derives of all of them."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.encode import encoder
from placegraph.indoor.language.described import units
from placegraph.indoor.language.index import columns_of
from placegraph.indoor.library.index import Index
from placegraph.indoor.library.shard import Usual
from placegraph.indoor.library.shard_file import BESIDE, USUAL, packed, unfinished, write_shard
from placegraph.indoor.library.signature_file import decoys
from placegraph.indoor.map.eight_bits import in_8_bits

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.language.described import Described
    from placegraph.indoor.library.scenes import Entry
    from placegraph.indoor.library.shards import SceneShards
    from placegraph.indoor.library.signature import Signature

    Arrays = dict[str, NDArray[Any]]

SIZE = 10_000
"""Scenes of a shard."""
SCENES_OF_USUAL = 2_000
"""Scenes of the first shard that tell what is usual."""


class Listed(NamedTuple):
    """One scene on its way into a shard."""

    name: str
    entry: Entry
    place: str = ""
    """Path of its map file, relative to the folder of the shards; empty: there is none."""
    described: Sequence[Described] | None = None
    """What may be said of it, where that is known already."""


def write_shards(
    folder: str | os.PathLike[str],
    scenes: Iterable[Listed],
    encoders: Sequence[str | Encoder] = ("labels", "appearance"),
    size: int = SIZE,
) -> SceneShards:
    """Write scenes into shards, so many at a time, and open them.

    What is usual is told by the first shard, for all: draw the order of scenes at random.

    Raises
    ------
    OptionError
        There is no scene, or the size is not positive.
    MapError
        They cannot be written.

    """
    from placegraph.indoor.library.shards import SceneShards

    made = [encoder(e) if isinstance(e, str) else e for e in encoders]
    keys = [e.key for e in made]
    if size < 1:
        raise OptionError(f"size is {size}; a shard holds at least one scene.")
    folder, left = Path(folder), iter(scenes)
    unfinished(folder)
    usual, number = None, 0
    while some := list(itertools.islice(left, size)):
        if usual is None:
            usual = usual_of(some, made)
        write_shard(folder / f"{number:05d}", *shard_arrays(some, keys))
        number += 1
    if usual is None:
        raise OptionError("There is no scene: a library in shards holds at least one.")
    told = {"encoders": [{"name": e.name, "key": e.key} for e in made], **usual.meta}
    write_shard(folder / BESIDE, *beside_of(made))
    write_shard(folder / USUAL, told | {"shards": number}, usual.arrays)  # the last: all is there
    return SceneShards.open(folder, encoders=made)


def shard_arrays(scenes: Sequence[Listed], keys: Sequence[str]) -> tuple[dict[str, Any], Arrays]:
    """Metadata and columns of a shard."""
    meta, arrays = of_texts(scenes)
    arrays |= of_index(Index.of([s.entry.signature for s in scenes], keys))
    told = {
        "names": [s.name for s in scenes],
        "paths": [s.place for s in scenes],
        "digests": [s.entry.digest for s in scenes],
        "earth": [
            json.dumps([p.to_dict() for p in s.entry.earth]) if s.entry.earth else ""
            for s in scenes
        ],
    }
    for name, strings in told.items():
        arrays[name], arrays[f"{name}_starts"] = packed(strings)
    return meta, arrays


def beside_of(encoders: Sequence[Encoder]) -> tuple[dict[str, Any], Arrays]:
    """Metadata and columns of the homes that no library has."""
    return {}, of_index(Index.of(decoys(encoders), [e.key for e in encoders]))


def usual_of(scenes: Sequence[Listed], encoders: Sequence[Encoder]) -> Usual:
    """What is usual in some scenes and in the homes beside them."""
    keys = [e.key for e in encoders]
    signatures: list[Signature] = [s.entry.signature for s in scenes[:SCENES_OF_USUAL]]
    index = Index.of(signatures + decoys(encoders), keys)
    meta, arrays = of_texts(scenes[:SCENES_OF_USUAL])
    for i, key in enumerate(keys):
        v = index.vocabularies[key]
        arrays[f"vectors_{i}"], arrays[f"common_{i}"] = v.vectors[v.usual], v.common
    return Usual(meta, arrays, keys)


def of_index(index: Index) -> Arrays:
    """What frames are compared with; vectors in 8 bits, each once."""
    scenes = int(index.owner[-1]) + 1
    arrays: Arrays = {
        "unit_starts": np.searchsorted(index.owner, np.arange(scenes + 1)).astype(np.int64),
        "starts": index.starts, "share": index.share, "place_starts": index.place_starts,
        "places": index.places, "panoramas": index.panoramas,
    }  # fmt: skip
    for i, v in enumerate(index.vocabularies.values()):
        numbers, scales = in_8_bits(v.vectors)
        arrays |= {f"vectors_{i}": numbers, f"scales_{i}": scales, f"code_{i}": v.code}
        sums = np.add.reduceat(
            (v.vectors - v.mean)[v.code] * index.share[:, None], index.starts[:-1]
        )
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        arrays[f"means_{i}"] = (sums / np.maximum(lengths, 1e-9)).astype(np.float32)
    return arrays


def of_texts(scenes: Sequence[Listed]) -> tuple[dict[str, Any], Arrays]:
    """What texts are compared with: postings of labels and of relations."""
    columns = columns_of([_described(s) for s in scenes])
    meta = {"labels": columns.labels, "relations": columns.relations, "scenes": columns.scenes}
    found = {
        "label_starts": columns.of_labels.starts, "label_units": columns.of_labels.units,
        "label_counts": columns.of_labels.counts, "triple_starts": columns.of_triples.starts,
        "triple_units": columns.of_triples.units, "triple_counts": columns.of_triples.counts,
        "triples": columns.triples, "looks": columns.looks, "room_looks": columns.room_looks,
        "much": columns.much, "rooms": columns.rooms, "whole": columns.whole,
        "scene": columns.scene,
    }  # fmt: skip
    return meta, {f"text_{name}": np.asarray(array) for name, array in found.items()}


def _described(listed: Listed) -> Sequence[Described]:
    if listed.described is not None:
        return listed.described
    s = listed.entry.signature
    return units(s.graph, [a.get("room", "") for a in s.attributes], s.attributes)
