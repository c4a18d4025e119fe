"""Poses of one to ten frames: right and certain answers in real places, and none where no map is.

Even frames of a recording make the map, and windows of its odd frames are asked (of the office, also
frames halfway between those of a map of one frame in 20). Odometry begins
elsewhere and drifts, unless the recording has its own. Absent places are parts that a map leaves out,
and windows of other recordings. `doors` and `carrels` are drawn worlds that repeat themselves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple
from zlib import crc32

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.metrics import NEAR, position_error, rotation_error
from placegraph_lab.tables.indoor.windows import Odometry, Window, true_poses, without_depth
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.worlds.flat.repeating import WORLDS, record_world

if TYPE_CHECKING:
    from placegraph_lab.tables.named.indoor_colmap import Peer

RIGHT = (0.10, 5.0)
"""Position [m] and rotation [deg] of a right pose."""
LENGTHS = (1, 2, 3, 5, 10)
REAL = ("office", "freiburg1_rpy", "corridor", "patio")
SETS = (*REAL, *WORLDS)
LEFT_OUT = {
    "corridor": ((slice(0, 21, 2), slice(35, 51)), (slice(31, 51, 2), slice(0, 22))),
    "doors": ((slice(0, 20, 2), slice(40, 64)), (slice(44, 64, 2), slice(0, 20))),
    "carrels": ((slice(0, 14, 2), slice(44, 64)), (slice(36, 64, 2), slice(0, 16))),
}
"""Frames that make a map, and frames that show other parts of the place."""
SPARSE = {"office": 20}
"""Recordings that are also asked in a map of one frame in so many: halfway between these frames."""
FOREIGN = 4  # windows of each other recording that a map is asked
SENSES = {
    "depth": {"depth": True},
    "images": {"colour": True},
    "both": {"depth": True, "colour": True},
    "landmarks": {"colour": True},
}
"""Terms of the search; `images` and `landmarks` get no depth, and only `landmarks` a map that has some."""
COLMAP = "colmap"
"""Single images in a map of SIFT features of the same frames, where pycolmap is installed."""
PARTS = ("present", "absent")
HALVES = {"even": slice(0, None, 2), "odd": slice(1, None, 2), "all": slice(None)}
_MAPPING = ("placegraph/io", "placegraph/indoor/mapping")
"""Folders whose code decides what a map of a capture is."""


@dataclass(frozen=True, eq=False)
class Source:
    """Recording of one place."""

    name: str
    folder: Path
    capture: Capture
    truth: Floats  # (T, 4, 4) map_from_camera
    odometry: Odometry | None
    """Source of odometry and gravity; None: the recording's own."""

    @classmethod
    def open(cls, name: str, folder: Path) -> Source:
        """Open a recording: `trajectory.tum` is the truth, else the recorder's own poses are."""
        capture = open_capture(folder, labels=None)
        if (folder / "trajectory.tum").exists():
            return cls(name, folder, capture, true_poses(folder), None)
        return cls(name, folder, capture, capture.odometry, Odometry())

    def windows(self, frames: slice, length: int, count: int) -> list[Window]:
        """Return at most `count` windows of consecutive `frames`, spread over all of them."""
        rows = range(*frames.indices(len(self.capture)))
        last = len(rows) - length
        if last < 0:
            return []
        found = []
        for start in np.unique(np.linspace(0, last, min(count, last + 1)).astype(int)):
            chosen = list(rows[start : start + length])
            part = replace(self.capture, frames=tuple(self.capture.frames[i] for i in chosen))
            truth = self.truth[chosen]
            rng = np.random.default_rng([crc32(self.name.encode()), *chosen])
            if self.odometry is not None:
                part, truth = self.odometry.apply(self.name, part, truth, rng)
            found.append(Window(self.name, part, truth[-1]))
        return found


