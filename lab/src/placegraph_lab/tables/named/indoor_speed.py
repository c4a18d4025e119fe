"""What scoring poses and localizing cost: time, rays a second, memory."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats, level_from_camera, rotation_z, split_pose
from placegraph.errors import PlacegraphError
from placegraph.indoor.encode.labels import InstancesEncoder
from placegraph.indoor.likelihood.observe import Background, sight, views
from placegraph.indoor.likelihood.score import Scorer, model_of
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.maps import coarse, decimate, fine, with_mesh
from placegraph_lab.tables.indoor.metrics import mean_particles
from placegraph_lab.tables.indoor.windows import true_poses
from placegraph_lab.tables.runner import (
    Quick,
    Run,
    known,
    markdown,
    number,
    option,
    parts,
    share,
    table,
)
from placegraph_lab.tables.statistics import apart, peak

PARTICLES = (50, 200, 1000, 5000)
STRIDES = (40.0, 20.0, 10.0, 5.0)
TRIANGLES = (1_000, 5_000, 20_000, 80_000, 300_000, 1_000_000)
BASE = (1000, 20.0, 20_000)
"""Particles, stride and triangles of the row that the others differ from in one thing."""
FRAMES = 10  # frames of a sequence that are localized


@dataclass(frozen=True)
class Cost:
    """Time to score poses against one frame."""

    triangles: int
    particles: int
    rays: int  # of a particle
    seconds: float
    casting: (
        float  # the same rays cast and nothing compared [s]; NaN where that cannot be told apart
    )

    @property
    def rate(self) -> float:
        """Rays a second, scoring included."""
        return self.particles * self.rays / self.seconds

    @property
    def share(self) -> float:
        """Share of the time that casting the rays takes."""
        return min(self.casting / self.seconds, 1.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for `json.dumps`."""
        return {
            "triangles": self.triangles,
            "particles": self.particles,
            "rays_per_particle": self.rays,
            "seconds": self.seconds,
            "rays_per_second": self.rate,
            "casting_share": None if np.isnan(self.casting) else self.share,
        }


def median_time(work: Callable[[], object], *, least: float = 0.3, times: int = 5) -> float:
    """Median wall time [s] of a call, over at least `times` calls and `least` seconds; warm."""
    work()
    spent: list[float] = []
    while len(spent) < times or sum(spent) < least:
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return float(np.median(spent))


def resized(scene: SceneMap, triangles: int) -> SceneMap:
    """The map in about so many triangles: cut into four, or decimated, at last by clustering."""
    if triangles > len(scene.mesh):
        return with_mesh(scene, fine(scene.mesh, triangles))
    mesh = coarse(scene.mesh, triangles, np.random.default_rng(0))
    cell = 0.05
    while len(mesh) > 1.2 * triangles:
        mesh = clustered(mesh, cell)
        cell *= 1.3
    return with_mesh(scene, mesh)


def clustered(mesh: Mesh, cell: float) -> Mesh:
    """Mesh whose corners are moved to the centres of cells [m].

    The first triangle of each object stays, so that every object has one.
    """
    first = np.unique(mesh.object_of, return_index=True)[1]
    points = (np.floor(mesh.vertices / cell) + 0.5) * cell
    kept = mesh.triangles[first]
    points[kept] = mesh.vertices[kept]
    vertices, triangles, owner = decimate(points, mesh.triangles, len(mesh), mesh.object_of)
    return Mesh.plain(vertices, triangles, owner)


def scattered_poses(folder: Path, count: int, rng: np.random.Generator) -> Floats:
    """Poses (N, 4) near those a sequence was really taken from, looking anywhere."""
    poses = split_pose(true_poses(folder))[0]
    rows = poses[rng.integers(len(poses), size=count)].copy()
    rows[:, :2] += rng.normal(0.0, 0.3, (count, 2))
    rows[:, 3] = rng.uniform(-np.pi, np.pi, count)
    return rows


