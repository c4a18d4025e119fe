"""Correspondences of frames with the map: depth readings, rendered pixels, landmarks (Sec. 3.6).

Landmarks are compared with the features of a frame all at once, so no pose needs to be known. Their
descriptors are RootSIFT turned by gravity, so that a camera may lie on its side, in their lowest
frequencies: a cosine transform over the 4 x 4 cells and a Fourier transform over the 8 directions of each
keep with 32 of 128 numbers most of what tells two descriptors apart, and are the same for every map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import (
    Camera,
    Floats,
    rotation_from_vector,
    rotation_z,
    split_pose,
    vector_from_rotation,
)
from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.likelihood.observe import REFERENCE, spread
from placegraph.indoor.map.scene import DESCRIPTOR_SIZE, Landmarks, Scene
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.pose.window import Window, time_stage
from placegraph.indoor.rays.trace_kernels import Tracer
from placegraph.indoor.refine.matching import Matcher, Matches
from placegraph.indoor.refine.matching.sift import SiftMatcher
from placegraph.indoor.refine.refine_kernels import plane_distances, read
from placegraph.indoor.render import Renderer, Rendering, camera_rays
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.images import resize_image

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching.matches import Features

_TILE = 4
_REACH = 3  # pixels from a reading to the points that its normal is made of


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Depth of one frame at R = 16 * tiles pixels, in tiles of 4 x 4."""

    directions: NDArray[np.float32]
    """(R, 3) rays in the camera through the pixels' centres, z = 1."""
    depth: NDArray[np.float32]
    """(R,) [m], 0: no reading."""
    normals: NDArray[np.float32]
    """(R, 3) of what was seen, towards the camera; zero where unknown."""


