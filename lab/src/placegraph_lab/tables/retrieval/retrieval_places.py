"""Walks of the retrieval benchmark: filmed in homes, kept on disk, decoded when asked for."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.rooms import Rooms, rooms_of
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.maps import house, place
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import WORLDS, code_key
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.home.catalogue import SYNONYMS
from placegraph_lab.worlds.home.home import STYLES, changed, home, record, scene_of, visit

LENGTH = 50  # frames of a walk through a home
RATE = 5.0  # frames a second
QUALITY = 92  # of the JPEG images, as in capture folders
_NOTHING = 255  # in label images


def filmed(flat: Flat, interior: Interior, seed: int, *, later: bool) -> Capture:
    """Walk through a home at any time of the day."""
    rng = np.random.default_rng([seed, 1 + later])
    state = changed(interior, rng) if later else interior
    walk = visit(flat, state, rng, frames=LENGTH, rate=RATE)
    daylight = float(rng.uniform())
    plain: dict[str, set[str]] = {}
    for word, others in SYNONYMS.items():
        for other in others:
            plain.setdefault(other, set()).add(word)
    labels = {thing.label for thing in state.things}
    return record(
        state,
        walk,
        rng,
        daylight=daylight,
        words={label: min(plain[label]) for label in labels if len(plain.get(label, ())) == 1},
    )


def write(path: Path, capture: Capture) -> None:
    """Write colours and labels of a capture of up to 254 labels, odometry and gravity."""
    blobs = [_jpeg(frame.rgb()) for frame in capture]
    labels = [ids for frame in capture if (ids := frame.labels()) is not None]
    content = {
        "camera": capture.camera.to_dict(),
        "label_camera": capture.label_camera.to_dict() if capture.label_camera else None,
        "label_names": {str(k): v for k, v in capture.label_names.items()},
    }
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with part.open("wb") as file:
        np.savez_compressed(
            file,
            content=np.frombuffer(json.dumps(content).encode(), np.uint8),
            images=np.frombuffer(b"".join(blobs), np.uint8),
            ends=np.cumsum([len(blob) for blob in blobs]),
            labels=np.where((ids := np.array(labels)) < 0, _NOTHING, ids).astype(np.uint8),
            stamps=capture.stamps,
            odometry=capture.odometry,
            gravity=capture.gravity,
        )
    part.replace(path)


def read(path: Path) -> Capture:
    """Capture that `write` wrote."""
    with np.load(path) as file:
        held = {name: file[name] for name in file.files}
    content = json.loads(held["content"].tobytes())
    camera = Camera(**content["camera"])
    other = content["label_camera"]
    names = {int(k): v for k, v in content["label_names"].items()}
    starts = np.concatenate([[0], held["ends"][:-1]])
    frames = [
        Frame(
            index=i,
            stamp=float(held["stamps"][i]),
            odometry=held["odometry"][i],
            gravity=held["gravity"][i],
            camera=camera,
            depth_camera=None,
            label_camera=Camera(**other) if other else None,
            label_kind="labels" if other else None,
            label_names=names,
            images=_Kept(held["images"][start:end].tobytes(), held["labels"][i] if other else None),
        )
        for i, (start, end) in enumerate(zip(starts, held["ends"], strict=True))
    ]
    return Capture.from_frames(frames)


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """Images of one frame."""

    blob: bytes
    ids: NDArray[np.uint8] | None

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return np.asarray(Image.open(io.BytesIO(self.blob)))

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return None

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        if self.ids is None:
            return None
        return np.where(self.ids == _NOTHING, -1, self.ids.astype(np.int32))


def _jpeg(colours: NDArray[np.uint8]) -> bytes:
    encoded = io.BytesIO()
    Image.fromarray(colours).save(encoded, "JPEG", quality=QUALITY)
    return encoded.getvalue()


_Number = TypeVar("_Number", bound=np.generic)

FIRST = 1000  # seed of the first home that figures are reported of; those below are for development
HOMES = 56
FINE = 0.4  # triangles of what several rooms share are cut to edges no longer than this [m]
NEAR = 0.3  # what is shared belongs to a room whose floor is no farther away than this [m]


@dataclass(frozen=True, eq=False)
class Place:
    """A scene of the library."""

    name: str
    scene: SceneMap
    room: str = ""
    """Places of one room, at different times, are not to be told apart; empty: it has but this."""


@dataclass(frozen=True, eq=False)
class Walk:
    """Frames taken in one place, some time after its map was made."""

    name: str
    place: str  # name of the place: the truth
    capture: Capture
    changed: bool  # whether things were moved, taken away or brought in since


def homes(seeds: Sequence[int], cache: Path) -> Iterator[tuple[Place, list[Walk]]]:
    """Homes, every style in turn, each with a walk as it was and one months later."""
    names = list(STYLES)
    folder = cache / f"scene_retrieval_walks_{code_key(WORLDS)}"
    for seed in seeds:
        rng = np.random.default_rng(seed)
        flat = home(rng, style=names[seed % len(names)])
        interior = flat.furnish(rng)
        name = f"home {seed}"
        walks = []
        for later in (False, True):
            kind = "later" if later else "same"
            made = partial(filmed, flat, interior, seed, later=later)
            path = folder / f"{seed} {kind}.npz"
            if not path.exists():
                write(path, made())
            capture = read(path)
            walks.append(Walk(f"{name} {kind}", name, capture, later))
        yield Place(name, scene_of(interior, name=name)), walks


# -------------------------------------------------------------------------------- house, office


def house_rooms(data: Path, cache: Path) -> tuple[list[Place], list[Walk]]:
    """Rooms of the house as scenes of their own, and what its sequences show in one room each.

    Images bring ids of objects; what the map calls these is taken for what a network says of them.
    """
    whole = house(data, cache)
    rooms = rooms_of(whole.mesh, whole.graph.labels, float(whole.floors[0]))
    places = []
    for i in range(len(rooms)):
        path = place(cache, f"house_room_{i + 1}")
        if not path.exists():
            room_scene(whole, rooms, i).save(path)
        places.append(Place(f"house {i + 1}", SceneMap.open(path)))
    names = {
        int(id_): label for id_, label in zip(whole.graph.ids, whole.graph.labels, strict=True)
    }
    walks = []
    for folder in sorted((data / "house").glob("seq[0-9]*")):
        capture = open_capture(folder)
        named = [replace(f, label_kind="labels", label_names=names) for f in capture.frames]
        of = rooms.at(true_poses(folder)[:, :3, 3])
        for i, place_ in enumerate(places):
            rows = np.flatnonzero(of == i)
            if not rows.size:
                continue
            # the longest part of the way that is spent in this room
            runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
            run = max(runs, key=len)
            frames: list[Frame] = named[run[0] : run[-1] + 1]
            told = json.loads((folder / "changes.json").read_text(encoding="utf-8"))
            walks.append(
                Walk(
                    f"{folder.name} in {place_.name}",
                    place_.name,
                    Capture.from_frames(frames),
                    bool(told["changed"]),
                )
            )
    return places, walks


def room_scene(scene: SceneMap, rooms: Rooms, room: int) -> SceneMap:
    """Map of one room: its things, and of what rooms share what is near its floor."""
    graph, mesh = scene.graph, scene.mesh
    shared = np.array(
        [(label.lower().endswith(("wall", "floor", "ceiling"))) for label in graph.labels]
    ) | (rooms.room_of < 0)
    whole = ~shared & (rooms.room_of == room)
    own = _part(mesh, whole[mesh.object_of])
    rest = finer(_part(mesh, shared[mesh.object_of]), FINE)
    middles = rest.vertices[rest.triangles].mean(axis=1)[:, :2]
    around = NEAR * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
    near = np.any([rooms.at(middles + shift) == room for shift in around], axis=0)
    joined = _joined(own, _part(rest, near))
    rows = np.unique(joined.object_of)
    at = np.full(len(graph), -1)
    at[rows] = np.arange(len(rows))
    edges = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
    return SceneMap.create(
        replace(joined, object_of=at[joined.object_of].astype(np.int32)),
        [graph.ids[i] for i in rows],
        [graph.labels[i] for i in rows],
        floor=float(scene.floors[0]),
        names=[graph.names[i] for i in rows],
        attributes=[scene.attributes[i] for i in rows],
        relations=[
            (int(at[a]), word, int(at[b])) for a, word, b in edges if at[a] >= 0 and at[b] >= 0
        ],
        scene=f"room {room + 1}",
        source=f"{scene.source}, room {room + 1}",
        encoded=scene.encoded,
    )


def finer(mesh: Mesh, longest: float) -> Mesh:
    """Mesh whose edges are no longer than this [m]: longer triangles are cut into four, and again."""
    while True:
        corners = mesh.vertices[mesh.triangles]
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
        long = edges > longest
        if not long.any():
            return mesh
        old = mesh.triangles[long]
        count, n = len(old), len(mesh.vertices)
        a, b, c = old.T
        ab, bc, ca = n + np.arange(3 * count).reshape(3, count)
        pairs = np.concatenate([old[:, [0, 1]], old[:, [1, 2]], old[:, [2, 0]]])

        fresh = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        mesh = Mesh(
            vertices=_with_middles(mesh.vertices, pairs),
            triangles=np.concatenate([mesh.triangles[~long], fresh]).astype(np.int32),
            object_of=np.concatenate([mesh.object_of[~long], np.tile(mesh.object_of[long], 4)]),
            colours=_with_middles(mesh.colours, pairs),
            uv=_with_middles(mesh.uv, pairs),
            texture_of=np.concatenate([mesh.texture_of[~long], np.tile(mesh.texture_of[long], 4)]),
            textures=mesh.textures,
        )


def _with_middles(column: NDArray[_Number], pairs: NDArray[np.int32]) -> NDArray[_Number]:
    """Rows (V, k), and below them the means of pairs (P, 2) of rows."""
    middle = column[pairs].astype(np.float64).mean(axis=1)
    return np.concatenate([column, middle.astype(column.dtype)])


def _part(mesh: Mesh, kept_: NDArray[np.bool_]) -> Mesh:
    """Mesh of some triangles (T,)."""
    triangles = mesh.triangles[kept_]
    used = np.unique(triangles)
    row = np.zeros(len(mesh.vertices), np.int32)
    row[used] = np.arange(len(used))
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        triangles=row[triangles],
        object_of=mesh.object_of[kept_],
        colours=mesh.colours[used],
        uv=mesh.uv[used],
        texture_of=mesh.texture_of[kept_],
    )


def _joined(one: Mesh, other: Mesh) -> Mesh:
    """Both meshes, which have the same textures."""
    return replace(
        one,
        vertices=np.concatenate([one.vertices, other.vertices]),
        triangles=np.concatenate([one.triangles, other.triangles + np.int32(len(one.vertices))]),
        object_of=np.concatenate([one.object_of, other.object_of]),
        colours=np.concatenate([one.colours, other.colours]),
        uv=np.concatenate([one.uv, other.uv]),
        texture_of=np.concatenate([one.texture_of, other.texture_of]),
    )


def office_half(data: Path, cache: Path) -> tuple[Place, Walk]:
    """The office as its first half shows it, cut into objects without names; and the other half."""
    (low, high), (first, last) = HALVES["b in a"]
    path = place(cache, "office_objects")
    if not path.exists():
        build_scene(data / "office", path, capture=FromCapture(frames=slice(low, high)))
    capture = open_capture(data / "office")[first:last]
    return Place("office", SceneMap.open(path)), Walk("office, other half", "office", capture, True)
