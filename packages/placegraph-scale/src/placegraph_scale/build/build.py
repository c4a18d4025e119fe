"""From extracts to a folder of shards: split, build tile after tile, and say what is in them.

All that is half done lies in ``WORLD/.build`` and is taken up again where it was left: a split is whole
when its `split.json` is there, a shard when the journal says so. Only whole shards stand in
``WORLD/shards``; `world.json` comes last.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from placegraph.core import files as locks
from placegraph.core.files import cannot_write, write_file
from placegraph.core.geo import check_zoom
from placegraph.core.threads import processors
from placegraph.errors import InputError, MapError, OptionError
from placegraph.io.osm.osm import checked_osm
from placegraph.io.osm.urls import all_on_disk, is_url, size_of
from placegraph.outdoor.map.cells import LARGEST, SMALLEST
from placegraph_scale.build.journal import Journal, plan_of, told
from placegraph_scale.build.split import Split, split, spread_large
from placegraph_scale.build.tile import TileDone, TileJob, build_tile
from placegraph_scale.build.workers import done
from placegraph_scale.remote import bring
from placegraph_scale.shards import WorldFile, finish
from placegraph_scale.shards.folder import digest_of
from placegraph_scale.shards.table import keep, kept

if TYPE_CHECKING:
    from placegraph_scale.shards.table import Counted

    Progress = Callable[[str, int, int | None], None]


WORK, PLAN, COUNTS, EXTRACTS = ".build", "plan.json", "counts", "extracts"
OVERLAP = 500.0
"""Viewpoints near a rare thing are looked at up to 400 m from it, and things are in sight up to 38 m
from a viewpoint: with this margin [m] a border changes neither."""
ZOOM = 12
"""Tiles of 10 km at the equator and 6 km at 50 degrees: 200,000 things in the densest cities."""


@dataclass(frozen=True)
class BuildOptions:
    """How a world is cut up, and by whom it is built."""

    zoom: int = ZOOM
    """Level of the quadtree: its tiles are the cores of shards."""
    overlap: float = OVERLAP
    """How far shards reach beyond their cores [m]."""
    cell_size: float = 50.0
    """Edge of a cell [m]."""
    stride: float | None = None
    """Distance of neighbouring cells' centres [m]; the cell size where not given."""
    edge_distance: float | None = None
    """Objects of a cell nearer than this are joined [m]; the cell size where not given."""
    vocabulary: Path | None = None
    """Folder with edited vocabulary tables."""
    workers: int | None = None
    """Processes of this machine; one a processor where not given."""
    scheduler: str | None = None
    """Address of a Dask scheduler, whose workers see the same folders."""
    work: Path | None = None
    """Folder of this machine where a world is built that is brought to a URL."""

    @property
    def sizes(self) -> tuple[float, float, float]:
        """Cells, their distance, and how far edges reach [m]."""
        stride = self.cell_size if self.stride is None else self.stride
        edges = self.cell_size if self.edge_distance is None else self.edge_distance
        return self.cell_size, stride, edges

    def check(self) -> None:
        """Raise `OptionError` where something is out of its range."""
        check_zoom(self.zoom)
        if not 0.0 <= self.overlap <= LARGEST:
            raise OptionError(f"overlap is {self.overlap} m; choose between 0 and 10,000 m.")
        if not all(SMALLEST <= size <= LARGEST for size in self.sizes):
            raise OptionError(f"sizes of cells are {self.sizes} m; choose between 1 and 10,000 m.")
        if self.workers is not None and self.workers < 1:
            raise OptionError(f"workers is {self.workers}; give at least 1.")


