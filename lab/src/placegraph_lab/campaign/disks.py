"""Disks that are full, read-only, or no longer ours: the error names the file, and all is as it was."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from placegraph_lab.campaign.kills import limited, listed, refused, rows_of, tried
from placegraph_lab.campaign.trial import Limits, read_only, small_disk, when

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.random import Generator

    from placegraph_lab.campaign.kills import Ground
    from placegraph_lab.campaign.row import Effort, Row
    from placegraph_lab.campaign.trial import Commands

LEAST = 2048
"""Smallest disk: the error itself has to be written somewhere [bytes]."""
PAGE = 4096
NOBODY = 65534


def disks(
    grounds: Sequence[Ground], commands: Commands, effort: Effort, rng: Generator, seconds: float
) -> Iterator[Row]:
    """Rows of every fault of a disk that can be made here."""
    faults: dict[str, Callable[[Ground], None]] = {
        "a full disk under": lambda g: full(g, commands, effort, rng),
    }
    root = os.geteuid() == 0
    if root:
        effort.folder.chmod(0o755)  # another user reads the inputs
        faults["a small disk under"] = lambda g: on_disk(g, commands, effort, rng, writable=True)
        faults["a read-only disk under"] = lambda g: on_disk(
            g, commands, effort, rng, writable=False
        )
        faults["a folder lost under"] = lambda g: lost(g, commands, effort, rng)
    else:
        effort.say("disks are not mounted, and users not changed: that takes root")
    for fault, once in faults.items():
        tried(grounds, once, seconds / len(faults), 4 * len(grounds))
        yield from rows_of(grounds, fault, effort.seed)


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
    """Another user runs it, and may no longer write to the folder from some moment on."""
    for path in ground.folder.iterdir():
        path.unlink() if path.is_file() else None
    old = ground.writing.before(ground.inputs, ground.folder)
    for path in ground.folder.iterdir():
        path.chmod(0o666)
    before = listed(ground.folder)
    limits = Limits(user=NOBODY)
    running = commands.start(ground.writing.words, ground.folder, ground.room, limits)
    if rng.random() < 0.7:  # just when it writes
        when(lambda: listed(ground.folder) != before, 3.0 * ground.seconds, running)
    else:
        running.process.join(ground.seconds * rng.random())
    ground.folder.chmod(0o555)
    try:
        ended = running.end()
        refused(ground, old, ended, effort.say, clean=False)
    finally:
        ground.folder.chmod(0o777)
