"""Commands that write files: their outputs, and the files that a killed one may leave behind."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

from placegraph.demo.town import FLAT, TOWN, unpack

TEXT = "A bakery is north of me."
OLD = b"what was there before"  # content of old files
RUN = ("--tum", "a.tum", "--png", "a.png", "--overlay", "b.png", "--record", "a.run")
RENDERED = (
    *(f"{name}.png" for name in ("colour", "depth", "objects", "objects_preview", "overlay")),
    "objects.json",
)
"""Outputs of `scene render`."""


@dataclass(frozen=True)
class WritingCommand:
    """A command that writes files: at any moment each is the complete old or new one."""

    what: str
    words: tuple[str, ...]  # of `placegraph`; files by their names in the folder of the trial
    makes: tuple[str, ...]  # files, or one folder
    leaves: tuple[str, ...] = ()
    """Patterns of files that a killed one leaves, beside those of every command."""
    old: str | None = ""
    """Input that is the old file; if empty, `OLD` bytes are; None: there is no old file."""
    ends: str = ""  # file of a folder that is written last

    def makes_file(self, name: str) -> bool:
        """Return whether the command makes a file of this name."""
        inside = any(name == m or name.startswith(f"{m}/") for m in self.makes)
        return inside and not self.keeps(name)

    def before(self, inputs: Path, folder: Path) -> dict[str, bytes]:
        """Write the old files into a folder; return their contents by name."""
        old: dict[str, bytes] = {}
        if self.ends:  # an unfinished folder is resumed
            if (folder / self.ends).exists():
                shutil.rmtree(folder / self.makes[0])
            return old
        for name in self.makes:
            path = folder / name
            if self.old is None:
                path.unlink(missing_ok=True)
                continue
            old[name] = (inputs / self.old).read_bytes() if self.old else OLD
            path.write_bytes(old[name])
        return old

    def keeps(self, name: str) -> bool:
        """Return whether a file of this name may stay after the next run."""
        return any(fnmatch(name, pattern) for pattern in self.leaves)

    def allows(self, name: str) -> bool:
        """Return whether a file of this name may be there after a kill."""
        last = name.rpartition("/")[2]
        own = [Path(made).name for made in self.makes]
        unfinished = [f".{each}.{end}" for each in own for end in ("tmp", "lock")]
        return self.makes_file(name) or last in unfinished or self.keeps(name)


def prepare(folder: Path) -> Path:
    """Write the inputs of all commands: maps, a library and a bag of the demo's world."""
    from placegraph.indoor.build import build_scene
    from placegraph.indoor.library import SceneLibrary
    from placegraph.io.capture.capture import open_capture
    from placegraph.outdoor.city import build_city
    from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture

    unpack(folder)
    town = build_city(folder / f"{TOWN}.osm", folder / "town.city")
    with patch("placegraph.core.mapfile.ALIGNMENT", 1):  # as in the map of a large city
        town.save(folder / "indexed.city", index=True)
    scene = build_scene(folder / f"{FLAT}.glb", folder / "flat.scene")
    capture = open_capture(folder / "walk")
    scene.diff(capture, scene.localize(capture, seed=0)).save(folder / "changes.json")
    library = SceneLibrary()
    for name in ("home1", "home3"):
        library.add(name, folder / f"{name}.scene")
    library.save(folder / "homes.library")
    with BagWriter(folder / "walk.mcap") as bag:
        write_capture(bag, open_capture(folder / "window", labels=None), Layout())
    return folder


