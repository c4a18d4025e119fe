"""Are changes found? A map of the house, and walks through it after furniture was moved or taken away.

Poses are those that localizing finds; what was changed is known to the evaluation alone. Prints a
Markdown table and writes every window as JSON. Every answer is written down at once: run it again
and it goes on where it was cut.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
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
from placegraph_lab.tables.runner import Column as Col

GONE = ("moved", "vanished")  # kinds that say that an object is not where the map has it
NEAR_NEW = 0.1
"""Maximum distance of an appeared object from the box of the moved one, to count as right [m]."""


@dataclass(frozen=True)
class WindowChanges:
    """Reported changes of one window of a sequence, beside the truth."""

    sequence: str
    first: int
    frames: int
    status: str
    changed: bool  # whether anything in the sequence was
    visible: tuple[str, ...]
    """Ids of what was truly moved or removed, and whose old place enough pixels show."""
    detected: tuple[str, ...]  # of these, what is reported as moved or vanished
    moves: int  # of `detected`, what truly moved
    moves_found: int  # ... and is reported as moved.
    removed: int
    removed_found: int  # of `detected`, what was truly removed, and is reported as vanished
    errors: tuple[tuple[float, float], ...]
    """Errors of the motions of right changes: distance of the box's centre [m], and rotation [deg]."""
    right: tuple[
        float, ...
    ]  # confidences of reports (moved, vanished) of things that truly changed
    wrong: tuple[float, ...]  # ... and of things that did not.
    new_right: int  # appeared, where something truly stands now that did not
    new_wrong: int
    seconds: float  # of comparing, without localizing


def changes_of(folder: Path) -> dict[str, Floats | None]:
    """Read the true changes of a sequence: ids, and motions (4, 4); None: removed."""
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


def ask(scene: SceneMap, folder: Path, first: int, frames: int, *, seed: int = 0) -> WindowChanges:
    """Localize a window of a sequence, compare it with the map, and hold that against the truth."""
    capture = open_capture(folder, labels=None)[first : first + frames]
    truth = read_tum(folder / "trajectory.tum").poses[first : first + frames]
    changed, options = changes_of(folder), DiffOptions(seed=seed)
    estimate = scene.localize(capture, seed=seed)
    begun = time.perf_counter()
    lost = estimate.status is Status.LOST
    changes = None if lost else diff_capture(scene, capture, estimate, options=options)
    seconds = time.perf_counter() - begun
    visible_ids = sorted(visible(scene, capture, truth, options) & changed.keys())
    reports = {c.id: c for c in changes or () if c.kind in GONE}
    found = [id_ for id_ in visible_ids if id_ in reports]
    removed = [id_ for id_ in found if changed[id_] is None]
    errors = [_motion_error(scene, reports[id_], changed[id_]) for id_ in found]
    appeared = [c.box for c in (changes.of("appeared") if changes else []) if c.box is not None]
    boxes = _new_boxes(scene, changed)
    new_right = sum(any(_meet(box, other) for other in boxes) for box in appeared)
    return WindowChanges(
        folder.name, first, len(capture), estimate.status.name, changed=bool(changed),
        visible=tuple(visible_ids), detected=tuple(found), moves=len(found) - len(removed),
        moves_found=sum(e is not None for e in errors), removed=len(removed),
        removed_found=sum(reports[id_].kind == "vanished" for id_ in removed),
        errors=tuple(e for e in errors if e is not None),
        right=tuple(c.confidence for c in reports.values() if c.id in changed),
        wrong=tuple(c.confidence for c in reports.values() if c.id not in changed),
        new_right=new_right, new_wrong=len(appeared) - new_right, seconds=seconds,
    )  # fmt: skip


def _motion_error(
    scene: SceneMap, report: Change, true: Floats | None
) -> tuple[float, float] | None:
    """Error of a reported motion, of the box's middle [m] and of the rotation [deg]."""
    found = report.after_from_before
    if true is None or found is None:
        return None
    middle = scene.graph.positions[scene.row_of(report.id)][None]
    off = np.linalg.norm(transform_points(found, middle) - transform_points(true, middle))
    return float(off), rotation_error(found, true)


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


