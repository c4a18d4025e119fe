"""Rooms that somebody described: texts, the rooms they may mean, and a bag of words to beat.

Texts stand in `worlds/data/sentences/rooms.tsv`, written from pictures of the rooms before the reader
was improved. Rooms are cut out of the maps of their homes and lose their names, as scans have none.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from math import log
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.indoor.build import build_scene
from placegraph.indoor.language import TextIndex, read
from placegraph.indoor.map.floor import split_label
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.relations import find_relations
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.windows import house_windows
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, table
from placegraph_lab.tables.scene.sentences import (
    FACTS,
    WRONG,
    RankedSentence,
    Scene,
    ask,
    ask_pose,
    figures,
    pose_figures,
    report,
    report_poses,
    rooms_of,
    scenes_of,
)
from placegraph_lab.tables.statistics import paired_interval
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import STYLES, home, scene_of

Ranker = Callable[[str, Sequence[int]], NDArray[np.float64]]
AMONG = 10  # rooms that a text is asked of
MISSING = 1.0 / 3.0  # share of its things that a poor map misses
OTHERS = 30  # homes that nobody described, whose rooms stand among the others
_WORD = re.compile(r"[a-z]+")


@dataclass(frozen=True, slots=True)
class RoomText:
    """A text and the room it describes."""

    room: str
    text: str


def read_texts() -> list[RoomText]:
    lines = _data("rooms.tsv")
    return [RoomText(*line.split("\t")) for line in lines]


def _data(name: str) -> list[str]:
    text = files("placegraph_lab.worlds").joinpath("data", "sentences", name).read_text("utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


# ------------------------------------------------------------------------------------- rooms


def rooms_told(house: SceneMap | None = None) -> dict[str, SceneMap]:
    """Scene maps of rooms by name: of the drawn flat, the homes, the office, and the house if given."""
    out = _cut(scene_of(Flat.load("altbau").furnish(np.random.default_rng(0))), "altbau")
    for name in dict.fromkeys(t.room.partition("/")[0] for t in read_texts()):
        if name.startswith("home "):
            _, seed, style = name.split()
            rng = np.random.default_rng(int(seed))
            out |= _cut(scene_of(home(rng, style=style).furnish(rng)), name)
    for i in range(OTHERS):
        rng = np.random.default_rng(400 + i)
        style = list(STYLES)[i % len(STYLES)]
        out |= _cut(scene_of(home(rng, style=style).furnish(rng)), f"home {400 + i} {style}")
    out["office"] = office()
    if house is not None:
        for line in _data("house.tsv"):
            name, *corners = line.split("\t")
            x0, y0, x1, y1 = map(float, corners)
            x, y = house.graph.positions[:, :2].T
            inside = (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)
            boxes = house.mesh.object_bounds(len(house))
            wide = np.ptp(boxes[:, :, :2], axis=1).prod(axis=1) > 100.0  # shell of the whole house
            out[f"house/{name}"] = part_of(house, np.flatnonzero(inside & ~wide))
    return out


def _cut(scene: SceneMap, name: str) -> dict[str, SceneMap]:
    rooms = np.array([a.get("room", "") for a in scene.attributes])
    return {
        f"{name}/{room}": part_of(scene, np.flatnonzero(rooms == room))
        for room in dict.fromkeys(rooms.tolist())
        if room
    }


def part_of(scene: SceneMap, rows: NDArray[np.intp]) -> SceneMap:
    """Some objects of a map as a map of its own, whose rooms nobody named."""
    row = np.full(len(scene), -1, np.int32)
    row[rows] = np.arange(len(rows))
    kept = np.flatnonzero(row[scene.mesh.object_of] >= 0)
    mesh = replace(
        scene.mesh,
        triangles=scene.mesh.triangles[kept],
        texture_of=scene.mesh.texture_of[kept],
        object_of=row[scene.mesh.object_of[kept]],
    )
    labels = [scene.graph.labels[i] for i in rows]
    return SceneMap.create(
        mesh,
        [scene.graph.ids[i] for i in rows],
        labels,
        floor=float(scene.floors[0]),
        relations=find_relations(mesh, labels, np.zeros(len(labels), np.int64)),
        encoded=scene.encoded,
    )


def office() -> SceneMap:
    """The office that was filmed, as somebody labelled it by its pictures: boxes with a colour."""
    lines = [line.split("\t") for line in _data("office.tsv")]
    corners, faces, colours = [], [], []
    for i, (_, x, y, z, w, d, h, colour) in enumerate(lines):
        low, size = np.array([x, y, z], float), np.array([w, d, h], float)
        corners.append(low + size * np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]))
        faces.append(_BOX + 8 * i)
        colours.append(np.tile([int(colour[k : k + 2], 16) for k in (1, 3, 5)], (8, 1)))
    mesh = Mesh.plain(
        np.concatenate(corners),
        np.concatenate(faces),
        np.repeat(np.arange(len(lines)), len(_BOX)),
        np.concatenate(colours),
    )
    labels = [line[0] for line in lines]
    relations = find_relations(mesh, labels, np.zeros(len(labels), np.int64))
    ids = [str(i) for i in range(len(labels))]
    return SceneMap.create(mesh, ids, labels, floor=0.0, relations=relations)


_BOX = np.array([
    [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
    [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
])  # fmt: skip


# ------------------------------------------------------------------------------------ rankers


def reader(scenes: Sequence[SceneMap | SceneGraph]) -> Ranker:
    """Scores by what the library reads and compares."""
    every = TextIndex(scenes)

    def rank(text: str, rows: Sequence[int]) -> NDArray[np.float64]:
        index = TextIndex()
        for row in rows:
            index.add_units(every.units(row))
        return index.scores(read(text))

    return rank


def bag(scenes: Sequence[SceneMap]) -> Ranker:
    """Scores by a bag of words: cosine of tf-idf with the words of the labels, in the singular.

    How rare a word is, the rooms among which it is asked say.
    """
    every = [
        Counter(_singular(w) for label in s.graph.labels for w in split_label(label))
        for s in scenes
    ]

    def rank(text: str, rows: Sequence[int]) -> NDArray[np.float64]:
        bags = [every[row] for row in rows]
        known = Counter(word for one in bags for word in one)
        rare = {word: log((1 + len(bags)) / (1 + count)) + 1.0 for word, count in known.items()}
        said = Counter(_singular(w) for w in _WORD.findall(text.lower()))
        query = {w: (1.0 + log(n)) * rare[w] for w, n in said.items() if w in rare}
        out = np.zeros(len(bags))
        for i, one in enumerate(bags):
            weights = {w: (1.0 + log(n)) * rare[w] for w, n in one.items()}
            norm = max(np.sqrt(sum(x * x for x in weights.values())), 1e-12)
            out[i] = sum(x * weights.get(w, 0.0) for w, x in query.items()) / norm
        return out

    return rank


def _singular(word: str) -> str:
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word


def hits(
    texts: Sequence[RoomText],
    names: Sequence[str],
    rankers: Mapping[str, Ranker],
    rng: Generator,
    *,
    draws: int,
    alike: bool,
) -> dict[str, NDArray[np.float64]]:
    """Return the rate (n,) at which each text's room comes first among ten, by ranker.

    The other nine are drawn at random, the same for all rankers; of k equal scores the room has
    1 / k of the first place. `alike`: rooms of the same kind come before others, kitchens among
    kitchens.
    """
    known = np.array(names)
    kinds = np.array([name.rpartition("/")[2] for name in names])
    out = {name: np.zeros(len(texts)) for name in rankers}
    for i, said in enumerate(texts):
        own = int(np.flatnonzero(known == said.room)[0])
        for _ in range(draws):
            others = rng.permutation(np.delete(np.arange(len(known)), own))
            if alike:
                others = others[np.argsort(kinds[others] != kinds[own], kind="stable")]
            rows = [own, *others[: AMONG - 1].tolist()]
            for name, rank in rankers.items():
                scores = rank(said.text, rows)
                first = scores >= scores.max() - 1e-9
                out[name][i] += first[0] / first.sum() / draws
    return out


# ------------------------------------------------------------------------------------- report_people


def ask_people(house: SceneMap | None, rng: Generator, *, draws: int) -> list[dict[str, Any]]:
    """Share of texts whose room comes first, of each half, with intervals; one entry a row."""
    rooms = rooms_told(house)
    names, maps = list(rooms), list(rooms.values())
    whole = _rankers(maps)
    settings = (
        ("any", False, whole),
        ("of its kind first", True, whole),
        (
            "any, a third of the things missing",
            False,
            _rankers([drop_objects(m, rng) for m in maps]),
        ),
    )
    texts = read_texts()
    out = []
    for half, name in enumerate(("tuned on", "test")):
        own = [t for t in texts[half::2] if t.room in rooms]
        unread = float(np.mean([len(read(t.text).ignored) for t in own]))
        for others, alike, rankers in settings:
            found = hits(own, names, rankers, rng, draws=draws, alike=alike)
            shares = {
                ranker: paired_interval([(first, np.zeros(len(own)))], rng)
                for ranker, first in found.items()
            }
            ahead = paired_interval([(found["all"], found["bag of words"])], rng)
            out.append({
                "half": name, "others": others, "texts": len(own), "rooms": len(maps),
                "unread": unread, "first": {k: v._asdict() for k, v in shares.items()},
                "ahead": ahead._asdict(),
            })  # fmt: skip
    return out


def _rankers(maps: Sequence[SceneMap]) -> dict[str, Ranker]:
    return {
        "bag of words": bag(maps),
        "without colours": reader([m.graph for m in maps]),
        "all": reader(maps),
    }


def drop_objects(scene: SceneMap, rng: Generator, share: float = MISSING) -> SceneMap:
    """A map that misses a share of its objects, drawn at random, but at least one is left."""
    kept = np.flatnonzero(rng.random(len(scene)) >= share)
    return part_of(scene, kept if len(kept) else np.array([0]))


def report_people(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown table of what `ask_people` found."""
    header = ["texts", "ten rooms", *rows[0]["first"], "ahead of the bag", "parts unread"]
    return markdown(
        header,
        [
            [
                f"{row['texts']}, {row['half']}",
                row["others"],
                *[_between(share) for share in row["first"].values()],
                _between(row["ahead"]),
                f"{row['unread']:.1f}",
            ]
            for row in rows
        ],
    )


