"""What does a picture of the map cost? Milliseconds by map, size, engine, samples and threads.

    python benchmarks/indoor_render.py
    python benchmarks/indoor_render.py --poses 8 --out /tmp/render.json

Poses are the true ones along all sequences of the house, and along the half of the office that its
map was not made of. Prints a Markdown table and writes JSON.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Annotated, Any

import numba
import numpy as np
import typer

from placegraph.formats.capture.camera import read_camera
from placegraph.geometry import Camera
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.render import Renderer, camera_rays
from placegraph.threads import processors
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.indoor.speed import no_cuda
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.tables import markdown, number, share

if TYPE_CHECKING:
    from placegraph.geometry import Floats
    from placegraph.indoor.rays.caster import Backend
    from placegraph.indoor.scene_map import SceneMap

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data"
TIMES = 5
"""Renderings of each pose, of which the median counts."""
WIDE = (-0.28, 0.09, 0.0, 0.0, -0.015)
"""Distortion of a wide lens."""
NAMES = {"embree": "Embree", "bvh": "own tree"}


def main(
    poses: Annotated[int, typer.Option(help="Poses of each map.")] = 24,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = DATA,
    cache: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = ROOT
    / "benchmarks/results/indoor_render.json",
) -> None:
    """Measure what rendering costs and print Markdown."""
    house, office = (
        read_camera(data / "house/seq00/camera.json"),
        read_camera(data / "office/camera.json"),
    )
    tours = [true_poses(folder) for folder in sorted((data / "house").glob("seq[0-9]*"))]
    half = next(iter(HALVES))
    (low, high) = HALVES[half][1]
    places = {
        "house": (indoor_maps.house(data, cache), (house.camera, office.camera), np.concatenate(tours)),
        "office": (
            indoor_maps.office(data, cache, half), (office.camera,), true_poses(data / "office")[low:high],
        ),
    }  # fmt: skip
    reason = no_cuda()
    rows: list[dict[str, Any]] = []
    for name, (scene, cameras, tour) in places.items():
        chosen = tour[np.linspace(0, len(tour) - 1, poses).round().astype(int)]
        rows += [
            {"map": name, "triangles": len(scene.mesh)} | row
            for row in measured(scene, cameras, chosen, cuda=not reason)
        ]
    print(f"#### A picture of the map, {poses} true poses each\n\n{table(rows)}\n")
    if reason:
        print(f"No row for CUDA: {reason}\n")
    lenses = {"no distortion": house.camera, "distorted": distorted(house.camera)}
    first = {lens: fresh_rays(camera) for lens, camera in lenses.items()}
    print(markdown(["rays of a new camera, 640 x 360, once", "ms"],
                   [[lens, number(1e3 * s, 0)] for lens, s in first.items()]))  # fmt: skip
    record = {"machine": machine(), "no_cuda": reason, "poses": poses, "rows": rows}
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(dumps(record | {"camera_seconds": first}), encoding="utf-8")


def measured(
    scene: SceneMap, cameras: tuple[Camera, ...], poses: Floats, *, cuda: bool
) -> list[dict[str, Any]]:
    """One row for each engine, size, number of samples and of threads."""
    backends: tuple[Backend, ...] = ("embree", "bvh")
    mesh = scene.mesh.vertices, scene.mesh.triangles
    engines = {NAMES[b]: Renderer(scene, caster=RayCaster(*mesh, backend=b)) for b in backends}
    if cuda:
        engines["CUDA"] = Renderer(scene, device="cuda")
    rows = []
    for name, renderer in engines.items():
        for camera in cameras:
            for samples in (1, 4):
                for threads in (0,) if name == "CUDA" else range(1, min(processors(), 2) + 1):
                    print(f"{name}, {camera.width}, {samples}, {threads}", file=sys.stderr)
                    row = timed(renderer, camera, poses, samples, threads)
                    rows.append({"engine": name} | row)
    return rows


def timed(
    renderer: Renderer, camera: Camera, poses: Floats, samples: int, threads: int
) -> dict[str, Any]:
    """Medians over `TIMES` renderings of each pose; 0 threads: they are not the CPU's."""
    before = numba.get_num_threads()
    numba.set_num_threads(max(threads, 1))
    spent, seen = [], []
    processor = process_time()
    renderer.render(poses[0], camera, samples=samples)
    for pose in poses:
        times = []
        for _ in range(TIMES):
            start = perf_counter()
            drawn = renderer.render(pose, camera, samples=samples)
            times.append(perf_counter() - start)
        spent.append(float(np.median(times)))
        seen.append(float(drawn.mask.mean()))
    processor = (process_time() - processor) / (TIMES * len(poses))
    numba.set_num_threads(before)
    return {
        "width": camera.width, "height": camera.height, "samples": samples, "threads": threads,
        "seconds": float(np.median(spent)), "p90_seconds": float(np.percentile(spent, 90)),
        "slowest_seconds": max(spent), "processor_seconds": processor, "covered": float(np.mean(seen)),
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown of all rows."""
    header = ["map", "triangles", "picture", "filled", "engine", "samples", "threads"]
    header += ["median", "90th percentile", "slowest", "of processors"]
    return markdown(header, [line(row) for row in rows])


def line(row: dict[str, Any]) -> list[str]:
    """Cells of one row."""
    return [
        row["map"],
        number(row["triangles"]),
        f"{row['width']} x {row['height']}",
        share(row["covered"]),
        row["engine"],
        number(row["samples"]),
        number(row["threads"] or None),
        *(
            number(1e3 * row[k], 1, "ms")
            for k in ("seconds", "p90_seconds", "slowest_seconds", "processor_seconds")
        ),
    ]


def distorted(camera: Camera) -> Camera:
    """The same camera behind a wide lens."""
    return Camera(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, distortion=WIDE
    )


def fresh_rays(camera: Camera) -> float:
    """Seconds that the rays of a camera take that was not used before."""
    camera_rays.cache_clear()
    start = perf_counter()
    camera_rays(camera)
    return perf_counter() - start


if __name__ == "__main__":
    typer.run(main)
