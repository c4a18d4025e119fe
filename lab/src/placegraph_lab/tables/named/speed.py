"""Table `speed`: time, memory, bytes and recall, beside what people would take instead.

Every method builds its map in one process, and answers in another one on one core, one question after
the other; all times are CPU seconds. `docs/benchmarks/index.md#side-by-side` explains the rows.
"""

from __future__ import annotations

import gc
import json
import os
import re
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np

from placegraph.core.geometry import Floats, LocalPlane
from placegraph.errors import PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Frame
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.tables.indoor.followers import CloudFollower, LaserFollower
from placegraph_lab.tables.indoor.metrics import near
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.named.bag_read import KINDS, repeat, time_container
from placegraph_lab.tables.named.indoor_colmap import (
    Peer,
    colmap_peer,
    extract_sift,
    extract_xfeat,
    xfeat_peer,
)
from placegraph_lab.tables.outdoor.baselines import Bag
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, Extract, unseen_queries
from placegraph_lab.tables.outdoor.metrics import BAGS, TUNED, distances
from placegraph_lab.tables.outdoor.places import Note, read_notes
from placegraph_lab.tables.outdoor.queries import Query, Setting, load
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import (
    Quick,
    Run,
    Seed,
    check_names,
    option,
    parts,
    shares,
    show,
    table,
)
from placegraph_lab.tables.statistics import peak, run_apart

TOWN = "vancouver"
METRES = (100.0, 250.0)  # A right place is within these of the truth
POSES = ((0.1, 5.0), (0.5, 10.0))  # ... and a right pose within these [m], [deg]
SENSES = PoseSearchOptions().only(depth=True, colour=True)

Ask = Callable[[Any], Any]
"""Answers one question: longitude and latitude (2,), map_from_camera (4, 4), or nothing."""


class Method(Protocol):
    """What is compared: builds a map in a folder, and opens it."""

    def build(self, folder: Path) -> None: ...

    def open(self, folder: Path) -> Ask: ...


@dataclass(frozen=True)
class Row:
    """What one method does in one task."""

    task: str
    method: str
    count: int
    right: tuple[float, ...]  # shares of the answers within both limits
    build: float  # CPU time of making the map [s]
    first: float  # ... of opening it and of the first answer [s]
    mean: float  # ... of an answer [s]
    worst: float  # ... 95 % are quicker [s]
    map_bytes: int
    memory: int  # most by which the process grew in opening and answering [bytes]


COLUMNS = (
    Col("", "method"), Col("right", "right", shares), Col("ms", "mean", 1, "", 1e3),
    Col("95 %", "worst", 1, "", 1e3), Col("first, s", "first", 2), Col("build, s", "build", 1),
    Col("map, MB", "map_bytes", 2, "", 1e-6), Col("memory, MB", "memory", 0, "", 1e-6),
)  # fmt: skip


Right = Callable[[Any, Any], tuple[bool, ...]]
"""Says of a question and its answer whether it is right, within each of two limits."""


def measure(task: str, title: str, method: Method, questions: Sequence[Any], right: Right) -> Row:
    """Build a map and ask a method, in a fresh process each."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build = run_apart(build_map, method, folder, cores=1)
        size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
        found = run_apart(ask_all, method, folder, questions, right, cores=1)
    return Row(task, title, build=build, map_bytes=size, **found)


def build_map(method: Method, folder: Path) -> float:
    """CPU time of a build [s], with that of its workers."""
    start = os.times()
    method.build(folder)
    return sum(os.times()[:4]) - sum(start[:4])


def ask_all(method: Method, folder: Path, questions: Sequence[Any], right: Right) -> dict[str, Any]:
    """Open a map and ask all questions: the fields of a `Row` that say how that went."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the largest memory is counted from here on
    before, start = peak(), time.process_time()
    ask = method.open(folder)
    seconds: list[float] = []
    held = []
    for question in questions:
        answer = ask(question)
        seconds.append(time.process_time() - start)
        held.append(right(question, answer))
        start = time.process_time()
    return {
        "count": len(held), "right": tuple(np.mean(held, axis=0).tolist()), "first": seconds[0],
        "mean": float(np.mean(seconds[1:])), "worst": float(np.quantile(seconds[1:], 0.95)),
        "memory": peak() - before,
    }  # fmt: skip


