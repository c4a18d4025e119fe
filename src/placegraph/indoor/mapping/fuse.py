"""Fusion of depth and colour: frames of known pose become one mesh."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.core.options import check_options, option
from placegraph.core.threads import run_parallel
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping import fuse_kernels as kernels
from placegraph.indoor.mapping.fuse_kernels import (
    SIZE,
    Blocks,
    compute_facets,
    find_farthest,
    find_visible,
)
from placegraph.io.capture.frame import Frame

FARTHEST = 1e4  # Cameras farther from the map's origin than this are damage [m]
JUMP = 0.5  # A pose that leaves its neighbours by more, while they stay together, is a slip [m]
AHEAD = 3  # Frames that are read while one is fused
LONGEST = 960  # Longer images [px] are made smaller: their pixels are finer than texels
SQUARE = 4  # Edge of the squares in which distortion is checked [px]
WIDE, WIDEST = 1.5, 2.0  # Undistorted images and depth are at most this much wider and higher


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Images of one frame without distortion, and where they were taken."""

    row: int
    depth: NDArray[np.float32]  # (h, w) [m], NaN: no reading; (0, 0): the frame has none
    image: NDArray[np.uint8]  # (H, W, 3), of one size in all views; (0, 0, 3): the frame has none
    cameras: tuple[Camera, Camera]  # of depth and of image
    map_from_camera: Floats

    @property
    def pinholes(self) -> Floats:
        """(2, 4) fx, fy, cx, cy [px] of depth and image."""
        return np.array([[c.fx, c.fy, c.cx, c.cy] for c in self.cameras])


def read_views(
    frames: Sequence[Frame],
    poses: Floats,
    good: NDArray[np.bool_],
    enough: float,
    left_out: Counter[str],
) -> Iterator[View | None]:
    """Read the views of all frames in order, None for those without a `good` pose (T,).

    The next frames are read while the caller works on the last; `enough` as of `read_view`. Raises
    `InputError` where an image is broken.
    """

    def view(row: int) -> View | None:
        plain = make_pinhole(frames[0].camera)
        return read_view(frames[row], row, poses[row], plain, enough) if good[row] else None

    with ThreadPoolExecutor(AHEAD) as reader:
        wait([reader.submit(view, row) for row in range(min(1, len(frames)))])  # maps its lens
        ahead = [reader.submit(view, row) for row in range(min(AHEAD, len(frames)))]
        for row in range(len(frames)):
            found = ahead.pop(0).result()
            if row + AHEAD < len(frames):
                ahead.append(reader.submit(view, row + AHEAD))
            if found is None:
                left_out["frames with a broken pose"] += 1
            elif not found.depth.size:
                left_out["frames without depth"] += 1
            yield found


def read_view(
    frame: Frame, row: int, map_from_camera: Floats, plain: Camera, enough: float
) -> View:
    """Read the view of a frame; its image is that of a pinhole camera `plain`.

    `enough`: focal length [px] to which depth is made smaller.
    """
    reading, camera = frame.depth(), frame.depth_camera or frame.camera
    depth, thin = np.zeros((0, 0), np.float32), camera
    if reading is not None and (reading > 0).any():
        thin = remove_distortion(shrink_camera(camera, enough / camera.fx), WIDEST)
        table = find_readings(camera, thin)
        depth = np.where(table >= 0, reading.ravel()[table], np.float32(np.nan))
    image = np.zeros((0, 0, 3), np.uint8)
    if frame.has_colour:
        image = np.ascontiguousarray(undistort_image(frame.rgb(), frame.camera, plain))
    return View(row, depth, image, (thin, plain), map_from_camera)


def make_pinhole(camera: Camera) -> Camera:
    """Make the camera without distortion whose images have at most `LONGEST` pixels a side."""
    camera = remove_distortion(camera, WIDE)
    return shrink_camera(camera, LONGEST / max(camera.width, camera.height))


def shrink_camera(camera: Camera, scale: float) -> Camera:
    """Return the camera with images of this scale, if that is smaller."""
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    return camera.resize(width, height) if scale < 1.0 else camera


