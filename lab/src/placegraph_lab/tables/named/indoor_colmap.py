"""Localization by local features of mapped views alone: COLMAP with SIFT, XFeat lifted by depth.

Both find candidates among the mapped views by VLAD, match their features one view after the other,
and leave the pose to COLMAP's PnP. Needs pycolmap, which only this comparison uses.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.core.estimate import Status
from placegraph.core.geometry import Camera, Floats
from placegraph.errors import MissingExtraError
from placegraph.indoor.build import build_scene
from placegraph.indoor.map.scene_file import measure_parts
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.mapping.landmarks import read_depth
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.refine.matching.matches import Features, match_mutually
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.metrics import NEAR, near, position_error, rotation_error
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Run, table
from placegraph_learn.xfeat import XFeatMatcher

WORDS = 64  # of VLAD
CANDIDATES = 10  # mapped views that a query is matched with
ERROR = 12.0  # reprojection error of an inlier of PnP [px]
LEAST = 12  # fewest inliers of a pose
RATIO = 0.8  # of SIFT's distances
SIFT = 512.0  # COLMAP's factor of the numbers of SIFT in 8 bits
_ROUNDS = 8
_SOME = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A mapped view: features of known points."""

    points: Floats  # (N, 3) [m, map]
    vectors: NDArray[np.float32]  # (N, D) unit vectors


@dataclass(frozen=True, eq=False)
class Peer:
    """A map of features, ready to be asked."""

    views: Sequence[View]
    words: NDArray[np.float32]  # (WORDS, D)
    images: NDArray[np.float32]  # (V, WORDS D) VLAD of each view
    bytes_a_feature: float
    features: Callable[[Frame], Features]  # of a query's image: points [px], vectors
    ratio: float

    @property
    def megabytes(self) -> float:
        count = sum(len(view.points) for view in self.views)
        return (count * self.bytes_a_feature + self.images.nbytes) / 1e6

    def save(self, path: Path) -> None:
        """Write the map, with `bytes_a_feature`: points in 32 bits, SIFT in 8 and others in 16."""
        vectors = np.concatenate([view.vectors for view in self.views])
        small = vectors.astype(np.float16)
        if self.ratio < 1.0:
            small = np.rint(SIFT * vectors).clip(0, 255).astype(np.uint8)
        points = np.concatenate([view.points for view in self.views]).astype(np.float32)
        ends = np.cumsum([len(view.points) for view in self.views])
        np.savez(
            path, points=points, vectors=small, ends=ends, words=self.words, images=self.images,
            of=(self.bytes_a_feature, self.ratio),
        )  # fmt: skip

    @classmethod
    def open(cls, path: Path, features: Callable[[Frame], Features]) -> Self:
        """Read a map that `save` wrote; `features` of a query's image are of the same kind."""
        with np.load(path) as file:
            points, vectors, ends = file["points"], file["vectors"], file["ends"][:-1]
            words, images, (size, ratio) = file["words"], file["images"], file["of"].tolist()
        unit = _unit(vectors.astype(np.float32))
        pairs = zip(np.split(points, ends), np.split(unit, ends), strict=True)
        views = [View(at.astype(np.float64), own) for at, own in pairs]
        return cls(views, words, images, size, features, ratio)

    def ask(self, frame: Frame) -> tuple[Floats | None, bool]:
        """map_from_camera (4, 4) of a frame, and whether enough features agree on one."""
        found = self.features(frame)
        if not len(found):
            return None, False
        nearest = np.argsort(-self.images @ vlad(found.vectors, self.words), kind="stable")
        pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for row in nearest[:CANDIDATES]:
            view = self.views[row]
            its = Features(np.zeros((len(view.points), 2)), view.vectors)
            ours, theirs, _ = match_mutually(found, its, ratio=self.ratio, apart=-1.0)
            pixels.append(found.points[ours])
            points.append(view.points[theirs])
        pose = pnp(np.concatenate(pixels), np.concatenate(points), frame.camera)
        return pose, pose is not None