# ------------------------------------------------------------------------------- texts to places


def place_right(question: Note | Query, place: Floats | None) -> tuple[bool, ...]:
    """Whether a place (2,) longitude, latitude [deg] is within each of `METRES`."""
    if place is None:
        return (False,) * len(METRES)
    goal = question.goal if isinstance(question, Note) else (question.longitude, question.latitude)
    off = distances(place, *goal)[0]
    return tuple(bool(off <= metres) for metres in METRES)


@dataclass(frozen=True)
class Sentences:
    """`placegraph`: the whole sentence."""

    osm: Path

    def build(self, folder: Path) -> None:
        build_city(self.osm, folder / "map.city")

    def open(self, folder: Path) -> Ask:
        city = CityMap.open(folder / "map.city")

        def ask(question: Note | Query) -> Floats | None:
            try:
                best = city.locate(question.text).best
            except PlacegraphError:
                return None  # a text that says nothing of a place
            return None if best is None else np.array([best.longitude, best.latitude])

        return ask


@dataclass(frozen=True)
class WordSearch:
    """SQLite's full-text search (FTS5) of names and kinds, ranked by BM25."""

    osm: Path

    def build(self, folder: Path) -> None:
        raw = load(self.osm).city
        lonlat = raw.plane.to_lonlat(raw.center).tolist()
        pairs = zip(raw.label.tolist(), raw.named.tolist(), strict=True)
        texts = [" ".join(raw.labels[i] for i in {*pair}).replace("_", " ") for pair in pairs]
        with closing(sqlite3.connect(folder / "names.db")) as db:
            options = (
                "words, lon UNINDEXED, lat UNINDEXED, tokenize='unicode61 remove_diacritics 2'"
            )
            db.execute(f"CREATE VIRTUAL TABLE place USING fts5({options})")
            rows = ((t, *at) for t, at in zip(texts, lonlat, strict=True))
            db.executemany("INSERT INTO place VALUES (?, ?, ?)", rows)
            db.commit()

    def open(self, folder: Path) -> Ask:
        db = sqlite3.connect(folder / "names.db")
        query = "SELECT lon, lat FROM place WHERE place MATCH ? ORDER BY rank LIMIT 1"

        def ask(question: Note | Query) -> Floats | None:
            words = " OR ".join(f'"{w}"' for w in set(re.findall(r"\w+", question.text)))
            found = db.execute(query, (words,)).fetchone()
            return None if found is None else np.array(found)

        return ask


@dataclass(frozen=True)
class Triples:
    """A bag of the triples around each cell, weighed by their rarity; knows what a text means."""

    osm: Path
    names: bool

    def build(self, folder: Path) -> None:
        reach, longest = BAGS[TUNED]
        bins = load(self.osm)
        bag = Bag.of(bins, "triples", reach=reach, longest=longest, names=self.names)
        plane = (bag.plane.longitude, bag.plane.latitude)
        arrays = {k: getattr(bag, k) for k in ("centers", "words", "starts", "cells", "idf")}
        np.savez(folder / "bag.npz", plane=plane, tie_breaks=bag.tie_breaks, **arrays)
        (folder / "labels.json").write_text(json.dumps(bag.label_number))

    def open(self, folder: Path) -> Ask:
        labels = json.loads((folder / "labels.json").read_text())
        with np.load(folder / "bag.npz") as file:
            arrays = dict(file)
        plane = LocalPlane(*arrays.pop("plane").tolist())
        bag = Bag(kind="triples", plane=plane, label_number=labels, **arrays)
        return lambda question: bag.locate(question, 1)[0]


