"""Observations: frames as views at sample points, patches of encoders, and the unit of depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats, level_from_camera
from placegraph.errors import InputError, OptionError
from placegraph.indoor.options import Likelihood, PoseSearchOptions
from placegraph.io.capture.frame import Frame, LazyImages

TEMPERATURE = 0.05
"""Cosine that counts one nat, of encoders whose vectors agree or do not."""


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Cosines of the patches of one image with the N objects of a map.

    Several patches may share a row of the table (two patches that both say "chair"); a learned
    encoder gives every patch a row of its own.
    """

    camera: Camera
    """Camera whose image the grid divides."""
    grid: tuple[int, int]
    """Rows and columns of patches; a property of the encoder."""
    rows: NDArray[np.int32]
    """(rows * columns,) int32, row of `table` of each patch, row by row; -1: says nothing."""
    table: NDArray[np.float32]
    """(L, N) float32, cosine similarity in [-1, 1] of each row with each object."""
    temperature: float = TEMPERATURE
    """Cosine that counts one nat."""
    named: bool = True
    """Whether patches say what a thing is, not what it looks like: looks alone make no pose `OK`."""


@runtime_checkable
class MapEncoder(Protocol):
    """Anything that encodes frames for one map."""

    def encode(self, frame: Frame) -> Patches | None:
        """Return patches of a frame; None where it has nothing to encode."""


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Background model: distribution of what a camera sees anywhere in a map.

    Every likelihood is a ratio against the background: a floor at the depth where all floors are seen is
    no evidence, and neither is a ray that leaves the map.
    """

    objects: Floats
    """(N,) share of each object among all rays of the visibility table that hit."""
    ranges: Floats
    """(bands of elevation, bins) share of each range among the rays of a band that hit."""
    distances: Floats
    """(bins,) range of each bin [m]."""
    highest: float
    """Elevation at which the bands end, above and below the horizon [rad]."""


class View(NamedTuple):
    """One frame sampled at one stride: R = 16 * tiles samples and their evidence.

    Samples form tiles of 4 x 4; a sample outside the image has patch -1.
    """

    directions: NDArray[np.float32]
    """(R, 3) rays in the level frame, of length 1 along the optical axis: distances are depths."""
    patch: NDArray[np.int32]
    """(R,) patch of each sample."""
    semantic: NDArray[np.float32]
    """(P + 1, N + 1) likelihood ratio of each patch if it sees object n, against anywhere; column N:
    the map ends there. Under ``gaussian``: cosine + 1 if n is its most similar object, else 0."""
    weight: NDArray[np.float32]
    """(P + 1,) weight of each patch; 0: no evidence. The last patch is for samples in none."""
    depth: NDArray[np.float32]
    """(R,) along the optical axis [m]; 0: no reading."""
    background_depth: NDArray[np.float32]
    """(R,) log-likelihood of the reading under the background model."""
    colour: NDArray[np.float32]
    """(R, 3) `surface.opponent` of the image, averaged over what each sample stands for."""
    footprint: float
    """Angle between neighbouring samples [rad]."""
    terms: NDArray[np.bool_]
    """(3,) whether each term is available and asked for: semantic, depth, colour."""


class Noise(NamedTuple):
    """Numbers of a likelihood, as compiled loops read them (`options.Likelihood`)."""

    gaussian: bool
    """Eq. 2's scores in [0, 2] instead of log-likelihoods."""
    depth_floor: float
    """Standard deviation of depth at 0 m [m] ..."""
    depth_slope: float
    """... and what it gains a metre."""
    depth_gain: float
    """Log-likelihood of a perfect reading above one that fits nothing."""
    near_cost: float
    """Log-likelihood lost by a reading nearer than the map: an object in front."""
    far_cost: float
    """... and by one beyond the map's surface: an object is gone."""
    depth_weight: float
    """Number of independent readings in a full depth image."""
    colour_weight: float
    """Number of independent samples in a full image by colour steps ..."""
    tone_weight: float
    """... and by tones, if these count."""
    depth_clip: float
    """Largest depth error [m] (Sec. 3.4), of which errors count as shares; 0: not clipped."""

    @classmethod
    def of(cls, options: Likelihood, *, gaussian: bool) -> Self:
        """Copy the numbers of the options."""
        return cls(gaussian, *(getattr(options, name) for name in cls._fields[1:]))


