"""Accuracy of encoders, patch by patch: in the house, both halves of the office, and drawn homes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.build import build_scene
from placegraph.indoor.encode import Encoder, MapEncoder, bind_encoder, encoder
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, Frame, open_capture
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, option, parts, render, share, table
from placegraph_lab.worlds.home.home import home, record, scene_of, visit

HOMES = 8
WALK = 15  # frames of a walk through a home
_FIRST_HOME = 7_000  # seeds of homes from here on


@dataclass(frozen=True, eq=False)
class Place:
    """A map, frames whose poses are known, and images of the map itself."""

    kind: str  # `house`, `office` or `homes`
    name: str
    scene: SceneMap
    frames: tuple[Frame, ...]
    map_from_camera: Floats  # (T, 4, 4) of the frames
    captures: tuple[Capture, ...]
    """Captures of the map, for encoders that need them; other frames, with map_from_camera as odometry."""


def places(data: Path, cache: Path, every: int = 1, homes: int = HOMES) -> Iterator[Place]:
    """All places, one after the other; of the frames of recordings every `every`-th.

    `data`: folder with the house and the office; `cache`: where maps are kept.
    """
    yield house(data, cache, every)
    for half in HALVES:
        yield office(data, cache, half, every)
    for i in range(homes):
        yield drawn_home(i)


def house(data: Path, cache: Path, every: int = 1) -> Place:
    """The house; its first sequence shows the map, the others are asked about."""
    path = place(cache, "house_default")
    if not path.exists():
        build_scene(data / "house/map/house.glb", path)
    first, *others = sorted((data / "house").glob("seq[0-9]*"))
    frames = tuple(frame for f in others for frame in open_capture(f)[::every])
    poses = np.concatenate([true_poses(f)[::every] for f in others])
    shown = replace_odometry(open_capture(first), true_poses(first))
    return Place("house", "house", SceneMap.open(path), frames, poses, (shown,))


def office(data: Path, cache: Path, half: str, every: int = 1) -> Place:
    """The office: one half of its frames makes the map, cut into objects; the other is asked."""
    (low, high), (first, last) = HALVES[half]
    path = place(cache, f"office_objects_{low}_{high}")
    if not path.exists():
        build_scene(data / "office", path, capture=FromCapture(frames=slice(low, high)))
    capture, truth = open_capture(data / "office"), true_poses(data / "office")
    rows = slice(first, last, every)
    shown = replace_odometry(capture[low:high:3], truth[low:high:3])
    scene = SceneMap.open(path)
    return Place("office", f"office, {half}", scene, capture[rows].frames, truth[rows], (shown,))


def drawn_home(number: int) -> Place:
    """A procedural home with objects' labels; two walks in different light."""
    rng = np.random.default_rng(_FIRST_HOME + number)
    flat = home(rng)
    interior = flat.furnish(rng)
    scene = scene_of(interior)
    walks = [visit(flat, interior, rng, frames=WALK) for _ in range(2)]
    asked, shown = (
        record(interior, walk, rng, daylight=float(rng.uniform(0.1, 0.9))) for walk in walks
    )
    poses, captures = walks[0].map_from_camera, (replace_odometry(shown, walks[1].map_from_camera),)
    return Place("homes", f"home {number}", scene, asked.frames, poses, captures)


def replace_odometry(capture: Capture, map_from_camera: Floats) -> Capture:
    """Capture whose odometry is map_from_camera (T, 4, 4): images of the map itself."""
    pairs = zip(capture, map_from_camera, strict=True)
    return replace(capture, frames=tuple(replace(frame, odometry=pose) for frame, pose in pairs))


RAYS = 6  # rays cast through a patch, across and down
TEMPERATURES = (0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3, 0.5)
"""Temperatures that are tried for the best."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of an encoder in one place, over patches of which half or more show one object."""

    patches: int
    encoded: float  # share of patches that say anything
    best: float  # share of patches whose best object is the true one
    auc: float  # share of the other objects that the true one is put before; a half by chance
    nats: float
    """Mean log-likelihood ratio of a patch as the particle filter weighs it, which takes a share
    of patches for wrong (`Likelihood.wrong`)."""
    bare: float  # the same of softmax(cosines / temperature) alone
    temperature: float  # of the encoder
    ideal: float  # temperature of `TEMPERATURES` with the most nats here
    ideal_nats: float
    milliseconds: float  # to encode a frame and compare it with the objects


def accuracy(
    encoder: MapEncoder, scene: SceneMap, frames: Sequence[Frame], map_from_camera: Floats
) -> Accuracy | None:
    """Accuracy over frames of true poses (T, 4, 4); None where the encoder says nothing of any.

    Things that are not where the map has them count against it. Raises `InputError` where an image
    is broken.
    """
    cosines, truth, temperature = [], [], 0.0
    silent, seconds = 0, 0.0
    for frame, pose in zip(frames, map_from_camera, strict=True):
        start = time.perf_counter()
        patches = encoder.encode(frame)
        seconds += time.perf_counter() - start
        if patches is None:
            continue
        temperature = patches.temperature
        true = true_objects(scene, patches.camera, pose, patches.grid)
        told = (patches.rows >= 0) & (true >= 0)
        silent += int(((true >= 0) & ~told).sum())
        cosines.append(patches.table[patches.rows[told]])
        truth.append(true[told])
    told_of = sum(map(len, truth))
    if not told_of:
        return None
    table, rows = np.concatenate(cosines).astype(np.float64), np.concatenate(truth)
    background = scene.visibility(PoseSearchOptions()).background.objects
    part = told_of / (told_of + silent)  # what is silent adds nothing
    wrong = PoseSearchOptions().likelihood.wrong
    trials = [part * float(nats(table, rows, background, t, wrong).mean()) for t in TEMPERATURES]
    own = table[np.arange(told_of), rows][:, None]
    others = max(table.shape[1] - 1, 1)
    before = ((own > table).sum(axis=1) + ((own == table).sum(axis=1) - 1) / 2) / others
    return Accuracy(
        patches=told_of + silent,
        encoded=part,
        best=part * float((table.argmax(axis=1) == rows).mean()),
        auc=part * float(before.mean()) + (1.0 - part) / 2,
        nats=part * float(nats(table, rows, background, temperature, wrong).mean()),
        bare=part * float(nats(table, rows, background, temperature).mean()),
        temperature=temperature,
        ideal=TEMPERATURES[int(np.argmax(trials))],
        ideal_nats=max(trials),
        milliseconds=seconds / len(frames) * 1e3,
    )


