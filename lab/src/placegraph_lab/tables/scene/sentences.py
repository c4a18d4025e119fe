"""Which scene does a sentence describe? Sentences made of true facts, some of them wrong.

The indoor task of "Where am I?" (Chen et al.): text to scene. A scene is asked about by a sentence of
k facts about one of its rooms, drawn by a seeded generator: what room it is, how many of a thing it
holds, how two things lie, and what it lacks; a share of the facts is of another scene. The labels
are said in other words where there are some.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, split_pose
from placegraph.core.graph import SceneGraph
from placegraph.indoor.language import TextIndex, read
from placegraph.indoor.map.floor import STRUCTURE_WORDS, is_nameless, split_label
from placegraph.indoor.map.relations import SAME_ROOM
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.metrics import NEAR, Answer, measure
from placegraph_lab.tables.runner import markdown, share, shares

if TYPE_CHECKING:
    from placegraph_lab.tables.indoor.windows import Window

FACTS = (1, 2, 3, 4, 6)  # facts in a sentence
WRONG = (0.0, 0.2)  # share of them that are of another scene
AMONG = (10, 50)  # scenes that a sentence is asked of, its own among them
AT = (1, 3, 5)
_NUMBERS = ("no", "a", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_WORDS = {
    "sofa": "couch", "television": "tv", "fridge": "refrigerator", "bookcase": "bookshelf",
    "picture": "painting", "bin": "trash can", "wardrobe": "closet", "rug": "carpet",
    "nightstand": "night stand", "washbasin": "sink", "stove": "cooker", "bathtub": "bath",
}  # fmt: skip
_OTHER_WORDS = 0.3  # how often they are used
_SAID = {
    "standing on": "on", "inside": "in", "attached to": "on", "above": "above",
    "next to": "next to",
}  # fmt: skip


class Scene(NamedTuple):
    """A scene that sentences are asked of."""

    name: str
    graph: SceneGraph
    rooms: tuple[str, ...]  # (N,) room of each object, empty where it is in none


@dataclass(frozen=True, slots=True)
class RankedSentence:
    """One sentence and where its scene came out."""

    scene: str
    text: str
    facts: int
    wrong: float
    candidates: int
    rank: int  # 1 if the scene was first; of equal scores the mean


def scenes_of(scene: SceneMap, name: str) -> Scene:
    return Scene(name, scene.graph, tuple(a.get("room", "") for a in scene.attributes))


def rooms_of(scene: Scene) -> list[Scene]:
    out = []
    for room in dict.fromkeys(r for r in scene.rooms if r):
        rows = np.flatnonzero(np.array(scene.rooms) == room)
        out.append(Scene(f"{scene.name}: {room}", scene.graph.subgraph(rows), (room,) * len(rows)))
    return out


def ask(
    scenes: Sequence[Scene], rng: Generator, *, facts: int, wrong: float, each: int = 2
) -> list[RankedSentence]:
    """Ask `each` sentences about every scene, among all numbers of scenes that there are.

    How rare things are is the whole library's; a sentence's scene and others drawn at random are
    ranked.
    """
    index = TextIndex([s.graph for s in scenes], [s.rooms for s in scenes])
    out = []
    for row, scene in enumerate(scenes):
        for _ in range(each):
            text = describe(scenes, row, rng, facts=facts, wrong=wrong)
            scores = index.scores(read(text))
            others = rng.permutation(np.delete(np.arange(len(scenes)), row))
            for among in AMONG:
                if among <= len(scenes):
                    rivals = scores[others[: among - 1]]
                    tied = np.abs(rivals - scores[row]) < 1e-9
                    better = (rivals > scores[row]) & ~tied
                    rank = 1 + int(better.sum()) + round(float(tied.sum()) / 2)
                    out.append(RankedSentence(scene.name, text, facts, wrong, among, rank))
    return out


def describe(scenes: Sequence[Scene], row: int, rng: Generator, *, facts: int, wrong: float) -> str:
    """A sentence of some facts about a room of a scene, each from another scene with `wrong`."""
    room, things = _room(scenes[row], rng)
    said: list[str] = []
    lies = rng.random(facts) < wrong
    if room and not room.isdigit():
        facts -= 1
    else:
        room = "room"
    own = _facts(scenes[row].graph, things, rng)
    for lie in lies[:facts]:
        source = own
        if lie:
            other = int(rng.integers(len(scenes) - 1))
            other += other >= row
            source = _facts(scenes[other].graph, _room(scenes[other], rng)[1], rng)
        fresh = [fact for fact in source if fact not in said]
        if fresh:
            said.append(fresh[0])
    article = "an" if room[0] in "aeiou" else "a"
    if not said:
        return f"{article} {room}"
    *first, last = said
    return f"{article} {room} with " + (f"{', '.join(first)} and {last}" if first else last)


def _room(scene: Scene, rng: Generator) -> tuple[str, list[int]]:
    rooms = [r for r in dict.fromkeys(scene.rooms) if r and len(_object_rows(scene, r)) > 1]
    if not rooms:
        return "", [i for i, label in enumerate(scene.graph.labels) if _has_meaning(label)]
    room = rooms[int(rng.integers(len(rooms)))]
    return room, _object_rows(scene, room)


def _object_rows(scene: Scene, room: str) -> list[int]:
    labels = scene.graph.labels
    return [i for i, r in enumerate(scene.rooms) if r == room and _has_meaning(labels[i])]


def _has_meaning(label: str) -> bool:
    words = split_label(label)
    return not is_nameless(label) and words[-1] not in STRUCTURE_WORDS


def _facts(graph: SceneGraph, rows: list[int], rng: Generator) -> list[str]:
    labels = graph.labels
    counts = Counter(labels[i] for i in rows)
    out = [_numbered(label, count, rng) for label, count in counts.items()]
    inside = set(rows)
    for s, relation, t in zip(graph.sources, graph.relations, graph.targets, strict=True):
        one, other = labels[int(s)], labels[int(t)]
        if {int(s), int(t)} <= inside and relation != SAME_ROOM and one != other:
            said = _SAID.get(relation, relation)
            out.append(f"{_numbered(one, 1, rng)} {said} {_numbered(other, 1, rng)}")
    return [out[i] for i in rng.permutation(len(out))]


def _numbered(label: str, count: int, rng: Generator) -> str:
    words = " ".join(split_label(label))
    if rng.random() < _OTHER_WORDS:
        words = _WORDS.get(words, words)
    if count == 1:
        return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"
    plural = (
        words
        if words.endswith("s")
        else f"{words}es"
        if words[-2:] in ("sh", "ch")
        else f"{words}s"
    )
    return f"{_NUMBERS[count] if count < len(_NUMBERS) else count} {plural}"


def report(ranked: Sequence[RankedSentence]) -> str:
    header = ["facts", *[f"{among}, {wrong:.0%} wrong" for among in AMONG for wrong in WRONG]]
    rows = []
    for facts in dict.fromkeys(a.facts for a in ranked):
        cells = [
            shares(
                recall(
                    [a for a in ranked if (a.facts, a.candidates, a.wrong) == (facts, among, wrong)]
                )
            )
            for among in AMONG
            for wrong in WRONG
        ]
        rows.append([str(facts), *cells])
    return markdown(header, rows)


def recall(ranked: Sequence[RankedSentence]) -> list[float]:
    """Shares of sentences whose scene was among the first 1, 3 and 5."""
    ranks = np.array([a.rank for a in ranked])
    return [float((ranks <= k).mean()) if len(ranks) else float("nan") for k in AT]


def figures(ranked: Sequence[RankedSentence]) -> list[dict[str, Any]]:
    """Recall of every row, with a sentence that came out last of it."""
    keys = dict.fromkeys((a.facts, a.wrong, a.candidates) for a in ranked)
    out = []
    for facts, wrong, among in keys:
        own = [a for a in ranked if (a.facts, a.wrong, a.candidates) == (facts, wrong, among)]
        worst = max(own, key=lambda a: a.rank)
        out.append(
            {"facts": facts, "wrong": wrong, "among": among, "sentences": len(own)}
            | {f"recall_{k}": value for k, value in zip(AT, recall(own), strict=True)}
            | {"worst": worst}
        )
    return out


SAID = ("nothing", "true", "wrong")  # sentences: none, of the true pose, of another frame's
TERMS = {"colour": {"colour": True}, "depth + colour": {"depth": True, "colour": True}}
POSE_FACTS = 2  # statements in a sentence, where there is that much to say
_NEXT_TO = 1.3  # what is nearer is next to one [m]
_SIDES = {"facing the {}": 0.0, "the {} is on my left": 90.0, "the {} is on my right": -90.0,
          "the {} is behind me": 180.0}  # fmt: skip
_OFF = 20.0  # degrees that a thing may lie beside the direction that is said
_RAYS = 90  # around the horizon
_LEVELS = np.deg2rad(np.linspace(-45.0, 30.0, 16))
_LEAST = 6  # rays that meet a thing that is spoken of


@dataclass(frozen=True)
class SentenceOutcome:
    """One localization."""

    terms: str
    text_kind: str  # one of `SAID`
    text: str
    answer: Answer


def describe_pose(scene: SceneMap, map_from_camera: Floats, rng: Generator, facts: int) -> str:
    """Describe a pose (4, 4) as somebody there might, in up to `facts` statements; empty for nothing."""
    pose, _ = split_pose(map_from_camera)
    turn = np.arange(_RAYS) * 2.0 * np.pi / _RAYS
    a, e = (grid.ravel() for grid in np.meshgrid(turn, _LEVELS))
    rays = np.stack(
        [np.cos(e) * np.cos(a + pose[3]), np.cos(e) * np.sin(a + pose[3]), np.sin(e)], 1
    )
    hits = scene.caster.cast(pose[:3], rays)
    met = hits.triangle >= 0
    thing = scene.mesh.object_of[hits.triangle[met]]
    away, left = (hits.distance * np.cos(e))[met], np.rad2deg(a)[met]
    said = []
    for row in np.unique(thing[np.bincount(thing)[thing] >= _LEAST]).tolist():
        words = split_label(scene.graph.labels[row])
        if is_nameless(scene.graph.labels[row]) or words[-1] in STRUCTURE_WORDS - {
            "window",
            "windows",
        }:
            continue
        own, name = thing == row, " ".join(words)
        if away[own].min() < _NEXT_TO:
            said.append(f"next to the {name}")
        middle = left[own][away[own].argmin()]
        for form, side in _SIDES.items():
            if abs((middle - side + 180.0) % 360.0 - 180.0) < _OFF:
                said.append(form.format(name))
    chosen = rng.permutation(len(said))[:facts]
    return ". ".join(said[i] for i in chosen)


def ask_pose(
    scene: SceneMap, windows: Sequence[Window], rng: Generator, *, seed: int = 0
) -> list[SentenceOutcome]:
    """Localize every window without a sentence, with a true one, and with a wrong one."""
    texts = [describe_pose(scene, w.truth, rng, POSE_FACTS) for w in windows]
    others = [(i + int(rng.integers(1, len(windows)))) % len(windows) for i in range(len(windows))]
    out = []
    for terms, use in TERMS.items():
        options = FilterOptions().only(**use)
        for i, window in enumerate(windows):
            for said, text in zip(SAID, ("", texts[i], texts[others[i]]), strict=True):
                start = time.perf_counter()
                estimate = scene.localize(
                    window.capture, description=text or None, options=options, refine=False,
                    seed=seed,
                )  # fmt: skip
                answer = measure(
                    estimate, window.truth, seconds=time.perf_counter() - start,
                    frames=len(window.capture), window=window.name, place=window.place,
                    changed=window.changed,
                )  # fmt: skip
                out.append(SentenceOutcome(terms, said, text, answer))
    return out


def pose_figures(spoken: Sequence[SentenceOutcome]) -> dict[str, dict[str, dict[str, float]]]:
    """By terms and sentence: recall at 0.5 m and 10 degrees, held by any mode, wrong OK, seconds."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for terms in TERMS:
        for said in SAID:
            own = [s.answer for s in spoken if (s.terms, s.text_kind) == (terms, said)]
            if own:
                right = np.array([a.within(*NEAR) for a in own])
                sure = np.array([a.status == "OK" for a in own])
                out.setdefault(terms, {})[said] = {
                    "windows": len(own),
                    "recall": float(right.mean()),
                    "held": float(np.mean([a.among_modes for a in own])),
                    "wrong_ok": float((sure & ~right).mean()),
                    "seconds": float(np.median([a.seconds for a in own])),
                }
    return out


def report_poses(spoken: Sequence[SentenceOutcome]) -> str:
    """Markdown table of `pose_figures`."""
    header = ["terms", "sentence", "recall", "held", "OK and wrong", "s"]
    rows = [
        [
            terms,
            said,
            share(f["recall"]),
            share(f["held"]),
            share(f["wrong_ok"]),
            f"{f['seconds']:.2f}",
        ]
        for terms, by in pose_figures(spoken).items()
        for said, f in by.items()
    ]
    return markdown(header, rows)