def peer(
    views: Sequence[View],
    features: Callable[[Frame], Features],
    bytes_a_feature: float,
    ratio: float,
    rng: np.random.Generator,
) -> Peer:
    """Map of views: the words of its VLAD are learned of their features."""
    every = np.concatenate([view.vectors for view in views])
    some = every[rng.permutation(len(every))[:_SOME]]
    words = some[:WORDS].copy()
    for _ in range(_ROUNDS):
        own = (some @ words.T).argmax(axis=1)
        for k in range(WORDS):
            if (own == k).any():
                words[k] = some[own == k].mean(axis=0)
        words /= np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-9)
    images = np.stack([vlad(view.vectors, words) for view in views])
    return Peer(views, words, images, bytes_a_feature, features, ratio)


def vlad(vectors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """VLAD (WORDS D,) of an image's vectors (N, D), signed roots, unit (Jegou et al. 2010)."""
    own = (vectors @ words.T).argmax(axis=1) if len(vectors) else np.zeros(0, np.int64)
    sums = np.zeros(words.shape)
    np.add.at(sums, own, vectors - words[own])
    flat = (np.sign(sums) * np.sqrt(np.abs(sums))).ravel()
    return (flat / max(float(np.linalg.norm(flat)), 1e-9)).astype(np.float32)


def pnp(pixels: Floats, points: Floats, camera: Camera) -> Floats | None:
    """COLMAP's LO-RANSAC and refinement at `ERROR`; None where fewer than `LEAST` agree."""
    colmap = pycolmap()
    if len(pixels) < LEAST:
        return None
    options = colmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = ERROR
    options.ransac.random_seed = 0
    told = colmap.estimate_and_refine_absolute_pose(pixels, points, colmap_camera(camera), options)
    if told is None or int(told["num_inliers"]) < LEAST:
        return None
    pose = np.eye(4)
    pose[:3] = told["cam_from_world"].inverse().matrix()
    return pose


def colmap_camera(camera: Camera) -> Any:
    """The camera as COLMAP has it; pixel centres at +0.5 in both."""
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    given = [*camera.distortion, *[0.0] * 8][:8] if camera.distortion else []
    return pycolmap().Camera(
        model="FULL_OPENCV" if given else "PINHOLE",
        width=camera.width, height=camera.height, params=[*pinhole, *given], camera_id=1,
    )  # fmt: skip


def xfeat_peer(
    frames: Sequence[Frame], poses: Floats, weights: Path, rng: np.random.Generator
) -> Peer:
    """XFeat features of mapped frames (T, 4, 4), lifted by their own depth; 64 numbers in 16 bits."""
    features = extract_xfeat(weights)
    views = []
    for frame, pose in zip(frames, poses, strict=True):
        found = features(frame)
        rays = frame.camera.directions(found.points)
        depth = read_depth(frame, rays)
        known = np.isfinite(depth)
        at = (rays * depth[:, None])[known] @ pose[:3, :3].T + pose[:3, 3]
        views.append(View(at, found.vectors[known]))
    return peer(views, features, 64 * 2 + 12, 1.0, rng)


def extract_xfeat(weights: Path) -> Callable[[Frame], Features]:
    """Return what finds XFeat's features of a frame."""
    network = XFeatMatcher(weights=weights)

    def features(frame: Frame) -> Features:
        found: Features = network.prepare_query(frame.rgb())
        return found

    return features


def colmap_peer(frames: Sequence[Frame], poses: Floats, rng: np.random.Generator) -> Peer:
    """SIFT features of mapped frames, triangulated by COLMAP with their poses (T, 4, 4) known.

    Each view is matched with those up to 10 frames away, and 2, 4, ... 512 beyond.
    """
    colmap = pycolmap()
    with tempfile.TemporaryDirectory() as folder:
        model, database = _triangulated(colmap, Path(folder), frames, poses)
        views = []
        for image in sorted(model.images.values(), key=lambda i: i.name):
            seen = [(n, p.point3D_id) for n, p in enumerate(image.points2D) if p.has_point3D()]
            rows = np.array([n for n, _ in seen], np.int64)
            points = [model.points3D[id_].xyz for _, id_ in seen]
            described = np.asarray(database.read_descriptors(image.image_id).data, np.float32)
            views.append(View(np.array(points).reshape(-1, 3), _unit(described[rows])))
        database.close()
    return peer(views, extract_sift(), 128 + 12, RATIO, rng)


def extract_sift() -> Callable[[Frame], Features]:
    """Return what finds COLMAP's SIFT features of a frame."""
    sift = pycolmap().Sift()

    def features(frame: Frame) -> Features:
        keypoints, vectors = sift.extract(np.ascontiguousarray(_grey(frame)))
        return Features(keypoints[:, :2].astype(np.float64), _unit(np.asarray(vectors, np.float32)))

    return features


def _triangulated(
    colmap: Any,
    folder: Path,
    frames: Sequence[Frame],
    poses: Floats,
) -> tuple[Any, Any]:
    names = [f"{t:06d}.png" for t in range(len(frames))]
    (folder / "images").mkdir()
    for name, frame in zip(names, frames, strict=True):
        Image.fromarray(_grey(frame)).save(folder / "images" / name, compress_level=1)
    camera = colmap_camera(frames[0].camera)
    reader = colmap.ImageReaderOptions()
    reader.camera_model = camera.model.name
    reader.camera_params = ",".join(map(str, camera.params))
    path = folder / "colmap.db"
    colmap.extract_features(
        path, folder / "images", names, colmap.CameraMode.PER_IMAGE, reader,
        device=colmap.Device.cpu,
    )  # fmt: skip
    database = colmap.Database.open(path)
    model = colmap.Reconstruction()
    images = database.read_all_images()
    for image in images:
        camera = colmap_camera(frames[names.index(image.name)].camera)
        camera.camera_id = image.camera_id
        database.update_camera(camera)
        model.add_camera_with_trivial_rig(camera)
    colmap.match_sequential(path, device=colmap.Device.cpu)
    for image in images:
        camera_from_map = np.linalg.inv(poses[names.index(image.name)])
        its = colmap.Image(
            name=image.name,
            keypoints=np.asarray(database.read_keypoints(image.image_id))[:, :2].astype(float),
            camera_id=image.camera_id,
            image_id=image.image_id,
        )
        model.add_image_with_trivial_frame(its, colmap.Rigid3d(camera_from_map[:3]))
    (folder / "model").mkdir()
    return colmap.triangulate_points(model, path, folder / "images", folder / "model"), database


def _grey(frame: Frame) -> NDArray[np.uint8]:
    return np.asarray(Image.fromarray(frame.rgb()).convert("L"))


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    vectors = vectors.reshape(-1, vectors.shape[-1] or 128)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def pycolmap() -> Any:
    """The library, or what to install."""
    try:
        import pycolmap as library
    except ImportError as error:
        raise MissingExtraError(
            "The comparison needs COLMAP: pip install 'placegraph-lab[colmap]'."
        ) from error
    library.logging.minloglevel = library.logging.Level.ERROR.value  # else every image is told
    return library


LIMITS = (0.10, 5.0)  # position [m] and rotation [deg] that the recall allows
BESIDE = slice(0, None, 2), slice(1, None, 2)  # every other frame makes the map, those between ask


@dataclass(frozen=True)
class Set:
    """A recording, the frames that make its map, and those that ask."""

    name: str
    folder: str
    made: slice
    queries: slice


SETS = (
    Set("office, beside mapped views", "office", *BESIDE),
    *(Set(f"office, {h}", "office", slice(*m), slice(*a)) for h, (m, a) in HALVES.items()),
    Set("freiburg1_rpy, beside mapped views", "freiburg1_rpy", *BESIDE),
)
OURS = {
    "images": PoseSearchOptions().only(colour=True),
    "depth and images": PoseSearchOptions().only(colour=True, depth=True),
}


@dataclass(frozen=True)
class Answer:
    """Result of one frame."""

    frame: int
    position: float  # error [m]; infinite of no pose
    rotation: float  # error [deg]; infinite of no pose
    sure: bool  # whether the pose was given as certain: `OK`, or enough inliers of PnP
    wrong: bool  # sure, and farther off than `NEAR`
    milliseconds: float  # CPU time


@dataclass(frozen=True)
class Row:
    """One method in one set."""

    set: str
    method: str
    megabytes: float
    answers: tuple[Answer, ...]

    @property
    def median(self) -> str:
        metres, degrees = np.median([(a.position, a.rotation) for a in self.answers], axis=0)
        return f"{lab.number(100 * metres, 1)} cm, {lab.number(degrees, 2)}°"

    @property
    def right(self) -> float:
        """Share of the answers within `LIMITS`."""
        metres, degrees = LIMITS
        return float(
            np.mean([a.position <= metres and a.rotation <= degrees for a in self.answers])
        )


COLUMNS = (
    Col("map, and who asks it", "method"), Col("median", "median"), Col("10 cm, 5°", "right", lab.share),
    Col("sure", lambda r: f"{sum(a.sure for a in r.answers)} of {len(r.answers)}"),
    Col("sure and wrong", lambda r: sum(a.wrong for a in r.answers)), Col("MB", "megabytes", 2),
    Col("ms", lambda r: float(np.median([a.milliseconds for a in r.answers])), 0),
)  # fmt: skip


def rows_of(
    recording: Set, data: Path, cache: Path, weights: Path, count: int, seed: int
) -> list[Row]:
    """Every method in one set, asked by `count` frames spread over it."""
    folder = data / recording.folder
    capture = open_capture(folder)
    has_truth = (folder / "trajectory.tum").exists()
    truth = true_poses(folder) if has_truth else capture.odometry
    every = range(len(capture))
    made, asking = list(every[recording.made]), list(every[recording.queries])
    chosen = [asking[i] for i in np.unique(np.linspace(0, len(asking) - 1, count).astype(int))]
    frames = [replace(capture[i], odometry=np.eye(4)) for i in chosen]  # one frame has no way
    mapped, poses = [capture[i] for i in made], truth[made]
    out = []

    def row(method: str, megabytes: float, ask: Ask) -> None:
        ask(frames[0])  # compiles
        answers = [_answer(frame, truth[i], ask) for frame, i in zip(frames, chosen, strict=True)]
        out.append(Row(recording.name, method, megabytes, tuple(answers)))

    scene, size, of_landmarks = _scene(recording, folder, cache)
    bare = replace(scene, landmarks=None)
    for senses, options in OURS.items():
        row(senses, size - of_landmarks, partial(_localize, bare, options, seed))
        row(f"{senses}, landmarks", size, partial(_localize, scene, options, seed))
    peers = {
        "*COLMAP, SIFT*": partial(colmap_peer, mapped, poses),
        "*XFeat, by depth*": partial(xfeat_peer, mapped, poses, weights),
    }
    for method, make in peers.items():
        peer = make(np.random.default_rng(seed))
        row(method, peer.megabytes, peer.ask)
    return out


Ask = Callable[[Frame], tuple[Floats | None, bool]]


def _localize(
    scene: SceneMap, options: PoseSearchOptions, seed: int, frame: Frame
) -> tuple[Floats | None, bool]:
    found = scene.localize([frame], options=options, seed=seed)
    pose = None if found.best is None else found.best.map_from_camera
    return pose, found.status is Status.OK


def _scene(recording: Set, folder: Path, cache: Path) -> tuple[SceneMap, float, float]:
    made = recording.made
    name = f"{recording.folder}_{made.start}_{made.stop}_{made.step}_landmarks"
    path = place(cache, name)
    if not path.exists():
        build_scene(folder, path, capture=FromCapture(frames=made, landmarks=True))
    parts = measure_parts(path)
    return SceneMap.open(path), sum(parts.values()) / 1e6, parts["landmarks"] / 1e6


def _answer(frame: Frame, truth: Floats, ask: Ask) -> Answer:
    start = time.process_time()
    pose, sure = ask(frame)
    milliseconds = 1e3 * (time.process_time() - start)
    if pose is None:
        return Answer(frame.index, np.inf, np.inf, sure, False, milliseconds)
    off = position_error(pose, truth), rotation_error(pose, truth)
    return Answer(frame.index, *off, sure, sure and not near(pose, truth, NEAR), milliseconds)


@table()
def indoor_colmap(
    run: Run,
    only: Annotated[str, lab.option("Sets, with semicolons between.")] = "",
    frames: Annotated[int, lab.option("Single frames asked of each set.")] = 24,
    seed: lab.Seed = 0,
    *,
    quick: lab.Quick = False,
) -> None:
    """Single frames beside COLMAP and XFeat: errors [cm], recall, size of the map, time."""
    wanted = lab.check_names(lab.parts(only, ";"), [one.name for one in SETS], "set")
    rows: list[Row] = []
    weights = run.shared / "weights/xfeat.pt"
    for one in SETS:
        if one.name in wanted:
            run.log(one.name)
            found = rows_of(one, run.data, run.cache, weights, 6 if quick else frames, seed)
            lab.show(one.name, COLUMNS, found)
            rows += found
    run.save({"rows": rows}, complete=not only)
