"""Process that uses one mutated input after the other, and may die from it.

    python -m placegraph_lab.campaign.worker FOLDER SEED [LAYOUTS]

Reads lines `NAME FIRST COUNT` from stdin, and writes a line of JSON for each input. Number and seed
alone determine an input, so that it can be drawn again.
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
from placegraph_lab.campaign.targets import Target, find_targets
from placegraph_lab.campaign.uses import Bench

ROOM = 1 << 30  # Bytes that an input may allocate; beyond, memory is refused
SECONDS = 10.0  # CPU time of an input
WARM_UPS = 8  # uses of each seed before the trials, so that all kernels are compiled
TIMES, FREE = 10, 300 << 20  # an input may take `TIMES` its own bytes, and `FREE` more


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one input."""

    number: int
    outcome: str  # one of `row.OUTCOMES`
    reason: str  # kind of the error and where it was raised, or nothing
    bytes: int  # memory that it took
    seconds: float


class Trials:
    """Inputs of one target, drawn and used in turn."""

    def __init__(self, target: Target, folder: Path, seed: int, bench: Bench) -> None:
        self.target, self.bench, self.seed = target, bench, seed
        self.folder = folder / "trial"
        self.seeds = target.write_seeds(
            folder / "seeds" / ("".join(c if c.isalnum() else "_" for c in target.name)), bench
        )

    def rng(self, number: int) -> Generator:
        """Return the generator of an input."""
        return np.random.default_rng([self.seed, zlib.crc32(self.target.name.encode()), number])

    def warm(self) -> list[str]:
        """Use all seeds unchanged some times; return why a seed was always refused, if any was."""
        return [reason for path in self.seeds if (reason := self._why_refused(path))]

    def _why_refused(self, path: Path) -> str:
        reason, accepted = "", 0
        for k in range(WARM_UPS):
            try:
                self.target.use(self.bench, path, np.random.default_rng(k))
            except PlacegraphError as error:
                reason = reason or f"{path.name}: {_where(error)}: {error}"
                continue
            except SystemExit:
                pass
            except Exception as error:  # noqa: BLE001  # is reported
                return f"{path.name}: {_where(error)}: {error}"
            accepted += 1
        return "" if accepted else reason

    def draw(self, number: int) -> tuple[Path, Generator]:
        """Write an input; return it and the generator for its use."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        rng = self.rng(number)
        seed = self.seeds[rng.integers(len(self.seeds))]
        place = self.folder / seed.name
        copy = shutil.copytree if seed.is_dir() else shutil.copyfile
        copy(seed, place)
        self.target.mutate(place, rng)
        return place, rng

    def run(self, number: int) -> Outcome:
        """Draw an input and use it; again where it took much memory, which a first import may do."""
        found, bound = self._run_once(number)
        if found.bytes > bound:
            found, bound = self._run_once(number)
        if found.bytes > bound and found.outcome in {"accepted", "typed"}:
            reason = f"{found.bytes >> 20} MB; {bound >> 20} MB are allowed"
            return replace(found, outcome="memory", reason=reason)
        return found

    def _run_once(self, number: int) -> tuple[Outcome, int]:
        """Return the outcome of an input, and the bytes that it may take."""
        place, rng = self.draw(number)
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        bound, before = TIMES * _size(place) + FREE, _status("VmRSS:")
        start = perf_counter()
        reason, outcome = "", "accepted"
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            with listen_to_compilation(_pause):
                self.target.use(self.bench, place, rng)
        except PlacegraphError as error:
            outcome, reason = "typed", type(error).__name__
        except SystemExit as end:
            outcome = "typed" if end.code else "accepted"
        except MemoryError as error:
            outcome, reason = "memory", _where(error)
        except Exception as error:  # noqa: BLE001  # is counted
            outcome, reason = "untyped", f"{_where(error)}: {error}"[:300]
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        took = _status("VmHWM:") - before
        return Outcome(number, outcome, reason, took, perf_counter() - start), bound


def _pause(_kernel: str, done: bool) -> None:
    """Stop the clock while a kernel is compiled."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS if done else 0.0)


def _where(error: BaseException) -> str:
    """Return the kind of an error, and the innermost line of placegraph."""
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if "src/placegraph/" in f.filename
    ]
    line = (
        f"{frames[-1].filename.rpartition('src/placegraph/')[2]}:{frames[-1].lineno}"
        if frames
        else "?"
    )
    return f"{type(error).__name__} at {line}"


def _size(place: Path) -> int:
    if not place.is_dir():
        return place.stat().st_size
    return sum(p.stat().st_size for p in place.rglob("*") if p.is_file() and not p.is_symlink())


def _status(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1]) << 10
    return 0


def _limit_memory(room: int | None) -> None:
    """Let the address space grow by `room` bytes, or without limit."""
    most = resource.RLIM_INFINITY if room is None else _status("VmSize:") + room
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def answer_requests(folder: Path, seed: int, layouts: Path | None) -> Iterator[dict[str, object]]:
    """Yield the answers to the lines of stdin."""
    bench, targets = Bench(folder), find_targets(layouts)
    known: dict[str, Trials] = {}
    for line in sys.stdin:
        name, first, count = line.strip().split("\t")
        _limit_memory(None)
        refused = []
        if name not in known:
            try:
                known[name] = Trials(targets[name], folder, seed, bench)
            except BaseException as error:  # noqa: BLE001  # pytest's skip is one
                yield {"seeds": 0, "refused": [f"cannot be drawn: {error!r}"]}
                continue
            refused = known[name].warm()
        yield {"seeds": len(known[name].seeds), "refused": refused}
        _limit_memory(ROOM)
        for number in range(int(first), int(first) + int(count)):
            yield asdict(known[name].run(number))
        yield {"done": name}


def main() -> None:
    """Answer stdin on the former stdout; drop all other output."""
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
        layouts = Path(sys.argv[3]) if sys.argv[3:] else None
        for answer in answer_requests(Path(sys.argv[1]), int(sys.argv[2]), layouts):
            out.write(json.dumps(answer) + "\n")
            out.flush()
    except BaseException:
        traceback.print_exc(file=log)
        raise


if __name__ == "__main__":
    main()
