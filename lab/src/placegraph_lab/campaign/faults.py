"""Faults of machines: processes killed, disks full or lost, files changed in use, services gone."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter, sleep

import numpy as np
from numpy.random import Generator

from placegraph_lab.campaign.outages import (
    CHANGES,
    TYPED,
    USES,
    kills_under_load,
    served_anew,
    services,
    used,
)
from placegraph_lab.campaign.row import Effort, Row, total
from placegraph_lab.campaign.trial import (
    Commands,
    Ended,
    Limits,
    Writing,
    ended,
    files_in,
    prepare,
    read_only,
    small_disk,
    when,
    writings,
)

KILLS = 60  # A minute of effort; five minutes are 300, where the machine is quick enough
SHARES = {
    "kills": 0.4, "disks": 0.2, "changed": 0.15, "services": 0.05, "load": 0.15, "resumed": 0.05,
}  # fmt: skip
"""Of the time."""


def rows(effort: Effort) -> Iterator[Row]:
    """Rows of this part."""
    rng, commands = np.random.default_rng(effort.seed), Commands()
    start = perf_counter()
    inputs = prepare(effort.folder / "inputs")
    grounds = [
        Ground.of(each, inputs, effort.folder / each.what.replace(" ", "-"), commands)
        for each in writings(inputs)
    ]
    effort.say(f"{len(grounds)} commands are ready after {perf_counter() - start:.0f} s")
    yield from kills(grounds, commands, effort, rng)
    yield from disks(grounds, commands, effort, rng, effort.seconds * SHARES["disks"])
    (made,) = (g.new["a.vectors"] for g in grounds if "a.vectors" in g.new)
    (inputs / "town.vectors").write_bytes(made)
    yield from changes(inputs, commands, effort, rng)
    yield from services(inputs, effort, effort.seconds * SHARES["services"])
    yield from kills_under_load(inputs, effort, rng, effort.seconds * SHARES["load"])
    yield from resumed(inputs, commands, effort, rng, effort.seconds * SHARES["resumed"])


def kills(
    grounds: list[Ground], commands: Commands, effort: Effort, rng: np.random.Generator
) -> Iterator[Row]:
    """Kill each command again and again; it works in between, and at the end."""
    done: Counter[str] = Counter()

    def once(ground: Ground) -> None:
        killed(ground, commands, rng, effort.say)
        done[ground.writing.what] += 1
        if done[ground.writing.what] % AGAIN == 0:
            ground.let_run(commands, effort.say)

    seconds = effort.seconds * SHARES["kills"]
    tried(grounds, once, seconds, int(KILLS * effort.seconds / 60))
    for ground in grounds:
        if done[ground.writing.what] % AGAIN:
            ground.let_run(commands, effort.say)
    effort.say(f"{done.total()} kills")
    yield from rows_of(grounds, "kill -9 of", effort.seed)


def changes(
    inputs: Path, commands: Commands, effort: Effort, rng: np.random.Generator
) -> Iterator[Row]:
    """Every change of every file that is in use, again and again; each in a process of its own."""
    try:
        import torch
    except ImportError:
        effort.say("PyTorch is not installed: its weights are left alone")
    else:
        torch.save({"a": torch.ones(1 << 20)}, inputs / "any.pt")
    folder, share = effort.folder / "changed", effort.seconds * SHARES["changed"]
    for what, (pattern, _) in USES.items():
        if not list(inputs.glob(pattern)):
            continue
        counts: Counter[str] = Counter()
        start = perf_counter()
        while not counts or perf_counter() - start < share / len(USES):
            for how in CHANGES:
                shutil.rmtree(folder, ignore_errors=True)
                shutil.copytree(inputs, folder)
                outcome = _one(commands, what, how, folder, int(rng.integers(1 << 31)))
                counts[outcome] += 1
                if outcome not in ("accepted", "typed"):
                    said = folder / "said.txt"
                    told = said.read_text() if said.exists() else ""
                    effort.say(f"{what} {how}: {outcome} {told}")
        seconds = perf_counter() - start
        yield Row.counted("faults", f"{what} changed in use", counts, effort.seed, seconds)
    right = served_anew(shutil.copytree(inputs, folder, dirs_exist_ok=True))
    found = {"accepted": int(right), "untyped": int(not right)}
    yield Row.counted("faults", "a clock set back under a server's maps", found, effort.seed, 0.0)


def _one(commands: Commands, what: str, how: str, folder: Path, seed: int) -> str:
    process = commands.process(used, what, how, folder, seed)
    code = ended(process)
    if code is None:
        process.kill()
        return "hang"
    return {0: "accepted", TYPED: "typed"}.get(code, "untyped" if code > 0 else "crash")


AGAIN = 6  # after so many kills a command is let run
NEAR = 0.02  # A kill that is aimed falls within so long after the folder has changed [s]


@dataclass
class Ground:
    """A folder in which a command is tried again and again; what a trial leaves is there in the next."""

    writing: Writing
    inputs: Path
    folder: Path
    room: Path
    new: dict[str, bytes] = field(default_factory=dict)
    """What the command makes, as it was let run first."""
    seconds: float = 0.0  # how long that took
    counts: Counter[str] = field(default_factory=Counter)
    taken: float = 0.0

    @classmethod
    def of(cls, writing: Writing, inputs: Path, folder: Path, commands: Commands) -> Ground:
        """Lay the folders and let the command run; `RuntimeError` where it cannot."""
        made = cls(writing, inputs, folder / "here", folder / "room")
        made.folder.mkdir(parents=True)
        made.room.mkdir()
        writing.before(inputs, made.folder)
        ended = commands.start(writing.words, made.folder, made.room).end()
        made.new = {name: b for name, b in files_in(made.folder).items() if writing.made(name)}
        if ended.code or not all((made.folder / name).exists() for name in writing.makes):
            raise RuntimeError(f"{writing.what} ended with {ended.code}: {ended.said[-400:]}")
        made.seconds = ended.seconds
        return made

    def whole(self, old: dict[str, bytes]) -> str:
        """What is wrong with the files that are there now; empty where nothing is."""
        there = files_in(self.folder)
        for name, found in there.items():
            if self.writing.made(name):
                if found not in (old.get(name), self.new.get(name)):
                    return f"{name} is neither the old nor the new one"
            elif not self.writing.allows(name):
                return f"{name} is left"
        gone = [name for name in old if name not in there]
        if self.writing.ends in there:
            gone += [name for name in self.new if name not in there]
        return f"{gone[0]} is gone" if gone else ""

    def count(self, outcome: str, why: str, said: str, say: Callable[[str], None]) -> None:
        """Count a trial, and tell what should not be."""
        self.counts[outcome] += 1
        if why:
            say(f"{self.writing.what}: {outcome}: {why} {said[-300:]}")

    def let_run(self, commands: Commands, say: Callable[[str], None]) -> None:
        """Let the command run where others were killed: it makes all, and clears away what they left."""
        self.writing.before(self.inputs, self.folder)
        ended = commands.start(self.writing.words, self.folder, self.room).end()
        there = files_in(self.folder)
        left = [n for n in there if n not in self.new and not self.writing.keeps(n)]
        why = "" if not left else f"{left[0]} stays"
        why = why or (
            "" if {n: there.get(n) for n in self.new} == self.new else "it made other files"
        )
        right = ended.code == 0 and not why
        outcome = "accepted" if right else worse(ended.outcome)
        self.count(outcome, "" if right else f"the next run: {ended.code} {why}", ended.said, say)


def killed(ground: Ground, commands: Commands, rng: Generator, say: Callable[[str], None]) -> None:
    """Kill the command once, anywhere or just when it writes, with its helpers or alone."""
    old = ground.writing.before(ground.inputs, ground.folder)
    before = listed(ground.folder)
    running = commands.start(ground.writing.words, ground.folder, ground.room)
    if rng.random() < 0.5:
        when(lambda: listed(ground.folder) != before, 3.0 * ground.seconds, running)
        sleep(NEAR * rng.random())
    else:
        running.process.join(ground.seconds * rng.random())
    alone = rng.random() < 0.5
    running.kill(alone=alone)
    ended = running.end()
    why = ground.whole(old)
    if not ended.killed and ended.code:
        outcome = worse(ended.outcome)  # nothing was refused before
        ground.count(outcome, f"it ended with {ended.code}", ended.said, say)
    elif why:
        ground.count("untyped", why, ended.said, say)
    elif left := running.helpers():
        ground.count("hang", f"processes {left} live on", "", say)
        running.kill()
    else:
        ground.count("accepted", "", "", say)


def tried(
    grounds: Sequence[Ground], once: Callable[[Ground], None], seconds: float, most: int
) -> int:
    """Try each ground in turn until time is over, or all were tried so often; how often that was."""
    end, count = perf_counter() + seconds, 0
    while count < most and perf_counter() < end and grounds:
        ground = grounds[count % len(grounds)]
        start = perf_counter()
        once(ground)
        ground.taken += perf_counter() - start
        count += 1
    return count


def rows_of(grounds: Sequence[Ground], fault: str, seed: int) -> Iterator[Row]:
    """A row for each command, and a fresh count."""
    for ground in grounds:
        if ground.counts:
            what = f"{fault} {ground.writing.what}"
            yield Row.counted("faults", what, ground.counts, seed, ground.taken)
        ground.counts, ground.taken = Counter(), 0.0


def refused(
    ground: Ground, old: dict[str, bytes], ended: Ended, say: Callable[[str], None], *, clean: bool
) -> None:
    """Judge a command that could not write: a typed error that names the file, all as it was."""
    why = ground.whole(old)
    there = {name for name in files_in(ground.folder) if not ground.writing.made(name)}
    if clean and not why and (left := {n for n in there if not ground.writing.keeps(n)}):
        why = f"{min(left)} is left"
    if ended.outcome == "typed" and not any(n in ended.said for n in ground.writing.makes):
        why = why or "its error names no file"
    outcome = worse(ended.outcome) if why else ended.outcome
    wrong = why or (f"it ended with {ended.code}" if outcome not in ("accepted", "typed") else "")
    ground.count(outcome, wrong, ended.said, say)


def worse(outcome: str) -> str:
    """Outcome of what went wrong though it ended in order."""
    return "untyped" if outcome in ("accepted", "typed") else outcome


def listed(folder: Path) -> list[str]:
    """Names in a folder, and in those below it."""
    return sorted(os.path.join(at, n) for at, ds, ns in os.walk(folder) for n in (*ds, *ns))  # noqa: PTH118


LEAST = 2048  # smallest disk: the error itself has to be written somewhere [bytes]
PAGE = 4096


def disks(
    grounds: Sequence[Ground], commands: Commands, effort: Effort, rng: Generator, seconds: float
) -> Iterator[Row]:
    """Rows of every fault of a disk that can be made here."""
    faults: dict[str, Callable[[Ground], None]] = {
        "a full disk": lambda g: full(g, commands, effort, rng)
    }
    root = os.geteuid() == 0
    if root:
        faults["a small disk"] = lambda g: on_disk(g, commands, effort, rng, writable=True)
        faults["a read-only disk"] = lambda g: on_disk(g, commands, effort, rng, writable=False)
        faults["a folder lost"] = lambda g: lost(g, commands, effort, rng)
    else:
        effort.say("disks are not mounted, and nothing is lost: that takes root")
    for fault, once in faults.items():
        tried(grounds, once, seconds / len(faults), 4 * len(grounds))
        rows = list(rows_of(grounds, fault, effort.seed))
        yield replace(total(rows, fault), said=f"{len(rows)} commands")


def full(ground: Ground, commands: Commands, effort: Effort, rng: Generator) -> None:
    """No file may grow beyond a size that is drawn."""
    most = max(map(len, ground.new.values()))
    size = int(rng.integers(LEAST, max(most, LEAST + 1)))
    limits = Limits(file=size)
    old = ground.writing.before(ground.inputs, ground.folder)
    ended = commands.start(ground.writing.words, ground.folder, ground.room, limits).end()
    refused(ground, old, ended, effort.say, clean=True)


def on_disk(
    ground: Ground, commands: Commands, effort: Effort, rng: Generator, *, writable: bool
) -> None:
    """On a file system of its own, too small for what is made, or read-only."""
    most = sum(map(len, ground.new.values()))
    size = PAGE * int(rng.integers(2, max(3, 2 * most // PAGE))) if writable else 64 * PAGE + most
    here = ground.folder
    with small_disk(here.with_name("disk"), size) as disk:
        if disk is None:
            return
        ground.folder = disk
        try:
            old = ground.writing.before(ground.inputs, disk)
            if not writable:
                read_only(disk)
            ended = commands.start(ground.writing.words, disk, ground.room).end()
            refused(ground, old, ended, effort.say, clean=True)
        except OSError:  # too small for the old ones, too
            pass
        finally:
            ground.folder = here


def lost(ground: Ground, commands: Commands, effort: Effort, rng: Generator) -> None:
    """From some moment on it may no longer write to the folder."""
    old = ground.writing.before(ground.inputs, ground.folder)
    before = listed(ground.folder)
    limits = Limits(bound=True)
    running = commands.start(ground.writing.words, ground.folder, ground.room, limits)
    if rng.random() < 0.7:  # just when it writes
        when(lambda: listed(ground.folder) != before, 3.0 * ground.seconds, running)
    else:
        running.process.join(ground.seconds * rng.random())
    folders = [ground.folder, *(ground.folder / n for n in listed(ground.folder))]
    folders = [path for path in folders if path.is_dir()]
    for path in folders:
        path.chmod(0o555)
    try:
        ended = running.end()
        refused(ground, old, ended, effort.say, clean=False)
    finally:
        for path in folders:
            path.chmod(0o755)


OPTIONS = ("--epochs", "4", "--examples", "6", "--steps", "2", "--batch", "3", "--check", "3", "--device",
           "cpu", "--quiet")  # fmt: skip
"""Of a training that takes seconds."""


def resumed(
    inputs: Path, commands: Commands, effort: Effort, rng: np.random.Generator, seconds: float
) -> Iterator[Row]:
    """Kill a training at random moments until it ends, and compare its weights; again and again."""
    try:
        import torch  # noqa: F401
    except ImportError:
        effort.say("PyTorch is not installed: nothing is trained")
        return
    from placegraph.outdoor.network.network import read_weights

    start, counts = perf_counter(), Counter[str]()
    room = effort.folder / "training"
    room.mkdir()
    first = _trained(inputs, commands, room, "whole", None)
    if first.code:
        effort.say(f"no training: {first.said[-300:]}")
        return
    wanted = read_weights(room / "whole.weights").fingerprint
    while not counts or perf_counter() - start < seconds:
        name = f"killed{counts.total()}"
        for _ in range(12):
            moment = first.seconds * (0.3 + rng.random())
            ended = _trained(inputs, commands, room, name, moment)
            if not ended.killed:
                break
        else:
            ended = _trained(inputs, commands, room, name, None)
        if ended.code:
            counts["untyped" if ended.outcome == "typed" else ended.outcome] += 1
            effort.say(f"a training ended with {ended.code}: {ended.said[-300:]}")
            continue
        same = read_weights(room / f"{name}.weights").fingerprint == wanted
        counts["accepted" if same else "untyped"] += 1
    seconds = perf_counter() - start
    yield Row.counted("faults", "kill -9 of a training, resumed", counts, effort.seed, seconds)


def _trained(
    inputs: Path, commands: Commands, room: Path, name: str, moment: float | None
) -> Ended:
    """Train, and go on where one of that name was killed; kill it after so many seconds."""
    words = (
        "city",
        "train",
        str(inputs / "town.city"),
        "-o",
        f"{name}.weights",
        "--work",
        f"{name}.work",
    )
    running = commands.start((*words, *OPTIONS), room, room)
    if moment is not None:
        running.process.join(moment)
        running.kill()
    return running.end()
