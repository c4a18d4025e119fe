"""Accuracy of fusion: in the house beside its mesh, in the office beside frames left out."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.fuse import FuseOptions, fuse
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Frame
from placegraph.io.mesh.gltf import read_glb
from placegraph_lab.tables.indoor.windows import true_poses
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, number, render, table
from placegraph_lab.tables.scene.surface import distances, spread
from placegraph_lab.tables.statistics import peak, run_apart

Fuser = Callable[[Sequence[Frame], Floats], Mesh]
SEQUENCES = ("seq00", "seq03", "seq04", "seq07")  # of the house, in which nothing was moved
SEEN = 6.0  # what cameras see nearer than this should be in the mesh [m]
GRAIN = 0.03  # of what they see, one point in a cube of this edge counts [m]
SAMPLES = 100_000
EVERY = 6  # of the office, every such frame is left out and asked about
NEAR = 0.10  # A reading is in the mesh where the mesh is this near to it along the optical axis [m]
SAME = 0.05  # colours are compared where it is this near [m]


@dataclass(frozen=True)
class Way:
    """One row: how frames are fused."""

    name: str
    fuser: Fuser


def make_fuser(options: FuseOptions | None = None, **given: Any) -> Fuser:
    """`placegraph.indoor.mapping.fuse.fuse` with options."""

    def run(frames: Sequence[Frame], poses: Floats) -> Mesh:
        fused = fuse(frames, poses, options=options, **given)
        return Mesh.plain(fused.vertices, fused.triangles, colours=fused.colours)

    return run


def open3d_volume(voxel: float = 0.03, cut: float = 4.0, reach: float = 7.5) -> Fuser:
    """Open3D's VoxelBlockGrid on the CPU, distances cut at `cut` voxels; colours at depth's size."""

    def run(frames: Sequence[Frame], poses: Floats) -> Mesh:
        import open3d  # type: ignore[import-not-found, unused-ignore]

        core, image_of = open3d.core, open3d.t.geometry.Image
        names, kinds = ("tsdf", "weight", "color"), (core.float32,) * 3
        grid = open3d.t.geometry.VoxelBlockGrid(
            names, kinds, (1, 1, 3), voxel, 8, 50_000, core.Device("CPU:0")
        )
        for frame, pose in zip(frames, poses, strict=True):
            depth, camera = frame.depth(), frame.depth_camera
            if depth is None or camera is None:
                continue
            # Open3D's pixels have their centres at whole numbers
            inner = np.diag([camera.fx, camera.fy, 1.0])
            inner[:2, 2] = camera.cx - 0.5, camera.cy - 0.5
            pinhole, view = core.Tensor(inner), core.Tensor(np.linalg.inv(pose))
            metres = image_of(core.Tensor(np.nan_to_num(depth)[..., None]))
            shade = at_depth(frame.rgb(), depth.shape).astype(np.float32) / 255
            blocks = grid.compute_unique_block_coordinates(metres, pinhole, view, 1.0, reach, cut)
            image = image_of(core.Tensor(shade))
            grid.integrate(blocks, metres, image, pinhole, pinhole, view, 1.0, reach, cut)
        mesh = grid.extract_triangle_mesh(0.5)
        colours = np.rint(255 * mesh.vertex.colors.numpy().clip(0, 1)).astype(np.uint8)
        triangles = mesh.triangle.indices.numpy()
        return Mesh.plain(mesh.vertex.positions.numpy(), triangles, colours=colours)

    return run


def at_depth(image: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    from PIL import Image

    small = Image.fromarray(image).resize((shape[1], shape[0]), Image.Resampling.BOX)
    return np.array(small)


class House:
    """The frames of the house in which nothing was moved, and its true mesh."""

    def __init__(self, folder: Path, sequences: Sequence[str] = SEQUENCES) -> None:
        model = read_glb(folder / "map/house.glb")
        self.mesh = Mesh.plain(model.vertices, model.triangles)
        parts = [(open_capture(folder / s), true_poses(folder / s)) for s in sequences]
        self.frames = [frame for capture, _ in parts for frame in capture]
        self.poses = np.concatenate([poses for _, poses in parts])
        caster = RayCaster(self.mesh.vertices, self.mesh.triangles)
        points = []
        for frame, pose in zip(self.frames, self.poses, strict=True):
            camera = frame.depth_camera or frame.camera
            rays = rays_of(camera, pose, 3)
            hits = caster.cast(np.broadcast_to(pose[:3, 3], rays.shape), rays)
            seen = (hits.triangle >= 0) & (hits.distance < SEEN)
            points.append((pose[:3, 3] + rays * hits.distance[:, None])[seen])
        found = np.concatenate(points)
        cells = np.floor(found / GRAIN).astype(np.int64)
        self.seen: Floats = found[np.unique(cells, axis=0, return_index=True)[1]]
        """(N, 3) what the cameras see [m], even over the surface."""

    def row(self, way: Way, rng: np.random.Generator) -> dict[str, Any]:
        start = perf_counter()
        mesh = way.fuser(self.frames, self.poses)
        seconds = perf_counter() - start
        off = distances(spread(mesh, rng, SAMPLES), self.mesh)
        few = self.seen[rng.permutation(len(self.seen))[:SAMPLES]]
        missed = distances(few, mesh)
        return {
            "way": way.name,
            "frames": len(self.frames),
            "seconds": seconds,
            "triangles": len(mesh),
            "median": float(np.median(off)),
            "mean": float(off.mean()),
            "p95": float(np.quantile(off, 0.95)),
            "within_3_cm": float((missed < 0.03).mean()),
            "within_5_cm": float((missed < 0.05).mean()),
        }


class Office:
    """The frames of the office, less every `EVERY`-th, and those."""

    def __init__(self, folder: Path) -> None:
        capture, self.poses = open_capture(folder), true_poses(folder)
        self.frames = list(capture)
        rows = np.arange(len(self.frames))
        self.asked = rows[EVERY // 2 :: EVERY]
        self.fused = np.setdiff1d(rows, self.asked)

    def row(self, way: Way) -> dict[str, Any]:
        mesh = way.fuser([self.frames[i] for i in self.fused], self.poses[self.fused])
        caster = RayCaster(mesh.vertices, mesh.triangles)
        seen = [compare_frame(self.frames[i], self.poses[i], mesh, caster) for i in self.asked]
        gaps, colours, slopes = (np.concatenate(part) for part in zip(*seen, strict=True))
        return {
            "way": way.name,
            "frames": len(self.asked),
            "triangles": len(mesh),
            "covered": float((gaps < NEAR).mean()),
            "median": float(np.median(gaps[np.isfinite(gaps)])),
            "colour": float(colours.mean()),
            "sharpness": float(slopes.mean()),
        }


def compare_frame(
    frame: Frame, pose: Floats, mesh: Mesh, caster: RayCaster
) -> tuple[Floats, Floats, Floats]:
    """Depth off (N,) [m, inf: no mesh], brightness off (M,) [0 to 255], correlation of slopes (1,).

    Brightness is compared after the frame's exposure (one factor, the median) is taken out; slopes
    are differences of brightness between neighbours in a line of pixels.
    """
    depth, camera = frame.depth(), frame.depth_camera
    if depth is None or camera is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    rays = rays_of(camera, pose, 1)
    hits = caster.cast(np.broadcast_to(pose[:3, 3], rays.shape), rays)
    found = np.where(hits.triangle >= 0, hits.distance, np.inf).reshape(depth.shape)
    off = np.abs(found - depth)
    shade = mesh.colour_at(np.maximum(hits.triangle, 0), hits.u, hits.v)
    model = shade.reshape(*depth.shape, 3).mean(axis=-1)
    image = at_depth(frame.rgb(), depth.shape).astype(np.float64).mean(axis=-1)
    same = off < SAME
    if not same.any():
        return off[np.isfinite(depth)], np.zeros(0), np.zeros(0)
    model = model * np.median(image[same] / np.maximum(model[same], 1.0))
    both = same[:, 2:] & same[:, :-2]
    one, two = ((p[:, 2:] - p[:, :-2])[both] for p in (model, image))
    alike = np.corrcoef(one, two)[0, 1:] if both.sum() > EVERY and one.any() and two.any() else []
    return off[np.isfinite(depth)], np.abs(model - image)[same], np.asarray(alike, np.float64)


def rays_of(camera: Camera, pose: Floats, step: int) -> Floats:
    """Rays (N, 3) in the map, 1 long along the optical axis, of every `step`-th line and column."""
    v, u = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step] + 0.5
    rays: Floats = camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3) @ pose[:3, :3].T
    return rays


TIMES = 3  # runs, of which the quickest counts: what else the machine does only slows them
WAYS = (
    Way("defaults", make_fuser()),
    Way("voxels of 2 cm", make_fuser(voxel=0.02)),
    Way("voxels of 5 cm", make_fuser(voxel=0.05)),
    Way("truncation 3 voxels", make_fuser(truncation=0.09)),
    Way("readings at edges kept", make_fuser(FuseOptions(edges=False))),
    Way("exposure as it is", make_fuser(FuseOptions(gains=False))),
)


def time_fusion(folder: Path, threads: int, what: str) -> dict[str, Any]:
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


SPEED = (
    Col("", "way"), Col("threads", "threads", 0),
    Col("frames/s", lambda r: r["frames"] / r["seconds"], 1), Col("seconds", "seconds", 1),
    Col("triangles", "triangles", 0), Col("volume", "volume_bytes", 0, "MB", 1e-6),
    Col("peak memory", "peak_bytes", 0, "MB", 1e-6), Col("agreement", "agreement", 1, "mm", 1e3),
)  # fmt: skip
HOUSE = (
    Col("", "way"), Col("seconds", "seconds", 1), Col("triangles", "triangles", 0),
    Col("off: median", "median", 1, "mm", 1e3), Col("mean", "mean", 1, "mm", 1e3),
    Col("95 %", "p95", 1, "mm", 1e3), Col("of what is seen, within 3 cm", "within_3_cm", 1, "%", 100),
    Col("5 cm", "within_5_cm", 1, "%", 100),
)  # fmt: skip
OFFICE = (
    Col("", "way"), Col("triangles", "triangles", 0),
    Col("readings within 10 cm", "covered", 1, "%", 100), Col("depth off: median", "median", 1, "mm", 1e3),
    Col("brightness off, of 255", "colour", 1), Col("slopes' correlation", "sharpness", 3),
)  # fmt: skip


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
    speed = [run_apart(time_fusion, place, n, "own") for n in (1, 2) if n <= cores]
    if rival:
        speed.append(run_apart(time_fusion, place, min(2, cores), "Open3D"))
    print(
        f"#### Office, all frames; the machine's load was {number(load, 1)}\n\n{render(SPEED, speed)}\n"
    )
    house, office, rng = House(run.data / "house"), Office(place), np.random.default_rng(0)
    right = [house.row(way, rng) for way in run.track(ways, "house")]
    print(f"#### House, beside its mesh\n\n{render(HOUSE, right)}\n")
    foretold = [office.row(way) for way in run.track(ways, "office")]
    print(f"#### Office, every sixth frame left out\n\n{render(OFFICE, foretold)}\n")
    run.save({"load_before": load, "speed": speed, "house": right, "office": foretold})