def compare_texts(run: Run, *, quick: bool, seed: int) -> list[Row]:
    """What people wrote about places of the town, and templates of tiles that trained nothing."""
    osm = run.osm / EXTRACTS[TOWN]
    extract, most = Extract(TOWN, osm), 30 if quick else 200
    city = extract.open(run.cache)
    notes = run.data / "text/vancouver_places.jsonl"
    written = [n for k in ("fountain", "art") for n in read_notes(notes, k, sentences=True)[1::2]]
    rows = []

    def row(task: str, title: str, method: Method, questions: Sequence[Any]) -> None:
        run.log(f"{task}: {title}")
        rows.append(measure(task, title, method, questions, place_right))

    settings: dict[str, Setting | None] = {
        "people's sentences about fountains and art": None,
        "templates, kinds of things": "none",
        "templates, names": "names",
    }
    for task, setting in settings.items():
        asked: Sequence[Note | Query] = written[:most]
        if setting is not None:
            asked = unseen_queries(extract, city, osm, n=most, seed=seed, setting=setting)
        row(task, "placegraph", Sentences(osm), asked)
        row(task, "SQLite FTS5", WordSearch(osm), asked)
        if setting is not None:
            row(task, "bag of triples", Triples(osm, setting == "names"), asked)
    return rows


# -------------------------------------------------------------------------------- frames to poses


@dataclass(frozen=True, eq=False)
class Question:
    """One frame, and where it was truly taken."""

    frame: Frame
    truth: Floats  # (4, 4) map_from_camera


def pose_right(question: Question, pose: Floats | None) -> tuple[bool, ...]:
    """Whether a pose (4, 4) is within each of `POSES`."""
    return tuple(pose is not None and near(pose, question.truth, limits) for limits in POSES)


@dataclass(frozen=True, eq=False)
class HalfRecording:
    """A half of a recording that a map is made of."""

    path: Path
    rows: tuple[int, int]

    def build_scene(self, folder: Path) -> None:
        how = FromCapture(frames=slice(*self.rows), landmarks=True)
        build_scene(self.path, folder / "map.scene", capture=how)

    @property
    def frames(self) -> tuple[Sequence[Frame], Floats]:
        """Frames, and their poses (T, 4, 4)."""
        rows = slice(*self.rows)
        return open_capture(self.path).frames[rows], true_poses(self.path)[rows]


@dataclass(frozen=True)
class Frames:
    """`placegraph`: each frame alone, by some senses."""

    made: HalfRecording
    options: PoseSearchOptions

    def build(self, folder: Path) -> None:
        self.made.build_scene(folder)

    def open(self, folder: Path) -> Ask:
        scene = SceneMap.open(folder / "map.scene")

        def ask(question: Question) -> Floats | None:
            alone = replace(question.frame, odometry=np.eye(4))
            best = scene.localize([alone], options=self.options).best
            return None if best is None else best.map_from_camera

        return ask


@dataclass(frozen=True)
class Features:
    """COLMAP's SIFT or XFeat (given weights): features of the mapped frames, PnP in RANSAC."""

    made: HalfRecording
    weights: Path | None = None

    def _make(self, frames: Sequence[Frame], poses: Floats) -> Peer:
        rng = np.random.default_rng(0)
        if self.weights is None:
            return colmap_peer(frames, poses, rng)
        return xfeat_peer(frames, poses, self.weights, rng)

    def build(self, folder: Path) -> None:
        self._make(*self.made.frames).save(folder / "features.npz")

    def open(self, folder: Path) -> Ask:
        features = extract_sift() if self.weights is None else extract_xfeat(self.weights)
        peer = Peer.open(folder / "features.npz", features)
        return lambda question: peer.ask(question.frame)[0]


def compare_frames(run: Run, *, quick: bool) -> list[Row]:
    """Single frames of each half of the office, in the map of the other half."""
    weights, rows = run.shared / "weights/xfeat.pt", []
    for name, made, asked in halves(run, 8 if quick else 24):
        methods: dict[str, Method] = {
            "placegraph, images and depth": Frames(made, SENSES),
            "placegraph, images": Frames(made, PoseSearchOptions().only(colour=True)),
            "COLMAP, SIFT": Features(made),
            "XFeat, lifted by depth": Features(made, weights),
        }
        for title, method in methods.items():
            run.log(f"{name}: {title}")
            rows.append(measure(f"single frames, office, {name}", title, method, asked, pose_right))
    return rows


