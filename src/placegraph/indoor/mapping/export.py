"""A scene map as a file for other programs: GLB, PLY, OSM, or Spark-DSG's JSON."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.files import write_file
from placegraph.core.plugins import load_module
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.textures import linear_from_srgb
from placegraph.indoor.mapping.osm import export_shapes
from placegraph.io.mesh.gltf import EXTRAS_KEY
from placegraph.io.mesh.gltf_write import Material, Part, Surface, encode_glb
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph.io.mesh.ply import write_ply
from placegraph.io.osm.indoor_osm import OSMAG_ENDINGS, encode_rooms

Paths = Mapping[str, ArrayLike]
_EYE, _MOST_EYES = 0.12, 60  # length of the pyramid that shows a camera [m]; pyramids along a path


def make_path_lines(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make segments (L, 2, 3) [m] of a camera's path (T, 4, 4), with pyramids that look ahead."""
    at = poses[:, :3, 3]
    way = np.stack([at[:-1], at[1:]], axis=1)
    corners = _EYE * np.array([(-0.5, -0.4, 1), (0.5, -0.4, 1), (0.5, 0.4, 1), (-0.5, 0.4, 1)])
    some = np.linspace(0, len(poses) - 1, min(len(poses), _MOST_EYES)).round().astype(np.int64)
    eyes = np.einsum("tij,cj->tci", poses[some, :3, :3], corners) + at[some, None]
    rims = np.stack([eyes, np.roll(eyes, -1, axis=1)], axis=2)
    rays = np.stack([np.broadcast_to(at[some, None], eyes.shape), eyes], axis=2)
    return np.concatenate([way, rims.reshape(-1, 2, 3), rays.reshape(-1, 2, 3)])


def _check_paths(paths: Paths) -> dict[str, NDArray[np.float64]]:
    checked = {str(name): np.asarray(values, np.float64) for name, values in paths.items()}
    for name, poses in checked.items():
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
            raise OptionError(
                f"camera_paths: {name!r} has shape {poses.shape}, expected (T, 4, 4)."
            )
        if not np.isfinite(poses).all():
            raise OptionError(f"camera_paths: {name!r} has a pose that is not finite; remove it.")
    return checked


_SAMPLES = np.array(
    [(0.90, 0.05), (0.70, 0.25), (0.70, 0.05), (0.50, 0.40), (0.50, 0.10), (0.40, 0.30)]
)  # Shares of a corner and of the next one at points of the corner's part of a triangle


def paint_vertices(scene: Scene) -> Model:
    """Return the map as a model without textures, whose vertices belong to one object each.

    A vertex has the mean colour of the texture around it, times its own colour: a wall of two
    triangles becomes even, a finely cut or scanned surface looks as before.
    """
    mesh, graph = scene.mesh, scene.graph
    # where textures or objects meet, each has its own vertex
    codes = (mesh.object_of.astype(np.int64) * len(mesh.textures) + mesh.texture_of)[:, None]
    keys = codes * len(mesh.vertices) + mesh.triangles
    _, first, corner = np.unique(keys, return_index=True, return_inverse=True)
    row = mesh.triangles.ravel()[first]
    triangles = corner.reshape(-1, 3).astype(np.int64)
    objects = zip(graph.ids, graph.labels, graph.names, map(dict, scene.attributes), strict=True)
    edges = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
    return Model(
        path=Path(scene.source or "scene"),
        objects=tuple(ModelObject(*columns) for columns in objects),
        vertices=mesh.vertices[row].astype(np.float64),
        triangles=triangles,
        object_of=mesh.object_of.astype(np.int64),
        colours=_tint_vertices(mesh, triangles, mesh.colours[row]),
        uv=np.zeros((len(row), 2)),
        picture_of=np.zeros(len(triangles), np.int64),
        pictures=(Texture(None),),
        relations=tuple(edges),
        floor=float(scene.floors[0]) if len(scene.floors) == 1 else None,
    )