def _between(share: Mapping[str, float]) -> str:
    return f"{share['mean']:.2f} ({share['low']:.2f} to {share['high']:.2f})"


def _scenes(homes: int, house: SceneMap | None, rng: np.random.Generator) -> list[Scene]:
    scenes = []
    for number in range(homes):
        interior = home(rng).furnish(rng)
        scenes.append(scenes_of(scene_of(interior), f"home {number}"))
    scenes.append(scenes_of(scene_of(Flat.load("altbau").furnish(rng)), "altbau"))
    if house is not None:
        scenes += rooms_of(scenes_of(house, "house"))
    return scenes


@table()
def scene_sentences(
    run: Run,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Recall of the scene that a sentence describes, and of poses with a sentence about them."""
    # Homes, sentences a scene and row, frames from one asked about to the next, sets of ten rooms
    homes, each, every, draws = (12, 1, 100, 1) if quick else (60, 4, 8, 20)
    glb = run.data / "house/map/house.glb"
    house = build_scene(glb, None) if glb.exists() else None
    if house is None:
        run.log(f"{glb} is not there: it is left out.")
    described = ask_people(house, np.random.default_rng(seed), draws=draws)
    print(f"Rooms that somebody described, first among ten of {described[0]['rooms']}\n")
    print(f"{report_people(described)}\n")
    scenes = _scenes(homes, house, np.random.default_rng(seed))
    rng = np.random.default_rng(seed + 1)
    asked: list[RankedSentence] = []
    for facts in FACTS:
        for wrong in WRONG:
            asked += ask(scenes, rng, facts=facts, wrong=wrong, each=each)
    print(f"{len(scenes)} scenes; recall@1/3/5 among 10 and among 50\n")
    print(report(asked))
    record: dict[str, Any] = {"scenes": figures(asked), "described": described}
    if house is not None:
        windows = house_windows(run.data / "house", 1, every=every)
        spoken = ask_pose(house, windows, rng, seed=seed)
        print(f"\n{len(windows)} single frames of the house\n\n{report_poses(spoken)}")
        record["poses"] = pose_figures(spoken)
    run.save(record)