class Model(Protocol):
    """Likelihood model of frames."""

    noise: Noise
    """Numbers of the model, for compiled loops."""

    def score_patches(
        self, cosines: NDArray[np.float32], temperature: float, object_shares: Floats
    ) -> Floats:
        """Score patches for each of N objects or, last column, for none: (M, N + 1).

        `cosines`: (M, N) of each kind of patch with each object; `temperature`: of their softmax;
        `object_shares`: (N,) how much of a map each object fills.
        """

    def shares(self, counts: Floats) -> Floats:
        """Return the weight (N,) of a patch of each object, by its number of patches (N,)."""

    def background_depth(
        self, depth: NDArray[np.float32], directions: Floats, background: Background
    ) -> NDArray[np.float32]:
        """Score readings (R,) [m] along directions (R, 3) under the background model."""

    def combine_terms(self, scores: NDArray[np.float32], terms: NDArray[np.bool_]) -> Floats:
        """Combine scores (N, 4) of `score_poses` to log-likelihoods (N,); `terms` (3,) are asked for."""

    def compute_temperature(self, views: Sequence[View]) -> float:
        """Return the temperature of modes by which the summed log-likelihood of views is divided."""


COARSE = 40.0
"""Stride of views for the visibility table and the coarse fit [px]."""
FINE = 20.0
"""Stride of views for the fine fit and the status decision [px]."""

REFERENCE = 640.0
"""Width of the image that strides are meant for [px]."""

_TILE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observation of one frame: its images, read and encoded once, from which views are cut."""

    frame: Frame
    level: Floats
    """(3, 3) level_from_camera"""
    patches: Patches | None
    depth: NDArray[np.float32] | None
    """(h, w) [m], NaN: no reading."""
    rgb: NDArray[np.uint8] | None
    """(H, W, 3)"""


def observe_frame(
    frame: Frame, encoder: MapEncoder | None, options: PoseSearchOptions
) -> Observation:
    """Read and encode the senses of a frame that the options ask for; `InputError`: a broken image."""
    depth = frame.depth() if options.depth else None
    if depth is not None and not np.isfinite(depth).any():
        depth = None
    return Observation(
        frame=frame,
        level=level_from_camera(frame.gravity),
        patches=encoder.encode(frame) if encoder is not None and options.semantic else None,
        depth=depth,
        rgb=frame.rgb() if options.colour and frame.has_colour else None,
    )


ViewCache = dict[tuple[Observation, float], View]
"""Views of frames by their stride [px], before patches are weighted."""


def views(
    observations: Sequence[Observation],
    stride: float,
    model: Model,
    background: Background,
    cut: ViewCache | None = None,
    *,
    scaled: bool = True,
) -> list[View]:
    """Make the views of frames of one window, `stride` pixels of the colour image between samples.

    An object seen in many patches of the window is weighted down (`Likelihood.object_patches`). `cut`:
    cache of views, which other windows of the same map may share. `scaled`: strides are for images up
    to `REFERENCE` wide; larger images have larger pixels, not more samples.
    """
    cut = {} if cut is None else cut
    found = []
    weights = _patch_weights([s.patches for s in observations], model)
    for observation, weight in zip(observations, weights, strict=True):
        camera, pixels = observation.frame.camera, float(stride)
        if scaled:
            pixels *= max(1.0, max(camera.width, camera.height) / REFERENCE)
        if (observation, pixels) not in cut:
            cut[observation, pixels] = _view(observation, pixels, model, background)
        found.append(cut[observation, pixels]._replace(weight=weight))
    return found


def _view(observation: Observation, stride: float, model: Model, background: Background) -> View:
    frame, patches = observation.frame, observation.patches
    samples = _samples(frame.camera, stride)
    inside = samples.inside
    patch = np.where(inside, 0, -1).astype(np.int32)
    semantic = np.ones((1, len(background.objects) + 1), np.float32)
    if patches is not None:
        cell = samples.cells(patches.camera, *patches.grid)
        patch = np.where(inside, np.where(cell >= 0, cell, len(patches.rows)), -1)
        semantic = _semantic(patches, model, background)
    directions = samples.directions @ observation.level.T
    depth = np.zeros(len(inside), np.float32)
    if observation.depth is not None:
        h, w = observation.depth.shape
        cell = samples.cells(frame.depth_camera or frame.camera, h, w)
        readings = np.where(inside & (cell >= 0), observation.depth.ravel()[cell], 0.0)
        depth = np.nan_to_num(readings).astype(np.float32)
    colour = np.zeros((len(inside), 3), np.float32)
    if observation.rgb is not None:
        colour = _opponents(observation.rgb, samples)
    return View(
        directions=directions.astype(np.float32),
        patch=patch.astype(np.int32),
        semantic=semantic,
        weight=np.zeros(len(semantic), np.float32),
        depth=depth,
        background_depth=model.background_depth(depth, directions, background),
        colour=colour,
        footprint=samples.footprint,
        terms=np.array(
            [patches is not None, observation.depth is not None, observation.rgb is not None]
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Sample points of a camera at one stride, in tiles of 4 x 4."""

    uv: Floats
    """(R, 2) [px]"""
    inside: NDArray[np.bool_]
    """(R,) false for samples that only fill up tiles."""
    row: NDArray[np.int64]
    """(R,) row of the sample's cell."""
    column: NDArray[np.int64]
    shape: tuple[int, int]
    """Rows and columns of cells."""
    directions: Floats
    """(R, 3) in the camera, z = 1."""
    footprint: float
    """Angle between neighbours [rad]."""
    camera: Camera
    stride: float

    def cells(self, camera: Camera, rows: int, columns: int) -> NDArray[np.int64]:
        """Return the cells (R,) of a rows x columns grid over another camera's image, -1 outside."""
        return _cells(self.camera, self.stride, camera, rows, columns)