def cost(
    scene: SceneMap,
    folder: Path,
    particles: int,
    stride: float,
    background: Background,
) -> Cost:
    """Time to score poses against the first frame of a sequence."""
    frame = open_capture(folder)[0]
    options = FilterOptions()
    sighting = sight(frame, InstancesEncoder(scene), options)
    view = views([sighting], stride, model_of(options.likelihood), background)[0]
    poses = scattered_poses(folder, particles, np.random.default_rng(0))
    scorer = Scorer(scene, FilterOptions().likelihood)
    nothing = view._replace(
        patch=np.full_like(view.patch, -1), terms=np.zeros_like(view.terms)
    )  # every ray is cast, and no hit is looked at
    return Cost(
        triangles=len(scene.mesh),
        particles=particles,
        rays=len(view.directions),
        seconds=median_time(lambda: scorer.terms(poses, view)),
        casting=median_time(lambda: scorer.terms(poses, nothing)),
    )


def costs(scene: SceneMap, folder: Path) -> list[Cost]:
    """One row for every number of particles, rays and triangles, the others as in `BASE`."""
    particles, stride, triangles = BASE
    background = scene.visibility(FilterOptions()).background
    middle = resized(scene, triangles)
    rows = [cost(middle, folder, n, stride, background) for n in PARTICLES]
    rows += [cost(middle, folder, particles, s, background) for s in STRIDES if s != stride]
    for n in TRIANGLES:
        if n != triangles:
            other = resized(scene, n)
            rows.append(cost(other, folder, particles, stride, background))
    return rows


def engines(scene: SceneMap, folder: Path, *, particles: int = 1000) -> dict[str, float]:
    """Rays a second of each engine, hits written to arrays: the rays of `BASE` at the given map.

    An engine that is not there has none.
    """
    camera = open_capture(folder).camera
    u, v = np.meshgrid(*(np.arange(BASE[1] / 2, n, BASE[1]) for n in (camera.width, camera.height)))
    level = level_from_camera([0.0, 1.0, 0.0])
    rays = camera.directions(np.stack([u, v], axis=-1).reshape(-1, 2)) @ level.T
    poses = scattered_poses(folder, particles, np.random.default_rng(0))
    directions = np.concatenate([rays @ rotation_z(yaw).T for yaw in poses[:, 3]])
    origins = np.repeat(poses[:, :3], len(rays), axis=0)
    mesh = scene.mesh.vertices, scene.mesh.triangles
    makers: dict[str, Callable[[], Any]] = {
        "Embree": lambda: RayCaster(*mesh, backend="embree"),
        "own tree": lambda: RayCaster(*mesh, backend="bvh"),
    }
    found = {}
    for name, make in makers.items():
        try:
            caster = make()
        except PlacegraphError:
            continue
        seconds = median_time(lambda c=caster: c.cast(origins, directions), times=3)  # type: ignore[misc]
        found[name] = len(origins) / seconds
    return found


def localizing(scene: Path, folders: Sequence[Path], options: FilterOptions) -> dict[str, Any]:
    """Time a frame, by stage, of the first frames of each sequence; run in a fresh process."""
    opened = SceneMap.open(scene)
    stages: dict[str, float] = {}
    total = {"seconds": 0.0, "rays": 0.0, "poses": 0.0, "scoring": 0.0, "particles": 0.0}
    start = time.perf_counter()
    ask = partial(opened.localize, options=options, refine=False)
    ask(open_capture(folders[0])[:FRAMES], seed=1)
    first = time.perf_counter() - start
    for folder in folders:
        capture = open_capture(folder)[:FRAMES]
        start = time.perf_counter()
        estimate = ask(capture, seed=0)
        total["seconds"] += time.perf_counter() - start
        stats = estimate.stats
        for stage, seconds in stats["seconds"].items():
            stages[stage] = stages.get(stage, 0.0) + seconds
        total["rays"] += stats["rays"]
        total["poses"] += stats["poses_scored"]
        total["scoring"] += stats["seconds_scoring"]
        total["particles"] += mean_particles(stats) * FRAMES
    frames = FRAMES * len(folders)
    return {
        "frame_seconds": total["seconds"] / frames,
        "stage_seconds": {stage: seconds / frames for stage, seconds in stages.items()},
        "passes": len(options.run),
        "particles": None if np.isnan(total["particles"]) else total["particles"] / frames,
        "poses_a_frame": total["poses"] / frames,
        "rays_a_frame": total["rays"] / frames,
        "rays_per_second": total["rays"] / total["scoring"],
        "scoring_share": total["scoring"] / total["seconds"],
        "first_call_seconds": first,
        "peak_bytes": peak(),
    }


