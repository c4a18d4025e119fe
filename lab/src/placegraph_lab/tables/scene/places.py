"""Walks of the retrieval benchmark: filmed in homes, kept on disk, decoded when asked for."""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.encode import Encoder
from placegraph.indoor.encode import encoder as encoder_named
from placegraph.indoor.encode.labels import LabelsEncoder
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.rooms import Rooms, find_rooms
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.frame import Frame, Images
from placegraph_lab.tables.indoor.bench import SHARE, NoisyLabels
from placegraph_lab.tables.indoor.maps import house, place
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import INDOOR, WORLDS, code_key
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.home.change import SYNONYMS
from placegraph_lab.worlds.home.home import STYLES, change_home, home, record, scene_of, visit

LENGTH = 50  # frames of a walk through a home
RATE = 5.0  # frames a second
QUALITY = 92  # of the JPEG images, as in capture folders
_NOTHING = 255  # in label images


def film_walk(flat: Flat, interior: Interior, seed: int, *, later: bool) -> Capture:
    """Walk through a home at any time of the day."""
    rng = np.random.default_rng([seed, 1 + later])
    state = change_home(interior, rng) if later else interior
    walk = visit(flat, state, rng, frames=LENGTH, rate=RATE)
    daylight = float(rng.uniform())
    plain: dict[str, set[str]] = {}
    for word, others in SYNONYMS.items():
        for other in others:
            plain.setdefault(other, set()).add(word)
    labels = {thing.label for thing in state.objects}
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
            images=_JpegImages(
                held["images"][start:end].tobytes(), held["labels"][i] if other else None
            ),
        )
        for i, (start, end) in enumerate(zip(starts, held["ends"], strict=True))
    ]
    return Capture.from_frames(frames)


@dataclass(frozen=True, slots=True, eq=False)
class _JpegImages:
    """Images of one frame."""

    blob: bytes
    ids: NDArray[np.uint8] | None

    def rgb(self) -> NDArray[np.uint8]:
        return np.asarray(Image.open(io.BytesIO(self.blob)))

    def depth(self) -> NDArray[np.float32] | None:
        return None

    def labels(self) -> NDArray[np.int32] | None:
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
    pictures: tuple[Capture, ...] = ()
    """Images of it, posed in its map, for encoders that need some."""


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
            made = partial(film_walk, flat, interior, seed, later=later)
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
    rooms = find_rooms(whole.mesh, whole.graph.labels, float(whole.floors[0]))
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


def _part(mesh: Mesh, chosen: NDArray[np.bool_]) -> Mesh:
    """Mesh of some triangles (T,)."""
    triangles = mesh.triangles[chosen]
    used = np.unique(triangles)
    row = np.zeros(len(mesh.vertices), np.int32)
    row[used] = np.arange(len(used))
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        triangles=row[triangles],
        object_of=mesh.object_of[chosen],
        colours=mesh.colours[used],
        uv=mesh.uv[used],
        texture_of=mesh.texture_of[chosen],
    )


def _joined(one: Mesh, other: Mesh) -> Mesh:
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


_AROUND = np.ones((3, 3), np.bool_)


class NoisyThings(NoisyLabels):
    """An encoder of labels that mislabels whole things, alike in all frames that follow.

    A thing is a connected region of patches that say the same; it is the one of the frame before
    that says the same within a patch of it, the largest of several. Frames are to be asked for
    in order, each once. Parameters and errors are those of `NoisyLabels`.
    """

    def __init__(
        self,
        encoder: LabelsEncoder,
        vocabulary: Iterable[str],
        share: float = SHARE,
        *,
        seed: int = 0,
        name: str = "",
    ) -> None:
        super().__init__(encoder, vocabulary, share, seed=seed, name=name)
        self._rng = np.random.default_rng([seed, crc32(name.encode())])
        self._words: dict[bytes, int] = {}
        self._before: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None
        self._taken: list[NDArray[np.float32] | None] = []
        """Feature of the object that each object is mistaken for; None for the object itself."""

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of the next frame's patches, those of some things wrong."""
        clean = self.encoder.patches(image)
        if clean is None:
            return None
        words = self._numbered(clean)
        things = np.full(words.shape, -1)
        out = clean.copy()
        for word in np.unique(words[words >= 0]):
            regions, count = ndimage.label(words == word)
            for region in range(1, count + 1):
                own = regions == region
                thing = self._before_this(own, int(word))
                if thing is None:
                    thing = len(self._taken)
                    self._taken.append(self._drawn(clean[own][0]))
                things[own] = thing
                taken = self._taken[thing]
                if taken is not None:
                    out[own] = taken
        self._before = words, things
        return out

    def _numbered(self, clean: NDArray[np.float32]) -> NDArray[np.int64]:
        """Number (rows, columns) of what each patch says; -1 of nothing."""
        words = np.full(clean.shape[:2], -1)
        for at in zip(*np.nonzero(clean.any(axis=2)), strict=True):
            words[at] = self._words.setdefault(clean[at].tobytes(), len(self._words))
        return words

    def _before_this(self, own: NDArray[np.bool_], word: int) -> int | None:
        if self._before is None:
            return None
        words, things = self._before
        near = things[ndimage.binary_dilation(own, _AROUND) & (words == word)]
        return int(np.bincount(near).argmax()) if near.size else None

    def _drawn(self, vector: NDArray[np.float32]) -> NDArray[np.float32] | None:
        if self._rng.random() >= self.share:
            return None
        others = self.vectors[self.vectors @ vector < 1 - 1e-5]
        return np.asarray(others[self._rng.integers(len(others))])


