"""Sets on which the tables of SG2Loc are measured: maps, recordings in them, and the truth."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.errors import InputError
from placegraph.indoor.build import build_scene
from placegraph.indoor.encode import BoundEncoder, Encoder, MapEncoder, encode_objects, encoder
from placegraph.indoor.encode.labels import InstancesEncoder, LabelsEncoder
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import FilterOptions, PoseSearchOptions
from placegraph.indoor.refine import RefineOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.frame import Frame
from placegraph_io.dataset.scan3r import read_rooms
from placegraph_io.dataset.scan3r_sequence import read_scan3r_sequence
from placegraph_io.dataset.scannet import axis_alignment
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor import scan3r, scannet
from placegraph_lab.tables.indoor.bench import NoisyEncoder, NoisyLabels
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.metrics import Answer, measure
from placegraph_lab.tables.indoor.scannet import register_scans
from placegraph_lab.tables.indoor.windows import (
    DRIFTING,
    HALVES,
    OFFICE_STRIDE,
    Odometry,
    Window,
    drifting_windows,
    is_changed,
    sample_frames,
    true_poses,
)
from placegraph_lab.tables.runner import INDOOR, WORLDS, Run, code_key
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.walks import write_walk
from placegraph_lab.worlds.home.home import STYLES, change_home, home, scene_of, visit

LAYOUT = """DIR/3RScan has 3RScan.json and a folder a scan (or scenes/SCAN), with its mesh, semseg.v2.json
and sequence/ or sequence.zip; where SceneGraphLoc's lists lie in DIR/3RScan/files, they part the rooms.
DIR/ScanNet has scans/sceneNNNN_NN (or sceneNNNN_NN), each with its mesh, annotation and .sens or
exported frames; beside them pairs.txt, if pairs and their alignment are known, and
SceneGraphFusion/sceneNNNN_NN, if scene graphs are to be predicted ones. A folder with data/house,
data/office and data/freiburg1_rpy is asked about these; homes are drawn."""


@dataclass(frozen=True, eq=False)
class Walk:
    """A recording that is asked about in a map."""

    name: str
    map: str
    open: Callable[[], tuple[Capture, Floats]] = field(repr=False)
    """Its frames, and their true map_from_camera (T, 4, 4)."""
    changed: bool | None = None
    """Whether things were moved since the map was made; None where nobody knows."""
    recording: str = ""
    """Name of its trajectory, if `Odometry` brings any; `name` if empty."""


@dataclass(frozen=True, eq=False)
class Set:
    """Recordings of one kind, and their maps."""

    name: str
    walks: tuple[Walk, ...]
    scene: Callable[[str], SceneMap]
    rooms: dict[str, str]  # which room each map shows: maps of one room are not to be told apart
    rate: float  # frames a second of a recording
    own_ids: bool = False  # instances of its label images are ids of the map's objects
    frames: int = 0  # of a walk, where that is known before one is opened
    pictures: Callable[[str], tuple[Capture, ...]] = lambda _: ()
    """Images that show a map's objects to an encoder, posed in the map; none where there are none."""

    @cached_property
    def longest(self) -> int:
        return self.frames or max((len(walk.open()[0]) for walk in self.walks), default=0)

    def windows(
        self, length: int, frames: int, seed: int, odometry: Odometry = DRIFTING
    ) -> list[tuple[Walk, Window]]:
        """Windows that do not overlap, of at most so many frames in all by state; 0: all of them.

        `odometry`: where their odometry and gravity come from.
        """
        found: dict[bool | None, list[tuple[Walk, Window]]] = {}
        for walk in self.walks:
            capture, truth = walk.open()
            rng = np.random.default_rng([seed, crc32(walk.name.encode())])
            made = drifting_windows(
                walk.name, capture, truth, length, rng,
                changed=walk.changed, odometry=odometry, recording=walk.recording,
            )  # fmt: skip
            found.setdefault(walk.changed, []).extend((walk, window) for window in made)
        return [pair for of_state in found.values() for pair in _thinned(of_state, frames, length)]


