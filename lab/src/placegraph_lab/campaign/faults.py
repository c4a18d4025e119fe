"""Faults of machines: killed processes, full or lost disks, files that change while in use."""

from __future__ import annotations

import os
import shutil
import subprocess
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
    are_maps_reloaded,
    kill_server_under_load,
    use_changed_file,
)
from placegraph_lab.campaign.row import Effort, Row, total
from placegraph_lab.campaign.trial import (
    CommandResult,
    Commands,
    Limits,
    WritingCommand,
    list_commands,
    mount_disk,
    prepare,
    read_files,
    wait_for,
    wait_until,
)

KILLS_PER_MINUTE = 60
SHARES = {"kills": 0.45, "disks": 0.2, "changed": 0.15, "load": 0.2}  # of the time


def rows(effort: Effort) -> Iterator[Row]:
    """Yield the rows of this part."""
    rng, commands = np.random.default_rng(effort.seed), Commands()
    start = perf_counter()
    inputs = prepare(effort.folder / "inputs")
    trials = [
        TrialFolder.prepare(each, inputs, effort.folder / each.what.replace(" ", "-"), commands)
        for each in list_commands(inputs)
    ]
    effort.report(f"{len(trials)} commands are ready after {perf_counter() - start:.0f} s")
    yield from kills(trials, commands, effort, rng)
    yield from disks(trials, commands, effort, rng, effort.seconds * SHARES["disks"])
    (vectors,) = (g.new["a.vectors"] for g in trials if "a.vectors" in g.new)
    (inputs / "town.vectors").write_bytes(vectors)
    yield from changes(inputs, commands, effort, rng)
    yield from kill_server_under_load(inputs, effort, rng, effort.seconds * SHARES["load"])


def kills(
    trials: list[TrialFolder], commands: Commands, effort: Effort, rng: np.random.Generator
) -> Iterator[Row]:
    """Kill each command again and again; let it run in between and at the end."""
    done: Counter[str] = Counter()

    def once(trial: TrialFolder) -> None:
        kill_once(trial, commands, rng, effort.report)
        done[trial.command.what] += 1
        if done[trial.command.what] % KILLS_PER_RUN == 0:
            trial.run_undisturbed(commands, effort.report)

    seconds = effort.seconds * SHARES["kills"]
    try_in_turn(trials, once, seconds, int(KILLS_PER_MINUTE * effort.seconds / 60))
    for trial in trials:
        if done[trial.command.what] % KILLS_PER_RUN:
            trial.run_undisturbed(commands, effort.report)
    effort.report(f"{done.total()} kills")
    yield from rows_of(trials, "kill -9 of", effort.seed)


def changes(
    inputs: Path, commands: Commands, effort: Effort, rng: np.random.Generator
) -> Iterator[Row]:
    """Change every kind of file while it is used, each time in a process of its own."""
    try:
        import torch
    except ImportError:
        effort.report("PyTorch is not installed; its weights are skipped")
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
                outcome = _try_change(commands, what, how, folder, int(rng.integers(1 << 31)))
                counts[outcome] += 1
                if outcome not in ("accepted", "typed"):
                    log = folder / "error.txt"
                    error = log.read_text() if log.exists() else ""
                    effort.report(f"{what} {how}: {outcome} {error}")
        seconds = perf_counter() - start
        yield Row.from_counts("faults", f"{what} changed in use", counts, effort.seed, seconds)
    right = are_maps_reloaded(shutil.copytree(inputs, folder, dirs_exist_ok=True))
    found = {"accepted": int(right), "untyped": int(not right)}
    yield Row.from_counts(
        "faults", "a clock set back under a server's maps", found, effort.seed, 0.0
    )


def _try_change(commands: Commands, what: str, how: str, folder: Path, seed: int) -> str:
    process = commands.process(use_changed_file, what, how, folder, seed)
    code = wait_for(process)
    if code is None:
        process.kill()
        return "hang"
    return {0: "accepted", TYPED: "typed"}.get(code, "untyped" if code > 0 else "crash")


KILLS_PER_RUN = 6  # kills after which a command is let run
AIM = 0.02  # an aimed kill falls within this time after the folder has changed [s]


