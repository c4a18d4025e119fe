"""Are changes found? A map of the house, and walks through it after furniture was moved or taken away.

    placegraph-lab table scene_changes
    placegraph-lab table scene_changes --quick

Poses are those that localizing finds; what was changed is known to the evaluation alone. Prints a
Markdown table and writes every window as JSON. Every answer is written down at once: run it again
and it goes on where it was cut.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from placegraph.core.estimate import Status
from placegraph.core.geometry import Floats
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.change.align import transform_points
from placegraph.indoor.mapping.change.changes import Change, DiffOptions
from placegraph.indoor.mapping.change.diff_capture import diff_capture
from placegraph.indoor.mapping.change.observe import observe_frame
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.tum import read_tum
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.metrics import rotation_error

GONE = ("moved", "vanished")  # kinds that say that an object is not where the map has it
NEAR_NEW = 0.1
"""What appeared is right where it lies this near to the box of a thing that moved there [m]."""


@dataclass(frozen=True)
class Told:
    """What one run said of one window of a sequence, beside the truth."""

    sequence: str
    first: int
    frames: int
    status: str
    changed: bool  # whether anything in the sequence was
    visible: tuple[str, ...]
    """Ids of what was truly moved or removed, and whose old place enough pixels show."""
    found: tuple[str, ...]  # of these, what is reported as moved or vanished
    moves: int  # of `found`, what truly moved
    moves_found: int  # ... and is reported as moved.
    removed: int
    removed_found: int  # of `found`, what was truly removed, and is reported as vanished
    errors: tuple[tuple[float, float], ...]
    """Of the motions of those: metres of the box's middle, and degrees."""
    right: tuple[
        float, ...
    ]  # confidences of reports (moved, vanished) of things that truly changed
    wrong: tuple[float, ...]  # ... and of things that did not.
    new_right: int  # appeared, where something truly stands now that did not
    new_wrong: int
    seconds: float  # of comparing, without localizing

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def changes_of(folder: Path) -> dict[str, Floats | None]:
    """What was changed before a sequence was recorded: ids, and motions (4, 4); None: removed."""
    told = json.loads((folder / "changes.json").read_text(encoding="utf-8"))
    return {
        str(c["id"]): np.array(c["matrix"], np.float64) if c["action"] == "move" else None
        for c in told["changes"]
    }


def visible(scene: SceneMap, capture: Capture, truth: Floats, options: DiffOptions) -> set[str]:
    """Ids of the objects whose old place enough pixels of enough frames show, from true poses.

    Pixels count where the map has the object in front and the depth has a reading that is not
    nearer: what hides an object shows nothing of it. Limits are those of the options.
    """
    counts = []
    for frame, pose in zip(capture, truth, strict=True):
        seen = observe_frame(scene, frame, pose)
        clear = seen.front.objects >= 0
        if seen.depth is not None:
            with np.errstate(invalid="ignore"):
                clear &= seen.depth > seen.front.depth - 0.1
        counts.append(np.bincount(seen.front.objects[clear], minlength=len(scene)))
    pixels = np.array(counts)
    frames = np.count_nonzero(pixels >= options.least_pixels / 10, axis=0)
    enough = (pixels.sum(axis=0) >= options.least_pixels) & (
        frames >= min(options.least_frames, len(pixels))
    )
    return {scene.graph.ids[i] for i in np.flatnonzero(enough).tolist()}


def ask(scene: SceneMap, folder: Path, first: int, frames: int, *, seed: int = 0) -> Told:
    """Localize a window of a sequence, compare it with the map, and hold that against the truth."""
    capture = open_capture(folder, labels=None)[first : first + frames]
    truth = read_tum(folder / "trajectory.tum").poses[first : first + frames]
    changed, options = changes_of(folder), DiffOptions(seed=seed)
    estimate = scene.localize(capture, seed=seed)
    begun = time.perf_counter()
    lost = estimate.status is Status.LOST
    told = None if lost else diff_capture(scene, capture, estimate, options=options)
    seconds = time.perf_counter() - begun
    seen = {id_ for id_ in visible(scene, capture, truth, options) if id_ in changed}
    reports = {c.id: c for c in told or () if c.kind in GONE}
    appeared = [c.box for c in (told.of("appeared") if told else []) if c.box is not None]
    boxes = _new_boxes(scene, changed)
    new_right = sum(any(_meet(box, other) for other in boxes) for box in appeared)
    return Told(
        sequence=folder.name,
        first=first,
        frames=len(capture),
        status=estimate.status.name,
        changed=bool(changed),
        visible=tuple(sorted(seen)),
        **_verdicts(scene, reports, changed, seen),
        right=tuple(c.confidence for c in reports.values() if c.id in changed),
        wrong=tuple(c.confidence for c in reports.values() if c.id not in changed),
        new_right=new_right,
        new_wrong=len(appeared) - new_right,
        seconds=seconds,
    )


