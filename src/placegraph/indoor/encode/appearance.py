"""The encoder that needs no weights: colour and texture of a patch against those of the surfaces.

Every small cell of an image is described by five numbers: lightness, two chromaticities, each
against the image's own level, and contrast at two scales. Cosines and sines of random projections of
them (random Fourier features, Rahimi and Recht, NIPS 2007) make the dot product of two cells a
Gaussian kernel; their mean over a patch, or over all cells that show an object, is a vector of
the distribution (a kernel mean embedding). Objects are looked at as visitors would see them: the
map is rendered from inside, and what is rendered is described as any other image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.encode.labels import GRID
from placegraph.indoor.likelihood.visibility import VisibilityTable
from placegraph.indoor.map.free_space import MAX_ELEVATION
from placegraph.indoor.map.map_kernels import AZIMUTHS, ELEVATIONS, NOTHING, STEP
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import STANDING, PoseSearchOptions
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

DIMENSION = 64
TEMPERATURE = 0.12
"""Calibrated on the shared house and on drawn homes (table `patch_accuracy` of the lab)."""
_CAMERA = Camera(256, 144, 184.0, 184.0, 128.0, 72.0)
"""Size that all images are brought to, and what the map is rendered with: 70 degrees wide."""
_CELL = 2  # [px]
_BLOCK = 4  # [cells], over which the coarser contrast is taken
_DARK = 40.0  # added to colours before their logarithm: differences of dark ones are noise
_EVEN = 0.05  # added to contrasts before theirs
_WIDTHS = np.array([0.75, 0.19, 0.04, 1.6, 1.2], np.float32)
"""Tolerances of similar colours: lightness, red - blue, green - both, fine and coarse contrast (logs)."""
_BALANCE = 0.8
"""Share of the cast of the brightest cells, and of the level of lightness, that is taken out."""
_BRIGHT = 0.3  # share of cells that count among the brightest
_ENOUGH = 32  # cells that an object is known by
_SEED = 2
POSITIONS_A_GLANCE = 24  # Free positions of the visibility table, 0.25 m apart, that share a glance
MIN_GLANCES = 32  # Glances at least
_PITCHES = np.deg2rad([-20.0, 0.0, 20.0, -35.0])
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_HALF = 7  # bins of azimuth to either side of a heading that a glance takes in: 70 degrees in all
_MAPPED = 0.9  # headings with this share of the most mapped one's surface will do
_WANTED = 24.0  # bins of a panorama that an object looked at should cover, of the 120 of a glance


def _frequencies() -> NDArray[np.float32]:
    """Return projections (5, DIMENSION / 2): orthogonal in sets, of lengths as of Gaussian vectors."""
    rng = np.random.default_rng(_SEED)
    count, parts = len(_WIDTHS), []
    for _ in range(-(-DIMENSION // 2 // count)):
        turned, _ = np.linalg.qr(rng.standard_normal((count, count)))
        parts.append(turned * np.sqrt(rng.chisquare(count, count))[:, None])
    return np.asarray(np.concatenate(parts)[: DIMENSION // 2].T / _WIDTHS[:, None], np.float32)


_FREQUENCIES = _frequencies()
_USUAL = np.array(
    [
        -0.381,  0.603, -0.507, -0.301, -0.367, -0.138, -0.349, -0.413,  0.443,  0.182, -0.613,
        0.148, -0.392,  0.480, -0.217,  0.273,  0.205,  0.193,  0.176,  0.458, -0.394, -0.025,
        0.455, -0.340, -0.445,  0.275, -0.282,  0.156,  0.360,  0.119, -0.428,  0.024,  0.122,
        0.311, -0.412, -0.048,  0.031, -0.296,  0.249, -0.100, -0.240,  0.182,  0.474, -0.389,
        0.013, -0.158, -0.216, -0.555, -0.226,  0.203, -0.203, -0.145,  0.528, -0.278, -0.115,
        0.135, -0.072, -0.205,  0.104,  0.209,  0.712,  0.419,  0.067,  0.342,
    ],
    np.float32,
)  # fmt: skip
"""Mean vector of the objects of a drawn flat, what all surfaces share: `placegraph-lab appearance`."""


class AppearanceEncoder:
    """Patches and objects by the colours and the texture that can be seen of them."""

    name = "appearance"
    dimension = DIMENSION
    temperature = TEMPERATURE

    @property
    def key(self) -> str:
        """Its name and a digest of its constants."""
        numbers = (_CELL, _BLOCK, _DARK, _EVEN, _BALANCE, _BRIGHT)
        parts = repr(numbers).encode(), _FREQUENCIES.tobytes(), _USUAL.tobytes()
        return f"appearance {hashlib.sha256(b''.join(parts)).hexdigest()[:8]}"

    def patches(self, image: Frame) -> NDArray[np.float32]:
        """Return unit vectors (9, 16, d) of a frame's patches; (16, 9, d) of an upright image.

        All are zero where the image shows one colour only, as behind a lid. Raises `InputError`
        where the image is broken.
        """
        from PIL import Image

        rgb = image.rgb()
        upright = rgb.shape[0] > rgb.shape[1]
        size = (_CAMERA.height, _CAMERA.width) if upright else (_CAMERA.width, _CAMERA.height)
        rows, columns = GRID[::-1] if upright else GRID
        if (rgb == rgb[0, 0]).all():
            return np.zeros((rows, columns, DIMENSION), np.float32)
        small = Image.fromarray(rgb).resize(size, Image.Resampling.BOX)
        features = _project_features(_describe_cells(np.asarray(small)))
        h, w, d = features.shape
        parts = features.reshape(rows, h // rows, columns, w // columns, d)
        return _normalize(parts.mean(axis=(1, 3)) - _USUAL)

    def camera(self, image: Frame) -> Camera:
        """Return camera of the colour image."""
        return image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:  # noqa: ARG002
        """Return unit vectors (N, d) of a map's objects; zero of what cannot be seen, or has no colour."""
        means, cells = surfaces(scene)
        return np.where(cells[:, None] > 0, _normalize(means - _USUAL), np.float32(0.0))


