"""RGB-D frames with poses become a coloured mesh."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.fuse.depth_kernels import facets_of
from placegraph.indoor.mapping.fuse.surface import surface_of
from placegraph.indoor.mapping.fuse.views import Shot, checked_poses, good_poses, views_of
from placegraph.indoor.mapping.fuse.volume import FullError, Volume
from placegraph.indoor.mapping.fuse.volume_kernels import SIZE
from placegraph.indoor.options import check_numbers, check_positive
from placegraph.io.capture.frame import Frame

VOXEL = 0.03
"""Edge of a voxel [m]."""
TRUNCATION = 4.0
"""Distances beyond this are cut [voxels], but not below `LEAST_TRUNCATION`."""
LEAST_TRUNCATION = 0.06
"""About what depth cameras err by at 3 m, three times [m]."""
REACH = 7.5
"""Greatest depth that is used [m]."""
FINEST, COARSEST = 0.002, 1.0
"""Voxels' edges [m]."""
COARSER = 1.5
"""By how much voxels grow where memory ends."""
WITNESSES = 256
"""Readings of a frame that are compared with the fused surface."""
MOST_WITNESSES = 1_000_000


def fuse(
    frames: Sequence[Frame],
    poses: ArrayLike | None = None,
    *,
    voxel: float = VOXEL,
    truncation: float | None = None,
    reach: float = REACH,
    options: FuseOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    left_out: Counter[str] | None = None,
) -> Fused:
    """Fuse depth and colour of frames into one mesh.

    Parameters
    ----------
    frames, poses
        Frames with depth, and (T, 4, 4) map_from_camera [m]; the frames' odometry if not given.
        Frames without depth, or whose pose is broken (not finite, not rigid, a slip off both
        neighbours), are passed over, and counted.
    voxel, reach
        Edge of a voxel and greatest depth that is used [m].
    truncation
        Distances from the surface beyond this are cut [m]; thinner things come out thicker or not
        at all. Four voxels if not given.
    options
        What else can be set.
    progress, left_out
        Are told how many frames are done, of how many; and what was passed over, by reason.

    Raises
    ------
    InputError
        An image is broken, no frame has depth and a pose, or they show no surface.
    OptionError
        An option is out of range, or memory ends and voxels may not become coarser.

    """
    options = options or FuseOptions()
    counts: Counter[str] = Counter() if left_out is None else left_out
    _check(voxel, truncation, reach)
    matrices = checked_poses(frames, poses)
    edge, why, start = voxel, "", perf_counter()
    while True:
        band = max(TRUNCATION * edge, LEAST_TRUNCATION) if truncation is None else truncation
        run = _Run(Volume(edge, max(band, 1.5 * edge), 1e9 * options.memory), options, len(frames))
        passed_over: Counter[str] = Counter()
        try:
            run.take(frames, matrices, reach, progress, passed_over)
            break
        except FullError as error:
            need = run.told_end(len(frames))
            if not options.coarsen or COARSER * edge > COARSEST:
                raise OptionError(
                    f"voxel: {need}; try voxel={COARSER * edge:.3g}, a shorter reach, or fewer frames."
                ) from error
            edge, why = COARSER * edge, why or need
    counts.update(passed_over)
    return run.finish(start, why and f"{why}; they are {100 * edge:.3g} cm now.", counts)


def _check(voxel: float, truncation: float | None, reach: float) -> None:
    if not FINEST <= voxel <= COARSEST:
        raise OptionError(f"voxel is {voxel}; its edge is {FINEST} to {COARSEST} m.")
    if truncation is not None and not 1.5 * voxel <= truncation <= 10 * COARSEST:
        raise OptionError(f"truncation is {truncation}; it is at least 1.5 voxels ({1.5 * voxel}).")
    if not 0 < reach < np.inf:
        raise OptionError(f"reach is {reach}; it must be greater than 0 m.")