@dataclass(frozen=True)
class Case:
    """Row of the table before the senses: a map, and the frames asked in it."""

    name: str
    part: str  # one of `PARTS`
    maps: tuple[tuple[str, slice], ...]  # recordings and their frames that make maps
    queries: tuple[tuple[tuple[str, slice, int], ...], ...]
    """Of each map: recordings, their frames, and the most windows of them."""


class PoseAnswer(NamedTuple):
    """Answer of a method to a window."""

    pose: Floats | None  # (4, 4) map_from_camera of the last frame
    status: str  # `OK`, `AMBIGUOUS`, `LOST`, or the name of an error
    probability: float
    reason: str


@dataclass(frozen=True)
class Answer:
    """Result of one window."""

    window: str
    frames: int
    position: float  # error [m]; infinite without a pose, and in absent places
    rotation: float  # error [deg]; infinite likewise
    status: str  # `OK`, `AMBIGUOUS`, `LOST`, or the name of an error
    probability: float
    milliseconds: float  # CPU time of the whole window
    reason: str

    def within(self, limits: tuple[float, float]) -> bool:
        """Return whether a pose lies within limits [m], [deg] of the truth."""
        return self.position <= limits[0] and self.rotation <= limits[1]

    @property
    def ok(self) -> bool:
        return self.status == "OK"

    @property
    def is_false(self) -> bool:
        """Whether the answer is certain, and wrong by more than `OK` promises."""
        return self.ok and not self.within(NEAR)


@dataclass(frozen=True)
class Row:
    """Answers to the windows of one case by some senses, by length."""

    case: str
    part: str
    senses: str
    answers: dict[int, tuple[Answer, ...]]

    def shares(self, of: str) -> list[float | None]:
        """Return the share of answers of each length that have a property or a status."""

        def holds(answer: Answer) -> bool:
            if of == "right":
                return answer.within(RIGHT)
            return answer.is_false if of == "false" else answer.status == of

        return [float(np.mean([holds(a) for a in n])) if n else None for n in self.answers.values()]

    @property
    def false(self) -> list[int]:
        return [sum(a.is_false for a in n) for n in self.answers.values()]

    @property
    def milliseconds(self) -> list[float | None]:
        """Median CPU time of a window of each length; None where nothing was localized."""
        times = [[a.milliseconds for a in n if a.milliseconds > 0] for n in self.answers.values()]
        return [float(np.median(n)) if n else None for n in times]


def _slashes(values: Iterable[float | None]) -> str:
    return "/".join(lab.number(v).replace(",", "") for v in values)


COLUMNS = (
    Col("", "case"), Col("senses", "senses"),
    Col("windows", lambda r: [len(n) for n in r.answers.values()], _slashes),
    Col("right", lambda r: r.shares("right"), lab.shares),
    Col("`OK`", lambda r: r.shares("OK"), lab.shares), Col("false `OK`", "false", _slashes),
    Col("`LOST`", lambda r: r.shares("LOST"), lab.shares),
    Col("ms", "milliseconds", _slashes),
)  # fmt: skip