def build_world(
    extracts: Sequence[str | PathLike[str]],
    folder: str | PathLike[str],
    options: BuildOptions | None = None,
    progress: Progress | None = None,
) -> WorldFile:
    """Build a folder of shards from OpenStreetMap extracts of any size.

    Begun, killed and called again with the same arguments, it goes on where it stopped; the bytes of
    the shards depend neither on that nor on how many workers there are.

    Parameters
    ----------
    extracts
        Files in the formats of `build_city`, or URLs of such; where they overlap, things are taken
        once. What lies at a URL is fetched to ``WORLD/.build/extracts`` and stays there.
    folder
        Is made where it is missing. A URL that fsspec knows takes `BuildOptions.work`.
    options
        See `BuildOptions`.
    progress
        Is told the step, how much of it is done, and of how much.

    Raises
    ------
    InputError
        An extract is missing, cannot be read, changed meanwhile, or none holds anything worth naming.
    MapError
        The folder cannot be written, as on a full disk; what is half done in it is damaged; or a
        worker was killed again and again.
    MapLockedError
        Somebody else is building there.
    MissingExtraError, ServiceError
        Dask, or what a URL takes, is not installed; the scheduler or a URL does not answer, or the
        former is of another version.
    OptionError
        An option is out of its range, or another build was begun in this folder.

    """
    options = options or BuildOptions()
    options.check()
    if is_url(folder):
        if options.work is None:
            raise OptionError(
                f"{folder} is a URL: name a folder of this machine (work) to build in."
            )
        here = replace(options, work=None)
        return bring(build_world(extracts, options.work, here, progress), str(folder), progress)
    if options.work is not None:
        raise OptionError("work: it is of worlds that are brought to a URL; leave it out.")
    tell = progress or (lambda _step, _done, _total: None)
    target = Path(folder)
    work = target / WORK
    if not extracts:
        raise OptionError("No extract is given; name at least one.")
    for path in extracts:  # before anything is made
        _ = size_of(str(path)) if is_url(path) else checked_osm(Path(path))
    try:
        (target / "shards").mkdir(parents=True, exist_ok=True)
        work.mkdir(exist_ok=True)
        with locks.exclusive(work / "journal.jsonl"):
            build = _Build(target, options, tell)
            build.begin(all_on_disk(extracts, work / EXTRACTS, tell))
            build.split()
            build.tiles()
            tell("counting words", 0, None)
            made = finish(target, options.zoom, options.overlap, build.each)
            build.clear()
    except OSError as error:
        raise cannot_write(Path(error.filename or work), error) from error
    return made


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
    said = None if tell is None else lambda step, n: tell(step, n, None)
    split(Path(job.path), folder, options.zoom, options.overlap, words, said)


