"""Best of both beside COLMAP: single frames, in our maps and in maps of local features.

    placegraph-lab table indoor_colmap
    placegraph-lab table indoor_colmap --only "office, beside mapped views" --frames 40

Prints a Markdown table and writes every answer as JSON. Needs `pip install './lab[colmap]'`, and for
XFeat its weights in `shared/weights`. `docs/benchmarks/indoor-colmap.md` says what is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.core.estimate import Status
from placegraph.core.geometry import Floats
from placegraph.indoor.build import build_scene
from placegraph.indoor.map.scene_file import bytes_of
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.metrics import NEAR, near, position_error, rotation_error
from placegraph_lab.tables.indoor.peers import Peer, colmap_peer, xfeat_peer
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import (
    Quick,
    Run,
    Seed,
    known,
    markdown,
    number,
    option,
    parts,
    share,
    table,
)

LIMITS = (0.10, 5.0)
"""Position [m] and rotation [deg] that the recall allows."""
BESIDE = slice(0, None, 2), slice(1, None, 2)
"""Every other frame makes the map, those between ask."""


@dataclass(frozen=True)
class Set:
    """A recording, the frames that make its map, and those that ask."""

    name: str
    folder: str
    made: slice
    asked: slice


SETS = (
    Set("office, beside mapped views", "office", *BESIDE),
    *(Set(f"office, {h}", "office", slice(*m), slice(*a)) for h, (m, a) in HALVES.items()),
    Set("freiburg1_rpy, beside mapped views", "freiburg1_rpy", *BESIDE),
)
OURS = {
    "images": FilterOptions().only(colour=True),
    "depth and images": FilterOptions().only(colour=True, depth=True),
}


@dataclass(frozen=True)
class Answer:
    """What became of one frame."""

    frame: int
    position: float
    """Error [m]; infinite of no pose."""
    rotation: float
    """Error [deg]; infinite of no pose."""
    sure: bool
    """Whether the pose was given as certain: `OK`, or enough inliers of PnP."""
    wrong: bool
    """Sure, and farther off than `NEAR`."""
    milliseconds: float
    """CPU time."""

    @property
    def right(self) -> bool:
        """Whether it lies within `LIMITS`."""
        return self.position <= LIMITS[0] and self.rotation <= LIMITS[1]


@dataclass(frozen=True)
class Row:
    """One method in one set."""

    set: str
    method: str
    megabytes: float
    answers: tuple[Answer, ...]


def rows_of(asked: Set, data: Path, cache: Path, weights: Path, count: int, seed: int) -> list[Row]:
    """Every method in one set, asked by `count` frames spread over it."""
    folder = data / asked.folder
    capture = open_capture(folder)
    told = (folder / "trajectory.tum").exists()
    truth = true_poses(folder) if told else capture.odometry
    every = range(len(capture))
    made, asking = list(every[asked.made]), list(every[asked.asked])
    chosen = [asking[i] for i in np.unique(np.linspace(0, len(asking) - 1, count).astype(int))]
    frames = [replace(capture[i], odometry=np.eye(4)) for i in chosen]  # one frame has no way
    mapped, poses = [capture[i] for i in made], truth[made]
    out = []

    def row(
        method: str, megabytes: float, ask: Callable[[Frame], tuple[Floats | None, bool]]
    ) -> None:
        ask(frames[0])  # compiles
        answers = [_answer(frame, truth[i], ask) for frame, i in zip(frames, chosen, strict=True)]
        out.append(Row(asked.name, method, megabytes, tuple(answers)))

    scene, size, of_landmarks = _scene(asked, folder, cache)
    for senses, options in OURS.items():
        bare = replace(scene, landmarks=None)
        row(senses, size - of_landmarks, _localizer(bare, options, seed))
        row(f"{senses}, landmarks", size, _localizer(scene, options, seed))
    peers = {
        "*COLMAP, SIFT*": lambda: colmap_peer(mapped, poses, np.random.default_rng(seed)),
        "*XFeat, by depth*": lambda: xfeat_peer(
            mapped, poses, weights, np.random.default_rng(seed)
        ),
    }
    for method, make in peers.items():
        peer = make()
        row(method, peer.megabytes, _asker(peer))
    return out


def _scene(asked: Set, folder: Path, cache: Path) -> tuple[SceneMap, float, float]:
    """Map with landmarks, its megabytes, and those of the landmarks."""
    made = asked.made
    name = f"{asked.folder}_{made.start}_{made.stop}_{made.step}_landmarks"
    path = place(cache, name)
    if not path.exists():
        build_scene(folder, path, capture=FromCapture(frames=made, landmarks=True))
    parts = bytes_of(path)
    return SceneMap.open(path), sum(parts.values()) / 1e6, parts["landmarks"] / 1e6


def _localizer(
    scene: SceneMap, options: FilterOptions, seed: int
) -> Callable[[Frame], tuple[Floats | None, bool]]:
    def ask(frame: Frame) -> tuple[Floats | None, bool]:
        found = scene.localize([frame], options=options, seed=seed)
        best = found.best
        return None if best is None else best.map_from_camera, found.status is Status.OK

    return ask


def _asker(peer: Peer) -> Callable[[Frame], tuple[Floats | None, bool]]:
    def ask(frame: Frame) -> tuple[Floats | None, bool]:
        pose = peer.ask(frame)
        return pose, pose is not None

    return ask


def _answer(
    frame: Frame, truth: Floats, ask: Callable[[Frame], tuple[Floats | None, bool]]
) -> Answer:
    start = time.process_time()
    pose, sure = ask(frame)
    took = 1e3 * (time.process_time() - start)
    if pose is None:
        return Answer(frame.index, np.inf, np.inf, sure, False, took)
    off = position_error(pose, truth), rotation_error(pose, truth)
    return Answer(frame.index, *off, sure, sure and not near(pose, truth, NEAR), took)


def to_dict(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Plain numbers, ready for `json.dumps`; infinity becomes None."""

    def plain(answer: Answer) -> dict[str, Any]:
        values = asdict(answer)
        return {k: None if v == np.inf else v for k, v in values.items()}

    return [
        {
            "set": r.set,
            "method": r.method,
            "megabytes": r.megabytes,
            "answers": [plain(a) for a in r.answers],
        }
        for r in rows
    ]