class Maps:
    """Recordings by name, and maps of them."""

    def __init__(self, run: lab.Run, *, fresh: bool, seed: int = 0) -> None:
        self.run, self.fresh, self.seed = run, fresh, seed
        self.source = cache(self._source)
        self.scene = cache(self._scene)
        self.peer = cache(self._peer)

    def _source(self, name: str) -> Source:
        if name in REAL:
            return Source.open(name, self.run.data / name)
        folder = self.run.cache / f"few_{name}{self.seed or ''}_{lab.code_key(lab.WORLDS)}"
        if not (folder / "gravity.txt").exists():
            self.run.log(f"drawing {name}")
            record_world(name, folder, seed=self.seed)
        return Source.open(name, folder)

    def _scene(self, name: str, start: int, stop: int | None, step: int) -> SceneMap:
        """Open the map of some frames of a recording, with landmarks."""
        code = lab.code_key(_MAPPING if name in REAL else (*_MAPPING, *lab.WORLDS))
        drawn = "" if name in REAL else self.seed or ""
        path = self.run.cache / f"few_{name}{drawn}_{start}_{stop}_{step}_{code}.scene"
        if self.fresh or not path.exists():
            self.run.log(f"map of {name}, frames {start}:{stop}:{step}")
            self.run.cache.mkdir(parents=True, exist_ok=True)
            how = FromCapture(frames=slice(start, stop, step), landmarks=True)
            build_scene(self.source(name).folder, path, capture=how)
        return SceneMap.open(path)

    def _peer(self, name: str, start: int, stop: int | None, step: int) -> Peer:
        """Map of SIFT features that COLMAP triangulates, of the same frames."""
        from placegraph_lab.tables.named.indoor_colmap import colmap_peer

        self.run.log(f"COLMAP's map of {name}, frames {start}:{stop}:{step}")
        source, rows = self.source(name), slice(start, stop, step)
        return colmap_peer(
            source.capture.frames[rows], source.truth[rows], np.random.default_rng(0)
        )

    def method(self, senses: str, name: str, frames: slice) -> Callable[[Capture], PoseAnswer]:
        """Return what localizes a capture by some senses in the map of some frames."""
        key = name, frames.start, frames.stop, frames.step
        if senses == COLMAP:
            return partial(_localize_by_peer, self.peer(*key))
        scene = self.scene(*key)
        bare = scene if senses == "landmarks" else replace(scene, landmarks=None)
        return partial(_localize, bare, senses)


