"""Table `scene_maps`: how small may a scene map be? Bytes, seconds, memory and recall of maps of many sizes.

Maps are built by `placegraph scene build`; all are asked about the same windows. Every answer is
written down at once: run it again and it goes on where it was cut.
"""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.indoor.map.scene_file import measure_parts
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor import refine as indoor_refine
from placegraph_lab.tables.indoor.bench import Job, ask, choose_jobs, house_jobs, office_jobs
from placegraph_lab.tables.indoor.metrics import Answer, score
from placegraph_lab.tables.indoor.refine import (
    RefineJob,
    RefineOutcome,
    RefineScore,
    refine_jobs,
    refine_score,
)
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.windows import (
    COVERED,
    EVERY,
    HALVES,
    OFFICE_EVERY,
    OFFICE_LENGTH,
    Window,
    house_windows,
    measure_coverage,
    office_windows,
)
from placegraph_lab.tables.runner import INDOOR, Journal, code_key
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.scene.surface import SurfaceDistances, compare

CHEAP = 30.0  # what takes less than this is built three times, and the median told [s]
_LAUNCHER = """
import json, os, subprocess, sys, time
start = time.perf_counter()
child = subprocess.Popen(sys.argv[1:])
_, status, usage = os.wait4(child.pid, 0)
unit = 1 if sys.platform == "darwin" else 1024
print(json.dumps({"code": os.waitstatus_to_exitcode(status), "peak": usage.ru_maxrss * unit,
                  "seconds": time.perf_counter() - start}))
"""


class Size(NamedTuple):
    name: str
    options: tuple[str, ...]  # of `placegraph scene build`


FULL = Size("full", ("--detail", "full"))
"""The source's own triangles and textures: what the others are compared with."""
NAMED = (FULL, *(Size(name, ("--detail", name)) for name in ("fine", "default", "small", "tiny")))
LABELLED = Size("labelled", ())
"""The default, its objects found by a segmenter of images instead of geometry and colour."""


class Place(NamedTuple):
    title: str
    source: str  # below the folder of the data
    options: tuple[str, ...]
    warm_up: tuple[str, ...]  # options of a build that shows all compiled code once, quickly


PLACES = {
    "house": Place("House, from its annotated mesh", "house/map/house.glb", (), ()),
    "b in a": Place(
        "Office, frames 0-185, no labels", "office", ("--frames", "0:186"), ("--frames", "0:30")
    ),
    "a in b": Place(
        "Office, frames 186-372, no labels", "office", ("--frames", "186:373"),
        ("--frames", "186:216"),
    ),
}  # fmt: skip
OFFICE_SIZES = ("full", "default", "small", "labelled")
"""Sizes of the office's map that are built by default: fusion takes a while."""


@dataclass(frozen=True)
class MapMeasurement:
    """Sizes and times of a map."""

    place: str
    size: str
    digest: str  # of the map file's bytes
    bytes: int
    parts: dict[str, int]
    """Bytes of graph, surface and colour."""
    objects: int
    labelled: int  # objects whose label says something
    triangles: int
    textures: int
    open_seconds: float  # median of 5, ray-casting structure included, compiled code warm
    build_seconds: float | None = None
    """Time of the build alone, in a fresh process with cached code; median of 3 where cheap."""
    command_seconds: float | None = None  # of the whole command
    peak_bytes: int | None = None  # largest memory of the command; the largest of those measured
    left_out: dict[str, int] | None = None
    notes: list[str] | None = None

    @property
    def name(self) -> str:
        return f"{self.place}, {self.size}"


