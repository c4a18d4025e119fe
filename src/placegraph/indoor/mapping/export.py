"""A scene map as a file for other programs: GLB, PLY, or Spark-DSG's JSON."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.textures import linear_from_srgb
from placegraph.indoor.mapping.camera_paths import Paths, checked, path_lines
from placegraph.indoor.mapping.osm.export import shapes_of
from placegraph.indoor.mapping.paint import painted
from placegraph.io.mesh.gltf import OWN
from placegraph.io.mesh.gltf_write import Material, Part, Surface, encode_glb
from placegraph.io.mesh.ply import write_ply
from placegraph.io.osm.indoor_osm_write import OSMAG_ENDINGS, encode_rooms
from placegraph_io.graphs.spark_dsg_write import MOST_PATHS, encode_spark_dsg

ENDINGS = (".glb", ".ply", ".json", ".osm", *OSMAG_ENDINGS)
MARK = "placegraph scene export"
"""Stands in the head of every file written here, by which it may be overwritten."""
QUALITY = 92
"""Of JPEG, for textures that a map has in WebP."""
_HEAD = 1 << 12


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

    What a file has no place for is told by `losses`. The old file stays until the new one is complete.

    Parameters
    ----------
    scene, path
        What to write, and the file, with one of `ENDINGS`.
    camera_paths
        Names and (T, 4, 4) map_from_camera of cameras' ways: lines in a .glb, agents in a .json.
    overwrite
        Whether to replace a file that was not written by this function.

    Returns the files that were written.

    Raises
    ------
    OptionError
        The ending is another, camera paths do not fit, `path` holds something else already, or
        rooms are wanted of a map that has none or is not anchored.
    MapError, MapLockedError
        The file cannot be written.

    """
    path, ending = Path(path), _ending(path)
    if not ending:
        raise OptionError(f"{path} has an unknown ending; a map becomes {', '.join(ENDINGS)}.")
    paths = checked(camera_paths or {})
    files = [path] if ending != ".ply" else [path, path.with_suffix(".labels.json")]
    if not overwrite:
        _check_free(files)
    if paths and ending not in (".glb", ".json"):
        raise OptionError(f"camera_paths: a {ending} has no place for them; export .glb or .json.")
    if ending == ".glb":
        write_file(path, [glb_of(scene, paths)])
    elif ending in (".osm", *OSMAG_ENDINGS):
        shapes, osmag = shapes_of(scene), ending != ".osm"
        write_file(path, [encode_rooms(shapes, osmag=osmag, generator=MARK)])
    elif ending == ".json":
        if len(paths) > MOST_PATHS:
            raise OptionError(f"camera_paths: {len(paths)}; a .json holds {MOST_PATHS} at most.")
        write_file(path, [_spark_dsg(scene, paths)])
    else:
        _ply(scene, path, files[1])
    return tuple(files)


def _ending(path: str | PathLike[str]) -> str:
    """The ending that says what a map becomes; empty where it is none of `ENDINGS`."""
    name = Path(path).name.lower()
    return max((e for e in ENDINGS if name.endswith(e)), key=len, default="")


def _check_free(files: Sequence[Path]) -> None:
    for file in files:
        if not _ours(file):
            raise OptionError(
                f"{file} is there already, and is no earlier export; name another file, or allow it "
                "to be overwritten (overwrite=True, or --force)."
            )


def losses(scene: Scene, path: str | PathLike[str]) -> tuple[str, ...]:
    """What of a map a file of this ending has no place for, in sentences."""
    ending, lost = _ending(path), []
    if ending in (".osm", *OSMAG_ENDINGS):
        lost.append(
            "Rooms and doors are written; furniture, surfaces and textures have no place in it."
        )
        return tuple(lost)
    relations = len(scene.graph.relations)
    if ending == ".ply" and relations:
        lost.append(f"Relations ({relations}) have no place in a .ply; a .glb or .json keeps them.")
    if ending == ".ply" and any(texture.shape[:2] != (1, 1) for texture in scene.mesh.textures):
        lost.append("Textures have no place in a .ply; they are averaged around each vertex.")
    if ending != ".json" and len(scene.scenes) > 1:
        lost.append(
            f"A map that is built of a {ending} is one scene: {len(scene.scenes)} scenes become one."
        )
    return tuple(lost)


def object_surfaces(mesh: Mesh, count: int) -> list[list[Surface]]:
    """Surfaces of each of `count` objects, one a texture: what GLB wants."""
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


