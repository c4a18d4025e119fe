"""Fuzzing of every reader and every endpoint: inputs are accepted, refused with an error, or break it.

A worker process uses inputs until it dies; the input that killed it is counted, and another worker
goes on.
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
from placegraph_lab.campaign.targets import find_targets

TIMEOUT = 240.0  # wall time in which a worker must answer [s]
BUSY = 1.0  # a worker that used more CPU time than this within a timeout is waited for [s]
STARTING = 900.0  # timeout of a worker that writes seeds and compiles [s]
PROGRAM = ("-m", "placegraph_lab.campaign.worker")
BATCH = 20  # inputs that a worker is asked for at a time
MIN_INPUTS, INPUTS_PER_MINUTE = 1000, 40
"""A target ends after so many inputs; the slow ones behind it get the time that is left."""


@dataclass
class Tally:
    """Outcomes of the inputs of one target."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: dict[str, list[int]] = field(
        default_factory=dict
    )  # Numbers of the faulty inputs, by fault
    reasons: dict[str, str] = field(default_factory=dict)  # message of the first, by fault
    refused: list[str] = field(default_factory=list)  # why unchanged seeds are refused
    seconds: float = 0.0
    peak: int = 0  # most memory that an input took [bytes]

    @property
    def tried(self) -> int:
        """Number of inputs so far."""
        return self.counts.total()

    def add(self, outcome: str, reason: str, took: int = 0) -> None:
        """Count an input."""
        if outcome in FAULTS:
            where, _, why = reason.partition(": ")
            self.faults.setdefault(f"{outcome}: {where}", []).append(self.tried)
            self.reasons.setdefault(f"{outcome}: {where}", why)
        self.counts[outcome] += 1
        self.peak = max(self.peak, took)


class WorkerSupervisor:
    """Runs one worker process, and starts another where it dies."""

    def __init__(self, effort: Effort) -> None:
        self.folder = effort.folder
        self._arguments = [str(effort.folder), str(effort.seed)]
        self._arguments += [str(effort.layouts)] if effort.layouts else []
        self._process: subprocess.Popen[bytes] | None = None
        self._unread = b""

    def run(self, name: str, seconds: float, most: int, tally: Tally) -> None:
        """Use inputs of a target for `seconds`, at most `most`."""
        start = perf_counter()
        while tally.tried < most and (perf_counter() - start < seconds or not tally.tried):
            self._ask(f"{name}\t{tally.tried}\t{min(BATCH, most - tally.tried)}\n")
            answer = self._read_line(STARTING)
            if answer is None:
                tally.refused = [f"the worker died: {self._explain_death()}"]
                break
            tally.refused = answer["refused"] or tally.refused
            if not answer["seeds"]:
                break
            while (answer := self._read_line(TIMEOUT)) and "done" not in answer:
                tally.add(answer["outcome"], answer["reason"], answer["bytes"])
            if answer is None:
                tally.add(*self._explain_death())
        tally.seconds += perf_counter() - start

    def end(self) -> None:
        """End the worker."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _ask(self, line: str) -> None:
        if self._process is None:
            command = [sys.executable, *PROGRAM]
            self._process = subprocess.Popen(  # noqa: S603  # our own interpreter
                [*command, *self._arguments],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                env=os.environ | {"MALLOC_ARENA_MAX": "2", "COLUMNS": "100"},
            )  # fmt: skip
            self._unread = b""
        assert self._process.stdin is not None  # noqa: S101  # a pipe
        self._process.stdin.write(line.encode())
        self._process.stdin.flush()

    def _read_line(self, timeout: float) -> dict[str, Any] | None:
        """Return the worker's next line; None where it died, or was killed after the timeout."""
        assert self._process is not None and self._process.stdout is not None  # noqa: S101, PT018
        pipe, spent = self._process.stdout.fileno(), self._cpu_time()
        while b"\n" not in self._unread:
            ready, _, _ = select.select([pipe], [], [], timeout)
            if not ready:
                before, spent = spent, self._cpu_time()
                if spent > before + BUSY:
                    continue
                self._process.send_signal(signal.SIGPROF)  # prints its stack, and ends it
                return None
            more = os.read(pipe, 1 << 16)
            if not more:
                return None
            self._unread += more
        line, _, self._unread = self._unread.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _cpu_time(self) -> float:
        """Return the CPU time of the worker [s]."""
        assert self._process is not None  # noqa: S101
        stat = Path(f"/proc/{self._process.pid}/stat").read_text("utf-8", "replace")
        user, system = stat.rpartition(") ")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def _explain_death(self) -> tuple[str, str]:
        """Return outcome and place of the input that killed the worker."""
        assert self._process is not None  # noqa: S101
        try:
            code = self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            code = -signal.SIGPROF
        self.end()
        log = self.folder / "died.log"
        stack = log.read_text("utf-8", "replace") if log.exists() else ""
        lines = re.findall(r'src/placegraph/(\S+)", line (\d+)', stack)
        where = ":".join(lines[0]) if lines else "outside of placegraph"
        if code == -signal.SIGPROF:
            return "hang", where
        name = signal.strsignal(-code) if code < 0 else f"exit code {code}"
        return "crash", f"{name} at {where}"


def run_targets(
    effort: Effort, names: Iterable[str], most: int = 1 << 40
) -> Iterator[tuple[str, Tally]]:
    """Yield the outcomes of each target in turn, each for its share of the time."""
    wanted = list(names)
    start, supervisor = perf_counter(), WorkerSupervisor(effort)
    try:
        for k, name in enumerate(wanted):
            left = effort.seconds - (perf_counter() - start)
            tally = Tally()
            supervisor.run(name, max(left, 0.0) / (len(wanted) - k), most, tally)
            counts = ", ".join(f"{n} {outcome}" for outcome, n in tally.counts.items())
            effort.report(
                f"{name}: {counts} in {tally.seconds:.0f} s, {tally.peak >> 20} MB at most"
            )
            for fault, numbers in tally.faults.items():
                times = f"{len(numbers)} times, first input {numbers[0]}"
                effort.report(f"  {fault} ({times}): {tally.reasons[fault]}")
            for reason in tally.refused:
                effort.report(f"  a sound seed is refused: {reason}")
            yield name, tally
    finally:
        supervisor.end()


def rows(effort: Effort) -> Iterator[Row]:
    """Yield a row for each format; a refused sound seed counts as untyped."""
    targets = find_targets(effort.layouts)
    most = max(MIN_INPUTS, int(INPUTS_PER_MINUTE * effort.seconds / 60.0))
    wanted = sorted(filter(effort.wants, targets), key=lambda n: targets[n].slow)
    for name, tally in run_targets(effort, wanted, most):
        tally.counts["untyped"] += len(tally.refused)
        yield Row.from_counts("fuzz", name, tally.counts, effort.seed, tally.seconds)


def main() -> None:
    """Draw one input again and use it here: `FOLDER SEED NAME NUMBER [LAYOUTS]`."""
    from placegraph_lab.campaign.uses import Bench
    from placegraph_lab.campaign.worker import Trials

    folder, seed, name, number, *layouts = sys.argv[1:]
    target = find_targets(Path(layouts[0]) if layouts else None)[name]
    trials = Trials(target, Path(folder), int(seed), Bench(Path(folder)))
    place, rng = trials.draw(int(number))
    sys.stderr.write(f"{place}\n")
    trials.target.use(trials.bench, place, rng)


if __name__ == "__main__":
    main()
