"""Table `indoor_render`: time of a picture of the map, by map, size, engine, samples and threads.

Poses are the true ones along all sequences of the house, and along the half of the office that its
map was not made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
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
from placegraph_lab.tables.indoor import maps
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, option, share, show, table

TIMES = 5  # renderings of each pose, of which the median counts
WIDE = (-0.28, 0.09, 0.0, 0.0, -0.015)  # distortion of a wide lens


def time_renderings(scene: SceneMap, camera: Camera, poses: Floats) -> Iterator[dict[str, Any]]:
    """One row for each engine, number of samples and of threads."""
    backends: dict[str, Backend] = {"Embree": "embree", "own tree": "bvh"}
    mesh, most = (scene.mesh.vertices, scene.mesh.triangles), numba.get_num_threads()
    counts = range(1, min(count_processors(), 2) + 1)
    for (name, backend), samples, threads in product(backends.items(), (1, 4), counts):
        renderer = Renderer(scene, caster=RayCaster(*mesh, backend=backend))
        numba.set_num_threads(threads)
        spent, covered = [], []
        processor = process_time()
        renderer.render(poses[0], camera, samples=samples)
        for pose in poses:
            times = []
            for _ in range(TIMES):
                start = perf_counter()
                drawn = renderer.render(pose, camera, samples=samples)
                times.append(perf_counter() - start)
            spent.append(float(np.median(times)))
            covered.append(float(drawn.mask.mean()))
        processor = (process_time() - processor) / (TIMES * len(poses))
        numba.set_num_threads(most)
        yield {
            "engine": name, "width": camera.width, "height": camera.height, "samples": samples,
            "threads": threads, "seconds": np.median(spent), "p90_seconds": np.percentile(spent, 90),
            "slowest_seconds": max(spent), "processor_seconds": processor,
            "covered": np.mean(covered),
        }  # fmt: skip


COLUMNS = (
    Col("map", "map"), Col("triangles", "triangles", 0),
    Col("picture", lambda r: f"{r['width']} x {r['height']}"), Col("filled", "covered", share),
    Col("engine", "engine"), Col("samples", "samples", 0), Col("threads", "threads", 0),
    Col("median", "seconds", 1, "ms", 1e3), Col("90th percentile", "p90_seconds", 1, "ms", 1e3),
    Col("slowest", "slowest_seconds", 1, "ms", 1e3),
    Col("of processors", "processor_seconds", 1, "ms", 1e3),
)  # fmt: skip


@table()
def indoor_render(
    run: Run, poses: Annotated[int, option("Poses of each map.")] = 24, *, quick: Quick = False
) -> None:
    """Time to render the map, by map, size, engine, samples and threads."""
    poses = 2 if quick else poses
    house, office = (
        read_camera(run.data / f"{p}/camera.json").camera for p in ("house/seq00", "office")
    )
    tours = [true_poses(folder) for folder in sorted((run.data / "house").glob("seq[0-9]*"))]
    half = next(iter(HALVES))
    tour = true_poses(run.data / "office")[slice(*HALVES[half][1])]
    places = {
        "house": (maps.house(run.data, run.cache), (house, office), np.concatenate(tours)),
        "office": (maps.office(run.data, run.cache, half), (office,), tour),
    }
    rows = []
    for name, (scene, cameras, tour) in places.items():
        chosen = tour[np.linspace(0, len(tour) - 1, poses).round().astype(int)]
        for camera in cameras:
            run.log(f"{name}, {camera.width} x {camera.height}")
            head = {"map": name, "triangles": len(scene.mesh)}
            rows += [head | row for row in time_renderings(scene, camera, chosen)]
    show(f"A picture of the map, {poses} true poses each", COLUMNS, rows)
    first = []
    for lens, camera in (("no distortion", house), ("distorted", replace(house, distortion=WIDE))):
        camera_rays.cache_clear()
        start = perf_counter()
        camera_rays(camera)
        first.append((lens, perf_counter() - start))
    show("", (Col("rays of a new camera, 640 x 360, once", "0"), Col("ms", "1", 0, "", 1e3)), first)
    run.save({"rows": rows, "camera_seconds": first})