def _thinned(
    pairs: list[tuple[Walk, Window]], frames: int, length: int
) -> list[tuple[Walk, Window]]:
    most = max(1, frames // length) if frames else len(pairs)
    drawn = np.random.default_rng(0).permutation(len(pairs))[:most]
    return [pairs[i] for i in sorted(drawn.tolist())]


def cache_maps(scene: Callable[[str], SceneMap]) -> Callable[[str], SceneMap]:
    return lru_cache(maxsize=12)(scene)


FIRST, HOMES, WALKED = 2000, 10, 4
"""Seed of the first home, homes there are, and homes that are walked through; no other table, and no
training, draws of these seeds."""
FRAMES = 100
CAMERA = Camera(320, 240, 230.0, 230.0, 160.0, 120.0)
RPY = {"second half in the first": (0, 52, 104), "first half in the second": (52, 0, 52)}
"""Rows of freiburg1_rpy: the first of the 52 frames of the map; the frames of the query."""


def of_house(data: Path, cache: Path) -> Set:
    """The rendered house, of which methods were developed: eight walks, four after changes."""
    walks = [
        Walk(path.name, "house", partial(_recorded, path), is_changed(path / "changes.json"))
        for path in sorted((data / "house").glob("seq[0-9]*"))
    ]
    scene = cache_maps(lambda _: indoor_maps.house(data, cache))
    return Set("house", tuple(walks), scene, {"house": "house"}, 5.0, own_ids=True)


def of_office(data: Path, cache: Path) -> Set:
    """The real office, of which methods were developed: each half asked in a map of the other."""
    walks = [
        Walk(half, half, partial(_recorded, data / "office", slice(*asked, OFFICE_STRIDE)))
        for half, (_, asked) in HALVES.items()
    ]
    folder = data / "office"
    spans = {half: slice(*made) for half, (made, _) in HALVES.items()}
    rooms = dict.fromkeys(spans, "office")
    scene = _halves(folder, cache, spans)
    return Set("office", tuple(walks), scene, rooms, 5.0, pictures=_pictures(folder, spans))


def of_freiburg(data: Path, cache: Path) -> Set:
    """A real sequence, nearly all turning, of which nothing was developed: halves as of the office."""
    folder = data / "freiburg1_rpy"
    walks = [
        Walk(half, half, partial(_recorded, folder, slice(first, last)))
        for half, (_, first, last) in RPY.items()
    ]
    spans = {half: slice(low, low + 52) for half, (low, *_) in RPY.items()}
    scene = _halves(folder, cache, spans, floor=0.0)  # which one half does not show
    rooms = dict.fromkeys(spans, "desk")
    pictures = _pictures(folder, spans)
    return Set("freiburg1_rpy", tuple(walks), scene, rooms, 30 / 7, pictures=pictures)


def _pictures(folder: Path, spans: dict[str, slice]) -> Callable[[str], tuple[Capture, ...]]:
    """Return what gives the frames that a half's map was made of, posed in the map."""
    return lambda half: (_posed(*_recorded(folder, spans[half])),)


def _posed(capture: Capture, map_from_camera: Floats) -> Capture:
    frames = tuple(
        replace(frame, odometry=pose) for frame, pose in zip(capture, map_from_camera, strict=True)
    )
    return replace(capture, frames=frames)


def _halves(
    folder: Path, cache: Path, spans: dict[str, slice], floor: float | None = None
) -> Callable[[str], SceneMap]:
    def scene(half: str) -> SceneMap:
        span = spans[half]
        path = place(cache, f"{folder.name}_objects_{span.start}_{span.stop}")
        if not path.exists():
            build_scene(folder, path, capture=FromCapture(frames=span), floor=floor)
        return SceneMap.open(path)

    return cache_maps(scene)


def of_homes(cache: Path, walked: int = WALKED, frames: int = FRAMES) -> Set:
    """Drawn homes of which nothing was developed: walks as they were, and months later."""
    styles = list(STYLES)
    drawn: dict[str, tuple[Flat, Interior]] = {}
    for i, seed in enumerate(range(FIRST, FIRST + HOMES)):
        rng = np.random.default_rng(seed)
        flat = home(rng, style=styles[i % len(styles)])
        drawn[f"home {seed}"] = flat, flat.furnish(rng)
    folder = cache / f"sg2loc_homes_{code_key(WORLDS)}"

    def walk(name: str, *, later: bool) -> tuple[Capture, Floats]:
        path = folder / f"{name.replace(' ', '_')}_{later:d}_{frames}"
        if not (path / "gravity.txt").exists():  # which is written last
            flat, interior = drawn[name]
            rng = np.random.default_rng([int(name.split()[1]), 1 + later])
            now = change_home(interior, rng) if later else interior
            way = visit(flat, now, rng, frames=frames)
            write_walk(now, way, path, rng, camera=CAMERA, labels="labels", daylight=rng.uniform())
        return _recorded(path)

    walks = [
        Walk(f"{name}{' later' * later}", name, partial(walk, name, later=later), later)
        for name in list(drawn)[:walked]
        for later in (False, True)
    ]
    scene = cache_maps(lambda name: scene_of(drawn[name][1], name=name))
    return Set("homes", tuple(walks), scene, {name: name for name in drawn}, 5.0, frames=frames)


def _recorded(path: Path, rows: slice = slice(None)) -> tuple[Capture, Floats]:
    capture = open_capture(path)
    truth = true_poses(path) if (path / "trajectory.tum").exists() else capture.odometry
    return capture[rows], truth[rows]


def of_3rscan(run: Run, split: scan3r.Split, pair_list: Path | None = None) -> Set:
    """3RScan: each scan of a split is asked in one other of its room, drawn, as far as they are there.

    `pair_list`: file with the pairs instead (`scan3r.read_pairs`); if not given, `pairs.txt` if it exists.
    """
    root = run.shared / "3RScan"
    rooms = read_rooms(root / "3RScan.json")
    lists = root / "files"
    parted = any((lists / name).exists() for name in scan3r.LISTS.values())
    there = [
        replace(room, scans=tuple(s for s in room.scans if _has(root, s.id)))
        for room in scan3r.split_rooms(rooms, lists if parted else None)[split]
    ]
    known_pairs = root / "pairs.txt"
    if pair_list or known_pairs.exists():
        pairs = scan3r.read_pairs(pair_list or known_pairs, rooms)
        there = list({pair.room: rooms.room_of(pair.room) for pair in pairs}.values())
    else:
        pairs = scan3r.cross_temporal_pairs(there, np.random.default_rng(0))
    if not pairs:
        raise InputError(
            f"{root} contains no two scans of one room of the split {split!r}. {LAYOUT}"
        )
    walks = [
        Walk(p.name, p.map, partial(scan3r.read_query, root, p), p.changed, p.query) for p in pairs
    ]
    run.log(f"3RScan, {split}: {len(pairs)} pairs of {sum(len(r.scans) for r in there)} scans.")

    def scene(scan: str) -> SceneMap:
        path = place(run.cache, f"3rscan_{scan}")
        if not path.exists():
            build_scene(scan3r.scan_folder(root, scan), path)
        return SceneMap.open(path)

    def pictures(scan: str) -> tuple[Capture, ...]:
        return (read_scan3r_sequence(scan3r.scan_folder(root, scan)),)  # in the scan's own axes

    rooms_of = {
        scan.id: room.reference for room in there for scan in room.scans if _has(root, scan.id)
    }
    return Set("3RScan", tuple(walks), cache_maps(scene), rooms_of, 10.0, pictures=pictures)


def _has(root: Path, scan: str) -> bool:
    return any((folder / scan).is_dir() for folder in (root, root / "scenes"))


def of_scannet(run: Run, pair_list: Path | None = None) -> Set:
    """ScanNet: pairs of scans of a room, one image in 25; what cannot be registered is left out.

    `pair_list`: file with the pairs (`scannet.read_pairs`); if not given, `pairs.txt` if it exists.
    """
    scans = _Scans(run)
    known_pairs = scans.root / "pairs.txt"
    pairs = (
        scannet.read_pairs(pair_list or known_pairs)
        if pair_list or known_pairs.exists()
        else scannet.derive_pairs(scannet.scans_in(scans.folder))
    )
    known = [found for pair in pairs if (found := scans.register_pair(pair)) is not None]
    run.log(f"ScanNet: {len(known)} of {len(pairs)} pairs are registered.")
    if not known:
        raise InputError(f"{scans.root}: no two scans of a room could be registered. {LAYOUT}")
    walks = [
        Walk(p.name, p.map, partial(scannet.read_query, scans.folder, p), recording=p.query)
        for p in known
    ]
    rooms_of = {walk.map: walk.map.partition("_")[0] for walk in walks}
    scene, rate = cache_maps(scans.scene), 30 / scannet.EVERY
    return Set("ScanNet", tuple(walks), scene, rooms_of, rate, pictures=scans.pictures)


class _Scans:
    """ScanNet's scans, annotated and, where SceneGraphFusion was run, with its scene graphs."""

    def __init__(self, run: Run) -> None:
        self.root = run.shared / "ScanNet"
        self.folder = self.root / "scans" if (self.root / "scans").is_dir() else self.root
        self._cache = run.cache
        self._journal = replace(run, name="sg2loc_registered").journal()

    def _predicted(self, scan: str) -> Path:
        return self.root / "SceneGraphFusion" / scan

    def scene(self, scan: str) -> SceneMap:
        """Map that is asked: the predicted graph where there is one, in the recording's axes."""
        if not self._predicted(scan).is_dir():
            return self._annotated(scan)
        path = place(self._cache, f"scenegraphfusion_{scan}")
        if not path.exists():
            mesh = self.folder / scan / f"{scan}_vh_clean_2.ply"
            build_scene(self._predicted(scan), path, reader={"mesh": mesh})
        return SceneMap.open(path)

    def pictures(self, scan: str) -> tuple[Capture, ...]:
        """One image in 25 of the scan that a map shows, posed in the axes of `scene`."""
        capture = sample_frames(open_capture(self.folder / scan), scannet.EVERY)
        if self._predicted(scan).is_dir():
            return (capture,)
        return (_posed(capture, axis_alignment(self.folder / scan) @ capture.odometry),)

    def _annotated(self, scan: str) -> SceneMap:
        path = place(self._cache, f"scannet_{scan}")
        if not path.exists():
            build_scene(self.folder / scan, path)
        return SceneMap.open(path)

    def register_pair(self, pair: scannet.ScanPair) -> scannet.ScanPair | None:
        """The pair with what leads into the axes of `scene`; None where nobody can tell."""
        motion = pair.map_from_query
        if motion is None:
            key = f"{code_key(INDOOR)} {pair.name}"
            if key not in self._journal:
                two = self._annotated(pair.map), self._annotated(pair.query)
                found = register_scans(*two, np.random.default_rng(0))
                self._journal.put(key, None if found is None else found.tolist())
            if self._journal[key] is None:
                return None
            motion = np.array(self._journal[key])
        if self._predicted(pair.map).is_dir():
            motion = np.linalg.inv(axis_alignment(self.folder / pair.map)) @ motion
        return replace(pair, map_from_query=motion)


IMAGES = "appearance"  # encoder of images that bring no labels, if none is named
GRID = tuple(np.arange(0.2, 2.5, 0.2).tolist())
"""Heights of the ablation *Uniform sampling*: a grid of 0.2 m upwards, too [m]."""


@dataclass(frozen=True)
class Recipe:
    """A filter, and what comes after it."""

    options: PoseSearchOptions
    refine: bool | RefineOptions = False


def recipes() -> dict[str, Recipe]:
    """By name: the paper's, its ablations, what its authors published, and ours."""
    paper = FilterOptions.paper()
    semantic = paper.only(semantic=True)
    finest = replace(paper.passes[-1], stride=1.0)
    return {
        **{
            name: Recipe(FilterOptions.preset(name), RefineOptions.preset(name) or False)
            for name in ("paper", "published", "coarse")
        },
        "ours": Recipe(PoseSearchOptions(), refine=True),
        "semantic": Recipe(semantic),
        "semantic+depth": Recipe(paper.only(semantic=True, depth=True)),
        "depth": Recipe(paper.only(depth=True)),
        "RGB": Recipe(paper.only(colour=True)),
        "stride 1": Recipe(replace(semantic, passes=(*paper.passes[:-1], finest))),
        "uniform": Recipe(replace(semantic, heights=GRID)),
        "fixed": Recipe(replace(semantic, kld=False)),
    }


@dataclass(frozen=True)
class Reply:
    filter: Answer  # of the filter alone; its seconds are the filter's
    final: Answer  # after refinement, where there is any
    refining: float  # [s]
    right: bool  # whether it named the right one of merged scenes

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> Reply:
        return cls(**row | {name: Answer(**row[name]) for name in ("filter", "final")})


@dataclass(frozen=True)
class How:
    frames: int  # most frames asked of a set, a state and a length; 0: all
    encoder: str
    matcher: str
    seed: int
    device: str
    odometry: str = "drift"
    """``exact``, ``drift`` or a path (`Odometry.of_name`)."""


class CachedEncoder:
    """Encoder whose vectors of maps and frames are kept in files: some take seconds a frame.

    `saved_seconds` counts the seconds that encoding took when it was done: whoever measures time adds them.
    """

    def __init__(self, encoder: Encoder, folder: Path) -> None:
        self.encoder, self.name, self.key = encoder, encoder.name, encoder.key
        self.dimension, self.temperature = encoder.dimension, encoder.temperature
        self.camera = encoder.camera
        self.folder = folder / hashlib.sha256(encoder.key.encode()).hexdigest()[:16]
        self.saved_seconds = 0.0

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Return the encoder's vectors of a frame, which depend on its colours and on its way up."""
        x, y = image.gravity[:2].tolist()
        parts = (image.rgb(), np.array([x > y, x > -y]))
        found = self._load_or_make(parts, lambda: self.encoder.patches(image))
        return found if found.size else None

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """Return the encoder's vectors (N, d) of a map's objects."""
        mesh, said = scene.mesh, repr([(str(c.path), len(c)) for c in captures]).encode()
        parts = (mesh.vertices, mesh.triangles, mesh.object_of, np.frombuffer(said, np.uint8))
        return self._load_or_make(parts, lambda: self.encoder.objects(scene, captures))

    def _load_or_make(
        self,
        parts: Sequence[NDArray[Any]],
        make: Callable[[], NDArray[np.float32] | None],
    ) -> NDArray[np.float32]:
        digest = hashlib.sha256()
        for part in parts:
            digest.update(repr(part.shape).encode() + np.ascontiguousarray(part).tobytes())
        path = self.folder / f"{digest.hexdigest()[:32]}.npz"
        if path.exists():
            with np.load(path) as file:
                self.saved_seconds += float(file["seconds"])
                vectors: NDArray[np.float32] = file["vectors"]
            return vectors
        start = time.perf_counter()
        made = make()
        vectors = np.zeros(0, np.float32) if made is None else made
        self.folder.mkdir(parents=True, exist_ok=True)
        partial_ = path.with_suffix(".part")
        with partial_.open("wb") as out:
            np.savez(out, vectors=vectors, seconds=time.perf_counter() - start)
        partial_.replace(path)
        return vectors


class WindowRunner:
    """Asks about windows that nobody asked about yet; all tables share one journal."""

    def __init__(self, run: Run, how: How, *, fresh: bool) -> None:
        self.run, self.how = run, how
        self.journal = replace(run, name="sg2loc").journal(fresh=fresh)
        self._code = code_key((*INDOOR, *WORLDS))  # once: what is loaded now is what answers
        self._warm: set[str] = set()
        self._merged = lru_cache(maxsize=2)(merged_scenes)
        self.odometry = Odometry.of_name(how.odometry)

    @cached_property
    def named_encoder(self) -> CachedEncoder | None:
        """The encoder that was asked for by name; None where none was."""
        if not self.how.encoder:
            return None
        return CachedEncoder(encoder(self.how.encoder), self.run.cache / "sg2loc_vectors")

    @property
    def saved_seconds(self) -> float:
        """Seconds of encoding that were spared so far, as it had been done."""
        return self.named_encoder.saved_seconds if self.named_encoder else 0.0

    def windows(self, of: Set, length: int) -> list[tuple[Walk, Window]]:
        """Windows of a set that are asked about, with the odometry that was asked for."""
        return of.windows(length, self.how.frames, self.how.seed, self.odometry)

    def replies(
        self,
        of: Set,
        recipe: str,
        length: int,
        *,
        odometry: Odometry | None = None,
        step: int = 1,
        merged: int = 1,
    ) -> list[Reply]:
        """Replies to windows of a set; of each, every `step`-th frame is used, the last of them too."""
        how, its = self.how, recipes()[recipe]
        odometry = odometry or self.odometry
        asked = of.windows(length, how.frames, how.seed, odometry)
        known = self.named_encoder.key if self.named_encoder else "", odometry, odometry.digest()
        where = str(self.run.shared.resolve())
        said = repr((its, replace(how, frames=0, odometry=""), known, merged, where))
        base = f"{self._code} {of.name} {hashlib.sha256(said.encode()).hexdigest()[:12]}"
        asked = [(walk, _keyframes(window, step)) for walk, window in asked]
        keys = [f"{base} {walk.map} {window.name}" for walk, window in asked]

        def ask(i: int) -> Reply:
            walk, window = asked[i]
            if recipe not in self._warm:  # what is timed is compiled; `ask` readies each map
                self._warm.add(recipe)
                short = replace(window, capture=window.capture[:2])
                self.ask(of, its, of.scene(walk.map), short, walk.map)
            return self.ask(of, its, *self._place_window(of, walk, window, merged), walk.map)

        left = len(self.journal.find_missing(keys))
        if left:
            self.run.log(f"{of.name}: {recipe}, {length} frames: {left} windows to ask")
        return [Reply.from_dict(row) for row in self.journal.fill(keys, ask)]

    def _place_window(
        self, of: Set, walk: Walk, window: Window, merged: int
    ) -> tuple[SceneMap, Window]:
        if merged == 1:
            return of.scene(walk.map), window
        names = group(of, walk.map, merged)
        scene = self._merged(of, names)
        map_from_scene = np.linalg.inv(scene.scene_from_map[names.index(walk.map)])
        return scene, replace(window, truth=map_from_scene @ window.truth)

    def ask(self, of: Set, recipe: Recipe, scene: SceneMap, window: Window, name: str) -> Reply:
        """Localize a window in a map; `name`: the right one of merged scenes."""
        how = self.how
        matcher = how.matcher if isinstance(recipe.refine, RefineOptions) else "auto"
        encoder = self.ready(of, recipe, scene, window, name)
        start = time.perf_counter() + self.saved_seconds
        estimate = scene.localize(
            window.capture, encoder=encoder, options=recipe.options,
            refine=recipe.refine, matcher=matcher, seed=how.seed, device=how.device,
        )  # fmt: skip
        seconds, coarse, refining = time.perf_counter() + self.saved_seconds - start, estimate, 0.0
        if estimate.refinement is not None:
            coarse = replace(estimate, modes=(estimate.refinement.coarse, *estimate.modes[1:]))
            refining = sum(estimate.refinement.stats["seconds"].values())
        best, of_window = estimate.best, window.fields | {"coverage": None}
        return Reply(
            filter=measure(coarse, window.truth, seconds=seconds - refining, **of_window),
            final=measure(estimate, window.truth, seconds=seconds, **of_window),
            refining=refining,
            right=best is not None and (len(scene.scenes) == 1 or best.scene == name),
        )

    def ready(
        self, of: Set, recipe: Recipe, scene: SceneMap, window: Window, name: str
    ) -> MapEncoder:
        """Make what a map needs before it is asked, its mapping in Table 4; returns its encoder."""
        scene.visibility(recipe.options)  # whose panoramas every start needs; casts rays, too
        return self.encoder(of, scene, window, name)

    def encoder(self, of: Set, scene: SceneMap, window: Window, name: str) -> MapEncoder:
        """Return the encoder of a window, bound to a map, `name`, or to merged maps."""
        if of.own_ids and not self.how.encoder:
            return NoisyEncoder(InstancesEncoder(scene), seed=self.how.seed, name=window.place)
        its = self.plain_encoder(window)
        if self.named_encoder is None:
            known = scene.compute_once(("sg2loc", its.key), lambda s: encode_objects(its, s))
            return BoundEncoder(its, known)
        # merged scenes are encoded separately, and their objects stand one after the other (App. D)
        names = scene.scenes if len(scene.scenes) > 1 else (name,)
        made = [encode_objects(its, of.scene(n), of.pictures(n)) for n in names]
        return BoundEncoder(its, np.concatenate(made))

    def plain_encoder(self, window: Window) -> Encoder:
        if self.named_encoder is not None:
            return self.named_encoder
        if window.capture.label_kind != "labels":
            return encoder(IMAGES)
        words = window.capture.label_names.values()
        return NoisyLabels(LabelsEncoder(), words, seed=self.how.seed, name=window.place)


def _keyframes(window: Window, step: int) -> Window:
    return replace(window, capture=window.capture[(len(window.capture) - 1) % step :: step])


def merged_scenes(of: Set, names: tuple[str, ...]) -> SceneMap:
    return merge_scenes({name: of.scene(name) for name in names})


def group(of: Set, name: str, count: int) -> tuple[str, ...]:
    """A map and `count` - 1 others, of other rooms, that come after it; fewer where there are fewer."""
    first = {room: map_ for map_, room in reversed(of.rooms.items())} | {of.rooms[name]: name}
    rooms = list(first)
    at = rooms.index(of.rooms[name])
    return tuple(sorted(first[room] for room in (rooms[at:] + rooms[:at])[:count]))