def halves(run: Run, most: int) -> Iterator[tuple[str, HalfRecording, list[Question]]]:
    """Each half of the office, and at most so many frames spread over the other half."""
    folder = run.data / "office"
    truth, frames = true_poses(folder), open_capture(folder, labels=None).frames
    for name, (made, (low, high)) in HALVES.items():
        last = min(high, len(frames)) - 1
        rows = np.unique(np.linspace(low, last, min(most, last + 1 - low)).astype(int))
        yield name, HalfRecording(folder, made), [Question(frames[i], truth[i]) for i in rows]


# ------------------------------------------------------------------------------ following a camera


@dataclass(frozen=True)
class Follow:
    """`placegraph`: a live tracker, which is not told where it starts."""

    made: HalfRecording

    def build(self, folder: Path) -> None:
        self.made.build_scene(folder)

    def open(self, folder: Path) -> Ask:
        scene = SceneMap.open(folder / "map.scene")
        live = scene.live(seed=0, background=False, options=SENSES)
        return lambda question: live.step(question.frame).map_from_camera


@dataclass(frozen=True)
class FollowDepth:
    """A follower of today, told its first pose: small_gicp's, or a laser's."""

    made: HalfRecording
    start: tuple[float, ...]  # map_from_camera (4, 4) of the first frame, line after line
    laser: bool

    def build(self, folder: Path) -> None:
        kind, name = (LaserFollower, "map.npz") if self.laser else (CloudFollower, "map.npy")
        kind.build(*self.made.frames, folder / name)

    def open(self, folder: Path) -> Ask:
        start = np.reshape(self.start, (4, 4))
        follower: LaserFollower | CloudFollower
        if self.laser:
            follower = LaserFollower.open(folder / "map.npz", start, np.random.default_rng(0))
        else:
            follower = CloudFollower(folder / "map.npy", start)
        return lambda question: follower.step(question.frame)


def compare_followers(run: Run, *, quick: bool) -> list[Row]:
    """All frames of each half of the office, in the map of the other half."""
    rows = []
    for name, made, asked in halves(run, 1000):
        start = tuple(asked[0].truth.ravel().tolist())
        methods: dict[str, Method] = {
            "placegraph, live": Follow(made),
            "small_gicp, start told": FollowDepth(made, start, laser=False),
            "laser AMCL, start told": FollowDepth(made, start, laser=True),
        }
        for title, method in methods.items():
            run.log(f"{name}: {title}")
            task, part = f"following, office, {name}", asked[: 40 if quick else None]
            rows.append(measure(task, title, method, part, pose_right))
    return rows


def compare_readers(run: Run, *, quick: bool) -> list[dict[str, Any]]:
    """Readers of an MCAP bag: milliseconds a frame of colour and depth."""
    walk = open_capture(run.data / "house/seq00", labels=None)
    with tempfile.TemporaryDirectory() as name:
        found = time_container(repeat(walk, 40 if quick else 300), KINDS[0], Path(name), 3)
    readers = {
        "placegraph, arrays": "arrays", "placegraph, messages": "messages",
        "rosbags alone": "rosbags", "mcap alone": "mcap",
    }  # fmt: skip
    return [{"method": k, "seconds": found[v] / found["frames"]} for k, v in readers.items()]


READERS = (Col("reading an MCAP bag", "method"), Col("ms a frame", "seconds", 2, "", 1e3))
PARTS = ("texts", "frames", "following", "bags")


@table()
def speed(
    run: Run,
    only: Annotated[str, option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Time, memory, bytes and recall of everything, beside what people would take instead."""
    wanted = check_names(parts(only), PARTS, "part")
    rows: list[Row] = []
    rows += compare_texts(run, quick=quick, seed=seed) if "texts" in wanted else []
    rows += compare_frames(run, quick=quick) if "frames" in wanted else []
    rows += compare_followers(run, quick=quick) if "following" in wanted else []
    for task in dict.fromkeys(row.task for row in rows):
        mine = [row for row in rows if row.task == task]
        show(f"{task}, {mine[0].count} asked", COLUMNS, mine)
    readers = compare_readers(run, quick=quick) if "bags" in wanted else []
    if readers:
        show("", READERS, readers)
    run.save({"load": os.getloadavg(), "rows": rows, "readers": readers}, complete=not only)