def undistort_image(colours: NDArray[np.uint8], camera: Camera, plain: Camera) -> NDArray[np.uint8]:
    """Return the image (h, w, 3) of a pinhole camera from that (H, W, 3) of another camera."""
    if camera.width > 1.5 * plain.width:  # averaged first, so that nothing aliases
        from PIL import Image

        size = (plain.width, round(camera.height * plain.width / camera.width))
        colours = np.asarray(Image.fromarray(colours).resize(size, Image.Resampling.BOX))
        camera = camera.resize(*size)
    if camera == plain:
        return colours
    out = np.empty((plain.height, plain.width, 3), np.uint8)
    kernels.resample_image(colours, _map_pixels(camera, plain), out)
    return out


@lru_cache(maxsize=8)
def _map_pixels(camera: Camera, plain: Camera) -> Floats:
    """Map the pixels of camera `plain` to pixels (h, w, 2) of another; NaN: beyond its lens."""
    v, u = np.mgrid[: plain.height, : plain.width] + 0.5
    rays = plain.directions(np.stack([u, v], axis=-1))
    places = camera.project(rays)
    # a strong distortion folds what lies far outside back into the image: the way back, which takes
    # long to find, differs in whole squares of pixels
    back = camera.directions(places[::SQUARE, ::SQUARE])
    off = np.abs(back - rays[::SQUARE, ::SQUARE]).max(axis=-1).repeat(SQUARE, 0).repeat(SQUARE, 1)
    places[~(off[: plain.height, : plain.width] < 1.0 / min(camera.fx, camera.fy))] = np.nan
    return np.ascontiguousarray(places)


@lru_cache(maxsize=8)
def remove_distortion(camera: Camera, widest: float) -> Camera:
    """Return a camera without distortion.

    Its images are as large as it takes to show all that the camera sees, up to `widest` times.
    """
    if camera.is_rectilinear:
        return camera
    w, h = camera.width, camera.height
    i, j = np.arange(w) + 0.5, np.arange(h) + 0.5
    rim = np.concatenate(
        [np.stack([i, np.full(w, v)], axis=1) for v in (0.0, h)]
        + [np.stack([np.full(h, u), j], axis=1) for u in (0.0, w)]
    )
    limit = 0.5 * widest * np.array([w, h])
    reached = camera.directions(rim)[:, :2] * (camera.fx, camera.fy)
    beyond = np.where(rim < (camera.cx, camera.cy), -limit, limit)
    reached = np.where(np.isfinite(reached), reached, beyond)
    low = np.ceil(np.minimum(np.maximum(-reached.min(axis=0), 1), limit))
    high = np.ceil(np.minimum(np.maximum(reached.max(axis=0), 1), limit))
    width, height = (low + high).astype(int).tolist()
    return Camera(width, height, camera.fx, camera.fy, float(low[0]), float(low[1]))


@lru_cache(maxsize=8)
def find_readings(camera: Camera, plain: Camera) -> NDArray[np.int64]:
    """Find the pixel that each pixel (h, w) of camera `plain` sees in a flat image; -1: none."""
    at = np.nan_to_num(_map_pixels(camera, plain), nan=-1.0)
    column, line = np.floor(np.moveaxis(at, -1, 0)).astype(np.int64)
    inside = (column >= 0) & (line >= 0) & (column < camera.width) & (line < camera.height)
    return np.where(inside, line * camera.width + column, -1)


def find_good_poses(poses: Floats) -> NDArray[np.bool_]:
    """Return which poses (T, 4, 4) are credible: finite, rigid, near the origin, and no slip.

    A slip is a single pose far off the two around it, that are near to each other.
    """
    with np.errstate(all="ignore"):
        turn = poses[:, :3, :3]
        square = turn @ np.swapaxes(turn, 1, 2)
        good: NDArray[np.bool_] = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        good &= (np.abs(square - np.eye(3)) < 1e-2).all(axis=(1, 2))
        good &= np.linalg.det(np.where(good[:, None, None], turn, np.eye(3))) > 0
        good &= (np.abs(poses[:, :3, 3]) < FARTHEST).all(axis=1)
    rows = np.flatnonzero(good)
    at = poses[rows, :3, 3]
    if len(rows) > 2:
        step = np.linalg.norm(np.diff(at, axis=0), axis=1)
        around = np.linalg.norm(at[2:] - at[:-2], axis=1)
        off = np.minimum(step[:-1], step[1:])
        good[rows[1:-1][(off > JUMP) & (off > 3 * around)]] = False
    return good