def _tint_vertices(
    mesh: Mesh, triangles: NDArray[np.int64], colours: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Multiply colours (W, 3) of the vertices of triangles (T, 3) with the texture around them."""
    white = replace(mesh, colours=np.full_like(mesh.colours, 255))
    count = len(triangles)
    areas = np.maximum(np.linalg.norm(mesh.normals(), axis=1), 1e-12)
    sums, weights = np.zeros((len(colours), 3)), np.zeros(len(colours))
    rows = np.repeat(np.arange(count, dtype=np.int32), len(_SAMPLES))
    for k in range(3):
        shares = np.zeros((len(_SAMPLES), 3))
        shares[:, k], shares[:, (k + 1) % 3] = _SAMPLES.T
        shares[:, (k + 2) % 3] = 1.0 - _SAMPLES.sum(axis=1)
        u, v = np.tile(shares[:, 1:], (count, 1)).astype(np.float32).T
        texels = white.colour_at(rows, u, v).reshape(count, -1, 3).mean(axis=1)
        for c in range(3):
            sums[:, c] += np.bincount(triangles[:, k], areas * texels[:, c], len(colours))
        weights += np.bincount(triangles[:, k], areas, len(colours))
    return np.rint(colours * (sums / weights[:, None]) / 255.0).astype(np.uint8)


ENDINGS = (".glb", ".ply", ".json", ".osm", *OSMAG_ENDINGS)
MARK = "placegraph scene export"
"""Stands in the head of every file written here, by which it may be overwritten."""


def export(
    scene: Scene,
    path: str | PathLike[str],
    *,
    camera_paths: Paths | None = None,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write a map as a file for other programs; what it becomes is told by the ending.

    - ``.glb``: a node for each object, named as it is or by its label, with id, label and attributes
      in `extras` (attributes called as one of these: under `extras.placegraph`) and textures as the
      map has them, WebP as JPEG. `build_scene` makes the same map of it again, with
      ``detail="full"`` triangle by triangle; of several scenes one.
    - ``.ply``: one mesh with colours by vertex (textures are averaged around each vertex) and
      `objectId` by face; beside it ``NAME.labels.json`` says what the ids are called. An id that is
      no number becomes one, and the attribute ``id`` (or ``map id``) keeps it.
    - ``.osm``: rooms and doors in Simple Indoor Tagging, of an anchored map, and as osmAG where the
      ending is ``.osmag``, ``.osmag.osm`` or ``.osmag.xml``.
    - ``.json``: a scene graph as Spark-DSG saves it, for Hydra and its kin: objects with boxes,
      labels and their part of the mesh, rooms (of the attribute ``room``, or the merged scenes).

    What a file has no place for is told by `list_losses`. The old file stays until the new one is complete.

    Raises `OptionError`: the ending is another, camera paths do not fit, `path` holds something
    else already, or rooms are wanted of a map that has none or is not anchored; `MapError` or
    `MapLockedError`: the file cannot be written.

    Parameters
    ----------
    scene, path
        What to write, and the file, with one of `ENDINGS`.
    camera_paths
        Names and (T, 4, 4) map_from_camera of cameras' ways: lines in a .glb, agents in a .json.
    overwrite
        Whether to replace a file that was not written by this function.

    Returns the files that were written.

    """
    path, ending = Path(path), _ending_of(path)
    if not ending:
        raise OptionError(f"{path} has an unknown ending; choose {', '.join(ENDINGS)}.")
    paths = _check_paths(camera_paths or {})
    files = [path] if ending != ".ply" else [path, path.with_suffix(".labels.json")]
    for file in files if not overwrite else ():
        if not _is_free(file):
            raise OptionError(
                f"{file} exists and is not an earlier export; choose another file, or "
                "overwrite it (overwrite=True, or --force)."
            )
    if paths and ending not in (".glb", ".json"):
        raise OptionError(f"camera_paths: {ending} files cannot store them; export .glb or .json.")
    if ending == ".glb":
        write_file(path, [encode_scene(scene, paths)])
    elif ending in (".osm", *OSMAG_ENDINGS):
        shapes, osmag = export_shapes(scene), ending != ".osm"
        write_file(path, [encode_rooms(shapes, osmag=osmag, generator=MARK)])
    elif ending == ".json":
        write_file(path, [_encode_spark_dsg(scene, paths)])
    else:
        _write_ply(scene, path, files[1])
    return tuple(files)


def _ending_of(path: str | PathLike[str]) -> str:
    name = Path(path).name.lower()
    return max((e for e in ENDINGS if name.endswith(e)), key=len, default="")


def list_losses(scene: Scene, path: str | PathLike[str]) -> tuple[str, ...]:
    """Return sentences about the parts of a map that a file of this ending cannot hold."""
    ending, lost = _ending_of(path), []
    if ending in (".osm", *OSMAG_ENDINGS):
        return (
            "Only rooms and doors are written; the format has no furniture, surfaces or textures.",
        )
    relations = len(scene.graph.relations)
    if ending == ".ply" and relations:
        lost.append(
            f"Relations ({relations}) cannot be written to .ply; export .glb or .json to keep them."
        )
    if ending == ".ply" and any(texture.shape[:2] != (1, 1) for texture in scene.mesh.textures):
        lost.append("Textures cannot be written to .ply; they are averaged around each vertex.")
    if ending != ".json" and len(scene.scenes) > 1:
        lost.append(
            f"A map built from a {ending} has one scene, so the {len(scene.scenes)} scenes "
            "are merged into one."
        )
    return tuple(lost)


def split_surfaces(mesh: Mesh, count: int) -> list[list[Surface]]:
    """Split the mesh into surfaces of each of `count` objects, one a texture: as GLB wants it."""
    order = np.lexsort([mesh.texture_of, mesh.object_of])
    keys = np.stack([mesh.object_of[order], mesh.texture_of[order]])
    starts = np.flatnonzero(np.diff(keys, axis=1, prepend=-1).any(axis=0))
    found: list[list[Surface]] = [[] for _ in range(count)]
    coloured = bool((mesh.colours != 255).any())
    plain = [texture.shape[:2] == (1, 1) for texture in mesh.textures]
    for rows in np.split(order, starts[1:]):
        used, corners = np.unique(mesh.triangles[rows], return_inverse=True)
        texture = int(mesh.texture_of[rows[0]])
        surface = Surface(
            vertices=mesh.vertices[used],
            triangles=corners.reshape(-1, 3),
            material=texture,
            uv=None if plain[texture] else mesh.uv[used],
            colours=mesh.colours[used] if coloured else None,
        )
        found[int(mesh.object_of[rows[0]])].append(surface)
    return found


def make_materials(scene: Scene, *, webp: bool = False) -> list[Material]:
    """Return a material for each texture: the encoded image, or the colour of a single texel.

    `webp`: keep images in WebP, which browsers show and some programs do not; else they become JPEG.
    """
    from PIL import Image

    made = []
    for texture, blob in zip(scene.mesh.textures, scene.encoded, strict=True):
        if texture.shape[:2] == (1, 1):
            r, g, b = linear_from_srgb(texture[0, 0] / 255.0).tolist()
            made.append(Material(factor=(r, g, b)))
        elif blob.startswith(b"RIFF") and not webp:
            file = io.BytesIO()
            Image.fromarray(texture).save(file, "JPEG", quality=92, subsampling=0)
            made.append(Material(file.getvalue()))
        else:
            made.append(Material(blob))
    return made


def encode_scene(scene: Scene, paths: Paths | None = None) -> bytes:
    """Return the bytes of a .glb file as `export` writes it."""
    graph = scene.graph
    parts = [
        Part(graph.names[i] or graph.labels[i], surfaces, _make_extras(scene, i))
        for i, surfaces in enumerate(split_surfaces(scene.mesh, len(graph)))
    ]
    for name, poses in _check_paths(paths or {}).items():
        parts.append(Part(name, lines=make_path_lines(poses)))
    scenes = zip(scene.scenes, scene.floors.tolist(), strict=True)
    edges = zip(graph.sources, graph.relations, graph.targets, strict=True)
    note = {
        "scenes": [{"name": name, "floor": floor} for name, floor in scenes],
        "relations": [[graph.ids[s], relation, graph.ids[t]] for s, relation, t in edges],
    }
    return encode_glb(parts, make_materials(scene), extras=note, generator=MARK)


def _make_extras(scene: Scene, row: int) -> dict[str, Any]:
    """Make the extras of an object's node; attributes whose names are taken stand under a key of ours."""
    label, attributes = scene.graph.labels[row], scene.attributes[row]
    hidden = {key: attributes[key] for key in ("label", "id", EXTRAS_KEY) if key in attributes}
    own: dict[str, Any] = {"attributes": hidden} if hidden else {}
    if not scene.graph.names[row]:
        own["name"] = ""
    plain = {key: value for key, value in attributes.items() if key not in hidden}
    return {
        **plain,
        "label": label,
        "id": scene.graph.ids[row],
        **({EXTRAS_KEY: own} if own else {}),
    }


def _encode_spark_dsg(scene: Scene, paths: dict[str, NDArray[np.float64]]) -> bytes:
    writer = load_module("placegraph_io.graphs.spark_dsg_write", "io")
    if len(paths) > writer.MOST_PATHS:
        raise OptionError(
            f"camera_paths: there are {len(paths)}, but a .json file can store at most "
            f"{writer.MOST_PATHS}."
        )
    model = paint_vertices(scene)
    rooms = []
    for thing, row in zip(model.objects, scene.scene_of.tolist(), strict=True):
        room, within = thing.attributes.get("room", ""), scene.scenes[row]
        named = len(scene.scenes) > 1 or not room
        rooms.append(" ".join(filter(None, [within if named else "", room])))
    note: dict[str, Any] = {"written by": MARK, "source": scene.source}
    if model.floor is not None:
        note["floor"] = model.floor
    encoded: bytes = writer.encode_spark_dsg(model, rooms, camera_paths=paths, note=note)
    return encoded


def _write_ply(scene: Scene, path: Path, table: Path) -> None:
    model = paint_vertices(scene)
    ids = [t.id for t in model.objects]
    own = {id_ for id_ in ids if id_.isdecimal() and id_.isascii() and str(int(id_)) == id_}
    own = {id_ for id_ in own if int(id_) < 1 << 30}
    last = max((int(id_) for id_ in own), default=-1)
    numbers = []
    for id_ in ids:
        last += id_ not in own
        numbers.append(int(id_) if id_ in own else last)
    entries = []
    for number, thing in zip(numbers, model.objects, strict=True):
        attributes = dict(thing.attributes)
        if str(number) != thing.id:
            key = "id"
            while key in attributes:
                key = f"map {key}"
            attributes[key] = thing.id
        entry = {"id": number, "label": thing.label, "name": thing.name, "attributes": attributes}
        entries.append(entry)
    table_content = {"written by": MARK, "objects": entries}
    write_file(table, [json.dumps(table_content, ensure_ascii=False, indent=1).encode()])
    objects = np.array(numbers, np.int64)[model.object_of]
    write_ply(
        path, model.vertices, model.triangles, model.colours, objects=objects, comments=(MARK,)
    )


def _is_free(path: Path) -> bool:
    """Return whether a file may be written over: it is missing, empty, or was written here."""
    try:
        if not os.path.lexists(path):
            return True
        with path.open("rb") as file:
            head = file.read(1 << 12)
    except (OSError, ValueError):
        return True  # a folder, or unreadable: writing says why
    return not head or MARK.encode() in head