def tracking(scene: Path, folders: Sequence[Path]) -> dict[str, Any]:
    """Time of an update of the tracker before and after it first says OK; in a fresh process."""
    opened = SceneMap.open(scene)
    before: list[float] = []
    after: list[float] = []
    for lap, folder in enumerate([folders[0], *folders]):
        capture = open_capture(folder)
        tracker = opened.tracker(capture.camera, seed=0)
        found = False
        for frame in capture:
            start = time.perf_counter()
            status = tracker.update(frame).status.name
            seconds = time.perf_counter() - start
            if lap:  # the first sequence warms the process
                (after if found else before).append(seconds)
            found |= status == "OK"
    return {
        "before_ok_seconds": float(np.median(before)),
        "after_ok_seconds": float(np.median(after)) if after else None,
        "after_ok_p95_seconds": float(np.percentile(after, 95)) if after else None,
        "updates": len(before) + len(after),
        "peak_bytes": peak(),
    }


PARTS = ("scoring", "engines", "localizing", "tracking", "start")
MEGA = 1e-6
PAPER = (
    ("*paper, three passes, a GPU (Tab. 4)*", "2.90 s"),
    ("*paper, coarse, a GPU (App. E)*", "1.60 s"),
)
METHODS = {
    "all terms": FilterOptions(),
    "semantic + depth": FilterOptions().only(semantic=True, depth=True),
    "semantic": FilterOptions().only(semantic=True),
    "depth + colour": FilterOptions().only(depth=True, colour=True),
    "all terms, without polish": replace(FilterOptions(), answer="mle"),
    "all terms, paper's recipe": FilterOptions.paper(),
    "all terms, paper's recipe, coarse": FilterOptions.coarse(),
}


def scoring(house: SceneMap, folder: Path) -> tuple[str, list[dict[str, Any]]]:
    """Cost of scoring poses against one frame."""
    found = costs(house, folder)
    header = ["triangles", "particles", "rays each", "ms", "µs a particle"]
    header += ["M rays/s", "casting"]
    lines = [cost_line(c) for c in found]
    return markdown(header, lines), [c.to_dict() for c in found]


def cost_line(c: Cost) -> list[str]:
    """Cells of one cost."""
    return [
        number(c.triangles),
        number(c.particles),
        number(c.rays),
        number(1e3 * c.seconds, 1),
        number(1e6 * c.seconds / c.particles, 1),
        number(MEGA * c.rate, 1),
        share(c.share),
    ]


def casting(house: SceneMap, folder: Path) -> tuple[str, list[dict[str, Any]]]:
    """Rays a second of every engine at three sizes of the map."""
    rows: list[dict[str, Any]] = []
    for triangles in (BASE[2], len(house.mesh), 300_000):
        scene = house if triangles == len(house.mesh) else resized(house, triangles)
        rows.append({"triangles": len(scene.mesh), "rays_per_second": engines(scene, folder)})
    names = list(dict.fromkeys(name for row in rows for name in row["rays_per_second"]))
    lines = [
        [number(row["triangles"]), *(number(MEGA * row["rays_per_second"][n], 1) for n in names)]
        for row in rows
    ]
    return markdown(["M rays/s, triangles", *names], lines), rows


def methods(
    maps: dict[str, Path], folders: list[Path], say: Callable[[str], None]
) -> tuple[str, list[dict[str, Any]]]:
    """Time a frame of each method on each map, in fresh processes."""
    rows = []
    for map_name, path in maps.items():
        for name, options in METHODS.items():
            if map_name != "house" and name not in {"all terms", "all terms, without polish"}:
                continue
            say(f"{name}, {map_name}")
            row = apart(localizing, path, folders, options)
            rows.append({"method": name, "map": map_name} | row)
    header = [f"{FRAMES} frames", "map", "a frame", "reading", "search"]
    header += ["a frame and pass", "polish", "particles", "M rays a frame", "M rays/s"]
    header += ["scoring", "peak"]
    lines = [method_line(row) for row in rows]
    lines += [[name, "", seconds, *["–"] * 9] for name, seconds in PAPER]
    return markdown(header, lines), rows


