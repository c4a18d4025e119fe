"""Disks that are full, read-only, or no longer ours: the error names the file, and all is as it was."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from numpy.random import Generator

from placegraph_lab.campaign.kills import Ground, limited, listed, refused, rows_of, tried
from placegraph_lab.campaign.row import Effort, Row, total
from placegraph_lab.campaign.trial import Commands, Limits, read_only, small_disk, when

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
    limited(ground, commands, Limits(file=size), effort.say)


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
