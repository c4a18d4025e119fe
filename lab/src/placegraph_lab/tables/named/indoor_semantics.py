"""Encoders in the particle filter: the rows of `placegraph-lab table indoor_semantics`.

Encoders of labels get the house's instances as labels, by the names that the map gives its objects,
or through `OTHER_WORDS`: what a segmentation trained elsewhere would say. Their noise is that of
`label_noise`, 30 % of the patches. Nothing is refined, as in the paper's Tables 7 and 8.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Annotated

from placegraph.errors import InputError, MissingExtraError
from placegraph.indoor.build import build_scene
from placegraph.indoor.encode import MapEncoder, bind_encoder, encoder
from placegraph.indoor.encode.labels import ClassesOfInstances, InstancesEncoder, LabelsEncoder
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.mesh.ply import write_ply
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.bench import (
    BARE,
    OFFICE,
    QUICK_EVERY,
    SEMANTIC,
    Bench,
    Job,
    NoisyEncoder,
    NoisyLabels,
    choose_jobs,
    localize,
)
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.metrics import THRESHOLDS, Answer
from placegraph_lab.tables.indoor.report import Row, ask_windows
from placegraph_lab.tables.indoor.windows import EVERY, HALVES, OFFICE_EVERY, Window
from placegraph_lab.tables.runner import Column as Col

NONE = "none"
TABLE = "labels, 0/1 table"
LABELS = "labels"
OTHERS = "labels, other words"
INSTANCES = "instances"
WITH_LABELS = (INSTANCES, TABLE, LABELS, OTHERS)
"""Encoders of a capture that brings labels; those of the house do."""
OF_IMAGES = ("appearance",)  # encoders of colour images that need no weights from elsewhere

TERMS = {name.replace("all", "semantic + depth + colour"): on for name, on in SEMANTIC.items()}

OTHER_WORDS = {
    "Portrait": "painting", "DeskPortrait": "photo frame", "RoomWindow": "windowpane",
    "Chair": "armchair", "Chandelier": "ceiling light", "FoldingDoor": "sliding door",
    "Airconditioner": "ventilator", "NightStand": "chest of drawers", "Carpet": "floor mat",
    "Light": "table lamp", "Trash": "waste basket", "TV": "computer monitor", "Bed": "bunk bed",
    "Board": "whiteboard", "SecurityCamera": "webcam", "CoffeeTable": "end table",
    "CookingBench": "worktop", "Curtain": "drapes", "KitchenTable": "dinner table",
    "ReadingDesk": "office desk", "BalconyTable": "side table", "Door": "wooden door",
    "Dumbbell": "weights", "Tablet": "ipad", "FitnessEquipment": "exercise machine",
    "Handle": "doorknob", "HouseWall": "brick wall", "Floor": "parquet",
    "KitchenCabinet": "cupboard", "KitchenUtensils": "cooking pot", "Rangehood": "extractor hood",
    "Refrigerator": "deep freezer", "SeasoningBox": "storage box", "ShoeRack": "coat stand",
    "Sofa": "couch", "Tableware": "plates", "TVCabinet": "sideboard", "Vase": "flower vase",
    "RoomWall": "partition", "Wardrobe": "closet", "Ceiling": "roof",
}  # fmt: skip
"""Another word for each label of the house: a synonym, or what is of its kind; none is the map's."""


def cases(images: Iterable[str] = OF_IMAGES) -> list[Job]:
    """All rows; `images`: the encoders of images that there are."""
    images = tuple(images)
    rows = []
    for where in ("house", *HALVES):
        pairs = [(NONE, terms) for terms in BARE]
        encoders = (*WITH_LABELS, *images) if where == "house" else images
        pairs += [(name, terms) for name in encoders for terms in TERMS]
        rows += [case(where, name, terms) for name, terms in pairs]
    return rows


def case(place: str, encoder: str, terms: str) -> Job:
    """Row of a table: an encoder, the terms beside it, and where."""
    options = PoseSearchOptions().only(**(TERMS | BARE)[terms])
    return Job(place, f"{encoder}: {terms}", options, place, encoder)


def available() -> list[str]:
    """Those of `OF_IMAGES` that can be made here."""
    found = []
    for name in OF_IMAGES:
        try:
            encoder(name)
        except (InputError, MissingExtraError, ModuleNotFoundError):  # no weights yet, no module
            continue
        found.append(name)
    return found


def rename_labels(capture: Capture, scene: SceneMap, words: dict[str, str]) -> Capture:
    """A capture of a map's instances as one of labels: those of the map, or other words for them."""
    names = {
        int(id_): words.get(label, label)
        for id_, label in zip(scene.graph.ids, scene.graph.labels, strict=True)
    }
    frames = tuple(replace(f, label_kind="labels", label_names=names) for f in capture.frames)
    return replace(capture, frames=frames, label_kind="labels", label_names=names)


def encoder_of(
    job: Job, scene: SceneMap, window: Window, seed: int
) -> tuple[MapEncoder | None, Window]:
    """An encoder with its noise, and the window as that is to see it."""
    if job.labels == NONE:
        return None, window
    if job.labels in {INSTANCES, TABLE}:
        clean = InstancesEncoder if job.labels == INSTANCES else ClassesOfInstances
        return NoisyEncoder(clean(scene), seed=seed, name=window.place), window
    if job.labels in {LABELS, OTHERS}:
        words = OTHER_WORDS if job.labels == OTHERS else {}
        capture = rename_labels(window.capture, scene, words)
        vocabulary = list(capture.label_names.values())
        noisy = NoisyLabels(LabelsEncoder(), vocabulary, seed=seed, name=window.place)
        return bind_encoder(noisy, scene), replace(window, capture=capture)
    return bind_encoder(encoder(job.labels), scene), window


