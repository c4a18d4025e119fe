"""Tables of what maps and answers cost: bytes, seconds, and scenes that are looked up."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.retrieval.retrieval_places import FIRST, HOMES, Place, Walk, homes
from placegraph_lab.tables.retrieval.retrieval_report import figures, main_table
from placegraph_lab.tables.retrieval.retrieval_study import Study
from placegraph_lab.tables.retrieval.retrieval_vectors import NOISY
from placegraph_lab.tables.runner import markdown, number
from placegraph_lab.tables.sg2loc.ask import Asking, recipes
from placegraph_lab.tables.sg2loc.paper import figures as said
from placegraph_lab.tables.sg2loc.sets import Set
from placegraph_lab.tables.sg2loc.spec import Spec

Made = tuple[str, list[Any]]


def storage(_: Spec, asking: Asking, of: Sequence[Set]) -> Made:
    """Table 3: megabytes of a map's file."""
    rows = _printed(3, ("3RScan [MB]", "ScanNet [MB]"))
    for its in of:
        scenes = [its.scene(name) for name in its.rooms]
        megabytes = float(np.mean([_filed(scene)[1] for scene in scenes])) / 1e6
        objects = sum(len(scene) for scene in scenes)
        vertices = sum(len(scene.mesh.vertices) for scene in scenes)
        rows.append(
            {"row": f"{its.name}, placegraph", "scenes": len(scenes), "a scene [MB]": megabytes,
             "objects a scene": objects / len(scenes), "vertices an object": vertices / objects}
        )  # fmt: skip
        asking.run.say(f"{its.name}: {len(scenes)} maps")
    return _written(rows), rows


def seconds(spec: Spec, asking: Asking, of: Sequence[Set]) -> Made:
    """Table 4: seconds of mapping (rays, panoramas, embeddings), of a frame, of the final fit."""
    heads = ("mapping [s]", "a frame [s]", "final fit [s]")
    rows = _printed(4, heads)
    for its in of:
        for name, recipe, _ in spec.rows:
            replies = [r for n in spec.lengths for r in asking.replies(its, recipe, n)]
            walk, window = its.windows(min(spec.lengths), 1, 0)[0]
            mapping = []
            for _again in range(3):  # the first compiles
                scene = _filed(its.scene(walk.map))[0]
                start = time.perf_counter()
                asking.ready(its, recipes()[recipe], scene, window)
                mapping.append(time.perf_counter() - start)
            told = (
                min(mapping),
                float(np.median([r.filter.seconds / r.filter.frames for r in replies])),
                float(np.median([r.refining for r in replies])),
            )
            row = {"row": f"{its.name}: {name}", "windows": len(replies)}
            rows.append(row | dict(zip(heads, told, strict=True)))
    return _written(rows), rows


def retrieval(_: Spec, asking: Asking, of: Sequence[Set]) -> Made:
    """Table 5: which scene it is, by the paper's sum and by ours, with the time it takes."""
    text, rows = [], []
    for its in of:
        if its.name == "homes":  # the fifty and more of `scene_retrieval`, a walk in each
            made = list(homes(range(FIRST, FIRST + HOMES), asking.run.cache))
            places = [place for place, _ in made]
            walks = [own[i % 2] for i, (_, own) in enumerate(made)]
        else:
            places = [Place(name, its.scene(name), room) for name, room in its.rooms.items()]
            walks = [Walk(w.name, w.map, w.open()[0], bool(w.changed)) for w in its.walks]
        study = Study(places, walks, asking.run.cache, asking.journal, asking.run.say)
        labelled = any(w.capture.label_kind == "labels" for w in walks)
        row = study.row(asking.how.encoder or (NOISY if labelled else "appearance"))
        text += [f"#### {its.name}: {len(places)} scenes, {len(walks)} walks", main_table([row])]
        rows += [{"set": its.name, "scenes": len(places)} | told for told in figures([row])]
    return "\n\n".join(text), rows


def _filed(scene: SceneMap) -> tuple[SceneMap, int]:
    """The same map, nothing derived yet, and the bytes of its file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.scene"
        scene.save(path)
        return SceneMap.open(path), path.stat().st_size


def _printed(table: int, heads: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {"row": f"*paper, {row}*"} | dict(zip(heads, numbers, strict=True))
        for row, (numbers,) in said(table)
    ]


def _written(rows: list[dict[str, Any]]) -> str:
    heads = list(dict.fromkeys(head for row in rows for head in row if head != "row"))
    whole = {"scenes", "windows", "objects a scene", "vertices an object"}
    return markdown(
        ["", *heads],
        [
            [row["row"], *(number(row.get(h), 0 if h in whole else 2) for h in heads)]
            for row in rows
        ],
    )