def sample_readings(
    frame: Frame, depth: NDArray[np.float32], count: int, phase: int = 0
) -> Readings:
    """Return about `count` readings of a depth image (h, w) [m], spread evenly.

    Two phases never share a pixel. Readings on edges of depth are left out: what lies between two
    surfaces belongs to none.
    """
    h, w = depth.shape
    camera = frame.depth_camera or frame.camera
    stride = max(2, round((h * w / count) ** 0.5))
    start = (stride // 2 + phase * (stride // 2)) % stride
    v, u = _tiled(np.arange(start, h, stride), np.arange(start, w, stride))
    found = Readings(*read(depth, camera_rays(camera), v, u, _REACH))
    if camera.model == "fisheye":
        seen = np.isfinite(camera.directions(np.stack([u, v], axis=-1) + 0.5)).all(axis=-1)
        found.depth[~seen] = 0.0
    return found


def _tiled(
    rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns (R,) of a lattice in tiles of 4 x 4, filled up with -1."""
    pad = [(0, -len(rows) % _TILE), (0, -len(columns) % _TILE)]
    v = np.pad(rows, pad[0], constant_values=-1)
    u = np.pad(columns, pad[1], constant_values=-1)
    grid = np.stack(np.meshgrid(v, u, indexing="ij"))
    tiles = grid.reshape(2, len(v) // _TILE, _TILE, len(u) // _TILE, _TILE)
    flat = tiles.transpose(0, 1, 3, 2, 4).reshape(2, -1)
    return flat[0], flat[1]


class Surfaces(NamedTuple):
    """The map as compiled code reads it to align depth."""

    tracer: Tracer
    normals: NDArray[np.float32]
    """(T, 3) unit normals."""
    object_of: NDArray[np.int32]
    """(T,)"""

    @classmethod
    def of(cls, scene: Scene) -> Surfaces:
        """Make the surfaces of a map."""
        return cls(scene.caster.tracer, scene.normals, scene.mesh.object_of)


class Kernel(NamedTuple):
    """Robust kernel of residuals [m]; see `options.DepthNoise`."""

    floor: float
    slope: float
    surface: float
    facing: tuple[float, float]
    width: float
    """Residual, in standard deviations, at which a reading has a quarter of its weight."""


def distances(
    surfaces: Surfaces, readings: Sequence[Readings | None], poses: Floats
) -> list[Floats]:
    """Measure distances (R,) [m] of the readings of each frame from the map's surface, at poses (T, 4, 4).

    NaN where there is no reading, infinite where the map shows nothing.
    """
    return [
        np.zeros(0)
        if one is None
        else plane_distances(
            surfaces,
            np.ascontiguousarray(pose[:3, :3]),
            np.ascontiguousarray(pose[:3, 3]),
            one.directions,
            one.depth,
        )
        for one, pose in zip(readings, poses, strict=True)
    ]


MOST = 5000
"""Largest number of matches of a view, the surest."""
_DIGITS = 7  # a tenth of a micrometre
BLOCKS = 9
"""Blocks in the width of an image; one of four is held back."""
_STEEP = 0.15
"""Largest change of depth within a pixel or two, as a share, where a match is lifted: beyond, the match
may be of either surface."""


@dataclass(frozen=True, slots=True, eq=False)
class PointMatches:
    """M matches of one frame with points of the map."""

    points: Floats
    """(M, 3) [m, map]"""
    pixels: Floats
    """(M, 2) where the frame's colour image shows them [px]."""
    rays: Floats
    """(M, 2) the same without the camera: x and y where z is 1."""
    sigma: Floats
    """(M,) standard deviation of the pixels [px]."""
    focal: float
    """[px]"""
    unit: float
    """Pixels of this camera in a pixel of an image `REFERENCE` wide, the unit of tolerances."""

    @classmethod
    def of(cls, points: Floats, pixels: Floats, camera: Camera, sigma: float) -> PointMatches:
        """Make matches of a camera; `sigma`: deviation of all [px of an image `REFERENCE` wide].

        Pixels without a ray are left out.
        """
        rays = camera.directions(pixels)[:, :2] if len(pixels) else np.zeros((0, 2))
        unit = max(camera.width, camera.height) / REFERENCE
        sigmas = np.full(len(points), sigma * unit)
        if camera.model == "fisheye":  # near its rim a pixel moves a ray far more than ahead
            sigmas *= 1.0 + np.sum(rays * rays, axis=1)
        seen = np.flatnonzero(np.isfinite(rays).all(axis=1))
        return cls(points, pixels, rays, sigmas, 0.5 * (camera.fx + camera.fy), unit)[seen]

    @classmethod
    def empty(cls) -> PointMatches:
        """Make an empty set of matches."""
        return cls(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), 1.0, 1.0)

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> PointMatches:
        """Select matches."""
        return replace(
            self,
            points=self.points[rows],
            pixels=self.pixels[rows],
            rays=self.rays[rows],
            sigma=self.sigma[rows],
        )

    def errors(self, map_from_camera: Floats) -> Floats:
        """Return reprojection errors (M,) [px] at a pose (4, 4); infinite behind the camera."""
        at = (self.points - map_from_camera[:3, 3]) @ map_from_camera[:3, :3]
        ahead = at[:, 2] > 1e-3
        xy = at[:, :2] / np.where(ahead, at[:, 2], 1.0)[:, None]
        off = self.focal * np.linalg.norm(xy - self.rays, axis=1)
        return np.where(ahead, off, np.inf)


def turn_views(map_from_camera: Floats, options: RefineOptions, rng: Generator) -> list[Floats]:
    """Turn a pose about the vertical by draws within +-spread: `views` in all (Sec. 3.6)."""
    out = [map_from_camera]
    for yaw in rng.uniform(-options.spread, options.spread, options.views - 1):
        pose = map_from_camera.copy()
        pose[:3, :3] = rotation_z(yaw) @ pose[:3, :3]
        out.append(pose)
    return out


def match_views(
    renderer: Renderer,
    frame: Frame,
    query: NDArray[np.uint8],
    poses: Sequence[Floats],
    matcher: Matcher,
    *,
    size: int,
    sigma: float,
) -> PointMatches:
    """Match a frame (H, W, 3) with renderings from poses (4, 4), and lift the matches (Sec. 3.6).

    `size`: longer side of the renderings [px]; the query is brought to theirs. `sigma`: deviation of
    a match [px of an image `REFERENCE` wide].
    """
    camera = shrink_camera(frame.camera, size)
    drawn = [renderer.render(pose, camera, samples=1) for pose in poses]
    shown = resize_image(query, camera.width, camera.height)
    found = matcher.match(shown, [d.colour for d in drawn], masks=[d.mask for d in drawn])
    found = _check_matches(found, matcher, len(drawn), camera)
    points, pixels = [np.zeros((0, 3))], [np.zeros((0, 2))]
    for picture, matches in zip(drawn, found, strict=True):
        lifted, whole = lift_pixels(picture, matches.rendered)
        points.append(lifted[whole])
        pixels.append(matches.query[whole])
    scale = np.array([frame.camera.width / camera.width, frame.camera.height / camera.height])
    return PointMatches.of(
        np.concatenate(points), np.concatenate(pixels) * scale, frame.camera, sigma
    )


def _check_matches(
    views: Sequence[Matches], matcher: Matcher, count: int, camera: Camera
) -> list[Matches]:
    """Keep the matches of each view that lie in both images; `OptionError`: a matcher gives none."""
    if not isinstance(views, Sequence) or len(views) != count:
        raise OptionError(
            f"The matcher {matcher.name!r} must return one Matches object for each of "
            f"{count} views."
        )
    size, checked = np.array([camera.width, camera.height] * 2), []
    for matches in views:
        if not isinstance(matches, Matches):
            raise OptionError(f"The matcher {matcher.name!r} returned {type(matches).__name__}.")
        both = np.concatenate([matches.query, matches.rendered], axis=1)
        rows = np.flatnonzero(((both >= 0) & (both <= size)).all(axis=1))[:MOST]
        checked.append(
            Matches(matches.query[rows], matches.rendered[rows], matches.confidence[rows])
        )
    return checked


def shrink_camera(camera: Camera, size: int) -> Camera:
    """Return the camera with images whose longer side is `size` [px]; as it is where that is longer."""
    scale = size / max(camera.width, camera.height)
    if scale >= 1.0:
        return camera
    return camera.resize(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def held_back(pixels: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Return which image points (N, 2) [px] of a camera lie in held-out blocks."""
    block = np.floor(pixels / (max(camera.width, camera.height) / BLOCKS)).astype(np.int64)
    return np.asarray((block % 2 == 1).all(axis=1))


def lift_pixels(picture: Rendering, pixels: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Lift pixels (N, 2) of a rendering to points (N, 3) [m, map], and return which are sound.

    Between pixel centres points are interpolated in the plane of the four around; a pixel at the
    end of the map, or astride two surfaces, is unsound.
    """
    h, w = picture.depth.shape
    if not len(pixels) or min(h, w) < 2:
        return np.zeros((len(pixels), 3)), np.zeros(len(pixels), bool)
    at = pixels - 0.5
    x = np.clip(np.floor(at[:, 0]), 0, w - 2).astype(np.int64)
    y = np.clip(np.floor(at[:, 1]), 0, h - 2).astype(np.int64)
    right, down = np.clip(at[:, 0] - x, 0, 1)[:, None], np.clip(at[:, 1] - y, 0, 1)[:, None]
    corners = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)]
    shares = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    points = np.sum(
        [s * picture.points[c].astype(np.float64) for c, s in zip(corners, shares, strict=True)],
        axis=0,
    )
    depths = np.stack([picture.depth[c] for c in corners])
    with np.errstate(invalid="ignore"):
        sound = np.ptp(depths, axis=0) < _STEEP * depths.min(axis=0)
    return points, sound & np.isfinite(points).all(axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """A pose that many matches agree on."""

    pose: Floats
    """(4, 4) map_from_camera of the reference frame."""
    inliers: list[NDArray[np.bool_]]
    """For each frame which of its matches agree."""

    @property
    def count(self) -> int:
        """Inliers of all frames."""
        return int(sum(i.sum() for i in self.inliers))


def solve_frame(matches: PointMatches, options: RefineOptions) -> Consensus | None:
    """Solve PnP with RANSAC on one frame, by PoseLib (Sec. 3.6); None: too few matches agree."""
    return solve_rig([matches], [np.eye(4)], options)


def solve_rig(
    matches: Sequence[PointMatches], reference_from_camera: Sequence[Floats], options: RefineOptions
) -> Consensus | None:
    """Solve PnP with RANSAC on frames that odometry ties together, by PoseLib; None: too few agree.

    `reference_from_camera`: (4, 4) of each frame; the pose found is the reference's. A rig agrees
    on a pose where no frame alone would: its wrong matches agree on nothing in common.
    """
    poselib = _poselib()
    used = [t for t, seen in enumerate(matches) if len(seen)]
    if sum(len(matches[t]) for t in used) < options.least:
        return None
    pixels = [matches[t].rays * matches[t].focal for t in used]
    points = [matches[t].points for t in used]
    cameras = [
        {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [matches[t].focal, 0.0, 0.0]}
        for t in used
    ]
    limit = options.inlier * max(matches[t].unit for t in used)
    ransac = {"max_reproj_error": limit, "max_iterations": 5000, "seed": 0}
    if len(used) == 1 and np.allclose(reference_from_camera[used[0]], np.eye(4)):
        pose, info = poselib.estimate_absolute_pose(pixels[0], points[0], cameras[0], ransac, {})
        inliers = [info["inliers"]]
    else:
        mounts = [poselib.CameraPose() for _ in used]
        for t, mount in zip(used, mounts, strict=True):
            inverse = np.asarray(np.linalg.inv(reference_from_camera[t]))
            mount.R, mount.t = inverse[:3, :3], inverse[:3, 3]
        pose, info = poselib.estimate_generalized_absolute_pose(
            pixels, points, mounts, cameras, ransac, {}
        )
        inliers = info["inliers"]
    agreed = [np.zeros(len(seen), bool) for seen in matches]
    for t, inlier in zip(used, inliers, strict=True):
        agreed[t] = np.asarray(inlier, bool)
    matrix = np.eye(4)
    # the last digits of PoseLib vary from call to call
    matrix[:3, :3] = rotation_from_vector(np.round(vector_from_rotation(pose.R.T), _DIGITS))
    matrix[:3, 3] = np.round(-pose.R.T @ pose.t, _DIGITS)
    found = Consensus(matrix, agreed)
    sound = np.isfinite(matrix).all() and found.count >= options.least
    return found if sound else None


def _poselib() -> Any:  # noqa: ANN401  # PoseLib is untyped
    try:
        import poselib
    except ImportError as error:
        raise MissingExtraError(
            "Poses from images need PoseLib: run `pip install poselib` (not available on "
            "every platform), or refine with depth only."
        ) from error
    return poselib


LARGEST = 640
"""Longer side [px] to which larger images are brought."""
RATIO = 0.9
"""Largest ratio of the distances to the nearest landmark and to the nearest one elsewhere."""
SIGMA = 0.7
"""Standard deviation of a feature [px of an image `REFERENCE` wide]."""
LOOKS = 5
"""Frames of a window that are compared with the landmarks."""
FEATURES = 1000
"""Most features of a query's image, the strongest first."""
SHARE = 0.05
"""Least share of the matches that must agree on a pose: fewer do so by chance."""
PLENTY = 20
"""Number of landmarks a frame from which on renderings are not needed."""
FARTHEST = (1.0, 0.6)
"""Largest move of a pose by a refinement, or by landmarks [m], [rad]; beyond lies another place."""
_APART = 0.1  # landmarks nearer to each other show the same spot [m]
_RIVALS = 4  # landmarks of one spot that are passed over in search of a rival
_BLOCK = 8192  # landmarks that are compared at once
_SIDES = 4
_DIRECTIONS = 8


def make_detector(features: int) -> SiftMatcher:
    """Make a detector of features; raises `MissingExtraError` where OpenCV is not installed."""
    return SiftMatcher(features=features)


def detect_features(sift: SiftMatcher, frame: Frame, rgb: NDArray[np.uint8]) -> Features:
    """Detect features of a frame's image (H, W, 3): points [px], vectors (N, `DESCRIPTOR_SIZE`)."""
    camera = shrink_camera(frame.camera, LARGEST)
    x, y, _ = frame.gravity
    down = float(np.degrees(np.arctan2(y, x)) - 90.0) % 360.0
    found = sift.describe_image(resize_image(rgb, camera.width, camera.height), down)
    scale = np.array([rgb.shape[1] / camera.width, rgb.shape[0] / camera.height])
    return type(found)(found.points * scale, compact(found.vectors))


def compact(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return unit vectors (N, `DESCRIPTOR_SIZE`) of RootSIFT descriptors (N, 128)."""
    if vectors.shape[1] != len(_basis()):
        return np.zeros((0, DESCRIPTOR_SIZE), np.float32)
    short = vectors @ _basis()
    return np.asarray(short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), 1e-9))


@cache
def _basis() -> NDArray[np.float32]:
    """Return (128, `DESCRIPTOR_SIZE`) orthonormal: frequencies of least product, without the mean."""
    across = np.arange(_SIDES)
    waves = np.cos(np.pi * np.outer(across + 0.5, across) / _SIDES) * np.sqrt(2.0 / _SIDES)
    waves[:, 0] /= np.sqrt(2.0)
    turn = np.arange(_DIRECTIONS)
    order = (turn + 1) // 2
    phase = 2.0 * np.pi * np.outer(turn, order) / _DIRECTIONS
    circles = np.where(turn % 2 == 1, np.cos(phase), np.sin(phase))
    circles[:, 0] = 1.0
    circles /= np.linalg.norm(circles, axis=0)
    whole = np.einsum("ai,bj,ck->abcijk", waves, waves, circles).reshape(128, 128)
    steep = np.multiply.outer(np.multiply.outer(across + 1, across + 1), order + 1).ravel()
    return whole[:, np.argsort(steep, kind="stable")[1 : DESCRIPTOR_SIZE + 1]].astype(np.float32)


def match_features(landmarks: Landmarks, features: Features, frame: Frame) -> PointMatches:
    """Match features of a frame with landmarks: mutual nearest, and clearly so (Lowe's ratio)."""
    if not len(features) or not len(landmarks):
        return PointMatches.empty()
    cosine, ranked = _rank_landmarks(features.vectors, landmarks.unit_vectors)
    sure, best = cosine[:, 0], ranked[:, 0]
    back = features.vectors @ landmarks.unit_vectors[best].T
    mutual = back.argmax(axis=0) == np.arange(len(features))
    apart = np.linalg.norm(landmarks.points[ranked] - landmarks.points[best][:, None], axis=2)
    elsewhere = apart[:, 1:] >= _APART
    # where all of them show one spot, the last stands for a rival
    rank = np.where(elsewhere.any(axis=1), elsewhere.argmax(axis=1), _RIVALS - 1) + 1
    rival = np.take_along_axis(cosine, rank[:, None], axis=1)[:, 0]
    clear = mutual & (1.0 - sure < RATIO**2 * (1.0 - rival))
    points = landmarks.points[best[clear]].astype(np.float64)
    return PointMatches.of(points, features.points[clear], frame.camera, SIGMA)


def _rank_landmarks(
    vectors: NDArray[np.float32], landmark_vectors: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return cosines (N, 1 + _RIVALS) and rows of the likeliest of L landmarks, likeliest first.

    Landmarks are gone through in blocks, so that memory does not grow with the map; where they are
    too few, the cosine is -1.
    """
    count = 1 + _RIVALS
    best = np.full((len(vectors), count), -1.0, np.float32)
    rows, every = np.zeros((len(vectors), count), np.int64), np.arange(len(vectors))
    for first in range(0, len(landmark_vectors), _BLOCK):
        cosine = vectors @ landmark_vectors[first : first + _BLOCK].T
        for _ in range(min(count, cosine.shape[1])):
            column = cosine.argmax(axis=1)
            # the last of those kept so far gives way, and moves up to its place
            better = cosine[every, column] > best[:, -1]
            if not better.any():
                break
            best[:, -1] = np.where(better, cosine[every, column], best[:, -1])
            rows[:, -1] = np.where(better, first + column, rows[:, -1])
            cosine[every, column] = -2.0
            order = np.argsort(-best, axis=1, kind="stable")
            best = np.take_along_axis(best, order, axis=1)
            rows = np.take_along_axis(rows, order, axis=1)
    return best, rows


def match_window(window: Window) -> list[PointMatches]:
    """Match up to `LOOKS` frames of a window with landmarks: (T,); cached for each frame.

    Empty for a map without landmarks, or if OpenCV is missing or images are switched off.
    """
    landmarks, out = window.scene.landmarks, [PointMatches.empty()] * len(window)
    if landmarks is None:
        return out
    try:
        sift = make_detector(FEATURES)
    except MissingExtraError:
        return out
    for t in spread(len(window), LOOKS):
        frame, rgb = window.observations[t].frame, window.observations[t].rgb
        if rgb is not None:
            match = partial(_match_frame, landmarks, sift, frame, rgb)
            out[t] = window.derive(("landmarks", frame.index), match)
    return out


def _match_frame(
    landmarks: Landmarks, sift: SiftMatcher, frame: Frame, rgb: NDArray[np.uint8]
) -> PointMatches:
    return match_features(landmarks, detect_features(sift, frame, rgb), frame)


def agree_on_pose(
    matches: Sequence[PointMatches], mounts: Floats, options: RefineOptions
) -> Consensus | None:
    """Solve the pose of the last of T frames from landmarks; None: too few agree.

    `mounts`: (T, 4, 4) last_from_camera.
    """
    consensus = solve_rig(matches, list(mounts), options)
    by_chance = consensus is None or consensus.count < SHARE * sum(map(len, matches))
    return None if by_chance else consensus


def drop_held_back(
    landmarks: Sequence[PointMatches], frames: Sequence[Frame], options: RefineOptions
) -> list[PointMatches]:
    """Drop the landmarks (T,) that are held out for the check."""
    pairs = zip(landmarks, frames, strict=True)
    return [s[~held_back(s.pixels, f.camera)] if options.check else s for s, f in pairs]


def measure_move(before: Floats, after: Floats) -> tuple[float, float]:
    """Return way [m] and turn [rad] from one pose (4, 4) to another."""
    turn = vector_from_rotation(after[:3, :3] @ before[:3, :3].T)
    return float(np.linalg.norm(after[:3, 3] - before[:3, 3])), float(np.linalg.norm(turn))


def has_plenty(matches: Sequence[PointMatches]) -> bool:
    """Return whether frames show so many landmarks that renderings are not needed."""
    return sum(map(len, matches)) >= PLENTY * sum(len(s) > 0 for s in matches)


def locate_by_landmarks(window: Window) -> Floats:
    """Return the pose (K, 4) of the last frame by landmarks: one, or none."""
    with time_stage(window.seconds, "landmarks"):
        odometry = np.stack([s.frame.odometry for s in window.observations])
        mounts = np.linalg.inv(odometry[-1]) @ odometry
        matches = match_window(window)
        try:
            consensus = agree_on_pose(matches, mounts, RefineOptions())
        except MissingExtraError:
            consensus = None
    return np.zeros((0, 4)) if consensus is None else split_pose(consensus.pose)[0][None]