class _Run:
    """One pass over the frames."""

    def __init__(self, volume: Volume, options: FuseOptions, total: int) -> None:
        self.volume, self.options = volume, options
        self.done = 0
        self.gains = np.full(total, np.nan)
        self.witnesses: list[NDArray[np.float64]] = []
        self.seen_by: list[int] = []
        self.each = max(1, min(WITNESSES, MOST_WITNESSES // max(total, 1)))

    def take(
        self,
        frames: Sequence[Frame],
        poses: Floats,
        reach: float,
        progress: Callable[[int, int], None] | None,
        passed_over: Counter[str],
    ) -> None:
        """Take in all frames."""
        for view in views_of(frames, poses, good_poses(poses), passed_over):
            if view is not None:
                facets = facets_of(view.depth, view.eyes[0], reach, self.options.edges)
                self.gains[view.row] = self.volume.take(view, facets, gains=self.options.gains)
                self.witnesses.append(self.some_points(view, facets))
                self.seen_by.append(view.row)
            self.done += 1
            if progress is not None:
                progress(self.done, len(frames))

    def told_end(self, total: int) -> str:
        """Where memory ended."""
        return (
            f"{self.options.memory:g} GB of memory ended at frame {self.done + 1} of {total} with "
            f"voxels of {100 * self.volume.voxel:.3g} cm"
        )

    def some_points(self, view: Shot, facets: NDArray[np.float32]) -> Floats:
        """Some of a view's readings that were used, spread over it, (N, 3) [m, map]."""
        v, u = np.nonzero(facets[..., 4])
        chosen = np.unique(
            np.linspace(0, max(len(v) - 1, 0), min(self.each, len(v))).astype(np.int64)
        )
        v, u = v[chosen], u[chosen]
        fx, fy, cx, cy = view.eyes[0]
        z = facets[v, u, 4].astype(np.float64)
        points: Floats = np.stack([(u + 0.5 - cx) / fx * z, (v + 0.5 - cy) / fy * z, z], axis=1)
        moved: Floats = points @ view.map_from_camera[:3, :3].T + view.map_from_camera[:3, 3]
        return moved

    def finish(self, start: float, why: str, counts: Counter[str]) -> Fused:
        """The mesh, and what there is to say."""
        volume, options = self.volume, self.options
        if not any(len(points) for points in self.witnesses):
            reasons = ", ".join(f"{n} {what}" for what, n in counts.items()) or "no frame"
            raise InputError(f"There is no depth to fuse ({reasons}); a map needs depth images.")
        vertices, triangles, colours = surface_of(
            volume, least=options.least, speck=options.speck, left_out=counts
        )
        if not len(triangles):
            raise InputError("The frames show no surface; a map needs depth images that overlap.")
        residuals = np.full(len(self.gains), np.nan)
        gaps = [volume.gaps(points) for points in self.witnesses]
        for row, gap in zip(self.seen_by, gaps, strict=True):
            residuals[row] = np.median(gap) if len(gap) else np.nan
        every = np.concatenate(gaps)
        gains = self.gains
        middle = float(np.exp(np.nanmean(np.log(gains))))  # the model took the first image's
        shades = np.minimum(colours / middle + 0.5, 255).astype(np.uint8)
        stats = FuseStats(
            seconds=perf_counter() - start,
            frames=len(self.seen_by),
            voxel=volume.voxel,
            voxels=volume.count * SIZE,
            memory=volume.bytes,
            agreement=float(np.median(every)),
            apart=float((every > 0.5 * volume.truncation).mean()),
            residuals=residuals,
            gains=gains / middle,
            coarser=why,
        )
        return Fused(vertices, triangles, shades, stats)


@dataclass(frozen=True, slots=True)
class FuseOptions:
    """How frames are fused; defaults are what measured best (`docs/benchmarks/maps.md`)."""

    least: float = 0.0003
    """Weight that a surface needs [1 / m^4]: one view weighs cos(angle of incidence) / depth^4, since
    the noise of depth grows with its square. One frontal view from 7.6 m is enough."""
    speck: float = 0.02
    """Connected parts of less surface than this are dropped [m^2]."""
    edges: bool = True
    """Drop readings at depth edges, where cameras often read a mean of both sides."""
    gains: bool = True
    """Bring every image to the brightness of the model fused so far: exposure changes vanish."""
    memory: float = 1.5
    """What the volume may take [GB]; making the mesh of it takes up to as much again."""
    coarsen: bool = True
    """Beyond that begin again with coarser voxels, and say so; else raise `OptionError`."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_positive(self, "memory")
        if self.memory > 2.0:
            raise OptionError(f"memory is {self.memory} GB; a volume takes 2 GB at most.")


@dataclass(frozen=True, slots=True, eq=False)
class FuseStats:
    """What fusion did, and how well the frames agree."""

    seconds: float
    frames: int
    """That were used."""
    voxel: float
    """Edge [m]; larger than asked for where `coarser` says so."""
    voxels: int
    """In blocks that hold anything."""
    memory: int
    """Of the volume [bytes]."""
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
class Fused:
    """Coloured surface; triangles face free space and share their vertices."""

    vertices: NDArray[np.float64]
    """(V, 3) [m, map]"""
    triangles: NDArray[np.int64]
    """(T, 3) rows of vertices, counter-clockwise seen from free space."""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB"""
    stats: FuseStats