@dataclass
class TrialFolder:
    """Folder in which a command is tried again and again; each trial finds what the last one left."""

    command: WritingCommand
    inputs: Path
    folder: Path
    room: Path
    new: dict[str, bytes] = field(
        default_factory=dict
    )  # Files that the command makes when it is let run
    seconds: float = 0.0  # duration of that run
    counts: Counter[str] = field(default_factory=Counter)
    elapsed: float = 0.0

    @classmethod
    def prepare(
        cls, command: WritingCommand, inputs: Path, folder: Path, commands: Commands
    ) -> TrialFolder:
        """Make the folders and run the command once; `RuntimeError` where it fails."""
        made = cls(command, inputs, folder / "here", folder / "room")
        made.folder.mkdir(parents=True)
        made.room.mkdir()
        command.before(inputs, made.folder)
        result = commands.start(command.words, made.folder, made.room).end()
        made.new = {
            name: b for name, b in read_files(made.folder).items() if command.makes_file(name)
        }
        if result.code or not all((made.folder / name).exists() for name in command.makes):
            raise RuntimeError(
                f"{command.what} ended with {result.code}: {result.error_output[-400:]}"
            )
        made.seconds = result.seconds
        return made

    def find_damage(self, old: dict[str, bytes]) -> str:
        """Return the defect of the files; empty where there is none."""
        there = read_files(self.folder)
        for name, found in there.items():
            if self.command.makes_file(name):
                if found not in (old.get(name), self.new.get(name)):
                    return f"{name} is neither the old nor the new one"
            elif not self.command.allows(name):
                return f"{name} is left"
        gone = [name for name in old if name not in there]
        if self.command.ends in there:
            gone += [name for name in self.new if name not in there]
        return f"{gone[0]} is gone" if gone else ""

    def count(self, outcome: str, why: str, output: str, report: Callable[[str], None]) -> None:
        """Count a trial, and report a fault."""
        self.counts[outcome] += 1
        if why:
            report(f"{self.command.what}: {outcome}: {why} {output[-300:]}")

    def run_undisturbed(self, commands: Commands, report: Callable[[str], None]) -> None:
        """Run the command after kills: it must make all files and remove leftovers."""
        self.command.before(self.inputs, self.folder)
        result = commands.start(self.command.words, self.folder, self.room).end()
        there = read_files(self.folder)
        left = [n for n in there if n not in self.new and not self.command.keeps(n)]
        why = "" if not left else f"{left[0]} stays"
        why = why or (
            "" if {n: there.get(n) for n in self.new} == self.new else "it made other files"
        )
        right = result.code == 0 and not why
        outcome = "accepted" if right else as_fault(result.outcome)
        self.count(
            outcome,
            "" if right else f"the next run: {result.code} {why}",
            result.error_output,
            report,
        )


def kill_once(
    trial: TrialFolder, commands: Commands, rng: Generator, report: Callable[[str], None]
) -> None:
    """Kill the command once, anywhere or just when it writes, with its helpers or alone."""
    old = trial.command.before(trial.inputs, trial.folder)
    before = list_names(trial.folder)
    running = commands.start(trial.command.words, trial.folder, trial.room)
    if rng.random() < 0.5:
        wait_until(lambda: list_names(trial.folder) != before, 3.0 * trial.seconds, running)
        sleep(AIM * rng.random())
    else:
        running.process.join(trial.seconds * rng.random())
    without_children = rng.random() < 0.5
    running.kill(without_children=without_children)
    result = running.end()
    why = trial.find_damage(old)
    if not result.killed and result.code:
        outcome = as_fault(result.outcome)
        trial.count(outcome, f"it ended with {result.code}", result.error_output, report)
    elif why:
        trial.count("untyped", why, result.error_output, report)
    elif left := running.helpers():
        trial.count("hang", f"processes {left} live on", "", report)
        running.kill()
    else:
        trial.count("accepted", "", "", report)


def try_in_turn(
    trials: Sequence[TrialFolder], once: Callable[[TrialFolder], None], seconds: float, most: int
) -> int:
    """Try each folder in turn until the time is over; return the number of trials, at most `most`."""
    end, count = perf_counter() + seconds, 0
    while count < most and perf_counter() < end and trials:
        trial = trials[count % len(trials)]
        start = perf_counter()
        once(trial)
        trial.elapsed += perf_counter() - start
        count += 1
    return count


def rows_of(trials: Sequence[TrialFolder], fault: str, seed: int) -> Iterator[Row]:
    """Yield a row for each command, and reset the counts."""
    for trial in trials:
        if trial.counts:
            what = f"{fault} {trial.command.what}"
            yield Row.from_counts("faults", what, trial.counts, seed, trial.elapsed)
        trial.counts, trial.elapsed = Counter(), 0.0


