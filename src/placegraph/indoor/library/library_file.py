"""The columns of a library's file; what they mean stands in `docs/formats.md`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import MapError, MissingExtraError, OptionError
from placegraph.graph import SceneGraph
from placegraph.indoor.encode import ENCODERS, Encoder, encoder
from placegraph.indoor.library.index import distinct
from placegraph.indoor.library.library import Entry, SceneLibrary
from placegraph.indoor.library.signature import BANDS, TURNS, Signature
from placegraph.indoor.map.scene import from_8_bits, in_8_bits
from placegraph.store import pack_strings, read_map, write_map

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.store import MapFile

KIND = "library"
VERSION = 1
_GRAIN = 0.01  # of positions and extents [m]


def save(library: SceneLibrary, path: str | os.PathLike[str]) -> None:
    """Write a library; raises as `SceneLibrary.save` does."""
    if not len(library):
        raise OptionError("The library is empty: add a scene before you save it.")
    entries = [library.entry(name) for name in library]
    nowhere = [n for n, e in zip(library, entries, strict=True) if e.path is None]
    if nowhere:
        raise OptionError(
            f"{nowhere[0]!r} is a map in memory; save it, and add it to the library by its file."
        )
    folder = Path(path).resolve().parent
    places = [os.path.relpath(e.path.resolve(), folder) for e in entries if e.path is not None]
    signatures = [e.signature for e in entries]
    meta = {
        "encoders": [{"name": e.name, "key": e.key} for e in library.encoders],
        "digests": [e.digest for e in entries],
        "height": library.height,
        "grain": _GRAIN,
    }
    arrays = {"names": pack_strings(library.names), "paths": pack_strings(places)}
    arrays |= _graphs(signatures) | _panoramas(signatures)
    for i, e in enumerate(library.encoders):
        arrays |= _vectors(i, np.concatenate([s.vectors[e.key] for s in signatures]))
    write_map(path, KIND, VERSION, meta, arrays)


def load(
    path: str | os.PathLike[str], encoders: str | Encoder | Sequence[str | Encoder] | None = None
) -> SceneLibrary:
    """Open a library's file; raises as `SceneLibrary.open` does."""
    file = read_map(path, KIND, VERSION)
    made = _encoders(file, encoders)
    try:
        library = SceneLibrary(made, height=file.meta["height"])
        names, places = file.strings("names"), file.strings("paths")
        digests = [str(digest) for digest in file.meta["digests"]]
        signatures = _signatures(file, [e.key for e in library.encoders])
        folder = Path(path).resolve().parent
        for name, place, signature, digest in zip(names, places, signatures, digests, strict=True):
            library.insert(name, Entry(signature, Path(os.path.normpath(folder / place)), digest))
    except (OptionError, KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise MapError(
            f"{path}: its columns contradict each other ({error}). Make the library again."
        ) from error
    return library


def signatures_of(path: str | os.PathLike[str]) -> tuple[Signature, ...]:
    """Signatures of a library's file, whatever encoders it is of; raises as `load` does."""
    file = read_map(path, KIND, VERSION)
    return tuple(_signatures(file, [str(e["key"]) for e in file.meta["encoders"]]))


def _encoders(
    file: MapFile, given: str | Encoder | Sequence[str | Encoder] | None
) -> list[Encoder]:
    """Encoders of a file, made by name or given; `MapError` where these are others."""
    known = [] if given is None else [given] if isinstance(given, str | Encoder) else list(given)
    made = {e.key: e for e in (encoder(g) if isinstance(g, str) else g for g in known)}
    try:
        wanted = [(str(e["name"]), str(e["key"])) for e in file.meta["encoders"]]
    except (KeyError, TypeError) as error:
        raise MapError(f"{file.header.path}: names no encoders. Make the library again.") from error
    out = [made.get(key) or _by_name(name, key) for name, key in wanted]
    for found, (_, key) in zip(out, wanted, strict=True):
        if found is None or (made and not made.keys() & {k for _, k in wanted}):
            here = ", ".join(made) or (found.key if found else "nothing that makes such vectors")
            raise MapError(
                f"{file.header.path} was encoded by {key}, and here is {here}: open it with the "
                "encoder that it was made with (encoders=..., or --encoder and --weights), or make "
                "the library again."
            )
    return [e for e in out if e is not None]


def _by_name(name: str, key: str) -> Encoder | None:
    """Encoder that can be made by its name alone, and has this key; None where there is none."""
    try:
        made = encoder(name) if name in ENCODERS else None
    except (OptionError, MissingExtraError):  # it needs weights, or what is not installed
        return None
    return made if made is not None and made.key == key else None


def _graphs(signatures: list[Signature]) -> dict[str, NDArray[Any]]:
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


def _panoramas(signatures: list[Signature]) -> dict[str, NDArray[Any]]:
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
    return {
        f"vectors_{i}": numbers,
        f"scales_{i}": scales,
        f"code_{i}": code.astype(np.int32),
    }


def _in_steps(metres: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.rint(metres / _GRAIN).astype(np.int32)


def _signatures(file: MapFile, keys: list[str]) -> list[Signature]:
    """Signatures of a file; raises any of `load`'s errors where columns do not fit."""
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
