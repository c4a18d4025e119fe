"""Shards of a library as files: everything that a search derives of all scenes is written once."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import write_map
from placegraph.errors import MapError, OptionError
from placegraph.indoor.encode import Encoder, encoder
from placegraph.indoor.language.index import columns_of
from placegraph.indoor.library.library import Entry
from placegraph.indoor.library.signature import Index, load_decoys, split_into_units
from placegraph.indoor.map.scene import quantize_vectors
from placegraph_scale.library.shards import (
    BESIDE,
    HEAD,
    KIND,
    VERSION,
    Background,
    SceneShards,
)

Arrays = dict[str, NDArray[Any]]


SIZE = 10_000
"Number of scenes per shard."
SCENES_OF_USUAL = 2_000
"""Scenes of the first shard that the background model is learned from."""


class NamedEntry(NamedTuple):
    """One scene on its way into a shard."""

    name: str
    entry: Entry
    place: str = ""
    """Path of its map file, relative to the folder of the shards; empty: there is none."""


def write_shards(
    folder: str | os.PathLike[str],
    scenes: Iterable[NamedEntry],
    encoders: Sequence[str | Encoder] = ("labels", "appearance"),
    size: int = SIZE,
) -> SceneShards:
    """Write scenes into shards, so many at a time, and open them.

    The background model is learned from the first shard: draw the order of scenes at random.

    Raises `OptionError`: there is no scene, or two have one name, or the size is not positive;
    `MapError`: they cannot be written.
    """
    made = [encoder(e) if isinstance(e, str) else e for e in encoders]
    keys = [e.key for e in made]
    if size < 1:
        raise OptionError(f"size is {size}; a shard must have at least one scene.")
    folder, left = Path(folder), iter(scenes)
    usual: Background | None = None
    names: set[str] = set()
    files: list[dict[str, Any]] = []
    for number in itertools.count():
        some = list(itertools.islice(left, size))
        if not some:
            break
        if usual is None:
            _empty(folder)
            usual = learn_background(some, made)
        for listed in some:
            if listed.name in names:
                raise OptionError(f"Two scenes are named {listed.name!r}; rename one of them.")
            names.add(listed.name)
        file = f"{number:05d}.shard"
        _write(folder / file, *pack_shard(some, keys))
        files.append({"file": file, "scenes": len(some)})
    if usual is None:
        raise OptionError("There is no scene; give at least one scene map.")
    _write(folder / BESIDE, {}, pack_index(Index.of(load_decoys(made), keys)))
    head = {"encoders": [{"name": e.name, "key": e.key} for e in made], "shards": files}
    _write(folder / HEAD, {**head, **usual.meta}, usual.arrays)
    return SceneShards.open(folder, encoders=made)


def _empty(folder: Path) -> None:
    """Make the folder, without shards that stood there: its head first, so that none are half new."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / HEAD).unlink(missing_ok=True)
        for old in folder.glob("*.shard"):
            old.unlink()
    except OSError as error:
        raise MapError(
            f"{folder} cannot be written ({error.strerror}); choose another place."
        ) from error


def _write(path: Path, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    write_map(path, KIND, VERSION, meta, arrays, mapped=tuple(arrays))


def pack_shard(scenes: Sequence[NamedEntry], keys: Sequence[str]) -> tuple[dict[str, Any], Arrays]:
    """Return metadata and columns of a shard."""
    meta, arrays = pack_texts(scenes)
    signatures = [s.entry.signature for s in scenes]
    arrays |= pack_index(Index.of(signatures, keys))
    objects = [u.objects for u in split_into_units(signatures)]
    arrays["order"] = np.concatenate(objects).astype(np.uint16)
    earth = [s.entry.earth for s in scenes]
    texts = {
        "names": [s.name for s in scenes],
        "paths": [s.place for s in scenes],
        "digests": [s.entry.digest for s in scenes],
        "earth": [json.dumps([p.to_dict() for p in poses]) if poses else "" for poses in earth],
        "buildings": [
            "\n".join(sorted({p.building for p in poses if p.building})) for poses in earth
        ],
    }
    for name, strings in texts.items():
        parts = [s.encode() for s in strings]
        starts = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
        arrays[f"{name}_starts"] = starts.astype(np.int64)
        arrays[name] = np.frombuffer(b"".join(parts) or b"\0", np.uint8)
    arrays["stand_starts"] = np.cumsum([0, *map(len, earth)]).astype(np.int64)
    stands = []  # longitude, latitude [deg], covariance east, both, north [m^2], probability
    for pose in (pose for own in earth for pose in own):
        (east, both), (_, north) = pose.covariance[:2, :2].tolist()
        stands.append((pose.longitude, pose.latitude, east, both, north, pose.probability))
    arrays["stands"] = np.array(stands, float).reshape(-1, 6)
    meta["rooms"] = list(dict.fromkeys(room for s in signatures for room in s.rooms))
    return meta, arrays


def learn_background(scenes: Sequence[NamedEntry], encoders: Sequence[Encoder]) -> Background:
    """Learn what is usual in some scenes and in the homes beside them."""
    keys = [e.key for e in encoders]
    signatures = [s.entry.signature for s in scenes[:SCENES_OF_USUAL]]
    index = Index.of(signatures + load_decoys(encoders), keys)
    meta, arrays = pack_texts(scenes[:SCENES_OF_USUAL])
    for i, key in enumerate(keys):
        v = index.vocabularies[key]
        arrays[f"vectors_{i}"], arrays[f"common_{i}"] = v.vectors[v.background], v.common
    return Background(meta, arrays, keys)


def pack_index(index: Index) -> Arrays:
    """Return the columns that frames are compared with; vectors in 8 bits, each once."""
    scenes = int(index.owner[-1]) + 1
    arrays: Arrays = {
        "unit_starts": np.searchsorted(index.owner, np.arange(scenes + 1)).astype(np.int64),
        "starts": index.starts, "share": index.share, "place_starts": index.place_starts,
        "places": index.places, "panoramas": index.panoramas,
    }  # fmt: skip
    for i, v in enumerate(index.vocabularies.values()):
        numbers, scales = quantize_vectors(v.vectors)
        arrays |= {f"vectors_{i}": numbers, f"scales_{i}": scales, f"code_{i}": v.code}
        sums = np.add.reduceat(
            (v.vectors - v.mean)[v.code] * index.share[:, None], index.starts[:-1]
        )
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        arrays[f"means_{i}"] = (sums / np.maximum(lengths, 1e-9)).astype(np.float32)
    return arrays


def pack_texts(scenes: Sequence[NamedEntry]) -> tuple[dict[str, Any], Arrays]:
    """Return the columns that texts are compared with: postings of labels and of relations."""
    columns = columns_of([s.entry.signature.described for s in scenes])
    meta = {"labels": columns.labels, "relations": columns.relations, "scenes": columns.scenes}
    found = {
        "label_starts": columns.of_labels.starts, "label_units": columns.of_labels.units,
        "label_counts": columns.of_labels.counts, "triple_starts": columns.of_triples.starts,
        "triple_units": columns.of_triples.units, "triple_counts": columns.of_triples.counts,
        "triples": columns.triples, "looks": columns.appearance, "room_looks": columns.room_looks,
        "much": columns.much, "rooms": columns.rooms, "whole": columns.is_scene,
        "scene": columns.scene,
    }  # fmt: skip
    return meta, {f"text_{name}": np.asarray(array) for name, array in found.items()}