def list_commands(inputs: Path) -> list[WritingCommand]:
    """Return every command that writes files."""
    osm, flat, city = inputs / f"{TOWN}.osm", inputs / "flat.scene", inputs / "town.city"
    window = inputs / "window"
    every = [
        ("city build", (osm, "-o", "a.city"), ("a.city",)),
        ("city embed", (city, "-o", "a.vectors"), ("a.vectors",)),
        ("city locate", (city, TEXT, "--html", "a.html", "--png", "a.png"), ("a.html", "a.png")),
        ("city info", (city, "--png", "a.png"), ("a.png",)),
        ("scene build", (inputs / f"{FLAT}.glb", "-o", "a.scene"), ("a.scene",)),
        ("scene localize", (flat, window, *RUN), RUN[1::2]),
        ("scene anchor", (flat, "--pose", "7.4,43.7,10,90", "-o", "a.scene"), ("a.scene",)),
        ("scene diff", (flat, window, "-o", "a.json", "--png", "a.png"), ("a.json", "a.png")),
        ("scene update", (flat, inputs / "changes.json", "-o", "a.scene"), ("a.scene",)),
        ("scene encode", (flat, "-o", "a.scene", "--encoder", "appearance"), ("a.scene",)),
        ("scene export", (flat, "a.glb", "--force"), ("a.glb",)),
        ("scene render", (flat, "-o", ".", "--pose", "2,2,1.6,0", "--capture", window), RENDERED),
        ("library build", (inputs / "home1.scene", "-o", "a.library"), ("a.library",)),
        ("bag localize", (inputs / "walk.mcap", flat, "-o", "a.mcap"), ("a.mcap",)),
    ]  # fmt: skip
    found = [WritingCommand(w, (*w.split(), *map(str, words)), makes) for w, words, makes in every]
    found[-1] = replace(found[-1], leaves=(".a.mcap.*",), old=None)
    tiles = (osm, "-o", "a.world", "--zoom", "15", "--overlap", "50", "--workers", "2")
    shards = (inputs / "homes.library", "-o", "a.shards", "--size", "1")
    homes = {
        "library add": ("a.library", inputs / "home2.scene"),
        "library remove": ("a.library", "home1"),
    }
    folders = {
        "world build": (tiles, "a.world", "world.json"),
        "library shard": (shards, "a.shards", "usual.shard"),
    }
    return [
        *found,
        *(
            WritingCommand(w, (*w.split(), *map(str, words)), ("a.library",), old="homes.library")
            for w, words in homes.items()
        ),
        *(
            WritingCommand(
                w, (*w.split(), *map(str, words)), (name,), (f"{name}/.*", f"{name}/*/.*"),
                ends=f"{name}/{last}",
            )
            for w, (words, name, last) in folders.items()
        ),
    ]  # fmt: skip


IDLE_TIMEOUT = 120.0  # a process that was idle for so long hangs [s]
CPU_TIMEOUT = 300.0  # a process that took so much CPU time hangs [s]
LOADED = (
    "placegraph.outdoor.city", "placegraph.outdoor.network", "placegraph.view", "placegraph.indoor.library",
    "placegraph.indoor.build", "placegraph.indoor.localize", "placegraph.indoor.mapping.change.update",
    "placegraph.indoor.mapping.export", "placegraph.cli", "placegraph_scale.build",
    "placegraph.core.jit", "placegraph.maps",
    "placegraph_ros.localizer", "osmium", "embreex.rtcore_scene", "PIL.Image",
)  # fmt: skip
"""Modules that are imported once for all trials."""
_TICK = 0.0005
POWERS = (1, 2)  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH, by which root ignores permissions
_CAPABILITY, _DROP = 0x20080522, 24  # version of the call, and PR_CAPBSET_DROP


@dataclass(frozen=True)
class CommandResult:
    """Exit code and error output of a command."""

    code: int | None  # negative for a signal; None: it did not end in its time
    error_output: str
    seconds: float
    killed: bool  # whether the trial killed it

    @property
    def outcome(self) -> str:
        """Return the outcome (one of `row.OUTCOMES`) of a command that nobody disturbed."""
        if self.code is None:
            return "hang"
        if self.code < 0:
            return "crash"
        if self.code == 0:
            return "accepted"
        typed = self.code in range(3, 14) and "Traceback" not in self.error_output
        return "typed" if typed else "untyped"


@dataclass(frozen=True)
class Limits:
    """Limits of a command."""

    file: int | None = None  # largest file that it may write [bytes]
    bound: bool = False  # whether permissions apply even where root started it


@dataclass
class RunningCommand:
    """A running command."""

    process: Any
    errors: Path
    start: float = field(default_factory=time.perf_counter)
    killed: bool = False

    def kill(self, *, without_children: bool = False) -> None:
        """Kill the command, with its helpers or alone."""
        self.killed = True
        with suppress(ProcessLookupError):  # its group has its number, once it has begun
            (os.kill if without_children else os.killpg)(self.process.pid, signal.SIGKILL)
        with suppress(ProcessLookupError):
            os.kill(self.process.pid, signal.SIGKILL)

    def end(self) -> CommandResult:
        """Wait for the end; return the result."""
        code = wait_for(self.process)
        if code is None:
            self.kill()
            self.process.join()
        said = self.errors.read_text(errors="replace") if self.errors.exists() else ""
        taken = time.perf_counter() - self.start
        ours = self.killed and code == -signal.SIGKILL
        return CommandResult(0 if ours else code, said, taken, ours)

    def helpers(self, seconds: float = 20.0) -> list[int]:
        """Return the processes of its group that outlive it by `seconds`."""
        end = time.monotonic() + seconds
        while found := _group(self.process.pid):
            if time.monotonic() > end:
                return found
            time.sleep(0.02)
        return []