def materials(scene: Scene, *, webp: bool = False) -> list[Material]:
    """A material for each texture of a map: the encoded image, or the colour of a single texel.

    `webp`: keep images in WebP, which browsers show and some programs do not; else they become JPEG.
    """
    made = []
    for texture, blob in zip(scene.mesh.textures, scene.encoded, strict=True):
        if texture.shape[:2] == (1, 1):
            r, g, b = linear_from_srgb(texture[0, 0] / 255.0).tolist()
            made.append(Material(factor=(r, g, b)))
        elif blob.startswith(b"RIFF") and not webp:
            made.append(Material(_jpeg(texture)))
        else:
            made.append(Material(blob))
    return made


def glb_of(scene: Scene, paths: Paths | None = None) -> bytes:
    """Bytes of a .glb file, as `export` writes it."""
    graph = scene.graph
    parts = [
        Part(graph.names[i] or graph.labels[i], surfaces, _extras(scene, i))
        for i, surfaces in enumerate(object_surfaces(scene.mesh, len(graph)))
    ]
    parts += [Part(name, lines=path_lines(poses)) for name, poses in checked(paths or {}).items()]
    return encode_glb(parts, materials(scene), extras=_note(scene), generator=MARK)


def _extras(scene: Scene, row: int) -> dict[str, Any]:
    """What a node says of its object; attributes whose names are taken stand under a key of ours."""
    label, attributes = scene.graph.labels[row], scene.attributes[row]
    hidden = {key: attributes[key] for key in ("label", "id", OWN) if key in attributes}
    own: dict[str, Any] = {"attributes": hidden} if hidden else {}
    if not scene.graph.names[row]:
        own["name"] = ""
    plain = {key: value for key, value in attributes.items() if key not in hidden}
    return {**plain, "label": label, "id": scene.graph.ids[row], **({OWN: own} if own else {})}


def _jpeg(texture: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(texture).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return file.getvalue()


def _note(scene: Scene) -> dict[str, Any]:
    """What readers want to know of a map beside its objects."""
    graph = scene.graph
    scenes = [
        {"name": name, "floor": floor}
        for name, floor in zip(scene.scenes, scene.floors.tolist(), strict=True)
    ]
    rows = zip(graph.sources, graph.relations, graph.targets, strict=True)
    return {
        "scenes": scenes,
        "relations": [[graph.ids[s], relation, graph.ids[t]] for s, relation, t in rows],
    }


def _spark_dsg(scene: Scene, paths: dict[str, NDArray[np.float64]]) -> bytes:
    model = painted(scene)
    several = len(scene.scenes) > 1
    rooms = []
    for thing, row in zip(model.things, scene.scene_of.tolist(), strict=True):
        room, within = thing.attributes.get("room", ""), scene.scenes[row]
        rooms.append(" ".join(filter(None, [within if several or not room else "", room])))
    note: dict[str, Any] = {"written by": MARK, "source": scene.source}
    if model.floor is not None:
        note["floor"] = model.floor
    return encode_spark_dsg(model, rooms, camera_paths=paths, note=note)


def _ply(scene: Scene, path: Path, table: Path) -> None:
    model = painted(scene)
    numbers = _numbers([t.id for t in model.things])
    entries = []
    for number, thing in zip(numbers, model.things, strict=True):
        kept = {} if str(number) == thing.id else {_free("id", thing.attributes): thing.id}
        entry = {"id": number, "label": thing.label, "name": thing.name}
        entries.append(entry | {"attributes": {**thing.attributes, **kept}})
    told = {"written by": MARK, "objects": entries}
    write_file(table, [json.dumps(told, ensure_ascii=False, indent=1).encode()])
    write_ply(
        path,
        model.vertices,
        model.triangles,
        model.colours,
        objects=np.array(numbers, np.int64)[model.thing_of],
        comments=(MARK,),
    )


def _free(key: str, taken: Mapping[str, str]) -> str:
    """The key, or `map key`, `map map key`, ... where an object has an attribute of that name."""
    return key if key not in taken else _free(f"map {key}", taken)


def _numbers(ids: list[str]) -> list[int]:
    """Whole numbers for ids: the id itself where it is one, else the next beyond all of them."""
    own = {id_ for id_ in ids if id_.isdecimal() and id_.isascii() and str(int(id_)) == id_}
    own = {id_ for id_ in own if int(id_) < 1 << 30}
    last = max((int(id_) for id_ in own), default=-1)
    numbers = []
    for id_ in ids:
        last += id_ not in own
        numbers.append(int(id_) if id_ in own else last)
    return numbers


def _ours(path: Path) -> bool:
    """Whether a file may be written over: it is not there, is empty, or was written here."""
    try:
        if not os.path.lexists(path):
            return True
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except (OSError, ValueError):
        return True  # a folder, or unreadable: writing says why
    return not head or MARK.encode() in head
