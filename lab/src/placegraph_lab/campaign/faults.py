"""Faults of machines: processes killed, disks full or lost, files changed in use, services gone."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np

from placegraph_lab.campaign.changed import CHANGES, TYPED, USES, served_anew, used
from placegraph_lab.campaign.disks import disks
from placegraph_lab.campaign.kills import AGAIN, Ground, killed, rows_of, tried
from placegraph_lab.campaign.outages import kills_under_load
from placegraph_lab.campaign.resumed import resumed
from placegraph_lab.campaign.row import Effort, Row
from placegraph_lab.campaign.services import services
from placegraph_lab.campaign.trial import Commands, ended
from placegraph_lab.campaign.writings import prepare, writings

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