def _verdicts(
    scene: SceneMap, reports: dict[str, Change], changed: dict[str, Floats | None], seen: set[str]
) -> dict[str, Any]:
    found = sorted(id_ for id_ in seen if id_ in reports)
    moves = [id_ for id_ in found if changed[id_] is not None]
    removed = [id_ for id_ in found if changed[id_] is None]
    errors = []
    for id_ in moves:
        true, said = changed[id_], reports[id_].after_from_before
        if true is not None and said is not None:
            middle = scene.graph.positions[scene.row_of(id_)][None]
            off = float(
                np.linalg.norm(transform_points(said, middle) - transform_points(true, middle))
            )
            errors.append((off, rotation_error(said, true)))
    return {
        "found": tuple(found),
        "moves": len(moves),
        "moves_found": len(errors),
        "removed": len(removed),
        "removed_found": sum(reports[id_].kind == "vanished" for id_ in removed),
        "errors": tuple(errors),
    }


def _new_boxes(scene: SceneMap, changed: dict[str, Floats | None]) -> list[Floats]:
    """Boxes (2, 3) of what moved, where it is now."""
    boxes, mesh = [], scene.mesh
    for id_, motion in changed.items():
        if motion is not None:
            own = mesh.object_of == scene.row_of(id_)
            points = transform_points(
                motion, mesh.vertices[mesh.triangles[own]].reshape(-1, 3).astype(float)
            )
            boxes.append(np.stack([points.min(axis=0), points.max(axis=0)]))
    return boxes


def _meet(box: Floats, other: Floats) -> bool:
    return bool(np.all((box[0] <= other[1] + NEAR_NEW) & (other[0] <= box[1] + NEAR_NEW)))


def report(rows: Iterable[tuple[str, Sequence[Told]]]) -> str:
    header = [
        "map, frames", "windows", "recall of gone", "precision", "motions found",
        "median error", "false, unchanged", "appeared right", "seconds",
    ]  # fmt: skip
    return lab.markdown(header, [[name, *_cells(told)] for name, told in rows])


def figures(told: Sequence[Told]) -> dict[str, Any]:
    """Sums and rates of some windows."""
    total = sum(len(t.visible) for t in told)
    right, wrong = sum(len(t.right) for t in told), sum(len(t.wrong) for t in told)
    errors = np.array([e for t in told for e in t.errors]).reshape(-1, 2)
    still = [
        t for t in told if t.sequence not in {s.sequence for s in told if s.visible or s.right}
    ]
    return {
        "windows": len(told),
        "lost": sum(t.status == "LOST" for t in told),
        "visible": total,
        "found": sum(len(t.found) for t in told),
        "right": right,
        "wrong": wrong,
        "recall": sum(len(t.found) for t in told) / total if total else None,
        "precision": right / (right + wrong) if right + wrong else None,
        "moves": sum(t.moves for t in told),
        "moves_found": sum(t.moves_found for t in told),
        "removed": sum(t.removed for t in told),
        "removed_found": sum(t.removed_found for t in told),
        "median_m": float(np.median(errors[:, 0])) if len(errors) else None,
        "median_deg": float(np.median(errors[:, 1])) if len(errors) else None,
        "still_windows": len(still),
        "still_false": sum(len(t.wrong) + t.new_wrong for t in still),
        "appeared_right": sum(t.new_right for t in told),
        "appeared_wrong": sum(t.new_wrong for t in told),
        "seconds": float(np.median([t.seconds for t in told])),
        "confidence_right": float(np.mean([c for t in told for c in t.right])) if right else None,
        "confidence_wrong": float(np.mean([c for t in told for c in t.wrong])) if wrong else None,
    }


def _cells(told: Sequence[Told]) -> list[str]:
    f = figures(told)
    error = f"{lab.number(f['median_m'], 3, 'm')}, {lab.number(f['median_deg'], 1)}°"
    return [
        f"{f['windows']}",
        f"{lab.share(f['recall'])} ({f['found']} of {f['visible']})",
        f"{lab.share(f['precision'])} ({f['right']} of {f['right'] + f['wrong']})",
        f"{f['moves_found']} of {f['moves']}",
        error,
        f"{f['still_false']} in {f['still_windows']}",
        f"{f['appeared_right']} of {f['appeared_right'] + f['appeared_wrong']}",
        lab.number(f["seconds"], 1),
    ]


STARTS = {25: (0,), 10: (0, 8, 15)}  # first frames of windows, by length


@lab.table()
def scene_changes(
    run: lab.Run, seed: lab.Seed = 0, *, quick: lab.Quick = False, fresh: lab.Fresh = False
) -> None:
    """Are changes found? A map of the house, and walks after furniture was moved or taken away."""
    journal, code = run.journal(fresh=fresh), lab.code_key(lab.INDOOR)
    scene = build_scene(run.data / "house/map/house.glb", None)
    folders = sorted((run.data / "house").glob("seq[0-9]*"))
    rows: list[tuple[str, list[Told]]] = []
    with run.progress() as tick:
        for length in (25,) if quick else STARTS:
            task = tick.add_task(f"{length} frames", total=len(folders) * len(STARTS[length]))
            told = []
            for folder in folders:
                for first in STARTS[length]:
                    key = f"{code} {folder.name} {first} {length} {seed}"
                    if key not in journal:
                        journal.put(key, ask(scene, folder, first, length, seed=seed).to_dict())
                    told.append(Told(**journal[key]))
                    tick.advance(task)
            rows.append((f"{length} frames", told))
    print(report(rows))
    found = {name: figures(told) for name, told in rows}
    windows = [t.to_dict() for _, told in rows for t in told]
    run.save({"triangles": len(scene.mesh), "rows": found, "windows": windows})
