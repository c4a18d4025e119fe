"""The columns of a scene map file; what they mean stands in `docs/formats.md`."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.core.graph import SceneGraph
from placegraph.core.mapfile import (
    MapFile,
    check_contents,
    pack_strings,
    read_header,
    read_map,
    write_map,
)
from placegraph.indoor.map.mesh import Mesh, decode_high_water, encode_high_water
from placegraph.indoor.map.scene import (
    MAX_LANDMARKS,
    Landmarks,
    S,
    Scene,
    dequantize_vectors,
    quantize_vectors,
)
from placegraph.indoor.map.textures import EncodedTextures

KIND = "scene"
VERSION = 2
CENTIMETRE = 0.01  # Step of viewpoints [m]
MAX_VIEWPOINTS = 300  # Most of a scene: where its cameras were, thinned
MAX_VIEWPOINT_DISTANCE = 10.0  # Viewpoints farther outside the mesh's box are an error of poses [m]

PARTS = {
    "surface": ("vertices", "triangles", "object_of", "texture_of"),
    "colour": ("colours", "uv", "textures", "texture_bytes"),
    "embeddings": ("embeddings", "embedding_scales"),
    "landmarks": ("landmark_points", "landmark_vectors"),
}
"""Columns of a map file by what they are for; all others are the graph's."""


def save_scene(scene: Scene, path: str | PathLike[str]) -> None:
    """Write a map file (atomically, with checksums); raises as `placegraph.core.mapfile` does."""
    write_map(path, KIND, VERSION, *pack_scene(scene))


def open_scene(path: str | PathLike[str], kind: type[S]) -> S:
    """Open a map file; raises `InputError` or `MapError` where it is not a sound scene map."""
    file = read_map(path, KIND, VERSION)
    with check_contents(path, "Build it again."):
        scene = kind(**_unpack_scene(file))
        scenes = len(scene.scenes)
        if len(scene.viewpoints) > MAX_VIEWPOINTS * scenes:
            raise ValueError(
                f"viewpoints: there are {len(scene.viewpoints):,}, but at most "
                f"{MAX_VIEWPOINTS} are allowed per scene"
            )
        if len(scene.landmarks or ()) > MAX_LANDMARKS * scenes:
            raise ValueError(
                f"landmarks: there are {len(scene.landmarks or ()):,}, but at most "
                f"{MAX_LANDMARKS:,} are allowed per scene"
            )
        slack = np.array([[-CENTIMETRE], [CENTIMETRE]])  # both were rounded
        if not is_near_box(scene.viewpoints, scene.bounds + slack).all():
            raise ValueError(
                f"viewpoints: some are more than {MAX_VIEWPOINT_DISTANCE:.0f} m outside the mesh"
            )
        return scene