def surfaces(scene: Scene) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return mean features (N, d) of a map's objects, not centred, and how many cells (N,) show them."""
    from placegraph.indoor.likelihood.visibility import visibility
    from placegraph.indoor.render import Renderer

    sums = np.zeros((len(scene), DIMENSION))
    cells = np.zeros(len(scene), np.int64)
    if not scene.has_colours:
        return sums.astype(np.float32), cells
    renderer = Renderer(scene)
    table = visibility(scene, PoseSearchOptions(heights=STANDING, spacing=0.25))

    def add_views(poses: NDArray[np.float64]) -> None:
        for pose in poses:
            drawn = renderer.render(pose, _CAMERA)
            _add_rendering(drawn.colour, drawn.objects, sums, cells)

    add_views(spread_poses(table))
    add_views(aim_poses(table, np.flatnonzero(cells < _ENOUGH)))
    return (sums / np.maximum(cells, 1)[:, None]).astype(np.float32), cells


def _add_rendering(
    colour: NDArray[np.uint8],
    objects: NDArray[np.int32],
    sums: NDArray[np.float64],
    cells: NDArray[np.int64],
) -> None:
    """Add the features of a rendering to the sums (N, d) of the objects that it shows."""
    valid = _average_squares((objects >= 0).astype(np.float32), _CELL) == 1.0
    if not valid.any():
        return
    filled = np.where((objects >= 0)[..., None], colour, colour[objects >= 0].mean(axis=0))
    features = _project_features(_describe_cells(filled, valid))[valid]
    visible, row = np.unique(objects[::_CELL, ::_CELL][valid], return_inverse=True)
    order = np.argsort(row.ravel(), kind="stable")
    counts = np.bincount(row.ravel())
    sums[visible] += np.add.reduceat(features[order], np.cumsum(counts) - counts, axis=0)
    cells[visible] += counts


