"""RGB-D frames into a mesh: frames a second, memory, and how right the mesh is.

    placegraph-lab table scene_fusion
    placegraph-lab table scene_fusion --quick

House: the four sequences in which nothing was moved, fused with their true poses, beside the true
mesh. Office: five of six frames are fused, and foretell the sixth. Prints Markdown tables and writes
JSON. Where Open3D is installed, its volume has a row.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
import numpy as np

from placegraph.indoor.mapping.fuse import FuseOptions, fuse
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor.windows import true_poses
from placegraph_lab.tables.runner import Quick, Run, markdown, number, table
from placegraph_lab.tables.scene.fusion import House, Office, Way, open3d_volume, own
from placegraph_lab.tables.statistics import apart, peak

TIMES = 3
"""Runs, of which the quickest counts: what else the machine does only slows them."""
WAYS = (
    Way("defaults", own()),
    Way("voxels of 2 cm", own(voxel=0.02)),
    Way("voxels of 5 cm", own(voxel=0.05)),
    Way("truncation 3 voxels", own(truncation=0.09)),
    Way("readings at edges kept", own(FuseOptions(edges=False))),
    Way("exposure as it is", own(FuseOptions(gains=False))),
)


def timed(folder: Path, threads: int, what: str) -> dict[str, Any]:
    """Fuse all frames of a capture with their true poses."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:threads]))
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    capture, poses = open_capture(folder), true_poses(folder)
    if what != "own":
        spent = []
        for _ in range(TIMES):
            start = perf_counter()
            mesh = open3d_volume()(capture.frames, poses)
            spent.append(perf_counter() - start)
        row = {"triangles": len(mesh), "frames": len(poses), "seconds": min(spent)}
    else:
        fuse(capture.frames[:3], poses[:3])  # compiled code is loaded
        runs = [fuse(capture.frames, poses) for _ in range(TIMES)]
        stats = runs[0].stats
        row = {
            "triangles": len(runs[0].triangles),
            "frames": stats.frames,
            "seconds": min(run.stats.seconds for run in runs),
            "voxels": stats.voxels,
            "volume_bytes": stats.memory,
            "agreement": stats.agreement,
            "apart": stats.apart,
        }
    return {"way": what, "threads": threads, "peak_bytes": peak()} | row


def speed_table(rows: list[dict[str, Any]]) -> str:
    """Markdown of what all frames cost."""
    header = [
        "",
        "threads",
        "frames/s",
        "seconds",
        "triangles",
        "volume",
        "peak memory",
        "agreement",
    ]
    cells = [
        [
            r["way"],
            number(r["threads"]),
            number(r["frames"] / r["seconds"], 1),
            number(r["seconds"], 1),
            number(r["triangles"]),
            number(1e-6 * r["volume_bytes"] if "volume_bytes" in r else None, 0, "MB"),
            number(1e-6 * r["peak_bytes"], 0, "MB"),
            number(1e3 * r["agreement"] if "agreement" in r else None, 1, "mm"),
        ]
        for r in rows
    ]
    return markdown(header, cells)


def house_table(rows: list[dict[str, Any]]) -> str:
    """Markdown of accuracy and completeness."""
    header = ["", "seconds", "triangles", "off: median", "mean", "95 %"]
    header += ["of what is seen, within 3 cm", "5 cm"]
    cells = [
        [
            r["way"],
            number(r["seconds"], 1),
            number(r["triangles"]),
            *(number(1e3 * r[k], 1, "mm") for k in ("median", "mean", "p95")),
            *(number(100 * r[k], 1, "%") for k in ("within_3_cm", "within_5_cm")),
        ]
        for r in rows
    ]
    return markdown(header, cells)


def office_table(rows: list[dict[str, Any]]) -> str:
    """Markdown of how well frames that were left out are foretold."""
    header = ["", "triangles", "readings within 10 cm", "depth off: median"]
    header += ["brightness off, of 255", "slopes' correlation"]
    cells = [
        [
            r["way"],
            number(r["triangles"]),
            number(100 * r["covered"], 1, "%"),
            number(1e3 * r["median"], 1, "mm"),
            number(r["colour"], 1),
            number(r["sharpness"], 3),
        ]
        for r in rows
    ]
    return markdown(header, cells)


@table()
def scene_fusion(run: Run, *, quick: Quick = False) -> None:
    """RGB-D frames into a mesh: frames a second, memory, and how right the mesh is."""
    ways = WAYS[:1] if quick else WAYS
    rival = find_spec("open3d") is not None
    if rival:
        ways = (*ways, Way("Open3D", open3d_volume()))
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    place = run.data / "office"
    speed = [apart(timed, place, n, "own") for n in (1, 2) if n <= cores]
    if rival:
        speed.append(apart(timed, place, min(2, cores), "Open3D"))
    print(
        f"#### Office, all frames; the machine's load was {number(load, 1)}\n\n{speed_table(speed)}\n"
    )
    house, office, rng = House(run.data / "house"), Office(place), np.random.default_rng(0)
    right = [house.row(way, rng) for way in run.track(ways, "house")]
    print(f"#### House, beside its mesh\n\n{house_table(right)}\n")
    foretold = [office.row(way) for way in run.track(ways, "office")]
    print(f"#### Office, every sixth frame left out\n\n{office_table(foretold)}\n")
    run.save({"load_before": load, "speed": speed, "house": right, "office": foretold})
