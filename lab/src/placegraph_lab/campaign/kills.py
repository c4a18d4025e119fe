"""`kill -9` at any moment of a command that writes: each file is the old or the new one, whole."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, sleep

from numpy.random import Generator

from placegraph_lab.campaign.row import Row
from placegraph_lab.campaign.trial import Commands, Ended, Limits, files_in, when
from placegraph_lab.campaign.writings import Writing

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


def limited(ground: Ground, commands: Commands, limits: Limits, say: Callable[[str], None]) -> None:
    """Run the command under limits, and judge it."""
    old = ground.writing.before(ground.inputs, ground.folder)
    ended = commands.start(ground.writing.words, ground.folder, ground.room, limits).end()
    refused(ground, old, ended, say, clean=True)


def worse(outcome: str) -> str:
    """Outcome of what went wrong though it ended in order."""
    return "untyped" if outcome in ("accepted", "typed") else outcome


def listed(folder: Path) -> list[str]:
    """Names in a folder, and in those below it."""
    return sorted(os.path.join(at, n) for at, ds, ns in os.walk(folder) for n in (*ds, *ns))  # noqa: PTH118