NOISY = "labels, 30 % wrong"
THINGS = "labels, 30 % of the things wrong"
BOTH = f"{NOISY}, and appearance"
ROWS: dict[str, tuple[str, ...]] = {
    "labels": ("labels",),
    NOISY: (NOISY,),
    THINGS: (THINGS,),
    BOTH: (NOISY, "appearance"),
    f"{THINGS}, and appearance": (THINGS, "appearance"),
    "appearance": ("appearance",),
}
"""Rows of the tables: what is said of frames, by one encoder or by two."""
_ENCODER = {NOISY: "labels", THINGS: "labels"}


def encoder_of(part: str) -> Encoder:
    """Encoder of a part of a row, without noise; raises as `placegraph.indoor.encode.encoder`."""
    return encoder_named(_ENCODER.get(part, part))


def noisy(encoder: Encoder, part: str, vocabulary: Sequence[str], walk: Walk) -> Encoder:
    """Encoder as it errs on one walk; that of `THINGS` is to be asked frame by frame, in order."""
    if part not in _ENCODER:
        return encoder
    if not isinstance(encoder, LabelsEncoder):
        raise OptionError(f"{part}: noise is of labels, not of the encoder {encoder.name}.")
    kind = NoisyLabels if part == NOISY else NoisyThings
    return kind(encoder, vocabulary, name=walk.name)


@dataclass(frozen=True, eq=False)
class EncodedWalk:
    walk: Walk  # its frames bring the vectors that `Replay` says
    seconds: float  # of encoding a frame; the median


class Replay:
    """Encoder that returns cached vectors of frames, and encodes maps."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self.name, self.key = encoder, encoder.name, encoder.key
        self.dimension, self.temperature = encoder.dimension, encoder.temperature
        self.camera, self.objects = encoder.camera, encoder.objects

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        return _said_of(image, self.key)


class ReplayLabels(LabelsEncoder):
    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        return _said_of(image, self.key)


def replay(encoder: Encoder) -> Encoder:
    return ReplayLabels() if isinstance(encoder, LabelsEncoder) else Replay(encoder)


def _said_of(image: Frame, key: str) -> NDArray[np.float32] | None:
    if not isinstance(image.images, _EncodedImages):
        raise OptionError(f"frame {image.index} has not been encoded; see `encode_walk`.")
    return image.images.vectors.get(key)


@dataclass(frozen=True, slots=True, eq=False)
class _EncodedImages:
    """Images of a frame, and what was said of it."""

    images: Images
    vectors: dict[str, NDArray[np.float32]]  # by the key of the encoder

    def rgb(self) -> NDArray[np.uint8]:
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        return self.images.depth()

    def labels(self) -> NDArray[np.int32] | None:
        return self.images.labels()


def all_encoded(
    walk: Walk,
    parts: Sequence[str],
    encoders: Sequence[Encoder],
    vocabulary: Sequence[str],
    cache: Path,
) -> EncodedWalk | None:
    """Encode a walk by all encoders of a row; None where none has anything for its frames."""
    seconds, known = 0.0, False
    for part, encoder in zip(parts, encoders, strict=True):
        found = encode_walk(walk, part, encoder, vocabulary, cache)
        if found is not None:
            walk, seconds, known = found.walk, seconds + found.seconds, True
    return EncodedWalk(walk, seconds) if known else None


def encode_walk(
    walk: Walk, row: str, encoder: Encoder, vocabulary: Sequence[str], cache: Path
) -> EncodedWalk | None:
    """Encode a walk; None where the encoder has nothing for its frames.

    Answers are kept in a file under `cache` for as long as code, data and the encoder's key stay.
    """
    name = hashlib.sha256(
        "\n".join((row, encoder.key, walk.name, *vocabulary)).encode()
    ).hexdigest()[:24]
    path = cache / f"scene_retrieval_vectors_{code_key((*INDOOR, *WORLDS))}" / f"{name}.npz"
    if not path.exists():
        _write(path, noisy(encoder, row, vocabulary, walk), walk)
    with np.load(path) as file:
        seconds, table, rows = float(file["seconds"]), file["table"], file["rows"]
    if not rows.size:
        return None
    frames = [
        replace(frame, images=_added(frame.images, encoder.key, table[of].astype(np.float32)))
        for frame, of in zip(walk.capture, rows, strict=True)
    ]
    return EncodedWalk(replace(walk, capture=replace(walk.capture, frames=tuple(frames))), seconds)


def _added(images: Images, key: str, vectors: NDArray[np.float32]) -> _EncodedImages:
    if isinstance(images, _EncodedImages):
        return replace(images, vectors={**images.vectors, key: vectors})
    return _EncodedImages(images, {key: vectors})


def _write(path: Path, encoder: Encoder, walk: Walk) -> None:
    """Write vectors (T, rows, columns, d), each that differs once, and the time that a frame took."""
    spent, images = [], []
    for frame in walk.capture:
        frame.rgb(), frame.labels()  # rendering and decoding are not timed
        start = time.perf_counter()
        image = encoder.patches(frame)
        spent.append(time.perf_counter() - start)
        if image is not None:
            images.append(image)
    if images and len(images) != len(walk.capture):
        raise OptionError(f"{walk.name}: only some frames have something for {encoder.name}.")
    whole = np.array(images, np.float32) if images else np.zeros((0, 1, 1, encoder.dimension))
    flat = whole.reshape(-1, encoder.dimension)
    table, rows = np.unique(flat, axis=0, return_inverse=True)
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with part.open("wb") as file:
        np.savez_compressed(
            file,
            table=table.astype(np.float16) if len(table) > len(rows) // 4 else table,
            rows=rows.reshape(whole.shape[:3]).astype(np.int32),
            seconds=np.median(spent),
        )
    part.replace(path)