def method_line(row: dict[str, Any]) -> list[str]:
    """Cells of one method."""
    stage = row["stage_seconds"]
    return [
        row["method"],
        row["map"],
        number(1e3 * row["frame_seconds"], 0, "ms"),
        number(1e3 * stage.get("reading", 0.0), 1, "ms"),
        number(1e3 * stage.get("search", 0.0), 1, "ms"),
        number(1e3 * stage.get("filter", 0.0) / max(1, row["passes"]), 1, "ms"),
        number(1e3 * stage.get("polish", 0.0), 1, "ms"),
        number(row["particles"]),
        number(MEGA * row["rays_a_frame"], 2),
        number(MEGA * row["rays_per_second"], 1),
        share(row["scoring_share"]),
        number(MEGA * row["peak_bytes"], 0, "MB"),
    ]


def tracked(path: Path, folders: list[Path]) -> tuple[str, dict[str, Any]]:
    """Updates of the tracker, before and after it has converged."""
    row = apart(tracking, path, folders)
    after, worst = row["after_ok_seconds"], row["after_ok_p95_seconds"]
    header = ["tracker", "before it is OK", "after", "95th percentile", "rate", "peak"]
    cells = [
        f"house, {row['updates']} updates",
        number(1e3 * row["before_ok_seconds"], 0, "ms"),
        number(after and 1e3 * after, 0, "ms"),
        number(worst and 1e3 * worst, 0, "ms"),
        number(after and 1 / after, 0, "Hz"),
        number(MEGA * row["peak_bytes"], 0, "MB"),
    ]
    return markdown(header, [cells]), row


def started(path: Path, folder: Path) -> tuple[str, dict[str, Any]]:
    """Cold start of the command line, compiled code cached."""
    command = ["scene", "localize", str(path), str(folder), "--frames", f"0:{FRAMES}", "--json"]
    spent = []
    for attempt in range(3 + 1):  # the first compiles, if nothing else did
        start = time.perf_counter()
        done = subprocess.run(  # noqa: S603  # our own command line
            [sys.executable, "-m", "placegraph.cli", *command],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise PlacegraphError(f"{' '.join(command)} fails: {done.stderr.strip()[-300:]}")
        if attempt:
            spent.append(time.perf_counter() - start)
    json.loads(done.stdout)
    seconds = float(np.median(spent))
    text = f"`placegraph scene localize`, {FRAMES} frames, cold"
    return markdown([text, "s"], [["house", number(seconds, 2)]]), {"seconds": seconds}


@table("SG2Loc, Table 4")
def indoor_speed(
    run: Run,
    only: Annotated[str, option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    *,
    quick: Quick = False,
) -> None:
    """What does localizing indoors cost? By particles, rays and triangles; memory, cold starts."""
    wanted = known(parts(only) or (["start"] if quick else []), PARTS, "part")
    folders = sorted((run.data / "house").glob("seq[0-9]*"))
    house = indoor_maps.house(run.data, run.cache)
    indoor_maps.coarse_house(run.data, run.cache)
    maps = {
        "house": indoor_maps.place(run.cache, "house"),
        "house, 20k triangles": indoor_maps.place(run.cache, f"house_{indoor_maps.COARSE}"),
    }
    work = {
        "start": ("Cold start", lambda: started(maps["house"], folders[0])),
        "localizing": (
            "Localizing, first frame and images included",
            lambda: methods(maps, folders, run.say),
        ),
        "tracking": ("Tracking", lambda: tracked(maps["house"], folders)),
        "scoring": ("Scoring poses against one frame", lambda: scoring(house, folders[0])),
        "engines": ("Ray casters, hits written to arrays", lambda: casting(house, folders[0])),
    }
    record: dict[str, Any] = {}
    for part, (title, measured) in work.items():
        if part in wanted:
            run.say(part)
            text, record[part] = measured()
            print(f"#### {title}\n\n{text}\n")
    run.save(record, whole=not only)