def ask(
    job: Job, scene: SceneMap, window: Window, *, seed: int = 0, device: str = "auto"
) -> Answer:
    """Localize a window, without refining, and measure the answer."""
    mapped, seen = encoder_of(job, scene, window, seed)
    return localize(scene, seen, mapped, job.options, seed=seed, device=device)


class SemanticBench(Bench):
    """Maps and windows; the office's maps are cut into objects, as encoders need some."""

    def scene(self, name: str) -> SceneMap:
        """Map `house`, or one of a key of `HALVES`."""
        if name not in HALVES:
            return super().scene(name)
        if name not in self._maps:
            low, high = HALVES[name][0]
            path = place(self.cache, f"office_objects_{low}_{high}")
            if not path.exists():
                mesh = super().scene(name).mesh
                ply = path.with_suffix(".ply")
                write_ply(ply, mesh.vertices, mesh.triangles, mesh.colours)
                build_scene(ply, path, detail="full")
                ply.unlink()
            self._maps.clear()
            self._maps[name] = SceneMap.open(path)
        return self._maps[name]


LIMITS = ((0.10, 5.0), (0.25, 10.0), (0.25, 2.0))
"""Recalls that are shown; the first two are the paper's."""
PUBLISHED = (
    ("Table 8", "semantic", (1.20, 21.44), (0.66, 8.77), (0.08, 0.26)),
    ("Table 8", "depth", (1.44, 39.01), (0.96, 6.42), (0.09, 0.32)),
    ("Table 8", "colour", (1.79, 44.78), (1.51, 17.37), (0.14, 0.20)),
    ("Table 7", "semantic", None, None, (0.11, 0.35)),
    ("Table 7", "semantic + depth", None, None, (0.20, 0.54)),
    ("Table 7", "semantic + depth + colour", None, None, (0.35, 0.61)),
)
"""Rows of the paper (3RScan, 5 frames): table, terms, mean, median, the first two recalls."""


def report(rows: Sequence[Row]) -> str:
    """Return a table for each place and length, and the paper's."""
    text = []
    for where, title in {"house": "House, 30 % of the labelled patches wrong", **OFFICE}.items():
        for length in sorted({r.length for r in rows if r.job.place == where}):
            mine = [r for r in rows if r.job.place == where and r.length == length]
            text += [f"#### {title}, {length} frames", lab.render(COLUMNS, mine)]
    published = [
        [f"*{source}, 3RScan*", terms, "–", error(mean), error(median), *map(lab.share, recall), *["–"] * 4]
        for source, terms, mean, median, recall in PUBLISHED
    ]  # fmt: skip
    text += ["#### Published (SG2Loc, 5 frames)", lab.render(COLUMNS, published)]
    return "\n\n".join(text)


def error(pair: tuple[float, float] | None) -> str:
    return f"{lab.number(pair[0], 3, 'm')} {lab.number(pair[1], 1)}°" if pair else "–"


COLUMNS = (
    Col("encoder", lambda r: "–" if r.job.labels == NONE else r.job.labels),
    Col("terms", lambda r: r.job.row.rpartition(": ")[2]), Col("windows", "score.windows"),
    Col("mean", "score.mean", error), Col("median", "score.median", error),
    *(Col(f"R@{100 * limits[0]:.0f}cm {limits[1]:.0f}°",
          f"score.recall.{THRESHOLDS.index(limits)}", lab.share)
      for limits in LIMITS),
    Col("OK", lambda r: r.score.status.get("OK", 0.0), lab.share),
    Col("OK right", "score.right", lab.share), Col("s/frame", "score.frame_seconds", 3),
)  # fmt: skip


@lab.table("SG2Loc, Tables 7, 8")
def indoor_semantics(
    run: lab.Run,
    only: Annotated[str, lab.option("Rows, with semicolons between: 'house: labels: *'.")] = "",
    windows: Annotated[str, lab.option("Frames of a window.")] = "5",
    every: lab.Every = EVERY,
    office_every: lab.OfficeEvery = OFFICE_EVERY,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    *,
    quick: lab.Quick = False,
    fresh: lab.Fresh = False,
) -> None:
    """Errors and recall of the particle filter by encoder, alone and with depth and colour."""
    if quick:
        every, office_every = QUICK_EVERY, 2 * office_every
    bench = SemanticBench(run.data, run.cache, every, office_every)

    def once(job: Job, window: Window, seed: int) -> Answer:
        return ask(job, bench.scene(job.place), window, seed=seed, device=device)

    jobs = choose_jobs(cases(available()), lab.parts(only, ";"))
    lengths = [int(n) for n in windows.split(",")]
    asked = ask_windows(
        run, jobs, bench, lambda _: lengths, once, seed=seed, device=device, fresh=fresh
    )
    rows = [Row(job, n, tuple(Answer(**a) for a in answers)) for job, n, answers in asked]
    print(report(rows))
    run.save({"rows": [row.record() for row in rows]}, complete=not only)