def true_objects(
    scene: SceneMap, camera: Camera, map_from_camera: Floats, grid: tuple[int, int]
) -> NDArray[np.int32]:
    """Object (rows * columns,) that half or more of the rays of a patch hit; -1: there is none."""
    rows, columns = grid
    y, x = np.mgrid[: rows * RAYS, : columns * RAYS] + 0.5
    uv = np.stack([x * camera.width / columns, y * camera.height / rows], axis=-1) / RAYS
    rays = camera.directions(uv.reshape(-1, 2)) @ map_from_camera[:3, :3].T
    hits = scene.caster.cast(map_from_camera[:3, 3], rays).triangle
    hit = np.where(hits >= 0, scene.mesh.object_of[np.maximum(hits, 0)], -1)
    tiles = hit.reshape(rows, RAYS, columns, RAYS).swapaxes(1, 2).reshape(rows * columns, -1)
    # sorted, what has half of them stands in the middle or just before it
    tiles = np.sort(tiles, axis=1)
    out = np.full(len(tiles), -1, np.int32)
    for middle in (RAYS * RAYS // 2 - 1, RAYS * RAYS // 2):
        much = (tiles == tiles[:, middle, None]).sum(axis=1) * 2 >= RAYS * RAYS
        out = np.where(much, tiles[:, middle], out)
    return out


def nats(
    cosines: Floats,
    truth: NDArray[np.int32],
    background: Floats,
    temperature: float,
    wrong: float = 0.0,
) -> Floats:
    """Log-likelihood ratio (P,) of the true object of each patch against the background.

    `cosines`: (P, N); `truth`: (P,) rows of objects; `background`: (N,) share of each object among
    all that is seen in the map; `wrong`: share of patches taken to say nothing true. Expected over
    the background, the ratio is one: its logarithm is what a patch tells.
    """
    logits = cosines / temperature
    ratio = np.exp(logits - logits.max(axis=1, keepdims=True))
    ratio /= ratio.mean(axis=1, keepdims=True)
    ratio = (1.0 - wrong) * ratio + wrong
    own = ratio[np.arange(len(truth)), truth]
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(own) - np.log(ratio @ background))


def mean(accuracies: Iterable[Accuracy | None]) -> Accuracy | None:
    """Mean over places of one kind, each counting alike; None where nothing was said in any."""
    known = [a for a in accuracies if a is not None]
    if not known:
        return None
    columns = {f.name: [getattr(k, f.name) for k in known] for f in fields(Accuracy)}
    means = {name: float(np.mean(values)) for name, values in columns.items()}
    return Accuracy(**means | {"patches": sum(columns["patches"])})


COLUMNS = (
    Col("place, encoder", "0"), Col("patches", "1.patches", 0), Col("that tell", "1.encoded", share),
    Col("best is true", "1.best", share), Col("AUC", "1.auc", share), Col("nats a patch", "1.nats", 2),
    Col("softmax alone", "1.bare", 2),
    Col("temperature", "1.temperature", lambda t: f"{t:.2g}" if t else "–"),
    Col("best of all", lambda r: r[1] and f"{r[1].ideal_nats:.2f} at {r[1].ideal:.2g}"),
    Col("ms a frame", "1.milliseconds", 1),
)  # fmt: skip


@table()
def patch_accuracy(
    run: Run,
    encoders: Annotated[str, option("Names and options.")] = "appearance; labels",
    every: Annotated[int, option("Of the recordings' frames, every so many.")] = 2,
    *,
    quick: Quick = False,
) -> None:
    """Accuracy of encoders on patches where poses are known: house, office, homes."""
    every, homes = (10, 2) if quick else (every, HOMES)
    asked: dict[str, Encoder] = {}
    for spec in parts(encoders, ";"):
        asked[spec] = encoder(spec)
    rows: list[dict[str, Any]] = []
    found: dict[str, dict[str, list[Accuracy | None]]] = {}
    for where in run.track(places(run.data, run.cache, every, homes), total=3 + homes):
        for spec, one in asked.items():
            tied = bind_encoder(one, where.scene, where.captures)
            told = accuracy(tied, where.scene, where.frames, where.map_from_camera)
            found.setdefault(where.kind, {}).setdefault(spec, []).append(told)
            rows.append({"place": where.name, "encoder": spec, "key": one.key, "accuracy": told})
    means = [
        (f"{kind}, {spec}", mean(told))
        for kind, by_encoder in found.items()
        for spec, told in by_encoder.items()
    ]
    print(render(COLUMNS, means))
    run.save({"rows": rows})
