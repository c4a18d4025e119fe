"""Walks with drifting odometry on which the camera is kidnapped, and how right a live pose is on them.

A walk is made of recorded parts, one after the other; at each join the camera is elsewhere, and odometry
has seen nothing of it.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Annotated, Any
from urllib.request import Request, urlopen
from zlib import crc32

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import Status
from placegraph.core.geometry import Floats, between, compose, pose_matrix, split_pose
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.indoor.track.belief import LivePose, Odometry
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import ArrayImages, Frame
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.metrics import NEAR, near, normalised_error, position_error
from placegraph_lab.tables.indoor.perturb import Clip, Recording, drift
from placegraph_lab.tables.indoor.refine import free_sigma
from placegraph_lab.tables.indoor.robustness import Places
from placegraph_lab.tables.named.indoor_few import REAL, Maps
from placegraph_lab.tables.named.serve_load import RunningServer, run_server
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.statistics import run_apart
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture

if TYPE_CHECKING:
    from placegraph.indoor.track.live import LiveTracker

PERIOD = 0.2  # seconds from an image to the next
RATE = 10  # samples of odometry an image: 50 Hz
RIGHT = (0.1, 10.0)  # A right pose is this near [m], [deg]
SENSES = PoseSearchOptions().only(depth=True, colour=True)
"""Labels of objects, which the recordings have, are not for robots."""


@dataclass(frozen=True, eq=False)
class Walk:
    """Frames in order of time, where they were taken, and at which the camera was kidnapped."""

    frames: tuple[Frame, ...]
    truth: Floats  # (T, 4, 4)
    kidnapped: tuple[int, ...]

    def pieces(self) -> Iterator[list[tuple[float, Floats]]]:
        """Odometry at 50 Hz up to each frame, its own time being the last."""
        odometry = Odometry()
        before = self.frames[0].stamp - PERIOD
        odometry.tell(before, self.frames[0].odometry)
        for frame in self.frames:
            odometry.tell(frame.stamp, frame.odometry)
            stamps = before + (np.arange(RATE) + 1) / RATE * (frame.stamp - before)
            found = [odometry.at(stamp) for stamp in [*stamps[:-1], frame.stamp]]
            yield [(sample.stamp, sample.pose) for sample in found if sample is not None]
            before = frame.stamp


def join_clips(parts: Sequence[Clip], degrees: float, rng: Generator) -> Walk:
    """Parts one after the other, with odometry that drifts by so many degrees a frame."""
    frames: list[Frame] = []
    for part in parts:
        own = drift(part, degrees, rng).frames
        onto = frames[-1].odometry @ np.linalg.inv(own[0].odometry) if frames else np.eye(4)
        frames += [replace(frame, odometry=onto @ frame.odometry) for frame in own]
    ends = np.cumsum([len(part.frames) for part in parts])
    stamped = (replace(f, stamp=i * PERIOD, index=i) for i, f in enumerate(frames))
    truth = np.concatenate([part.truth for part in parts])
    return Walk(tuple(stamped), truth, tuple(ends[:-1].tolist()))


def walks(recordings: Sequence[Recording], degrees: float, seed: int) -> list[Walk]:
    """Whole recordings as walks of four parts, three kidnappings each, in an order that is drawn.

    Four recordings are a walk; one that is alone is cut into quarters.
    """
    rng = np.random.default_rng(seed)
    if len(recordings) == 1:
        only = recordings[0]
        ends = np.linspace(0, len(only.frames), 5).astype(int)
        parts = [Clip.of(only, range(a, b)) for a, b in pairwise(ends.tolist())]
    else:
        parts = [Clip.of(r, range(len(r.frames))) for r in recordings]
    order = rng.permutation(len(parts))
    fours = [order[i : i + 4] for i in range(0, len(order) - 3, 4)]
    return [join_clips([parts[i] for i in four], degrees, rng) for four in fours]


def loop_recordings(
    recordings: Sequence[Recording], rng: Generator
) -> Iterator[tuple[Frame, Floats, bool]]:
    """Frames without end: to and fro along a recording, then kidnapped onto another.

    Each with its true pose (4, 4), and whether the camera was kidnapped just before.
    """
    at, level, number, row = np.zeros(4), None, 0, -1
    while True:
        row = int(rng.choice([r for r in range(len(recordings)) if r != row]))
        part = recordings[row]
        there = list(range(len(part.frames)))
        loop = [*there, *there[-2:0:-1], *there, *there[-2::-1]]
        poses, level = split_pose(np.stack([f.odometry for f in part.frames]))
        for i, k in enumerate(loop):
            if i:
                at = compose(at, between(poses[loop[i - 1]], poses[k]))
            frame, stamp = part.frames[k], number * PERIOD
            odometry = pose_matrix(at, level[k])
            yield (
                replace(frame, odometry=odometry, stamp=stamp, index=number),
                part.truth[k],
                i == 0,
            )
            number += 1


@dataclass(frozen=True, slots=True)
class FrameResult:
    status: str
    right: bool  # whether its pose is `RIGHT`
    foretold: bool  # whether the pose that odometry told just before its image was looked at is
    false: bool  # whether it is `OK`, and not what `OK` promises
    milliseconds: float  # CPU time
    kidnapped: bool

    @property
    def sure(self) -> bool:
        return self.status == Status.OK


def is_right(pose: LivePose, truth: Floats, limits: tuple[float, float] = RIGHT) -> bool:
    """Whether there is a pose, and it is that near to the truth (4, 4)."""
    return pose.map_from_camera is not None and near(pose.map_from_camera, truth, limits)


def track_walk(scene: SceneMap, walk: Walk, seed: int) -> list[FrameResult]:
    """Each frame of a walk, with odometry at 50 Hz before it, in one tracker."""
    live = scene.live(seed=seed, background=False, options=SENSES)
    seen = []
    rows = zip(walk.frames, walk.truth, walk.pieces(), strict=True)
    for i, (frame, truth, samples) in enumerate(rows):
        seen.append(looked_at(live, frame, truth, samples, kidnapped=i in walk.kidnapped))
    return seen


def looked_at(
    live: LiveTracker,
    frame: Frame,
    truth: Floats,
    samples: Sequence[tuple[float, Floats]],
    *,
    kidnapped: bool,
) -> FrameResult:
    """Odometry up to a frame, then the frame."""
    start = process_time()
    for stamp, pose in samples:
        foretold = live.move(stamp, pose)
    told = live.step(frame)
    taken = process_time() - start
    wrong = told.status is Status.OK and not is_right(told, truth, NEAR)
    return FrameResult(
        told.status.name, is_right(told, truth), is_right(foretold, truth), wrong, 1e3 * taken, kidnapped
    )  # fmt: skip


def recoveries(results: Sequence[FrameResult]) -> list[int | None]:
    """Frames after each kidnapping until one is `OK` and right; None: it was not before the next."""
    starts = [i for i, s in enumerate(results) if s.kidnapped]
    found: list[int | None] = []
    for start, end in pairwise([*starts, len(results)]):
        after = (i - start for i in range(start, end) if results[i].sure and results[i].right)
        found.append(next(after, None))
    return found


@dataclass(frozen=True)
class Row:
    """Figures of some walks."""

    place: str
    degrees: float
    frames: int
    right: float  # share of all frames whose pose is right
    sure: float  # ... that are `OK` ...
    tracked: float  # ... and of those the share that is right.
    foretold: float
    """Share of frames right before their image came, after a frame that was `OK`; without kidnapped ones."""
    false: float  # share of all frames that are `OK` and wrong, and
    longest: int  # ... most of them in a row.
    recovered: list[int | None]
    milliseconds: float  # CPU time a frame, median,
    worst: float  # ... and the worst.

    @classmethod
    def of(cls, place: str, degrees: float, walks: Sequence[Sequence[FrameResult]]) -> Row:
        """Figures of what was seen on each of some walks."""
        every = [seen for walk in walks for seen in walk]
        after = [b for walk in walks for a, b in pairwise(walk) if a.sure and not b.kidnapped]
        milliseconds = [s.milliseconds for s in every]

        def mean(field: str, of: Sequence[FrameResult] = every) -> float:
            return float(np.mean([getattr(s, field) for s in of])) if of else float("nan")

        return cls(
            place, degrees, len(every), right=mean("right"), sure=mean("sure"),
            tracked=mean("right", [s for s in every if s.sure]), foretold=mean("foretold", after),
            false=mean("false"), longest=max(longest(walk, lambda s: s.false) for walk in walks),
            recovered=[r for walk in walks for r in recoveries(walk)],
            milliseconds=float(np.median(milliseconds)), worst=max(milliseconds),
        )  # fmt: skip

    @property
    def delays(self) -> list[int]:
        """Frames until the pose is found again, of kidnappings after which it is."""
        return [r for r in self.recovered if r is not None]

    @property
    def most(self) -> str:
        lost = len(self.recovered) - len(self.delays)
        return f"{max(self.delays)}{f', {lost} never' * bool(lost)}" if self.delays else "–"


def longest(results: Sequence[FrameResult], which: Callable[[FrameResult], bool]) -> int:
    most = run = 0
    for one in results:
        run = run + 1 if which(one) else 0
        most = max(most, run)
    return most


MAPPED = {"even frames": "between mapped frames", "first half": "in the other half"}


@dataclass(frozen=True)
class FollowedRow:
    """Errors of `OK` poses of a recording that is followed as a bag is, over their covariance."""

    name: str
    mapped: str  # one of `MAPPED`
    frames: int  # frames that are followed
    errors: list[float]  # of `OK` poses [m]
    six: float  # mean squared error whitened by the covariance, 6 if honest
    axis: float  # mean squared error along the least certain direction over its variance, 1


def follow_recording(maps: Maps, name: str, mapped: str) -> FollowedRow:
    """Follow the frames of a recording that its map was not made of; odd rows were for tuning."""
    source, step = maps.source(name), 2
    count = len(source.capture)
    made, asked = slice(0, None, step), slice(1, None, step)
    if mapped == "first half":
        step = max(1, count // 240)
        made, asked = slice(0, count // 2, step), slice(count // 2 + 1, None, step)
    scene = replace(maps.scene(name, made.start, made.stop, made.step), landmarks=None)
    rows = list(range(*asked.indices(count)))
    part = replace(source.capture, frames=tuple(source.capture.frames[i] for i in rows))
    truth = source.truth[rows]
    if source.odometry is not None:
        rng = np.random.default_rng(crc32(name.encode()))
        part, truth = source.odometry.apply(name, part, truth, rng)
    live = scene.live(seed=0, background=False, options=SENSES)
    told = [(live.step(frame), pose) for frame, pose in zip(part, truth, strict=True)]
    found = [
        (t.estimate.best, pose)
        for t, pose in told[::2]
        if t.status is Status.OK and t.estimate is not None and t.estimate.best is not None
    ]
    white = [normalised_error(m.covariance, m.map_from_camera, pose) for m, pose in found]
    return FollowedRow(
        name, mapped, len(told[::2]),
        [position_error(m.map_from_camera, pose) for m, pose in found],
        float(np.mean([w @ w for w in white])) if white else float("nan"),
        float(np.mean([free_sigma(m, pose) ** 2 for m, pose in found])) if white else float("nan"),
    )  # fmt: skip


ODOMETRY = 100.0  # samples a second


@dataclass(frozen=True)
class Clock:
    """Tells and waits; a fake one makes tests quick."""

    start: float

    def now(self) -> float:
        return time.perf_counter() - self.start

    def until(self, when: float) -> None:
        """Wait until so many seconds after the start."""
        time.sleep(max(0.0, when - self.now()))


def play_walks(data: Path, cache: Path, path: Path, rate: float, seconds: float) -> dict[str, Any]:
    """Play walks of the house with images at a rate [Hz], and odometry at 100 Hz, in a fresh process."""
    recordings = Places(data, cache).recordings("house")["house"]
    endless = loop_recordings(recordings, np.random.default_rng(0))
    every = islice(endless, int(rate * seconds))
    frames = [_read(replace(f, stamp=i / rate)) for i, (f, _, _) in enumerate(every)]
    with SceneMap.open(path).live(options=SENSES) as live:
        for frame in frames[:8]:  # compiled code, and the table
            live.step(frame)
        live.lose()
        spent = process_time()
        told = play(live, frames, frames[7].stamp + 100.0, Clock(perf_counter()))
        spent = process_time() - spent
        live.wait()
        return {"rate": rate, "cores": spent / told["seconds"], "dropped": live.dropped} | told


def _read(frame: Frame) -> Frame:
    return replace(frame, images=ArrayImages(frame.rgb(), frame.depth(), frame.labels()))


def play(live: LiveTracker, frames: list[Frame], base: float, clock: Clock) -> dict[str, Any]:
    """Give images and odometry when their time has come; what each call took, and how old poses were."""
    calls, ages, behind = [], [], []
    coming = iter(frames)
    image = next(coming)
    for stamp, pose in wheels(frames):
        clock.until(stamp)
        start = clock.now()
        told = live.move(base + stamp, pose)
        calls.append(clock.now() - start)
        behind.append(start - stamp)
        if told.map_from_camera is not None:
            ages.append(told.age)
        if image.stamp <= stamp:
            live.see(replace(image, stamp=base + image.stamp))
            image = next(coming, replace(image, stamp=np.inf))
    return {
        "seconds": frames[-1].stamp, "images": len(frames), "moves": len(calls),
        "with_pose": len(ages), "move_ms": quantiles(calls), "age_ms": quantiles(ages),
        "behind_ms": quantiles(behind),
    }  # fmt: skip


def wheels(frames: list[Frame]) -> Iterator[tuple[float, Floats]]:
    """Odometry of frames at 100 Hz."""
    odometry = Odometry()
    odometry.tell(frames[0].stamp, frames[0].odometry)
    count = 0
    for frame in frames[1:]:
        odometry.tell(frame.stamp, frame.odometry)
        while (stamp := count / ODOMETRY) <= frame.stamp:
            sample = odometry.at(stamp)
            assert sample is not None  # noqa: S101  of the last step
            yield stamp, sample.pose
            count += 1


def quantiles(seconds: list[float]) -> dict[str, float]:
    """Median, 95 and 99 % and the most, in milliseconds; nothing of nothing."""
    if not seconds:
        return {}
    found = 1e3 * np.percentile(seconds, [50, 95, 99, 100])
    return dict(zip(("p50", "p95", "p99", "most"), found.round(3).tolist(), strict=True))


def from_files(scene: SceneMap, paths: Sequence[Path]) -> dict[str, Any]:
    """Captures or bags, a new tracker each: reading an image, and all until its pose is there."""
    wall, cpu, sure = [], [], 0
    for lap, path in enumerate([paths[0], *paths]):  # the first warms
        live = scene.live(options=SENSES, background=False)
        capture = open_capture(path)
        for row in range(len(capture)):
            start, spent = perf_counter(), process_time()
            told = live.step(capture[row])
            if lap:
                wall.append(perf_counter() - start)
                cpu.append(process_time() - spent)
                sure += told.status.name == "OK"
    return figures(wall, cpu, sure)


def from_server(maps: Path, paths: Sequence[Path]) -> dict[str, Any]:
    """Images sent over WebSockets to sessions of a server beside us, until each answer is there."""
    with run_server(maps) as server:
        asyncio.run(_session(server, paths[0]))
        wall: list[float] = []
        sure, spent = 0, server.cpu()
        for path in paths:
            found = asyncio.run(_session(server, path))
            wall += [seconds for seconds, _ in found]
            sure += sum(status == "OK" for _, status in found)
        each = (server.cpu() - spent) / len(wall)
    return figures(wall, [each], sure)


async def _session(server: RunningServer, path: Path) -> list[tuple[float, str]]:
    from websockets.asyncio.client import connect

    capture = open_capture(path, labels=None)
    c = capture.camera
    camera = {n: getattr(c, n) for n in ("fx", "fy", "cx", "cy", "width", "height")}
    begun = await asyncio.to_thread(_post, f"{server.url}/v1/sessions", {"camera": camera})
    address = f"{server.url.replace('http', 'ws')}/v1/sessions/{begun['session']}"
    found = []
    async with connect(address, ping_interval=None, max_size=None) as socket:
        rows = zip(
            sorted((path / "rgb").iterdir()), sorted((path / "depth").iterdir()), strict=True
        )
        for frame, (colours, depth) in zip(capture, rows, strict=True):
            start = perf_counter()
            await socket.send(json.dumps({
                "image": base64.b64encode(colours.read_bytes()).decode(),
                "depth": base64.b64encode(depth.read_bytes()).decode(),
                "odometry": frame.odometry.tolist(), "gravity": frame.gravity.tolist(),
                "stamp": frame.stamp,
            }))  # fmt: skip
            answer = json.loads(await socket.recv())
            found.append((perf_counter() - start, answer["estimate"]["status"]))
    return found


def _post(url: str, body: dict[str, Any]) -> dict[str, Any]:
    kind = {"Content-Type": "application/json"}
    request = Request(url, json.dumps(body).encode(), kind)  # noqa: S310  # our own server
    with urlopen(request, timeout=60) as answer:  # noqa: S310
        told: dict[str, Any] = json.loads(answer.read())
        return told


def figures(wall: list[float], cpu: list[float], sure: int) -> dict[str, Any]:
    told = {"frames": len(wall), "sure": sure / len(wall), "wall_ms": quantiles(wall)}
    return told | {"cpu_ms": quantiles(cpu), "in_time": sum(s <= 0.1 for s in wall) / len(wall)}


PARTS = ("walks", "paced", "ways", "covariances")
DRIFTS = (0.2, 0.5, 1.0)  # degrees a frame
RATES = (10.0, 30.0)  # images a second
SECONDS = 20.0  # of each
WALKED = (
    Col("", "place"), Col("drift", lambda r: f"{r.degrees:g}°"), Col("frames", "frames"),
    Col("right", "right", lab.share), Col("OK", "sure", lab.share), Col("right of OK", "tracked", 3),
    Col("foretold", "foretold", lab.share), Col("false OK", "false", 3), Col("longest", "longest"),
    Col("found after", lambda r: float(np.median(r.delays)) if r.delays else None, 0),
    Col("most", "most"), Col("CPU ms", "milliseconds", 0), Col("worst", "worst", 0),
)  # fmt: skip
PACED = (
    Col("images", lambda p: f"{p['rate']:g} Hz"),
    Col("looked at", lambda p: (p["images"] - p["dropped"]) / p["seconds"], 1, "Hz"),
    Col("dropped", lambda p: p["dropped"] / p["images"], lab.share),
    Col("odometry", lambda p: p["moves"] / p["seconds"], 0, "Hz"),
    Col("ms a call", "move_ms.p50", 2), Col("99 %", "move_ms.p99", 1), Col("most", "move_ms.most", 1),
    Col("age of poses, ms", "age_ms.p50", 0), Col("95 %", "age_ms.p95", 0), Col("cores", "cores", 2),
)  # fmt: skip
FOLLOWED = (
    Col("", "name"), Col("asked", lambda r: MAPPED[r.mapped]), Col("frames", "frames"),
    Col("`OK`", lambda r: len(r.errors)),
    Col("median", lambda r: 100 * float(np.median(r.errors)) if r.errors else None, 1, "cm"),
    Col("six", "six", 1), Col("axis", "axis", 2),
)  # fmt: skip
WAYS = (
    Col("frames by", "way"), Col("ms, median", "wall_ms.p50", 0), Col("95 %", "wall_ms.p95", 0),
    Col("CPU ms", "cpu_ms.p50", 0), Col("a second", lambda w: 1e3 / w["wall_ms"]["p50"], 1),
    Col("within 100 ms", "in_time", lab.share), Col("OK", "sure", lab.share),
)  # fmt: skip


@lab.table()
def robot_live(
    run: lab.Run,
    seed: lab.Seed = 0,
    only: Annotated[str, lab.option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    *,
    quick: lab.Quick = False,
) -> None:
    """A robot's pose on the way: share right, time to relocalize, latency."""
    wanted = lab.check_names(lab.parts(only) or (["walks"] if quick else []), PARTS, "part")
    places = Places(run.data, run.cache)
    house = places.scene("house")
    record: dict[str, Any] = {"load": os.getloadavg()}
    if "walks" in wanted:
        rows = measure_walks(run, places, seed, DRIFTS[1:2] if quick else DRIFTS)
        lab.show("", WALKED, rows)
        record["walks"] = rows
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "maps").mkdir()
        house.save(folder / "maps/house.scene")
        if "paced" in wanted:
            file = folder / "maps/house.scene"
            every = [
                run_apart(play_walks, run.data, run.cache, file, r, SECONDS, cores=2) for r in RATES
            ]
            lab.show("", PACED, every)
            record["paced"] = every
        if "ways" in wanted:
            paths = sorted((run.data / "house").glob("seq[0-9]*"))
            scene = places.scene("house")
            out = []
            for path in paths:
                with BagWriter(folder / path.name) as writer:
                    write_capture(writer, open_capture(path, labels=None), Layout())
                out.append(folder / path.name)
            found = {
                "folder": from_files(scene, paths),
                "MCAP": from_files(scene, out),
                "WebSocket": from_server(folder / "maps", paths),
            }
            lab.show("", WAYS, [{"way": name} | way for name, way in found.items()])
            record["ways"] = found
    if "covariances" in wanted:
        maps = Maps(run, fresh=False)
        followed = [follow_recording(maps, name, mapped) for name in REAL for mapped in MAPPED]
        lab.show("", FOLLOWED, followed)
        record["covariances"] = followed
    run.save(record, complete=not only)


def measure_walks(run: lab.Run, places: Places, seed: int, drifts: tuple[float, ...]) -> list[Row]:
    """All walks at each drift."""
    rows = []
    for place in ("house", "office"):
        for degrees in drifts:
            seen = []
            for where, recordings in places.recordings(place).items():
                for walk in walks(recordings, degrees, seed):
                    run.log(f"{where}, {degrees} degrees a frame, {len(walk.frames)} frames")
                    seen.append(track_walk(places.scene(where), walk, seed))
            rows.append(Row.of(place, degrees, seen))
    return rows