class Maps:
    """Maps by place and size, made when first asked for; of those opened the last is kept.

    `data`: folder with `house` and `office`; `weights`: network of the segmenter that `LABELLED`
    asks for; `cache`: folder for maps; `journal`: where measurements are written down; `tell`: is
    told what is being done.
    """

    def __init__(
        self,
        data: Path,
        weights: Path,
        cache: Path,
        journal: Journal,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.data, self.weights, self.journal, self.tell = data, weights, journal, tell
        self.folder = cache / "scene_maps"
        self.folder.mkdir(parents=True, exist_ok=True)
        self._code = code_key(INDOOR)
        self._opened: tuple[Path, SceneMap] | None = None
        self._warm: set[tuple[str, ...]] = set()

    def path(self, place: str, size: Size) -> Path:
        return self.folder / f"{place} {size.name}.scene".replace(" ", "_")

    def measure_map(self, place: str, size: Size) -> MapMeasurement:
        """Measure a map; it is built if this code has not done so yet."""
        key, path = f"made {self._code} {place} {size}", self.path(place, size)
        if key in self.journal and path.exists():
            row = MapMeasurement(**self.journal[key])
            if digest(path) == row.digest:
                return row
        self._opened = None
        self.tell(f"{place}: building {size.name}")
        built = self._built(place, size, path)
        scene = SceneMap.open(path)
        spent = []
        for _ in range(5 + 1):  # the first one warms
            start = time.perf_counter()
            assert SceneMap.open(path).caster is not None  # noqa: S101  # made on first use
            spent.append(time.perf_counter() - start)
        facts: dict[str, Any] = (
            {"place": place, "size": size.name}
            | {
                "digest": digest(path),
                "bytes": path.stat().st_size,
                "parts": measure_parts(path),
                "objects": len(scene),
                "labelled": sum(label not in {"", "unknown"} for label in scene.graph.labels),
                "triangles": len(scene.mesh),
                "textures": len(scene.mesh.textures),
                "open_seconds": float(np.median(spent[1:])),
            }
            | built
        )
        self.journal.put(key, facts)
        return MapMeasurement(**facts)

    def scene(self, place: str, size: Size) -> SceneMap:
        path = self.path(place, size)
        if self._opened is None or self._opened[0] != path:
            self.measure_map(place, size)
            self._opened = path, SceneMap.open(path)
        return self._opened[1]

    def measure_distances(self, place: str, size: Size) -> SurfaceDistances:
        codes = [self.measure_map(place, s).digest for s in (FULL, size)]
        key = f"apart {self._code} {' '.join(codes)}"
        if key not in self.journal:
            self.tell(f"{place}: how far {size.name} is from full")
            one, other = (SceneMap.open(self.path(place, s)).mesh for s in (FULL, size))
            self.journal.put(key, compare(one, other, np.random.default_rng(0)))
        return SurfaceDistances(**self.journal[key])

    def command(self, place: str, size: Size, out: Path, more: Sequence[str] = ()) -> list[str]:
        """Arguments of `placegraph` that build a map."""
        of = PLACES[place]
        network = ("--segmenter", str(self.weights)) if size == LABELLED else ()
        return [
            "scene", "build", str(self.data / of.source), "-o", str(out), "--json",
            *(more or of.options), *size.options, *network,
        ]  # fmt: skip

    def _built(self, place: str, size: Size, path: Path) -> dict[str, Any]:
        """Build a map, several times if that is quick; what was measured."""
        usual = size if size == LABELLED else Size("default", ())
        kind = (PLACES[place].source, usual.name)
        if kind not in self._warm:  # compiled code is cached from now on
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "warm.scene"
                run(self.command(place, usual, out, PLACES[place].warm_up))
            self._warm.add(kind)
        command = self.command(place, size, path)
        runs = [run(command)]
        if runs[0].seconds < CHEAP:
            runs += [run(command), run(command)]
        told = json.loads(runs[0].out)
        return {
            "build_seconds": float(np.median([json.loads(r.out)["seconds"] for r in runs])),
            "command_seconds": float(np.median([r.seconds for r in runs])),
            "peak_bytes": max(r.peak for r in runs),
            "left_out": told["left_out"],
            "notes": told["notes"],
        }


class Run(NamedTuple):
    """A command that ran in a process of its own."""

    out: str
    seconds: float
    peak: int  # largest memory [bytes]


def run(arguments: Sequence[str]) -> Run:
    """Run `placegraph` with arguments.

    A small process starts it: Linux counts what a parent held as the peak of its child, too.
    """
    done = subprocess.run(  # noqa: S603  # our own command line
        [sys.executable, "-c", _LAUNCHER, sys.executable, "-m", "placegraph.cli", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    *lines, last = done.stdout.splitlines() or [""]
    told = json.loads(last) if not done.returncode else {"code": done.returncode}
    if told["code"]:
        raise PlacegraphError(f"{' '.join(arguments)} fails: {done.stderr.strip()[-500:]}")
    return Run("\n".join(lines), told["seconds"], told["peak"])


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


ROWS = (
    "instances: semantic", "instances: semantic + depth", "none: depth + colour",
    "b in a: depth + colour", "a in b: depth + colour",
)  # fmt: skip
"""Rows of the protocol of `indoor_filter`."""
REFINED_ROWS = (
    "house found: all, auto", "house disturbed: no depth, auto",
    "b in a disturbed: no depth, auto", "a in b disturbed: no depth, auto",
)  # fmt: skip
"""Rows of the protocol of `indoor_refine`: where textures matter, images refine alone."""
REFINED_SIZES = ("full", "default", "small")
LENGTHS = (5, 10)  # frames of the house's windows; refining gets the longer ones
LIMITS = {"house": ((0.10, 5.0), (0.25, 2.0)), "office": ((0.10, 5.0), (0.25, 10.0))}
"""Position [m] and rotation [deg] that a recall allows; the second is what the aims count."""


@dataclass(frozen=True)
class Row:
    """A row of `indoor_filter` or `indoor_refine`, for windows of one length."""

    job: Job | RefineJob
    length: int

    @property
    def name(self) -> str:
        return f"{self.job.name}, {self.length} frames"

    @property
    def place(self) -> str:
        return self.job.map if isinstance(self.job, Job) else self.job.place


def findings() -> list[Row]:
    """All rows of recall."""
    jobs = [j for j in (*house_jobs(), *office_jobs()) if j.name in ROWS]
    return [Row(j, n) for j in jobs for n in ((OFFICE_LENGTH,) if j.table in HALVES else LENGTHS)]


class WindowRunner:
    """Asks about windows on maps of any size, what was answered before not again.

    `maps`: the maps; their journal holds the answers, too; `every`, `office_every`: frames from the
    start of a window to the next, in the house and in the office; `seed`: of the filter, the label
    noise and disturbed starts; `device`: for the filter.
    """

    def __init__(
        self, maps: Maps, every: int, office_every: int, *, seed: int = 0, device: str = "auto"
    ) -> None:
        self.maps, self.every, self.office_every = maps, every, office_every
        self.seed, self.device = seed, device
        self._code = code_key(INDOOR)
        self._windows: dict[tuple[str, int], list[Window]] = {}

    def windows(self, place: str, length: int) -> list[Window]:
        """Windows of a place; of the office those that its full map covers, for all sizes."""
        if (place, length) not in self._windows:
            data = self.maps.data
            if place in HALVES:
                full = self.maps.scene(place, FULL)
                made = office_windows(
                    data / "office", place, length=length, every=self.office_every
                )
                made = [measure_coverage(full, w) for w in made]
                made = [w for w in made if w.coverage is not None and w.coverage >= COVERED]
            else:
                made = house_windows(data / "house", length, every=self.every)
            self._windows[place, length] = made
        return self._windows[place, length]

    def answers(self, row: Row, size: Size) -> list[Any]:
        """Answers of a row on a map: `Answer`, or `RefineOutcome`."""
        windows, journal, job = self.windows(row.place, row.length), self.maps.journal, row.job
        digest = self.maps.measure_map(row.place, size).digest
        keys = [f"{digest} {job.key(w, self.seed, self._code)} {self.device}" for w in windows]
        if asked := len(journal.find_missing(keys)):
            self.maps.tell(f"{size.name}: {row.name}, {asked} windows")

        def once(window: Window, seed: int) -> Answer | RefineOutcome:
            scene, how = self.maps.scene(row.place, size), {"seed": seed, "device": self.device}
            if isinstance(job, Job):
                return ask(job, scene, window, **how)  # type: ignore[arg-type]
            return indoor_refine.ask(job, scene, window, matcher=job.matcher, **how)  # type: ignore[arg-type]

        found = journal.fill(
            keys,
            lambda i: once(windows[i], self.seed),
            warm=lambda: once(windows[0], self.seed + 1),
        )
        return [Answer(**a) if isinstance(job, Job) else RefineOutcome.from_dict(a) for a in found]


@dataclass(frozen=True)
class PairedAnswers:
    """Answers on a map beside those on the full one, to the same windows."""

    place: str
    row: str
    size: str
    answers: tuple[Answer, ...]
    full: tuple[Answer, ...]
    limits: tuple[tuple[float, float], ...]

    @property
    def recalls(self) -> tuple[float, ...]:
        """Share of answers within each of `limits`."""
        return tuple(
            sum(a.within(*w) for a in self.answers) / len(self.answers) for w in self.limits
        )

    def record(self) -> dict[str, Any]:
        return {"row": self.row, "size": self.size, "score": score(self.answers)}

    @property
    def steps(self) -> tuple[int, ...]:
        """Compare windows with the full map by the last of `limits`: 1 gained, -1 lost, 0 alike."""
        limits = self.limits[-1]
        return tuple(
            a.within(*limits) - b.within(*limits)
            for a, b in zip(self.answers, self.full, strict=True)
        )


def difference(steps: Sequence[int]) -> tuple[float, float]:
    """Points of recall that a map gains over the full one, and their standard error.

    The error is that of paired answers: what both maps find or miss has no part in it.
    """
    if not steps:
        return math.nan, math.nan
    points = 100.0 * np.array(steps, np.float64)
    return float(points.mean()), float(points.std() / math.sqrt(len(points)))


def study(
    asking: WindowRunner, rows: Sequence[Row], sizes: dict[str, list[Size]]
) -> list[PairedAnswers]:
    """All rows on all sizes of their places, map by map."""
    return [
        PairedAnswers(
            place, row.name, size.name,
            tuple(asking.answers(row, size)), tuple(asking.answers(row, FULL)),
            LIMITS["office" if place in HALVES else "house"],
        )
        for place in dict.fromkeys(r.place for r in rows)
        for size in (FULL, *(s for s in sizes[place] if s != FULL))
        for row in rows
        if row.place == place and asking.windows(place, row.length)
    ]  # fmt: skip


def refinement(
    asking: WindowRunner, rows: Sequence[Row], sizes: dict[str, list[Size]]
) -> list[tuple[str, str, RefineScore]]:
    """Refined poses of all rows on the sizes that `REFINED_SIZES` names, summarized."""
    return [
        (row.name, size.name, refine_score(results))
        for row in rows
        for size in sizes[row.place]
        if size.name in REFINED_SIZES and (results := asking.answers(row, size))
    ]


ROOM = 30  # objects of a usual room
STORAGE = {
    "HLoc": (294.4, 283.3), "MeshLoc": (1433.6, 589.7), "Loc-NeRF": (143.9, 66.6),
    "SG2Loc": (9.8, 28.2), "ACE": (4.2, 4.2),
}  # fmt: skip
"""MB a scene of 3RScan and of ScanNet: Table 3 of the paper."""
ALL = {s.name: s for s in (*NAMED, LABELLED)}


def _distances(off: SurfaceDistances | None) -> str:
    if off is None:
        return "–"
    return " / ".join(lab.number(1e3 * d, 1) for d in (off.mean, off.most, off.maximum))


MAPS = (
    Col("", "0.name"), Col("objects", "0.objects", 0), Col("triangles", "0.triangles", 0),
    *(Col(f"{part} kB", f"0.parts.{part}", 1, "", 1e-3) for part in ("graph", "surface", "colour")),
    Col("total kB", "0.bytes", 1, "", 1e-3),
    Col(f"kB a room of {ROOM}", lambda r: ROOM * r[0].bytes / r[0].objects, 0, "", 1e-3),
    Col("build s", "0.build_seconds", 2), Col("peak MB", "0.peak_bytes", 0, "", 1e-6),
    Col("opens ms", "0.open_seconds", 0, "", 1e3), Col("off mm: mean / 95 % / most", "1", _distances),
)  # fmt: skip
REFINED = (
    Col("", "0"), Col("size", "1"), Col("windows", "2.windows", 0),
    Col("median", "2.after.median", errors), Col("10 cm, 5°", "2.after.recall.0", lab.share),
    Col("accepted", "2.accepted", lab.share), Col("s refining", "2.refine_seconds", 2),
)  # fmt: skip


def report(
    made: Sequence[MapMeasurement],
    apart: dict[str, SurfaceDistances],
    pairs: Sequence[PairedAnswers],
    refined: Sequence[tuple[str, str, RefineScore]],
) -> str:
    """Return all tables that there are rows for; `apart` by the name of the map."""
    text = ["#### What a map takes", lab.render(MAPS, [(m, apart.get(m.name)) for m in made])]
    paper = [[f"*{name}*", lab.number(a, 1), lab.number(b, 1)] for name, (a, b) in STORAGE.items()]
    text += ["#### The paper's MB a scene", lab.markdown(["", "3RScan", "ScanNet"], paper)]
    for place, of in PLACES.items():
        if mine := [p for p in pairs if p.place == place]:
            limits = " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in mine[0].limits)
            text += [f"#### {of.title}: recall within {limits} (windows)", recall_table(mine)]
    if refined:
        text += ["#### Refined poses", lab.render(REFINED, refined)]
    return "\n\n".join(text)


def recall_table(pairs: Sequence[PairedAnswers]) -> str:
    """Return recall of every row by size, and the difference to the full map, rows pooled."""
    windows = {p.row: len(p.answers) for p in pairs}
    lines = []
    for size in dict.fromkeys(p.size for p in pairs):
        at = {p.row: p for p in pairs if p.size == size}
        steps = [step for p in at.values() for step in p.steps]
        points, error = difference(steps)
        told = [f"{points:+.1f} ± {error:.1f}", f"{steps.count(1)} / {steps.count(-1)}"]
        told = ["–", "–"] if size == FULL.name else told
        lines.append([size, *(lab.shares(at[row].recalls) for row in windows), *told])
    heads = [f"{row} ({count})" for row, count in windows.items()]
    return lab.markdown(["", *heads, "points against full", "gained / lost"], lines)


def sizes_of(place: str, names: list[str]) -> list[Size]:
    fits = NAMED if place == "house" else ALL.values()
    if not names and place != "house":
        names = list(OFFICE_SIZES)
    return [FULL, *(s for s in fits if s != FULL and (not names or s.name in names))]


@lab.table("SG2Loc, Tables 3, 4")
def scene_maps(
    run: lab.Run,
    only: Annotated[
        str, lab.option("Rows, with semicolons between: 'instances: *; a in b*'.")
    ] = "",
    sizes: Annotated[
        str, lab.option(f"Sizes with commas between: {', '.join(ALL)}; full is always there.")
    ] = "",
    every: lab.Every = EVERY,
    office_every: lab.OfficeEvery = OFFICE_EVERY,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    *,
    fresh: lab.Fresh = False,
    quick: lab.Quick = False,
    weights: Annotated[
        Path | None, lab.option("Of the network that labels images; those of --data if not given.")
    ] = None,
) -> None:
    """Bytes, seconds, memory and recall of scene maps of many sizes."""
    rows = findings()
    refining = [Row(j, LENGTHS[-1]) for j in refine_jobs(("auto",)) if j.name in REFINED_ROWS]
    if only:
        asked_for = [n if n.endswith(("*", "frames")) else f"{n}, *" for n in lab.parts(only, ";")]
        both = {r.name for r in choose_jobs([*rows, *refining], asked_for)}
        rows = [r for r in rows if r.name in both]
        refining = [r for r in refining if r.name in both]
    names = lab.parts(sizes)
    if quick:
        names, every, office_every = names or ["default", "small"], 50, 60
    lab.check_names(names, ALL, "size")
    weights = weights or run.shared / "weights/deeplabv3_mnv2_pascal_quant.tflite"
    maps = Maps(run.data, weights, run.cache, run.journal(fresh=fresh), run.log)
    asked = {r.place for r in rows} | {r.place for r in refining}
    wanted = {place: sizes_of(place, names) for place in PLACES if place in asked}
    if not (weights.exists() and find_spec("ai_edge_litert")):
        run.log("No labelled maps: they need the network's weights and the extra `segment`.")
        wanted = {place: [s for s in of if s != LABELLED] for place, of in wanted.items()}
    made = [maps.measure_map(place, size) for place, of in wanted.items() for size in of]
    apart = {
        maps.measure_map(place, size).name: maps.measure_distances(place, size)
        for place, of in wanted.items()
        for size in of
        if size not in (FULL, LABELLED)
    }
    asking = WindowRunner(maps, every, office_every, seed=seed, device=device)
    pairs, refined = study(asking, rows, wanted), refinement(asking, refining, wanted)
    print(report(made, apart, pairs, refined))
    built = [lab.plain(m) | {"off_m": apart.get(m.name)} for m in made]
    record = {"paper": {"storage_MB": STORAGE}, "maps": built}
    record |= {"recall": [p.record() for p in pairs], "refined": refined}
    run.save(record, complete=not (only or sizes))