def make_cases(names: Sequence[str], parts: Sequence[str], count: int) -> list[Case]:
    """Return the cases of some recordings, each asked at most `count` windows."""
    made, odd = slice(0, None, 2), slice(1, None, 2)
    found = []
    if "present" in parts:
        found += [Case(n, "present", ((n, made),), (((n, odd, count),),)) for n in names]
        for name in (n for n in names if n in SPARSE):
            n = SPARSE[name]
            between = ((name, slice(n // 2, None, n), count),)
            title, few = f"{name}, 1 frame in {n} mapped", slice(0, None, n)
            found.append(Case(title, "present", ((name, few),), (between,)))
    if "absent" in parts:
        for name in names:
            if name in LEFT_OUT:
                maps = tuple((name, mapped) for mapped, _ in LEFT_OUT[name])
                queries = tuple(((name, beyond, count),) for _, beyond in LEFT_OUT[name])
                found.append(Case(f"{name}, a part not in its map", "absent", maps, queries))
        for name in (n for n in names if n in REAL):
            others = tuple((o, odd, FOREIGN) for o in REAL if o != name)
            found.append(Case(f"others in {name}", "absent", ((name, made),), (others,)))
    return found


def measure_case(maps: Maps, case: Case, senses: str, lengths: Sequence[int], half: str) -> Row:
    """Ask all windows of a case; COLMAP gets single images."""
    answers: dict[int, list[Answer]] = {n: [] for n in lengths}
    for (name, frames), queries in zip(case.maps, case.queries, strict=True):
        localize = maps.method(senses, name, frames)
        warm = False
        for length in lengths:
            windows = [
                window
                for other, rows, count in queries
                for window in maps.source(other).windows(rows, length, count)
                if senses != COLMAP or length == 1
            ]
            for window in windows[HALVES[half]]:
                if not warm:  # so that nothing is compiled or cast in what is timed
                    localize(window.capture)
                    warm = True
                start = time.process_time()
                found = localize(window.capture)
                took = 1e3 * (time.process_time() - start)
                truth = None if case.part == "absent" else window.truth
                answers[length].append(_measure(window, truth, found, took))
    return Row(case.name, case.part, senses, {n: tuple(found) for n, found in answers.items()})


def _measure(
    window: Window, truth: Floats | None, answer: PoseAnswer, milliseconds: float
) -> Answer:
    pose = None if truth is None else answer.pose
    return Answer(
        window=window.name,
        frames=len(window.capture),
        position=np.inf if pose is None else position_error(pose, window.truth),
        rotation=np.inf if pose is None else rotation_error(pose, window.truth),
        status=answer.status,
        probability=answer.probability,
        milliseconds=milliseconds,
        reason=answer.reason,
    )


def _localize(scene: SceneMap, senses: str, capture: Capture) -> PoseAnswer:
    terms = SENSES[senses]
    if not terms.get("depth"):
        capture = without_depth(capture)
    try:
        found = scene.localize(capture, options=PoseSearchOptions().only(**terms))
    except PlacegraphError as error:
        return PoseAnswer(None, type(error).__name__, 0.0, str(error))
    if found.best is None:
        return PoseAnswer(None, found.status.name, 0.0, found.reason)
    best = found.best
    return PoseAnswer(
        best.map_from_camera, found.status.name, float(best.probability), found.reason
    )


def _localize_by_peer(peer: Peer, capture: Capture) -> PoseAnswer:
    pose, sure = peer.ask(capture[0])
    return PoseAnswer(pose, "OK" if sure else "LOST", float(sure), "")


def pool_rows(rows: Sequence[Row], part: str) -> list[Row]:
    """Return one row of all cases of a part for each kind of senses."""
    found = []
    for senses in dict.fromkeys(r.senses for r in rows):
        mine = [r for r in rows if r.part == part and r.senses == senses]
        if len(mine) > 1:
            every = {n: tuple(a for r in mine for a in r.answers[n]) for n in mine[0].answers}
            found.append(Row("**all**", part, senses, every))
    return found


@lab.table()
def indoor_few(
    run: lab.Run,
    sets: Annotated[str, lab.option(f"Recordings with commas: {', '.join(SETS)}.")] = "",
    frames: Annotated[str, lab.option("Frames of a window, with commas.")] = "1,2,3,5,10",
    senses: Annotated[
        str, lab.option(f"With commas: {', '.join((*SENSES, COLMAP))}.")
    ] = "depth,images,both",
    half: Annotated[str, lab.option("Windows asked: odd (for tuning), even, or all.")] = "even",
    parts: Annotated[str, lab.option(f"With commas: {', '.join(PARTS)}.")] = "",
    windows: Annotated[int, lab.option("Most windows of a length of each recording.")] = 24,
    *,
    seed: Annotated[int, lab.option("Seed of the drawn recordings.")] = 0,
    quick: lab.Quick = False,
    fresh: Annotated[bool, lab.option("Make all maps anew.")] = False,
) -> None:
    """Poses of one to ten frames: right, OK and false OK, in places on the map and absent ones."""
    names = lab.check_names(lab.parts(sets), SETS, "recording")
    wanted = lab.check_names(lab.parts(parts), PARTS, "part")
    kinds = lab.check_names(lab.parts(senses), (*SENSES, COLMAP), "sense")
    half = lab.check_names([half], HALVES, "half")[0]
    lengths = [1, 5] if quick else [int(n) for n in lab.parts(frames)]
    maps = Maps(run, fresh=fresh, seed=seed)
    rows: list[Row] = []
    for case in make_cases(names, wanted, 8 if quick else windows):
        for kind in kinds:
            row = measure_case(maps, case, kind, lengths, half)
            run.log(lab.render(COLUMNS, [row]).splitlines()[-1])
            rows.append(row)
    for part in wanted:
        mine = [r for r in rows if r.part == part]
        title = f"{part.title()}, {'/'.join(map(str, lengths))} frames, {half} windows"
        columns = [c for c in COLUMNS if part == "present" or c.title != "right"]
        lab.show(title, columns, [*mine, *pool_rows(rows, part)])
    run.save({"rows": rows}, complete=not (sets or parts or seed) and half == "even")