def figures(windows: Sequence[WindowChanges]) -> dict[str, Any]:
    """Sums and rates of some windows."""

    def total(name: str) -> int:
        values = [getattr(t, name) for t in windows]
        return sum(len(v) if isinstance(v, tuple | list) else v for v in values)

    def mean(name: str) -> float | None:
        values = [c for t in windows for c in getattr(t, name)]
        return float(np.mean(values)) if values else None

    errors = np.array([e for t in windows for e in t.errors]).reshape(-1, 2)
    moved = {t.sequence for t in windows if t.visible or t.right}
    still = [t for t in windows if t.sequence not in moved]
    right, wrong, seen = total("right"), total("wrong"), total("visible")
    return {
        "windows": len(windows),
        "lost": sum(t.status == "LOST" for t in windows),
        **{k: total(k) for k in ("visible", "detected", "right", "wrong")},
        **{k: total(k) for k in ("moves", "moves_found", "removed", "removed_found")},
        "recall": total("detected") / seen if seen else None,
        "precision": right / (right + wrong) if right + wrong else None,
        "median_m": float(np.median(errors[:, 0])) if len(errors) else None,
        "median_deg": float(np.median(errors[:, 1])) if len(errors) else None,
        "still_windows": len(still),
        "still_false": sum(len(t.wrong) + t.new_wrong for t in still),
        "appeared_right": total("new_right"),
        "appeared_wrong": total("new_wrong"),
        "seconds": float(np.median([t.seconds for t in windows])),
        "confidence_right": mean("right"),
        "confidence_wrong": mean("wrong"),
    }


def _of(part: str, total: str, other: str = "") -> Callable[[dict[str, Any]], str]:
    return lambda f: f"{f[part]} of {f[total] + (f[other] if other else 0)}"


COLUMNS = (
    Col("map, frames", "name"), Col("windows", "windows"),
    Col("recall of gone", lambda f: f"{lab.share(f['recall'])} ({_of('detected', 'visible')(f)})"),
    Col("precision", lambda f: f"{lab.share(f['precision'])} ({_of('right', 'right', 'wrong')(f)})"),
    Col("motions found", _of("moves_found", "moves")),
    Col("median error",
        lambda f: f"{lab.number(f['median_m'], 3, 'm')}, {lab.number(f['median_deg'], 1)}°"),
    Col("false, unchanged", lambda f: f"{f['still_false']} in {f['still_windows']}"),
    Col("appeared right", _of("appeared_right", "appeared_right", "appeared_wrong")),
    Col("seconds", "seconds", 1),
)  # fmt: skip


def report(rows: Iterable[tuple[str, Sequence[WindowChanges]]]) -> str:
    """Markdown table, one row a way of asking."""
    return lab.render(COLUMNS, [figures(told) | {"name": name} for name, told in rows])


STARTS = {25: (0,), 10: (0, 8, 15)}  # first frames of windows, by length


@lab.table()
def scene_changes(
    run: lab.Run, seed: lab.Seed = 0, *, quick: lab.Quick = False, fresh: lab.Fresh = False
) -> None:
    """Recall and precision of changes on walks after furniture was moved or taken away."""
    journal, code = run.journal(fresh=fresh), lab.code_key(lab.INDOOR)
    scene = build_scene(run.data / "house/map/house.glb", None)
    folders = sorted((run.data / "house").glob("seq[0-9]*"))
    rows: list[tuple[str, list[WindowChanges]]] = []
    with run.progress() as tick:
        for length in (25,) if quick else STARTS:
            task = tick.add_task(f"{length} frames", total=len(folders) * len(STARTS[length]))
            told = []
            for folder in folders:
                for first in STARTS[length]:
                    key = f"{code} {folder.name} {first} {length} {seed}"
                    if key not in journal:
                        journal.put(key, ask(scene, folder, first, length, seed=seed))
                    told.append(WindowChanges(**journal[key]))
                    tick.advance(task)
            rows.append((f"{length} frames", told))
    print(report(rows))
    found = {name: figures(told) for name, told in rows}
    windows = [t for _, told in rows for t in told]
    run.save({"triangles": len(scene.mesh), "rows": found, "windows": windows})