def judge_refusal(
    trial: TrialFolder,
    old: dict[str, bytes],
    result: CommandResult,
    report: Callable[[str], None],
    *,
    clean: bool,
) -> None:
    """Check a command that could not write: a typed error that names the file, and unchanged files."""
    why = trial.find_damage(old)
    there = {name for name in read_files(trial.folder) if not trial.command.makes_file(name)}
    if clean and not why and (left := {n for n in there if not trial.command.keeps(n)}):
        why = f"{min(left)} is left"
    if result.outcome == "typed" and not any(n in result.error_output for n in trial.command.makes):
        why = why or "its error names no file"
    outcome = as_fault(result.outcome) if why else result.outcome
    wrong = why or (f"it ended with {result.code}" if outcome not in ("accepted", "typed") else "")
    trial.count(outcome, wrong, result.error_output, report)


def as_fault(outcome: str) -> str:
    """Return the outcome of a trial that failed a check."""
    return "untyped" if outcome in ("accepted", "typed") else outcome


def list_names(folder: Path) -> list[str]:
    """Return the paths of all files and folders below a folder."""
    return sorted(os.path.join(at, n) for at, ds, ns in os.walk(folder) for n in (*ds, *ns))  # noqa: PTH118


MIN_DISK = 2048  # [bytes]: the error itself has to be written somewhere
PAGE = 4096


def disks(
    trials: Sequence[TrialFolder],
    commands: Commands,
    effort: Effort,
    rng: Generator,
    seconds: float,
) -> Iterator[Row]:
    """Yield the rows of every fault of a disk that can be caused here."""
    faults: dict[str, Callable[[TrialFolder], None]] = {
        "a full disk": lambda g: fill_disk(g, commands, effort, rng)
    }
    root = os.geteuid() == 0
    if root:
        faults["a small disk"] = lambda g: use_small_disk(g, commands, effort, rng, writable=True)
        faults["a read-only disk"] = lambda g: use_small_disk(
            g, commands, effort, rng, writable=False
        )
        faults["a folder lost"] = lambda g: lose_folder(g, commands, effort, rng)
    else:
        effort.report("disks are not mounted and no folder is lost: only root can do that")
    for fault, once in faults.items():
        try_in_turn(trials, once, seconds / len(faults), 4 * len(trials))
        rows = list(rows_of(trials, fault, effort.seed))
        yield replace(total(rows, fault), note=f"{len(rows)} commands")


def fill_disk(trial: TrialFolder, commands: Commands, effort: Effort, rng: Generator) -> None:
    """Limit the size of files to a drawn one."""
    most = max(map(len, trial.new.values()))
    size = int(rng.integers(MIN_DISK, max(most, MIN_DISK + 1)))
    limits = Limits(file=size)
    old = trial.command.before(trial.inputs, trial.folder)
    result = commands.start(trial.command.words, trial.folder, trial.room, limits).end()
    judge_refusal(trial, old, result, effort.report, clean=True)


def use_small_disk(
    trial: TrialFolder, commands: Commands, effort: Effort, rng: Generator, *, writable: bool
) -> None:
    """Use a file system that is too small for the output, or read-only."""
    most = sum(map(len, trial.new.values()))
    size = PAGE * int(rng.integers(2, max(3, 2 * most // PAGE))) if writable else 64 * PAGE + most
    here = trial.folder
    with mount_disk(here.with_name("disk"), size) as disk:
        if disk is None:
            return
        trial.folder = disk
        try:
            old = trial.command.before(trial.inputs, disk)
            if not writable:
                subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)  # noqa: S603, S607
            result = commands.start(trial.command.words, disk, trial.room).end()
            judge_refusal(trial, old, result, effort.report, clean=True)
        except OSError:  # too small for the old files, too
            pass
        finally:
            trial.folder = here


def lose_folder(trial: TrialFolder, commands: Commands, effort: Effort, rng: Generator) -> None:
    """Forbid writing to the folder from some moment on."""
    old = trial.command.before(trial.inputs, trial.folder)
    before = list_names(trial.folder)
    limits = Limits(bound=True)
    running = commands.start(trial.command.words, trial.folder, trial.room, limits)
    if rng.random() < 0.7:  # just when it writes
        wait_until(lambda: list_names(trial.folder) != before, 3.0 * trial.seconds, running)
    else:
        running.process.join(trial.seconds * rng.random())
    folders = [trial.folder, *(trial.folder / n for n in list_names(trial.folder))]
    folders = [path for path in folders if path.is_dir()]
    for path in folders:
        path.chmod(0o555)
    try:
        result = running.end()
        judge_refusal(trial, old, result, effort.report, clean=False)
    finally:
        for path in folders:
            path.chmod(0o755)