def _describe_cells(
    rgb: NDArray[np.uint8] | NDArray[np.float64], valid: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Return five numbers (h, w, 5) of each cell of an image; levels are those of the cells known."""
    fine = rgb.astype(np.float32)
    colour = np.log(_average_squares(fine, _CELL) + np.float32(_DARK))
    light = colour.mean(axis=-1)
    red_blue = colour[..., 0] - colour[..., 2]
    green = colour[..., 1] - (colour[..., 0] + colour[..., 2]) / 2
    there = np.ones(light.shape, np.bool_) if valid is None else valid
    bright = there & (light >= np.quantile(light[there], 1.0 - _BRIGHT))
    shade = np.log(fine.mean(axis=-1) + np.float32(8.0))
    return np.stack(
        [
            light - _BALANCE * np.median(light[there]),
            red_blue - _BALANCE * red_blue[bright].mean(),
            green - _BALANCE * green[bright].mean(),
            np.log(_contrast(shade, _CELL) + np.float32(_EVEN)),
            np.kron(
                np.log(_contrast(_average_squares(shade, _CELL), _BLOCK) + np.float32(_EVEN)),
                np.ones((_BLOCK, _BLOCK), np.float32),
            ),
        ],
        axis=-1,
    ).astype(np.float32)


def _project_features(described: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return features (..., d) whose dot products are kernels of descriptions (..., 5)."""
    angles = described @ _FREQUENCIES
    return np.concatenate([np.cos(angles), np.sin(angles)], axis=-1)


def _average_squares(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return means over squares of an image (h, w, ...)."""
    h, w = image.shape[:2]
    parts = image.reshape(h // size, size, w // size, size, *image.shape[2:])
    return np.asarray(parts.mean(axis=(1, 3)), np.float32)


def _contrast(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return standard deviations over squares of an image (h, w)."""
    variance = _average_squares(image**2, size) - _average_squares(image, size) ** 2
    return np.sqrt(np.maximum(variance, 0.0))


def _normalize(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (vectors / np.maximum(lengths, 1e-9)).astype(np.float32)


def spread_poses(table: VisibilityTable) -> Floats:
    """Return poses (G, 4, 4) map_from_camera, evenly spread over the free positions of a map.

    Headings are spread too, as far as there is anything to be seen; pitches take turns.
    """
    if not len(table):
        return np.zeros((0, 4, 4))
    count = min(max(MIN_GLANCES, len(table) // POSITIONS_A_GLANCE), max(len(table), MIN_GLANCES))
    rows = _choose_distant(table.positions, count)
    mapped = (table.panoramas.ranges[rows] != NOTHING).mean(axis=1)
    ahead = sum(np.roll(mapped, shift, axis=1) for shift in range(-_HALF, _HALF + 1))
    poses = []
    for i, row in enumerate(rows.tolist()):
        good = np.flatnonzero(ahead[i] >= _MAPPED * ahead[i].max())
        heading = good[int(i * _GOLDEN % 1.0 * len(good))] * STEP
        poses.append(_make_pose(table.positions[row], heading, _PITCHES[i % len(_PITCHES)]))
    return np.stack(poses)


def aim_poses(table: VisibilityTable, objects: NDArray[np.intp]) -> Floats:
    """Return poses (G, 4, 4), one for each of these objects (rows) that is visible from anywhere."""
    poses = []
    elevations = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * 2.0 - 1.0) * MAX_ELEVATION
    azimuths = np.arange(AZIMUTHS) * STEP
    for row in objects.tolist():
        seen = table.panoramas.objects == row
        bins = seen.sum(axis=(1, 2))
        if not bins.any():
            continue
        with np.errstate(divide="ignore"):
            best = int(np.abs(np.log(bins / _WANTED)).argmin())
        e, a = np.nonzero(seen[best])
        heading = np.arctan2(np.sin(azimuths[a]).mean(), np.cos(azimuths[a]).mean())
        poses.append(_make_pose(table.positions[best], heading, elevations[e].mean()))
    return np.stack(poses) if poses else np.zeros((0, 4, 4))


def _choose_distant(points: Floats, count: int) -> NDArray[np.intp]:
    """Return rows of points, each the farthest from those before it; again from the start if too few."""
    rows = np.zeros(count, np.intp)
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, np.linalg.norm(points - points[rows[i - 1]], axis=1))
        rows[i] = distance.argmax()
        if distance[rows[i]] == 0.0:
            distance[:] = np.inf
    return rows


def _make_pose(position: Floats, heading: float, pitch: float) -> Floats:
    ahead = [np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)]
    right = [np.sin(heading), -np.cos(heading), 0.0]
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = position
    return pose