class Commands:
    """Starts commands: each is forked from a process that has imported `LOADED`."""

    def __init__(self) -> None:
        self._context: Any = get_context("forkserver")
        self._context.set_forkserver_preload(list(LOADED))

    def start(
        self, words: tuple[str, ...], folder: Path, room: Path, limits: Limits | None = None
    ) -> RunningCommand:
        """Run `placegraph WORDS` in a folder; `room` is for its errors and temporary files."""
        errors = room / "errors.txt"
        errors.unlink(missing_ok=True)
        process = self.process(command, words, folder, room, errors, limits or Limits())
        return RunningCommand(process, errors)

    def process(self, work: Callable[..., None], *given: object) -> Any:  # noqa: ANN401  # its process
        """Run a function in a process of its own."""
        process = self._context.Process(target=work, args=given)
        process.start()
        return process


def command(words: tuple[str, ...], folder: Path, room: Path, errors: Path, limits: Limits) -> None:
    """Run the command line in this process, in a process group of its own."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(folder)
    tempfile.tempdir = str(room)
    nothing, out = os.open(os.devnull, os.O_RDWR), os.open(errors, os.O_CREAT | os.O_WRONLY, 0o666)
    for given, number in ((nothing, 0), (nothing, 1), (out, 2)):
        os.dup2(given, number)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    if limits.file is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limits.file, resource.RLIM_INFINITY))
    if limits.bound:
        import ctypes

        libc = ctypes.CDLL(None)
        for power in POWERS:
            libc.prctl(_DROP, power, 0, 0, 0)
        head, sets = (ctypes.c_uint32 * 2)(_CAPABILITY, 0), (ctypes.c_uint32 * 6)()
        libc.capget(head, sets)
        for k in (0, 1, 2):  # what is in effect, what may be, and what is handed on
            sets[k] &= ~sum(1 << power for power in POWERS)
        if libc.capset(head, sets):
            raise OSError("root cannot be bound here")
    sys.argv = ["placegraph", *words]
    from placegraph.cli import main

    main()


def wait_until(moment: Callable[[], bool], seconds: float, running: RunningCommand) -> bool:
    """Wait until `moment` holds, the command ends, or `seconds` pass; return whether it holds."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end and running.process.exitcode is None:
        if moment():
            return True
        time.sleep(_TICK)
    return moment()


@contextmanager
def mount_disk(folder: Path, size: int) -> Iterator[Path | None]:
    """Mount a file system of `size` bytes; yield None where that is not allowed."""
    import subprocess

    folder.mkdir(parents=True, exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(words, capture_output=True, check=False).returncode:  # noqa: S603
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False)  # noqa: S603, S607


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder by relative name."""
    found: dict[str, bytes] = {}
    for path in folder.rglob("*"):
        with suppress(OSError):  # gone meanwhile
            if path.is_file():
                found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def wait_for(process: Any) -> int | None:  # noqa: ANN401  # of multiprocessing
    """Wait for a process; return its exit code, or None where it hangs."""
    since, before = time.monotonic(), -1.0
    while process.exitcode is None:
        process.join(0.5)
        busy, spent = _at_work(process.pid)
        if busy or spent != before:
            since, before = time.monotonic(), spent
        if spent > CPU_TIMEOUT or time.monotonic() - since > IDLE_TIMEOUT:
            return None
    code: int = process.exitcode
    return code


def _at_work(number: int) -> tuple[bool, float]:
    """Return whether a process group is running or runnable, and its CPU time [s]."""
    busy, ticks = False, 0
    for each in {number, *_group(number)}:
        with suppress(OSError, ValueError, IndexError):
            stat = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
            busy |= stat[0] in "RD"
            ticks += int(stat[11]) + int(stat[12])
    return busy, ticks / os.sysconf("SC_CLK_TCK")


def _group(number: int) -> list[int]:
    """Return the living processes of a group."""
    found = []
    for path in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            state, _, group = (path / "stat").read_text().rpartition(")")[2].split()[:3]
            if path.name.isdigit() and int(group) == number and state not in "ZX":
                found.append(int(path.name))
    return found