def is_near_box(points: NDArray[np.float64], box: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of points (N, 3) lie at most `MAX_VIEWPOINT_DISTANCE` outside a box (2, 3) [m]."""
    return np.asarray(
        (
            (points > box[0] - MAX_VIEWPOINT_DISTANCE) & (points < box[1] + MAX_VIEWPOINT_DISTANCE)
        ).all(axis=1)
    )


def pack_scene(scene: Scene) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return metadata and arrays of a scene map."""
    graph, mesh = scene.graph, scene.mesh
    grain, uv_grain = mesh.steps()
    kinds = sorted(set(graph.relations))
    code = {kind: i for i, kind in enumerate(kinds)}
    meta = {
        "source": scene.source,
        "scenes": list(scene.scenes),
        "floors": scene.floors.tolist(),
        "scene_from_map": scene.scene_from_map.tolist(),
        "grain": grain,
        "uv_grain": uv_grain,
        "encoder": scene.encoder,
    }
    if scene.anchors:
        meta["anchors"] = [anchor.to_dict() for anchor in scene.anchors]
    arrays: dict[str, NDArray[Any]] = {
        "ids": pack_strings(graph.ids),
        "labels": pack_strings(graph.labels),
        "names": pack_strings(graph.names),
        "attributes": pack_strings([_json(a) for a in scene.attributes]),
        "scene_of": scene.scene_of,
        "positions": graph.positions,
        "extents": np.zeros((len(graph), 3)) if graph.extents is None else graph.extents,
        "sources": graph.sources.astype(np.int32),
        "targets": graph.targets.astype(np.int32),
        "relation_of": np.array([code[r] for r in graph.relations], np.int32),
        "relations": pack_strings(kinds),
        "vertices": (mesh.vertices / np.float32(grain)).astype(np.int32),
        "triangles": encode_high_water(mesh.triangles),
        "object_of": mesh.object_of,
        "texture_of": mesh.texture_of,
        "uv": (mesh.uv / np.float32(uv_grain)).astype(np.int32),
        "colours": mesh.colours,
        "textures": np.frombuffer(b"".join(scene.encoded), np.uint8),
        "texture_bytes": np.array([len(b) for b in scene.encoded], np.int64),
    }
    if graph.embeddings is not None:
        arrays["embeddings"], arrays["embedding_scales"] = quantize_vectors(graph.embeddings)
    if len(scene.viewpoints):
        arrays["viewpoints"] = np.rint(scene.viewpoints / CENTIMETRE).astype(np.int32)
    if scene.own_agreement is not None:
        arrays["own_reach"] = scene.own_agreement
    if scene.landmarks is not None:
        arrays |= scene.landmarks.columns()
    return meta, arrays


def measure_parts(path: str | PathLike[str]) -> dict[str, int]:
    """Return bytes of a map file's parts: graph, surface, colour, embeddings, landmarks.

    Raises `InputError` and `MapError` as `placegraph.core.mapfile.read_header` does.
    """
    part_of = {column: part for part, columns in PARTS.items() for column in columns}
    header = read_header(path)
    total: Counter[str] = Counter({"graph": 0})
    for block in header.blocks:
        total[part_of.get(block.name, "graph")] += block.length
    total["graph"] += header.file_size - sum(total.values())
    return dict(total)


def _unpack_scene(file: MapFile) -> dict[str, Any]:
    """Return fields of a `Scene` from a file's columns."""
    if "own_agreement" in file.arrays:
        raise ValueError("own_agreement was measured by an older placegraph, in other units")
    data = file.array("textures", "|u1").tobytes()
    lengths = file.array("texture_bytes", "<i8")
    ends = np.cumsum(lengths)
    if not lengths.size or int(lengths.min()) < 0 or int(ends[-1]) != len(data):
        raise ValueError("texture_bytes do not add up")
    blobs = tuple(
        data[end - length : end]
        for end, length in zip(ends.tolist(), lengths.tolist(), strict=True)
    )
    return {
        "graph": _graph(file),
        "mesh": _mesh(file, EncodedTextures(blobs, file.header.path)),
        "attributes": _attributes(file.strings("attributes")),
        "floors": np.array(file.meta["floors"], np.float64),
        "scenes": tuple(str(name) for name in file.meta["scenes"]),
        "scene_of": file.array("scene_of", "<i4"),
        "scene_from_map": np.array(file.meta["scene_from_map"], np.float64),
        "source": str(file.meta["source"]),
        "encoded": blobs,
        "encoder": str(file.meta.get("encoder", "")),
        "landmarks": Landmarks.read(file),
        "own_agreement": (
            file.array("own_reach", "<f8", 2) if "own_reach" in file.arrays else None
        ),
        "anchors": tuple(Anchor.from_dict(dict(a)) for a in file.meta.get("anchors", ())),
        "viewpoints": (
            file.array("viewpoints", "<i4", 2) * CENTIMETRE
            if "viewpoints" in file.arrays
            else np.zeros((0, 3))
        ),
    }


def _graph(file: MapFile) -> SceneGraph:
    kinds = file.strings("relations")
    code = file.array("relation_of", "<i4")
    if code.size and not 0 <= int(code.min()) <= int(code.max()) < len(kinds):
        raise ValueError("relation_of refers to missing relations")
    return SceneGraph(
        ids=file.strings("ids"),
        labels=file.strings("labels"),
        names=file.strings("names"),
        positions=file.array("positions", "<f8", 2),
        extents=file.array("extents", "<f8", 2),
        sources=file.array("sources", "<i4").astype(np.int64),
        targets=file.array("targets", "<i4").astype(np.int64),
        relations=tuple(map(kinds.__getitem__, code.tolist())),
        embeddings=_embeddings(file) if "embeddings" in file.arrays else None,
    )


def _embeddings(file: MapFile) -> NDArray[np.float32]:
    numbers, scales = file.array("embeddings", "|i1", 2), file.array("embedding_scales", "<f4")
    if len(scales) != len(numbers) or not np.isfinite(scales).all() or (scales < 0).any():
        raise ValueError("embedding_scales do not match the embeddings")
    return dequantize_vectors(numbers, scales)


def _mesh(file: MapFile, textures: EncodedTextures) -> Mesh:
    grain, uv_grain = (float(file.meta[key]) for key in ("grain", "uv_grain"))
    if not (0 < grain < 1e6 and 0 < uv_grain < 1e6):
        raise ValueError(f"grain {grain}, uv_grain {uv_grain}")
    return Mesh(
        vertices=file.array("vertices", "<i4", 2).astype(np.float32) * np.float32(grain),
        triangles=decode_high_water(file.array("triangles", "<i4")),
        object_of=file.array("object_of", "<i4"),
        colours=file.array("colours", "|u1", 2),
        uv=file.array("uv", "<i4", 2).astype(np.float32) * np.float32(uv_grain),
        texture_of=file.array("texture_of", "<i4"),
        textures=textures,
    )


def _json(attributes: dict[str, str]) -> str:
    return json.dumps(attributes, ensure_ascii=False, sort_keys=True) if attributes else ""


def _attributes(texts: Sequence[str]) -> tuple[dict[str, str], ...]:
    found = json.loads(f"[{','.join(text or '{}' for text in texts)}]")
    if len(found) != len(texts):
        raise ValueError(f"attributes are of {len(found)} objects instead of {len(texts)}")
    return tuple({str(k): str(v) for k, v in dict(each).items()} for each in found)