FIRST = 4096  # Blocks that there is room for at first
BLOCK = 24 * SIZE  # Bytes of a block, less a few for its place
STEP = 2  # Every such line and column of the depth calls for blocks
BRIGHTNESS_STEP = 4  # Likewise, for comparing brightness
ENOUGH = 200  # Places that brightness must be compared at
DARKEST, BRIGHTEST = 0.5, 2.0  # What an image is multiplied by, at most


class FullError(Exception):
    """The volume would outgrow its memory; caught within fusion."""


def make_hash(room: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Make an empty hash, keys and rows (K,), for so many blocks."""
    size = 1 << int(np.ceil(np.log2(4 * room)))
    return np.full(size, -1, np.int64), np.zeros(size, np.int32)


class Volume:
    """Signed distances in blocks; `integrate` adds views, in place."""

    def __init__(self, voxel: float, truncation: float, memory: float) -> None:
        """Empty volume of voxels of this edge [m], that may take `memory` bytes."""
        self.most = max(int(memory / BLOCK), 1)
        self.count = 0
        room = min(FIRST, self.most)
        self.blocks = Blocks(
            *make_hash(room),
            places=np.zeros((room, 3), np.int32),
            distance=np.zeros((room, SIZE), np.float32),
            weight=np.zeros((room, SIZE), np.float32),
            colour=np.zeros((room, SIZE, 3), np.float32),
            paint=np.zeros((room, SIZE), np.float32),
            voxel=float(voxel),
            truncation=float(truncation),
        )

    def grow(self) -> None:
        """Make room for more blocks; `FullError` where memory ends."""
        room = len(self.blocks.places)
        if room >= self.most:
            raise FullError
        more = min(room + room // 2, self.most)
        columns: dict[str, Any] = self.blocks._asdict()
        del self.blocks  # else no column would be freed before all are copied
        for name in ("places", "distance", "weight", "colour", "paint"):
            old = columns[name]
            columns[name] = np.zeros((more, *old.shape[1:]), old.dtype)
            columns[name][:room] = old
        columns["keys"], columns["rows"] = make_hash(more)
        self.blocks = Blocks(**columns)
        kernels.rehash(self.blocks, self.count)

    @property
    def bytes(self) -> int:
        """Memory of the blocks that are used."""
        return self.count * BLOCK

    def integrate(self, view: View, facets: NDArray[np.float32], *, gains: bool) -> float:
        """Take in a view, in place; what its image was multiplied by to fit those before.

        `facets`: (h, w, 6) of `compute_facets`. Raises `FullError` where memory ends.
        """
        pose, depth_eye = view.map_from_camera, view.pinholes[0]
        while True:
            count = kernels.allocate_blocks(self.blocks, self.count, facets, depth_eye, pose, STEP)
            self.count = count if count >= 0 else -1 - count
            if count >= 0:
                break
            self.grow()
        gain = self.measure_gain(view, facets) if gains else 1.0
        back = np.linalg.inv(pose)
        far = find_farthest(facets)
        chosen = find_visible(self.blocks, self.count, far, depth_eye, facets.shape[:2], back)
        run_parallel(
            kernels.integrate, len(chosen), self.blocks, chosen, facets, view.image, gain, view.pinholes,
            back,
        )  # fmt: skip
        return gain

    def measure_gain(self, view: View, facets: NDArray[np.float32]) -> float:
        """Return the factor from an image's brightness to the model's; 1 where they hardly overlap."""
        ratios = kernels.brightness_ratios(
            self.blocks, facets, view.image, view.pinholes, view.map_from_camera, BRIGHTNESS_STEP
        )
        if len(ratios) < ENOUGH:
            return 1.0
        return float(np.clip(np.median(ratios), DARKEST, BRIGHTEST))

    def measure_gaps(self, points: Floats) -> NDArray[np.float32]:
        """Return distances (N,) [m] of points (N, 3) [m, map] from the surface, cut at the truncation."""
        return kernels.measure_gaps(self.blocks, points)


Ints = NDArray[np.int64]
Colours = NDArray[np.uint8]

NOTHING = 1e-12  # Triangles of no more than this are none [m^2]


def extract_surface(
    volume: Volume, *, least: float, speck: float, left_out: Counter[str]
) -> tuple[Floats, Ints, Colours]:
    """Extract vertices (V, 3) [m], triangles (T, 3) that face free space, and colours (V, 3).

    `least` and `speck` as of `FuseOptions`. All are empty where the volume shows no surface.
    """
    loop_of, loops = make_loop_tables()
    blocks, count = volume.blocks, volume.count
    around = kernels.find_neighbours(blocks, count)
    # neighbouring voxels differ by one voxel at most, and by noise; not by a truncation
    cases, crossed, sizes = kernels.find_cells(around, blocks, least, loops)
    starts = _sum_sizes(sizes)
    points, colours, first = kernels.make_vertices(
        around, blocks, cases, crossed, starts, loop_of, loops
    )
    none = np.zeros((0, 4), np.int32)
    grid = around, blocks.distance, cases, crossed, first, loop_of
    ends = _sum_sizes(kernels.make_quads(*grid, np.zeros(count, np.int64), none))
    quads = np.empty((ends[-1], 4), np.int32)
    kernels.make_quads(*grid, ends, quads)
    del around, cases, crossed, first, grid
    triangles = kernels.split_quads(points, quads)
    del quads
    return drop_specks(points, triangles, colours, speck, left_out)


def drop_specks(
    points: Floats, triangles: Ints, colours: Colours, least: float, left_out: Counter[str]
) -> tuple[Floats, Ints, Colours]:
    """Drop connected parts of less than `least` [m^2], and vertices that nothing uses."""
    root = kernels.find_roots(len(points), triangles)[triangles[:, 0]]
    area = kernels.measure_areas(points, triangles)
    size = np.bincount(root, area, minlength=len(points))
    dropped = np.unique(root[size[root] < least])
    if len(dropped):
        left_out["parts of the surface that are too small"] += len(dropped)
    # where knowledge ends in one line, both triangles of a quad may have no area
    kept = triangles[(size[root] >= least) & (area > NOTHING)]
    used = np.zeros(len(points), np.bool_)
    used[kept.ravel()] = True
    place = np.cumsum(used) - 1
    return points[used], place[kept], colours[used]


@lru_cache(maxsize=1)
def make_loop_tables() -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Tabulate the loop of every edge by case (256, 12), -1: not crossed; and loops by case (256,).

    On each face of a cell the surface joins crossed edges in pairs. Where all four are crossed, the
    two corners behind the surface are cut off one by one; the cell beyond the face does the same.
    Case 0 stands for cells that are known in part: all their crossed edges share one vertex.
    """
    loop_of = np.full((256, 12), -1, np.int8)
    loops = np.zeros(256, np.int8)
    loop_of[0], loops[0] = 0, 1
    edges = {}
    for edge in range(12):
        low = int(kernels.low_corner(edge))
        edges[frozenset((low, low | 1 << (edge >> 2)))] = edge
    faces = [
        (side, side | one, side | one | two, side | two)
        for one, two, axis in ((2, 4, 1), (4, 1, 2), (1, 2, 4))
        for side in (0, axis)
    ]
    for case in range(1, 256):
        group = {e: e for pair, e in edges.items() if len({case >> c & 1 for c in pair}) == 2}
        for face in faces:
            round_ = [edges[frozenset((face[n], face[(n + 1) % 4]))] for n in range(4)]
            crossed = [e for e in round_ if e in group]
            pairs = [tuple(crossed)] if len(crossed) == 2 else []
            if len(crossed) == 4:
                pairs = [(round_[n - 1], round_[n]) for n in range(4) if case >> face[n] & 1]
            for a, b in pairs:
                old, new = group[a], group[b]
                group = {e: new if g == old else g for e, g in group.items()}
        names = sorted(set(group.values()))
        loops[case] = len(names)
        for edge, name in group.items():
            loop_of[case, edge] = names.index(name)
    return loop_of, loops


def _sum_sizes(sizes: Ints) -> Ints:
    """Return starts of parts, and the end (B + 1,)."""
    return np.concatenate([[0], np.cumsum(sizes)])


VOXEL = 0.03  # Edge of a voxel [m]
TRUNCATION = 4.0  # Distances beyond this are cut [voxels], but not below `LEAST_TRUNCATION`
LEAST_TRUNCATION = 0.06  # About what depth cameras err by at 3 m, three times [m]
REACH = 7.5  # Greatest depth that is used [m]
FINEST, COARSEST = 0.002, 1.0  # Voxels' edges [m]
COARSER = 1.5  # By how much voxels grow where memory ends
READINGS = 256  # Readings of a frame that are compared with the fused surface
MOST_READINGS = 1_000_000


def fuse(
    frames: Sequence[Frame],
    poses: ArrayLike | None = None,
    *,
    voxel: float = VOXEL,
    truncation: float | None = None,
    reach: float = REACH,
    options: FuseOptions | None = None,
    watch: Callable[[View], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
    left_out: Counter[str] | None = None,
) -> FusedSurface:
    """Fuse depth and colour of frames into one mesh.

    Raises `InputError`: an image is broken, no frame has depth and a pose, or they show no surface;
    `OptionError`: an option is out of range, or memory ends and voxels may not become coarser.

    `frames`, `poses`: frames with depth, and (T, 4, 4) map_from_camera [m]; the frames' odometry if
        not given. Frames without depth, or whose pose is broken (not finite, not rigid, a slip off
        both neighbours), are passed over, and counted.
    `voxel`, `reach`: edge of a voxel and greatest depth that is used [m].
    `truncation`: distances from the surface beyond this are cut [m]; thinner things come out
        thicker or not at all. Four voxels if not given.
    `options`: what else can be set.
    `watch`: is given every view that is read, in order, and again where voxels become coarser.
    `progress`, `left_out`: are told how many frames are done, of how many; and what was passed
        over, by reason.
    """
    options = options or FuseOptions()
    counts: Counter[str] = Counter() if left_out is None else left_out
    if not FINEST <= voxel <= COARSEST:
        raise OptionError(f"voxel is {voxel}; it must be {FINEST} to {COARSEST} m.")
    if truncation is not None and not 1.5 * voxel <= truncation <= 10 * COARSEST:
        raise OptionError(
            f"truncation is {truncation}; it must be at least 1.5 voxels ({1.5 * voxel})."
        )
    if not 0 < reach < np.inf:
        raise OptionError(f"reach is {reach}; it must be greater than 0.")
    given = [frame.odometry for frame in frames] if poses is None else poses
    matrices = np.asarray(given, np.float64).reshape(-1, 4, 4)
    edge, why, start = voxel, "", perf_counter()
    while True:
        band = max(TRUNCATION * edge, LEAST_TRUNCATION) if truncation is None else truncation
        run = _Run(Volume(edge, max(band, 1.5 * edge), 1e9 * options.memory), options, len(frames))
        passed_over: Counter[str] = Counter()
        try:
            run.integrate(frames, matrices, reach, watch, progress, passed_over)
            break
        except FullError as error:
            need = (
                f"The memory limit of {options.memory:g} GB was reached at frame "
                f"{run.done + 1} of {len(frames)} with voxels of {100 * edge:.3g} cm"
            )
            if not options.coarsen or COARSER * edge > COARSEST:
                raise OptionError(
                    f"voxel: {need}; try voxel={COARSER * edge:.3g}, a shorter reach, or fewer frames."
                ) from error
            edge, why = COARSER * edge, why or need
    counts.update(passed_over)
    return run.finish(start, why and f"{why}; the voxel size is now {100 * edge:.3g} cm.", counts)


class _Run:
    """One pass over the frames."""

    def __init__(self, volume: Volume, options: FuseOptions, total: int) -> None:
        self.volume, self.options = volume, options
        self.done = 0
        self.gains = np.full(total, np.nan)
        self.readings: list[NDArray[np.float64]] = []
        self.seen_by: list[int] = []
        self.each = max(1, min(READINGS, MOST_READINGS // max(total, 1)))

    def integrate(
        self,
        frames: Sequence[Frame],
        poses: Floats,
        reach: float,
        watch: Callable[[View], None] | None,
        progress: Callable[[int, int], None] | None,
        passed_over: Counter[str],
    ) -> None:
        """Take in all frames."""
        enough = reach / self.volume.blocks.voxel  # pixels as wide as voxels where depth ends
        for view in read_views(frames, poses, find_good_poses(poses), enough, passed_over):
            if view is not None and watch is not None:
                watch(view)
            if view is not None and view.depth.size:
                facets = compute_facets(view.depth, view.pinholes[0], reach, self.options.edges)
                self.gains[view.row] = self.volume.integrate(view, facets, gains=self.options.gains)
                self.readings.append(self._choose_readings(view, facets))
                self.seen_by.append(view.row)
            self.done += 1
            if progress is not None:
                progress(self.done, len(frames))

    def _choose_readings(self, view: View, facets: NDArray[np.float32]) -> Floats:
        """Choose some of a view's used readings, spread over it (N, 3) [m, map]."""
        used = np.flatnonzero(facets[..., 4] > 0.0)
        last, count = max(len(used) - 1, 0), min(self.each, len(used))
        chosen = np.unique(np.linspace(0, last, count).astype(np.int64))
        v, u = np.divmod(used[chosen], facets.shape[1])
        fx, fy, cx, cy = view.pinholes[0]
        z = facets[v, u, 4].astype(np.float64)
        points: Floats = np.stack([(u + 0.5 - cx) / fx * z, (v + 0.5 - cy) / fy * z, z], axis=1)
        moved: Floats = points @ view.map_from_camera[:3, :3].T + view.map_from_camera[:3, 3]
        return moved

    def finish(self, start: float, why: str, counts: Counter[str]) -> FusedSurface:
        """Extract the mesh, and compare it with the readings."""
        volume, options = self.volume, self.options
        if not any(len(points) for points in self.readings):
            reasons = ", ".join(f"{n} {what}" for what, n in counts.items()) or "no frame"
            raise InputError(
                f"The capture has no depth to fuse ({reasons}); a map needs depth images."
            )
        vertices, triangles, colours = extract_surface(
            volume, least=options.least, speck=options.speck, left_out=counts
        )
        if not len(triangles):
            raise InputError("The frames show no surface; a map needs depth images that overlap.")
        residuals = np.full(len(self.gains), np.nan)
        gaps = [volume.measure_gaps(points) for points in self.readings]
        for row, gap in zip(self.seen_by, gaps, strict=True):
            residuals[row] = np.median(gap) if len(gap) else np.nan
        every = np.concatenate(gaps)
        gains = self.gains
        middle = float(np.exp(np.nanmean(np.log(gains))))  # the model took the first image's
        shades = np.minimum(colours / middle + 0.5, 255).astype(np.uint8)
        stats = FuseStats(
            seconds=perf_counter() - start,
            frames=len(self.seen_by),
            voxel=volume.blocks.voxel,
            voxels=volume.count * SIZE,
            memory=volume.bytes,
            agreement=float(np.median(every)),
            apart=float((every > 0.5 * volume.blocks.truncation).mean()),
            residuals=residuals,
            gains=gains / middle,
            coarser=why,
        )
        return FusedSurface(vertices, triangles, shades, stats)


@dataclass(frozen=True, slots=True)
class FuseOptions:
    """Options of fusion; defaults are what measured best (`docs/benchmarks/indoor.md#scene-maps`)."""

    least: float = option(
        0.0003,
        "Least weight of a surface. One view weighs cos(angle of incidence) / depth^4, since the noise "
        "of depth grows with its square; one frontal view from 7.6 m is enough.",
        unit="1/m^4",
    )
    speck: float = option(
        0.02, "Minimum surface of a connected part; smaller ones are dropped.", unit="m^2"
    )
    edges: bool = option(True, "Drop readings at depth edges, where cameras often mix both sides.")
    gains: bool = option(
        True,
        "Adjust the brightness of every image to the model so far, which removes exposure changes.",
    )
    memory: float = option(
        1.5,
        "Maximum memory of the volume; meshing may need the same amount again.",
        unit="GB",
        above=0,
        maximum=2,
    )
    coarsen: bool = option(
        True, "Restart with coarser voxels when memory is exceeded; otherwise raise `OptionError`."
    )

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True, eq=False)
class FuseStats:
    """Statistics of a fusion, and how well the frames agree."""

    seconds: float
    frames: int
    """That were used."""
    voxel: float
    """Edge [m]; larger than asked for where `coarser` says so."""
    voxels: int
    """In blocks that hold anything."""
    memory: int
    """Memory of the volume [bytes]."""
    agreement: float
    """Median distance of the used readings from the fused surface [m]. Poses that drift show here:
    it should not be much above the depth's own noise."""
    apart: float
    """Share of the readings that are farther from it than half the truncation."""
    residuals: NDArray[np.float64]
    """(T,) the same median by frame [m], NaN where it was not used: bad poses stand out."""
    gains: NDArray[np.float64]
    """(T,) what each image was multiplied by, NaN where it was not used."""
    coarser: str = ""
    """Why the voxels are coarser than asked for, or empty."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedSurface:
    """Coloured surface; triangles face free space and share their vertices."""

    vertices: NDArray[np.float64]
    """(V, 3) [m, map]"""
    triangles: NDArray[np.int64]
    """(T, 3) rows of vertices, counter-clockwise seen from free space."""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB"""
    stats: FuseStats
