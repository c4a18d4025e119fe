"""Builds of worlds in shards: split extracts, build tile after tile, and count words.

All that is half done lies in ``WORLD/.build``, and a build resumes there: a split is complete when its
`split.json` is there, a shard when the journal says so. Only complete shards stand in ``WORLD/shards``;
`world.json` comes last.

A task is a function and one argument, both of which can be sent to other processes; it writes its files
in one step, so that it can be done again wherever its worker was killed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from itertools import islice
from multiprocessing import get_context
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from placegraph.core.files import lock_file, write_error, write_file
from placegraph.core.threads import count_processors, end_with_parent
from placegraph.errors import InputError, MapError, OptionError, ServiceError
from placegraph.io.osm.osm import check_osm
from placegraph.io.osm.urls import fetch_all, is_url, remote_size
from placegraph_scale.folder import SHARDS, WorldFile, bring, digest_of
from placegraph_scale.options import BuildOptions
from placegraph_scale.shards.words import WordCounts, finish
from placegraph_scale.shards.workers import connect
from placegraph_scale.tiles import (
    Split,
    TileDone,
    TileJob,
    build_tile,
    no_room,
    split,
    spread_large,
)

Progress = Callable[[str, int, "int | None"], None]
Task = TypeVar("Task")
Made = TypeVar("Made")

TRIES = 3
"""A task is given up when so many of its workers were killed."""
WORK, PLAN, COUNTS, EXTRACTS = ".build", "plan.json", "counts", "extracts"


def build_world(
    extracts: Sequence[str | PathLike[str]],
    folder: str | PathLike[str],
    options: BuildOptions | None = None,
    progress: Progress | None = None,
) -> WorldFile:
    """Build a folder of shards from OpenStreetMap extracts of any size.

    Interrupted and called again with the same arguments, a build resumes; the bytes of the shards depend
    neither on that nor on the number of workers.

    Raises `InputError`: an extract is missing, cannot be read, changed meanwhile, or none holds
    anything worth naming; `MapError`: the folder cannot be written, as on a full disk; what is half
    done in it is damaged; or a worker was killed again and again; `MapLockedError`: somebody else
    is building there; `MissingExtraError` or `ServiceError`: Dask, or what a URL takes, is not
    installed; the scheduler or a URL does not answer, or the former is of another version;
    `OptionError`: an option is out of its range, or another build was begun in this folder.

    `extracts`: files in the formats of `build_city`, or URLs of such; where they overlap, objects
        are taken once. What lies at a URL is fetched to ``WORLD/.build/extracts`` and stays there.
    `folder`: is made where it is missing. A URL that fsspec knows takes `BuildOptions.work`.
    `options`: see `BuildOptions`.
    `progress`: is told the step, how much of it is done, and of how much.
    """
    options = options or BuildOptions()
    if is_url(folder):
        if options.work is None:
            raise OptionError(f"{folder} is a URL; name a local folder for the build (work).")
        here = replace(options, work=None)
        return bring(build_world(extracts, options.work, here, progress), str(folder), progress)
    if options.work is not None:
        raise OptionError("work: it applies only to worlds written to a URL; remove it.")
    tell = progress or (lambda _step, _done, _total: None)
    target = Path(folder)
    work = target / WORK
    if not extracts:
        raise OptionError("No extract is given; name at least one.")
    for path in extracts:  # before anything is made
        _ = remote_size(str(path)) if is_url(path) else check_osm(Path(path))
    try:
        (target / SHARDS).mkdir(parents=True, exist_ok=True)
        work.mkdir(exist_ok=True)
        with lock_file(work / "journal.jsonl"):
            build = _Build(target, options, tell)
            build.resume(fetch_all(extracts, work / EXTRACTS, tell))
            build.split()
            build.tiles()
            tell("counting words", 0, None)
            made = finish(target, options.zoom, options.overlap, build.count)
            build.clear()
    except OSError as error:
        raise write_error(Path(error.filename or work), error) from error
    return made


class _Build:
    """One build in its folder, step after step."""

    def __init__(self, target: Path, options: BuildOptions, tell: Progress) -> None:
        self.target, self.options, self.tell = target, options, tell
        self.work, self.extracts = target / WORK, [Path()]
        self.journal = Journal(self.work / "journal.jsonl")
        self.workers = options.workers or count_processors()

    def resume(self, extracts: list[Path]) -> None:
        """Resume the build that was begun here, if it is the same."""
        self.extracts = sorted(extracts)
        plan, path = _plan(self.extracts, self.options), self.work / PLAN
        if path.exists():
            known = _read_json(path)
            for what in plan:
                if known.get(what) != plan[what]:
                    raise OptionError(
                        f"{self.target} was started with different {what}; use the same, "
                        f"choose another folder, or remove {self.target} to start again."
                    )
        elif (self.target / "world.json").exists():
            raise OptionError(
                f"{self.target} already contains a world; choose another folder, or remove it."
            )
        else:  # shards built by another plan do not belong to this build
            for shard in (self.target / SHARDS).glob("*.city"):
                shard.unlink()
            write_file(path, [json.dumps(plan, indent=1).encode()])
        self.journal.read()

    def split(self) -> None:
        """Split the extracts that are not split, unless all that is left to be built lies there."""
        if (self.work / "tiles.json").exists() and all(job.is_ready for job in self._missing()):
            return
        todo = [
            _SplitJob(str(path), str(folder), self.options)
            for path, folder in zip(self.extracts, self._folders("things"), strict=True)
            if (begun := Split.load(folder)) is None or not begun.complete
        ]
        if todo:  # what touches many tiles is shared out anew as well
            (self.work / "tiles.json").unlink(missing_ok=True)
        if len(todo) == 1 or self.workers == 1:
            for job in todo:
                _split(job, self.tell)
        else:
            with closing(run_tasks(_split, todo, self.workers)) as parts:
                for n, _ in enumerate(parts, 1):
                    self.tell("splitting extracts", n, len(todo))

    def tiles(self) -> None:
        """Build the shards that are missing, each as soon as a worker is free."""
        (self.work / COUNTS).mkdir(exist_ok=True)
        if not (self.work / "tiles.json").exists():
            self._spread()
        jobs = self._missing()
        with closing(run_tasks(build_tile, jobs, self.workers, self.options.scheduler)) as built:
            for n, (row, made) in enumerate(built, 1):
                self.journal.add(made)
                for path, _ in jobs[row].objects:
                    Path(path).unlink(missing_ok=True)
                self.tell("building tiles", n, len(jobs))
        if not any(made.digest for made in self.journal.done.values()):
            raise InputError(
                f"{self.extracts[0]} contains no two objects near each other; use a larger extract."
            )

    def count(self, work: Callable[[Path], WordCounts], paths: list[Path]) -> Iterator[WordCounts]:
        """Yield the words of all shards, in their order: as saved when built, else counted by `work`."""
        lost = [path for path in paths if not self._counts(path.stem).exists()]
        for n, found in run_tasks(work, lost, self.workers, self.options.scheduler):
            found.save(self._counts(lost[n].stem), digest_of(lost[n]))
        for path in paths:
            yield WordCounts.load(self._counts(path.stem), digest_of(path)) or work(path)

    def clear(self) -> None:
        """Remove what is of no more use: a journal and a plan are left, and take no room."""
        for folder in (*self._folders("things"), *self._folders("large"), self.work / COUNTS):
            shutil.rmtree(folder, ignore_errors=True)

    def _counts(self, key: str) -> Path:
        return self.work / COUNTS / key

    def _folders(self, name: str) -> list[Path]:
        return [self.work / f"{name}-{n}" for n in range(len(self.extracts))]

    def _spread(self) -> None:
        """Spread what touches many tiles over those that hold more, and list the files of each tile."""
        self.tell("partitioning large files", 0, None)
        splits = [Split.load(folder) for folder in self._folders("things")]
        populated = sorted({key for s in splits if s for key in s.populated})
        files: dict[str, list[tuple[str, int]]] = {key: [] for key in populated}
        for found, things, large in zip(
            splits, self._folders("things"), self._folders("large"), strict=True
        ):
            if found is None or not found.complete:
                raise MapError(f"{things} is missing; run the same command again.")
            shutil.rmtree(large, ignore_errors=True)
            large.mkdir()
            sizes = spread_large(things, large, found.sizes, populated, self.options.overlap)
            for folder, its in ((things, found.sizes), (large, sizes)):
                for key in its.keys() & files.keys():
                    files[key].append((str(folder / f"{key}.things"), its[key]))
        write_file(self.work / "tiles.json", [json.dumps(files, sort_keys=True).encode()])

    def _missing(self) -> list[TileJob]:
        """Return jobs of the tiles whose shard is not there as the journal has it, by key."""
        source, options = ", ".join(path.name for path in self.extracts), self.options
        jobs = []
        for key, things in sorted(_read_json(self.work / "tiles.json").items()):
            out, built = self.target / SHARDS / f"{key}.city", self.journal.done.get(key)
            if built is None or not built.stands(out):
                named = tuple((path, size) for path, size in things)
                counts = str(self._counts(key))
                jobs.append(
                    TileJob(key, named, str(out), options.overlap, options.sizes, source, counts)
                )
        return jobs


@dataclass(frozen=True)
class _SplitJob:
    """An extract to be split, in a folder of its own."""

    path: str
    folder: str
    options: BuildOptions


def _split(job: _SplitJob, tell: Progress | None = None) -> None:
    from placegraph.outdoor.language.vocabulary import Vocabulary

    folder, options = Path(job.folder), job.options
    folder.mkdir(exist_ok=True)
    words = Vocabulary.load(options.vocabulary) if options.vocabulary else None
    progress = None if tell is None else lambda step, n: tell(step, n, None)
    split(Path(job.path), folder, options.zoom, options.overlap, words, progress)


def _read_json(path: Path) -> dict[str, Any]:
    """Read a file of a build; raises `MapError` where it is damaged."""
    try:
        found = json.loads(path.read_bytes())
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise MapError(f"{path} is damaged; remove {path.parent}, and run the same command again.")
    return found


def _plan(extracts: Iterable[Path], options: BuildOptions) -> dict[str, Any]:
    """Return the inputs of a build; if one changes, it is another build."""
    known = asdict(options)
    for name in ("workers", "scheduler", "vocabulary", "work"):
        del known[name]
    words, files = hashlib.sha256(), []
    if options.vocabulary is not None:
        for path in sorted(options.vocabulary.iterdir()):
            words.update(path.name.encode() + path.read_bytes())
    for path in extracts:
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_SEQUENTIAL)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        files.append([path.name, path.stat().st_size, digest])
    return {"extracts": files, "options": known, "vocabulary": words.hexdigest()}


class Journal:
    """Tiles that are finished: a line a tile, on disk before the next one counts."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.done: dict[str, TileDone] = {}
        """By key."""

    def read(self) -> None:
        """Read the file; a last line that was cut off is taken away."""
        if not self.path.exists():
            return
        whole = 0
        with self.path.open("rb+") as file:
            for line in file:
                try:
                    made = TileDone(**json.loads(line))
                except (ValueError, TypeError):
                    break
                self.done[made.key] = made
                whole += len(line)
            file.truncate(whole)

    def add(self, made: TileDone) -> None:
        """Write down that a tile is finished; raises `MapError` where the disk is full."""
        line = json.dumps(asdict(made)).encode() + b"\n"
        try:
            with self.path.open("ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise no_room(self.path, error) from error
        self.done[made.key] = made


def run_tasks(
    work: Callable[[Task], Made], tasks: Sequence[Task], workers: int, scheduler: str | None = None
) -> Generator[tuple[int, Made]]:
    """Yield numbers and results of all tasks, in the order in which they are done; close it if left.

    Raises `MissingExtraError`: dask is wanted, and not installed; `MapError`: a task's worker was
    killed again and again; `OptionError`: `workers` is less than 1; `ServiceError`: the scheduler
    does not answer, or is of another version.

    `work`: function of a module, so that other processes find it.
    `tasks`: its arguments, once each; again where a worker was killed.
    `workers`: processes of this machine; 1: this one itself.
    `scheduler`: address of a Dask scheduler (``tcp://host:port``), whose workers do it instead.
    """
    if workers < 1:
        raise OptionError(f"workers is {workers}; give at least 1.")
    if scheduler is not None:
        return _run_on_cluster(work, tasks, scheduler)
    if workers == 1 or len(tasks) < 2:
        return (pair for pair in enumerate(map(work, tasks)))
    return _run_in_processes(work, tasks, workers)


def _run_in_processes(
    work: Callable[[Task], Made], tasks: Sequence[Task], workers: int
) -> Generator[tuple[int, Made]]:
    """Yield results from processes of this machine; new ones replace those that were killed."""
    left, killed = dict(enumerate(tasks)), 0
    while left:
        before = len(left)
        try:
            with ProcessPoolExecutor(workers, get_context("spawn"), end_with_parent) as pool:
                try:
                    # few wait in the pool at a time, so that the first that fails ends it
                    rest = iter(list(left.items()))
                    waiting = {pool.submit(work, t): n for n, t in islice(rest, 2 * workers)}
                    while waiting:
                        for future in wait(waiting, return_when=FIRST_COMPLETED)[0]:
                            number = waiting.pop(future)
                            for n, task in islice(rest, 1):
                                waiting[pool.submit(work, task)] = n
                            result = future.result()
                            del left[number]
                            yield number, result
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise
        except BrokenProcessPool as error:
            killed = killed + 1 if len(left) == before else 1
            if killed == TRIES:
                raise _killed(next(iter(left.values())), "Use fewer --workers") from error


def _run_on_cluster(
    work: Callable[[Task], Made], tasks: Sequence[Task], scheduler: str
) -> Generator[tuple[int, Made]]:
    """Yield results from the workers of a Dask scheduler, which gives a killed one's tasks to others."""
    client = connect(scheduler)
    distributed: Any = import_module("distributed")  # parts of it have no types

    try:
        rest = iter(enumerate(tasks))
        running, numbers = distributed.as_completed(loop=client.loop), {}

        def start(most: int) -> None:
            for n, task in islice(rest, most):
                future = client.submit(work, task, pure=False)
                numbers[future.key] = n
                running.add(future)

        start(4 * max(1, len(client.scheduler_info(n_workers=-1)["workers"])))
        for future in running:
            try:
                result = future.result()
            except distributed.scheduler.KilledWorker as error:
                raise _killed(future.key, "Give workers more memory") from error
            except (distributed.CancelledError, distributed.comm.CommClosedError) as error:
                raise ServiceError(
                    f"The connection to the scheduler was lost ({error}); start it and run "
                    "the same command again, which resumes the build."
                ) from error
            start(1)
            yield numbers.pop(future.key), result
    finally:
        client.close()


def _killed(task: object, advice: str) -> MapError:
    key = getattr(task, "key", task)
    return MapError(
        f"{key}, or a task of the same worker: the worker was killed {TRIES} times, probably for "
        f"lack of memory. {advice}, or choose a higher --zoom (smaller tiles); finished parts are "
        "kept."
    )