class _Build:
    """One build in its folder, step after step."""

    def __init__(self, target: Path, options: BuildOptions, tell: Progress) -> None:
        self.target, self.options, self.tell = target, options, tell
        self.work, self.extracts = target / WORK, [Path()]
        self.journal = Journal(self.work / "journal.jsonl")
        self.workers = options.workers or processors()

    def begin(self, extracts: list[Path]) -> None:
        """Take up the build that was begun here, if it is the same."""
        self.extracts = sorted(extracts)
        plan, path = plan_of(self.extracts, self.options), self.work / PLAN
        if path.exists():
            known = told(path)
            for what in plan:
                if known.get(what) != plan[what]:
                    raise OptionError(
                        f"{self.target} was begun with other {what}; build with the same, into another "
                        f"folder, or remove {self.target} to begin anew."
                    )
        elif (self.target / "world.json").exists():
            raise OptionError(
                f"{self.target} holds a world already; build into another folder, or remove it."
            )
        else:  # what was built by another plan is none of ours
            for shard in (self.target / "shards").glob("*.city"):
                shard.unlink()
            write_file(path, [json.dumps(plan, indent=1).encode()])
        self.journal.read()

    def split(self) -> None:
        """Split the extracts that are not, unless what is left to be built lies there."""
        if (self.work / "tiles.json").exists() and all(job.lies_there for job in self._missing()):
            return
        todo = [
            _SplitJob(str(path), str(folder), self.options)
            for path, folder in zip(self.extracts, self._folders("things"), strict=True)
            if (begun := Split.read_in(folder)) is None or not begun.whole
        ]
        if todo:  # what touches many tiles is shared out anew as well
            (self.work / "tiles.json").unlink(missing_ok=True)
        if len(todo) == 1 or self.workers == 1:
            for job in todo:
                _split(job, self.tell)
        else:
            with closing(done(_split, todo, self.workers)) as parts:
                for n, _ in enumerate(parts, 1):
                    self.tell("splitting extracts", n, len(todo))

    def each(self, work: Callable[[Path], Counted], paths: list[Path]) -> Iterator[Counted]:
        """Words of all shards, in their order: as kept when they were built, else counted by `work`."""
        lost = [path for path in paths if not self._counts(path.stem).exists()]
        for n, counted in done(work, lost, self.workers, self.options.scheduler):
            keep(counted, self._counts(lost[n].stem), digest_of(lost[n]))
        for path in paths:
            yield kept(self._counts(path.stem), digest_of(path)) or work(path)

    def tiles(self) -> None:
        """Build the shards that are missing, each as soon as a worker is free."""
        (self.work / COUNTS).mkdir(exist_ok=True)
        jobs = self._missing() if (self.work / "tiles.json").exists() else self._spread()
        total = len(jobs)
        with closing(done(build_tile, jobs, self.workers, self.options.scheduler)) as built:
            for n, (row, made) in enumerate(built, 1):
                self.journal.add(made)
                for path, _ in jobs[row].things:
                    Path(path).unlink(missing_ok=True)
                self.tell("building tiles", n, total)
        if not any(made.digest for made in self.journal.done.values()):
            raise InputError(f"{self.extracts[0]} holds no two things that stand near each other.")

    def clear(self) -> None:
        """Remove what is of no more use: a journal and a plan are left, and take no room."""
        for folder in (*self._folders("things"), *self._folders("large"), self.work / COUNTS):
            shutil.rmtree(folder, ignore_errors=True)

    def _counts(self, key: str) -> Path:
        return self.work / COUNTS / key

    def _folders(self, name: str) -> list[Path]:
        return [self.work / f"{name}-{n}" for n in range(len(self.extracts))]

    def _spread(self) -> list[TileJob]:
        """Jobs of all tiles, once what touches many of them is spread over those that hold more."""
        self.tell("sharing out what is large", 0, None)
        splits = [Split.read_in(folder) for folder in self._folders("things")]
        populated = sorted({key for s in splits if s for key in s.populated})
        files: dict[str, list[tuple[str, int]]] = {key: [] for key in populated}
        for found, things, large in zip(
            splits, self._folders("things"), self._folders("large"), strict=True
        ):
            if found is None or not found.whole:
                raise MapError(f"{things} has gone; run the same command again.")
            shutil.rmtree(large, ignore_errors=True)
            large.mkdir()
            sizes = spread_large(things, large, found.sizes, populated, self.options.overlap)
            for folder, its in ((things, found.sizes), (large, sizes)):
                for key in its.keys() & files.keys():
                    files[key].append((str(folder / f"{key}.things"), its[key]))
        write_file(self.work / "tiles.json", [json.dumps(files, sort_keys=True).encode()])
        return self._missing()

    def _missing(self) -> list[TileJob]:
        """Jobs of the tiles whose shard is not there as the journal has it, by key."""
        source = ", ".join(path.name for path in self.extracts)
        jobs = []
        for key, things in sorted(told(self.work / "tiles.json").items()):
            out = self.target / "shards" / f"{key}.city"
            built: TileDone | None = self.journal.done.get(key)
            if built is None or not built.stands(out):
                named = tuple((path, size) for path, size in things)
                margin, sizes = self.options.overlap, self.options.sizes
                counts = str(self._counts(key))
                jobs.append(TileJob(key, named, str(out), margin, sizes, source, counts))
        return jobs