@lru_cache(maxsize=16)
def _samples(camera: Camera, stride: float) -> _Samples:
    """Return samples at the centres of cells about `stride` pixels wide that fill the whole image."""
    columns = max(_TILE, round(camera.width / stride))
    rows = max(_TILE, round(camera.height / stride))
    across, down = -(-columns // _TILE), -(-rows // _TILE)

    def tiles(a: NDArray[np.int64]) -> NDArray[np.int64]:
        return a.reshape(down, _TILE, across, _TILE).swapaxes(1, 2).ravel()

    y, x = np.mgrid[: down * _TILE, : across * _TILE]
    x, y = tiles(x), tiles(y)
    inside = (x < columns) & (y < rows)
    x, y = np.minimum(x, columns - 1), np.minimum(y, rows - 1)
    uv = np.stack([(x + 0.5) * camera.width / columns, (y + 0.5) * camera.height / rows], axis=1)
    directions = camera.directions(uv)
    # where the distortion cannot be undone, there is no ray to compare
    known = np.abs(camera.project(directions) - uv).max(axis=1) < 1.0
    directions[~known] = (0.0, 0.0, 1.0)
    inside &= known
    return _Samples(
        uv=uv,
        inside=inside,
        row=y,
        column=x,
        shape=(rows, columns),
        directions=directions,
        footprint=camera.width / columns / camera.fx,
        camera=camera,
        stride=stride,
    )


@lru_cache(maxsize=64)
def _cells(
    own: Camera, stride: float, camera: Camera, rows: int, columns: int
) -> NDArray[np.int64]:
    uv = camera.project(_samples(own, stride).directions)
    with np.errstate(invalid="ignore"):
        x = np.floor(uv[:, 0] * columns / camera.width)
        y = np.floor(uv[:, 1] * rows / camera.height)
        there = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    cell = np.where(there, y, 0).astype(np.int64) * columns + np.where(there, x, 0).astype(np.int64)
    return np.where(there, cell, -1)


def _opponents(rgb: NDArray[np.uint8], samples: _Samples) -> NDArray[np.float32]:
    """Return opponent colours (R, 3) of the image, averaged over the cell of each sample."""
    from PIL import Image

    rows, columns = samples.shape
    small = Image.fromarray(rgb).resize((columns, rows), Image.Resampling.BOX)
    colour = np.asarray(small, np.float32)[samples.row, samples.column] / 255.0
    red, green, blue = colour.T
    total = colour.sum(axis=1)
    shade = 1.0 / (total + 0.06)
    out = np.stack([total, (red - blue) * shade, (2.0 * green - red - blue) * shade], axis=1)
    return out.astype(np.float32)


def _semantic(patches: Patches, model: Model, background: Background) -> NDArray[np.float32]:
    """Score each patch for each object and, last column, for none: (P + 1, N + 1).

    The last row is for samples that lie in no patch.
    """
    # only the rows in use: the table of a merged map has thousands
    words, row = np.unique(patches.rows, return_inverse=True)
    table = model.score_patches(patches.table[words], patches.temperature, background.objects)
    table = np.concatenate([table[row.ravel()], np.ones((1, table.shape[1]))])
    return np.ascontiguousarray(table, np.float32)


def _patch_weights(sequence: Sequence[Patches | None], model: Model) -> list[NDArray[np.float32]]:
    """Return the weight (P + 1,) of each patch of each frame; zero: no evidence."""
    rows = [
        np.zeros(1, np.int64) - 1
        if p is None
        else np.where(p.rows >= 0, p.table.argmax(axis=1)[p.rows], -1)
        for p in sequence
    ]
    seen = np.concatenate(rows) if rows else np.zeros(0, np.int64)
    share = model.shares(np.bincount(seen[seen >= 0], minlength=1).astype(np.float64))
    return [np.append(np.where(r >= 0, share[r], 0.0), 0.0).astype(np.float32) for r in rows]


def spread(count: int, most: int) -> NDArray[np.int64]:
    """Select at most `most` of `count` rows, evenly spread, with the last."""
    first = 0 if most > 1 else count - 1
    return np.unique(np.linspace(first, count - 1, min(most, count)).round().astype(np.int64))


def recent(count: int, most: int) -> NDArray[np.int64]:
    """Select at most `most` of `count` rows, the newer the denser, with the first and the last.

    New frames lie near the frame in question however odometry drifts; old frames see other parts of the
    map, and tell places apart.
    """
    kept = np.arange(min(most, count))
    back = (count - 1) * (kept / max(1, len(kept) - 1)) ** 2
    return np.asarray(count - 1 - np.maximum(kept, np.rint(back).astype(np.int64))[::-1])


FACTORS = (1000.0, 100.0, 39.37, 10.0, 5.0, 3.281)
"""Factors between units that are mistaken: mm, cm, inches, 0.1 mm for mm, TUM's 1/5000 m for mm, feet."""
LONGEST = 30.0
"""No depth camera for rooms measures a median longer than this [m]; the map may say more ..."""
DIAGONALS = 3.0
"""... as many of its own diagonals."""
SHORTEST = 0.05
"""And none a shorter one than this [m]."""
TELLING = 0.75
"""Log-likelihood of a reading that a factor must gain, on average [nat]: true metres of every window
of the shared house, office and flats gain less, in the map of another place too (0.42 at most)."""
_FEWEST = 100  # readings that say anything
_A_FRAME = 1000  # readings of a frame that are looked at
_SMOOTH = 4.0  # standard deviation in bins of the table: cameras are held higher or lower
_FLOOR = 0.01  # density, in units of an even one, of readings that the map never shows
_USUAL = 2.0  # median of the depth in a room [m]


def check_unit(diagonal: float, observations: Sequence[Observation]) -> None:
    """Refuse depth that cannot be in metres; `diagonal` is the map's [m].

    Raises `InputError`: the median of all frames is absurd; the message names `camera.json` and
    what would fit; `OptionError`: the same for frames in memory.
    """
    found = [_some(s.depth) for s in observations if s.depth is not None]
    readings = np.concatenate([np.zeros(0, np.float32), *found])
    if len(readings) < _FEWEST:
        return
    middle = float(np.median(readings))
    if SHORTEST <= middle <= max(LONGEST, DIAGONALS * diagonal):
        return
    factor = _nearest(middle / _USUAL)
    frame = next(s.frame for s in observations if s.depth is not None)
    error = InputError if isinstance(frame.images, LazyImages) else OptionError
    raise error(f"The median of the depth is {middle:.3g} m. {describe_unit_error(frame, factor)}")


def _some(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return some readings of an image (h, w), evenly spread."""
    step = max(1, int((depth.size / _A_FRAME) ** 0.5))
    some = depth[step // 2 :: step, step // 2 :: step]
    return some[np.isfinite(some)]


def _nearest(ratio: float) -> float:
    """Return the known factor, or inverse factor, nearest to a ratio."""
    known = np.concatenate([FACTORS, 1.0 / np.array(FACTORS)])
    return float(known[np.abs(np.log(known / ratio)).argmin()])


def suspect_unit_factor(views: Sequence[View], background: Background) -> float | None:
    """Return the factor by which depth looks too long (over 1) or too short; None: depth is in metres.

    Divide the readings by each of `FACTORS` or its inverse, and compare their likelihood, by the ranges
    that the map shows at their elevation, with that of the readings as they are. A factor must gain
    `TELLING` a reading [nat].
    """
    aims = np.concatenate([v.directions[v.depth > 0] for v in views]).astype(np.float64)
    depth = np.concatenate([v.depth[v.depth > 0] for v in views]).astype(np.float64)
    reach = np.linalg.norm(aims, axis=1)
    elevation = np.arcsin(aims[:, 2] / reach)
    is_inside = np.abs(elevation) < background.highest
    if np.count_nonzero(is_inside) < _FEWEST:
        return None
    density = _density(background)
    bands, bins = density.shape
    band = ((elevation[is_inside] / background.highest + 1.0) / 2.0 * bands).astype(int)
    low, high = np.log(background.distances[[0, bins - 1]])
    place = (np.log((depth * reach)[is_inside]) - low) / (high - low) * (bins - 1)
    known = np.concatenate([[1.0], FACTORS, 1.0 / np.array(FACTORS)])
    shifts = np.log(known) / (high - low) * (bins - 1)
    at = np.rint(place - shifts[:, None]).astype(int)
    shown = np.where((at >= 0) & (at < bins), density[band, np.clip(at, 0, bins - 1)], 0.0)
    likelihood = np.log(shown + _FLOOR).mean(axis=1)
    best = int(likelihood.argmax())
    # readings that fit nowhere in this map with any factor are no evidence of a unit
    if likelihood[best] < 0.0 or likelihood[best] - likelihood[0] < TELLING:
        return None
    return float(known[best])


def _density(background: Background) -> Floats:
    """Return the densities of ranges (bands, bins), smoothed, in units of an even distribution."""
    ranges = background.ranges[:, :-1]  # the last bin: the map ends
    reach = np.arange(-12, 13)
    kernel = np.exp(-0.5 * (reach / _SMOOTH) ** 2)
    kernel /= kernel.sum()
    smooth = np.stack([np.convolve(row, kernel, "same") for row in ranges])
    return np.asarray(smooth * ranges.shape[1])


def describe_unit_error(frame: Frame, factor: float) -> str:
    """Return a sentence about depth that is `factor` times too long, with the file and the right unit."""
    times, direction = (factor, "long") if factor > 1 else (1.0 / factor, "short")
    finding = (
        f"The depth readings appear about {times:.{(0 if times > 9 else 1)}f} times too {direction}"
    )
    if not isinstance(frame.images, LazyImages):
        return f"{finding}; give depth in metres."
    unit = frame.images.unit
    if unit is None:
        return f"{finding} for metres; check the unit of the depth images."
    return (
        f"{finding}: check {unit.source}, which is {unit.per_metre:g} units per metre; "
        f"{unit.per_metre * factor:.4g} would fit."
    )
