"""A process that takes one mutated input after the other, and may die of it.

    python -m placegraph_lab.campaign.worker FOLDER SEED

Reads lines `NAME FIRST COUNT` from stdin; of each input that it has taken it writes a line of JSON.
An input is told by its number and the seed alone, so that it can be drawn again.
"""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import shutil
import signal
import sys
import traceback
import warnings
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.random import Generator

from placegraph.core.cache import listen_to_compilation
from placegraph.errors import PlacegraphError
from placegraph_lab.campaign.targets import TARGETS, Target
from placegraph_lab.campaign.uses import Bench

ROOM = 1 << 30
"""Bytes that an input may take beyond what the process has already; beyond, memory is refused."""
SECONDS = 10.0  # CPU time of an input
TRIES = 8  # how often each seed is used as it is, so that all that is used by chance is compiled
TIMES, FREE = 10, 300 << 20  # an input takes at most so many times its own bytes, and these


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an input."""

    number: int
    outcome: str  # one of `row.OUTCOMES`
    said: str  # kind of the error and where it was raised, or nothing
    bytes: int  # memory that it took
    seconds: float


class Trials:
    """Inputs of one target, drawn and used one after the other."""

    def __init__(self, target: Target, folder: Path, seed: int, bench: Bench) -> None:
        self.target, self.bench, self.seed = target, bench, seed
        self.folder = folder / "trial"
        self.seeds = target.drawn(
            folder / "seeds" / ("".join(c if c.isalnum() else "_" for c in target.name)), bench
        )

    def rng(self, number: int) -> Generator:
        """Of an input's number."""
        return np.random.default_rng([self.seed, zlib.crc32(self.target.name.encode()), number])

    def warm(self) -> list[str]:
        """Use all seeds as they are, some times; those that are never taken, which none should be."""
        told = [self._refused(path) for path in self.seeds]
        return [said for said in told if said]

    def _refused(self, path: Path) -> str:
        said, taken = "", 0
        for k in range(TRIES):
            try:
                self.target.use(self.bench, path, np.random.default_rng(k))
            except PlacegraphError as error:
                said = said or f"{path.name}: {_where(error)}: {error}"
                continue
            except SystemExit:
                pass
            except Exception as error:  # noqa: BLE001  # is told
                return f"{path.name}: {_where(error)}: {error}"
            taken += 1
        return "" if taken else said

    def draw(self, number: int) -> tuple[Path, Generator]:
        """Write an input, and what chance it is used by."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        rng = self.rng(number)
        seed = self.seeds[rng.integers(len(self.seeds))]
        place = self.folder / seed.name
        copy = shutil.copytree if seed.is_dir() else shutil.copyfile
        copy(seed, place)
        self.target.spoil(place, rng)
        return place, rng

    def take(self, number: int) -> Outcome:
        """Draw an input and use it; once more where it took much, which may have been a library's start."""
        found, bound = self._take(number)
        if found.bytes > bound:
            found, bound = self._take(number)
        if found.bytes > bound and found.outcome in {"accepted", "typed"}:
            said = f"{found.bytes >> 20} MB, where {bound >> 20} MB are allowed"
            return replace(found, outcome="memory", said=said)
        return found

    def _take(self, number: int) -> tuple[Outcome, int]:
        """What became of an input, and how many bytes it may take."""
        place, rng = self.draw(number)
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        bound, before = TIMES * _size(place) + FREE, _status("VmRSS:")
        start = perf_counter()
        said, outcome = "", "accepted"
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            with listen_to_compilation(_pause):
                self.target.use(self.bench, place, rng)
        except PlacegraphError as error:
            outcome, said = "typed", type(error).__name__
        except SystemExit as end:
            outcome = "typed" if end.code else "accepted"
        except MemoryError as error:
            outcome, said = "memory", _where(error)
        except Exception as error:  # noqa: BLE001  # is counted
            outcome, said = "untyped", f"{_where(error)}: {error}"[:300]
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        took = (_status("VmHWM:")) - before
        return Outcome(number, outcome, said, took, perf_counter() - start), bound


def _pause(_kernel: str, done: bool) -> None:
    """Compiling, which is done once, is not an input's time."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS if done else 0.0)


def _where(error: BaseException) -> str:
    """Kind of an error, and the innermost line of ours."""
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if "src/placegraph/" in f.filename
    ]
    at = (
        f"{frames[-1].filename.rpartition('src/placegraph/')[2]}:{frames[-1].lineno}"
        if frames
        else "?"
    )
    return f"{type(error).__name__} at {at}"


def _size(place: Path) -> int:
    if not place.is_dir():
        return place.stat().st_size
    return sum(p.stat().st_size for p in place.rglob("*") if p.is_file() and not p.is_symlink())


def _status(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1]) << 10
    return 0


def _limited(room: int | None) -> None:
    """Let the address space grow by so many bytes, or without end."""
    most = resource.RLIM_INFINITY if room is None else _status("VmSize:") + room
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def lines(folder: Path, seed: int) -> Iterator[dict[str, object]]:
    """What is to be told of what stdin asks for."""
    bench = Bench(folder)
    known: dict[str, Trials] = {}
    for line in sys.stdin:
        name, first, count = line.strip().split("\t")
        _limited(None)
        refused = []
        if name not in known:
            try:
                known[name] = Trials(TARGETS[name], folder, seed, bench)
            except BaseException as error:  # noqa: BLE001  # a test's writer skips by one of its own
                yield {"seeds": 0, "refused": [f"cannot be drawn: {error!r}"]}
                continue
            refused = known[name].warm()
        yield {"seeds": len(known[name].seeds), "refused": refused}
        _limited(ROOM)
        for number in range(int(first), int(first) + int(count)):
            yield asdict(known[name].take(number))
        yield {"done": name}


def main() -> None:
    """Answer stdin on what was stdout; all else that is printed goes nowhere."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    log = Path(sys.argv[1], "died.log").open("w", encoding="utf-8")  # noqa: SIM115  # is kept open
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    faulthandler.enable(log)
    faulthandler.register(signal.SIGPROF, log, chain=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    try:
        for told in lines(Path(sys.argv[1]), int(sys.argv[2])):
            out.write(json.dumps(told) + "\n")
            out.flush()
    except BaseException:
        traceback.print_exc(file=log)
        raise


if __name__ == "__main__":
    main()
