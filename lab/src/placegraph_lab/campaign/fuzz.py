"""Every reader and every endpoint under mutated inputs: accepted, refused by name, or broken.

A worker takes inputs until it dies; what killed it is counted, and another goes on behind it.
"""

from __future__ import annotations

import json
import os
import re
import select
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from placegraph_lab.campaign.row import FAULTS, Effort, Row
from placegraph_lab.campaign.targets import TARGETS

PATIENCE = 240.0  # wall time in which a worker says something; it is killed then [s]
BUSY = 1.0
"""CPU time in this by which a worker is waited for on; more than 10 s end it by themselves [s]."""
STARTING = 900.0  # the same of a worker that draws seeds and compiles [s]
PROGRAM = ("-m", "placegraph_lab.campaign.worker")
BATCH = 20  # inputs that a worker is asked for at a time
LEAST, A_MINUTE = 1000, 40
"""A target ends at so many inputs, or at so many for each minute of all: what it leaves of its time is
for those behind it, which are slow."""


@dataclass
class Tally:
    """What became of the inputs of one target."""

    counts: Counter[str] = field(default_factory=Counter)
    found: dict[str, list[int]] = field(default_factory=dict)
    """Numbers of the inputs that broke something, by what they broke."""
    said: dict[str, str] = field(default_factory=dict)  # the message of the first of them
    refused: list[str] = field(default_factory=list)  # seeds that are not taken as they are
    seconds: float = 0.0
    most: int = 0  # most memory that an input took [bytes]

    @property
    def tried(self) -> int:
        """Inputs so far; the next one's number."""
        return self.counts.total()

    def add(self, outcome: str, said: str, took: int = 0) -> None:
        """Count an input."""
        if outcome in FAULTS:
            where, _, why = said.partition(": ")
            self.found.setdefault(f"{outcome}: {where}", []).append(self.tried)
            self.said.setdefault(f"{outcome}: {where}", why)
        self.counts[outcome] += 1
        self.most = max(self.most, took)


class Keeper:
    """Keeps one worker at work; another takes its place where it dies."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        self._process: subprocess.Popen[bytes] | None = None
        self._heard = b""

    def run(self, name: str, seconds: float, most: int, tally: Tally) -> None:
        """Try inputs of a target for so long, or so many."""
        start = perf_counter()
        while tally.tried < most and (perf_counter() - start < seconds or not tally.tried):
            self._ask(f"{name}\t{tally.tried}\t{min(BATCH, most - tally.tried)}\n")
            told = self._hear(STARTING)
            if told is None:
                tally.refused = [f"the worker died of them: {self._died()}"]
                break
            tally.refused = told["refused"] or tally.refused
            if not told["seeds"]:
                break
            while (told := self._hear(PATIENCE)) and "done" not in told:
                tally.add(told["outcome"], told["said"], told["bytes"])
            if told is None:
                tally.add(*self._died())
        tally.seconds += perf_counter() - start

    def end(self) -> None:
        """Let the worker go."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _ask(self, line: str) -> None:
        if self._process is None:
            command = [sys.executable, *PROGRAM]
            self._process = subprocess.Popen(  # noqa: S603  # our own interpreter
                [*command, str(self.folder), str(self.seed)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                env=os.environ | {"MALLOC_ARENA_MAX": "2", "COLUMNS": "100"},
            )  # fmt: skip
            self._heard = b""
        assert self._process.stdin is not None  # noqa: S101  # a pipe
        self._process.stdin.write(line.encode())
        self._process.stdin.flush()

    def _hear(self, patience: float) -> dict[str, Any] | None:
        """The worker's next line; None where it died, or was killed as it said nothing."""
        assert self._process is not None and self._process.stdout is not None  # noqa: S101, PT018
        pipe, worked = self._process.stdout.fileno(), self._worked()
        while b"\n" not in self._heard:
            ready, _, _ = select.select([pipe], [], [], patience)
            if not ready:
                before, worked = worked, self._worked()
                if worked > before + BUSY:  # where others have the processor, an input takes long
                    continue
                self._process.send_signal(signal.SIGPROF)  # says where it is, and dies
                return None
            more = os.read(pipe, 1 << 16)
            if not more:
                return None
            self._heard += more
        line, _, self._heard = self._heard.partition(b"\n")
        told: dict[str, Any] = json.loads(line)
        return told

    def _worked(self) -> float:
        """CPU time of the worker [s]."""
        assert self._process is not None  # noqa: S101
        told = Path(f"/proc/{self._process.pid}/stat").read_text("utf-8", "replace")
        user, system = told.rpartition(") ")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def _died(self) -> tuple[str, str]:
        """Outcome and place of the input that the worker died of; there is no worker then."""
        assert self._process is not None  # noqa: S101
        try:
            code = self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            code = -signal.SIGPROF
        self.end()
        log = self.folder / "died.log"
        told = log.read_text("utf-8", "replace") if log.exists() else ""  # died before it wrote
        at = re.findall(r'src/placegraph/(\S+)", line (\d+)', told)
        where = f"{at[0][0]}:{at[0][1]}" if at else "outside of placegraph"
        if code == -signal.SIGPROF:
            return "hang", where
        name = signal.strsignal(-code) if code < 0 else f"exit code {code}"
        return "crash", f"{name} at {where}"


def tallies(
    effort: Effort, names: Iterable[str], most: int = 1 << 40
) -> Iterator[tuple[str, Tally]]:
    """What becomes of the inputs of each target, one after the other, each for its share of time."""
    wanted = list(names)
    start, keeper = perf_counter(), Keeper(effort.folder, effort.seed)
    try:
        for k, name in enumerate(wanted):
            left = effort.seconds - (perf_counter() - start)
            tally = Tally()
            keeper.run(name, max(left, 0.0) / (len(wanted) - k), most, tally)
            told = ", ".join(f"{n} {outcome}" for outcome, n in tally.counts.items())
            effort.say(f"{name}: {told} in {tally.seconds:.0f} s, {tally.most >> 20} MB at most")
            for what, numbers in tally.found.items():
                told = f"{len(numbers)} times, first input {numbers[0]}"
                effort.say(f"  {what} ({told}): {tally.said[what]}")
            for what in tally.refused:
                effort.say(f"  a sound seed is refused: {what}")
            yield name, tally
    finally:
        keeper.end()


def rows(effort: Effort) -> Iterator[Row]:
    """A row a format; a sound seed that is refused counts as untyped."""
    most = max(LEAST, int(A_MINUTE * effort.seconds / 60.0))
    wanted = sorted(filter(effort.wants, TARGETS), key=lambda n: TARGETS[n].slow)
    for name, tally in tallies(effort, wanted, most):
        tally.counts["untyped"] += len(tally.refused)
        yield Row.counted("fuzz", name, tally.counts, effort.seed, tally.seconds)


def main() -> None:
    """Draw one input again and use it here: `FOLDER SEED NAME NUMBER`, for who mends it."""
    from placegraph_lab.campaign.uses import Bench
    from placegraph_lab.campaign.worker import Trials

    folder, seed, name, number = sys.argv[1:]
    trials = Trials(TARGETS[name], Path(folder), int(seed), Bench(Path(folder)))
    place, rng = trials.draw(int(number))
    sys.stderr.write(f"{place}\n")
    trials.target.use(trials.bench, place, rng)


if __name__ == "__main__":
    main()
