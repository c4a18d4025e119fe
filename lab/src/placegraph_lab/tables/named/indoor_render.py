"""What does a picture of the map cost? Milliseconds by map, size, engine, samples and threads.

    placegraph-lab table indoor_render
    placegraph-lab table indoor_render --poses 8 --out render.json

Poses are the true ones along all sequences of the house, and along the half of the office that its
map was not made of. Prints a Markdown table and writes JSON.
"""

from __future__ import annotations

import sys
from time import perf_counter, process_time
from typing import Annotated, Any

import numba
import numpy as np

from placegraph.core.geometry import Camera, Floats
from placegraph.core.threads import count_processors
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.rays.caster import Backend
from placegraph.indoor.render import Renderer, camera_rays
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.json_files import read_camera
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import Quick, Run, markdown, number, option, share, table

TIMES = 5  # renderings of each pose, of which the median counts
WIDE = (-0.28, 0.09, 0.0, 0.0, -0.015)  # distortion of a wide lens
HEADER = ["map", "triangles", "picture", "filled", "engine", "samples", "threads", "median"]
HEADER += ["90th percentile", "slowest", "of processors"]
NAMES = {"embree": "Embree", "bvh": "own tree"}


def measured(scene: SceneMap, cameras: tuple[Camera, ...], poses: Floats) -> list[dict[str, Any]]:
    """One row for each engine, size, number of samples and of threads."""
    backends: tuple[Backend, ...] = ("embree", "bvh")
    mesh = scene.mesh.vertices, scene.mesh.triangles
    engines = {NAMES[b]: Renderer(scene, caster=RayCaster(*mesh, backend=b)) for b in backends}
    rows = []
    for name, renderer in engines.items():
        for camera in cameras:
            for samples in (1, 4):
                for threads in range(1, min(count_processors(), 2) + 1):
                    print(f"{name}, {camera.width}, {samples}, {threads}", file=sys.stderr)
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
                    row = {
                        "width": camera.width,
                        "height": camera.height,
                        "samples": samples,
                        "threads": threads,
                        "seconds": float(np.median(spent)),
                        "p90_seconds": float(np.percentile(spent, 90)),
                        "slowest_seconds": max(spent),
                        "processor_seconds": processor,
                        "covered": float(np.mean(seen)),
                    }
                    rows.append({"engine": name} | row)
    return rows


def line(row: dict[str, Any]) -> list[str]:
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
    return Camera(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, distortion=WIDE
    )


def fresh_rays(camera: Camera) -> float:
    camera_rays.cache_clear()
    start = perf_counter()
    camera_rays(camera)
    return perf_counter() - start


@table()
def indoor_render(
    run: Run, poses: Annotated[int, option("Poses of each map.")] = 24, *, quick: Quick = False
) -> None:
    """What does a picture of the map cost? By map, size, engine, samples and threads."""
    poses = 2 if quick else poses
    house, office = (read_camera(run.data / f"{p}/camera.json") for p in ("house/seq00", "office"))
    tours = [true_poses(folder) for folder in sorted((run.data / "house").glob("seq[0-9]*"))]
    half = next(iter(HALVES))
    low, high = HALVES[half][1]
    places = {
        "house": (
            indoor_maps.house(run.data, run.cache),
            (house.camera, office.camera),
            np.concatenate(tours),
        ),
        "office": (
            indoor_maps.office(run.data, run.cache, half),
            (office.camera,),
            true_poses(run.data / "office")[low:high],
        ),
    }
    rows: list[dict[str, Any]] = []
    for name, (scene, cameras, tour) in places.items():
        chosen = tour[np.linspace(0, len(tour) - 1, poses).round().astype(int)]
        rows += [
            {"map": name, "triangles": len(scene.mesh)} | row
            for row in measured(scene, cameras, chosen)
        ]
    print(
        f"#### A picture of the map, {poses} true poses each\n\n{markdown(HEADER, map(line, rows))}\n"
    )
    lenses = {"no distortion": house.camera, "distorted": distorted(house.camera)}
    first = {lens: fresh_rays(camera) for lens, camera in lenses.items()}
    header = ["rays of a new camera, 640 x 360, once", "ms"]
    print(markdown(header, [[lens, number(1e3 * s, 0)] for lens, s in first.items()]))
    run.save({"rows": rows, "camera_seconds": first})