@table()
def indoor_colmap(
    run: Run,
    only: Annotated[str, option("Sets, with semicolons between.")] = "",
    frames: Annotated[int, option("Single frames asked of each set.")] = 24,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """How near do single frames come, beside COLMAP and XFeat? Centimetres, recall, MB, milliseconds."""
    wanted = known(parts(only, ";"), [one.name for one in SETS], "set")
    rows: list[Row] = []
    for one in SETS:
        if one.name in wanted:
            run.say(one.name)
            count = 6 if quick else frames
            weights = run.shared / "weights/xfeat.pt"
            rows += rows_of(one, run.data, run.cache, weights, count, seed)
    print(report(rows))
    run.save({"rows": to_dict(rows)}, whole=not only)


def report(rows: list[Row]) -> str:
    """One table; of each row medians over all frames, those without a pose among them."""
    header = ["map, and who asks it", "median", "10 cm, 5°", "sure", "sure and wrong", "MB", "ms"]
    lines: list[list[str]] = []
    for row in rows:
        if row is rows[0] or row.set != rows[rows.index(row) - 1].set:
            lines.append([f"**{row.set}**", *[""] * 6])
        told = row.answers
        off = np.array([(a.position, a.rotation) for a in told])
        middle = np.median(off, axis=0)
        lines.append([
            row.method,
            f"{number(100 * middle[0], 1)} cm, {number(middle[1], 2)}°",
            share(float(np.mean([a.right for a in told]))),
            f"{sum(a.sure for a in told)} of {len(told)}",
            str(sum(a.wrong for a in told)),
            number(row.megabytes, 2),
            number(float(np.median([a.milliseconds for a in told]))),
        ])  # fmt: skip
    return markdown(header, lines)
