"""One seed, one answer: over processes, hash seeds, threads, threading layers and ray casters."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

import placegraph
from placegraph_lab.campaign import specimen
from placegraph_lab.campaign.row import Effort, Row

PROGRAM = str(specimen.__file__)
FRAMES = 4
PATIENCE = 1800.0  # A process is given up after so long [s]; the first compiles
CLOSE = 0.01
"""So far apart may numbers of two matrices of poses be where rays are cast by another program."""
LAYERS = ("workqueue", "omp", "tbb")


@dataclass
class Told:
    """What processes print, and what the first of them did."""

    folder: Path
    known: dict[str, Any] = field(default_factory=dict)

    @property
    def first(self) -> dict[str, Any]:
        """Of a process as it comes."""
        if not self.known:
            self.known = told()
        return self.known


def told(
    words: Sequence[str] = (),
    *,
    change: Mapping[str, str] | None = None,
    within: Sequence[str] = (),
    program: str = sys.executable,
) -> dict[str, Any]:
    """What the program says in a process of its own, with `change` to its environment.

    Raises `RuntimeError` with its last words where it fails.
    """
    done = subprocess.run(  # noqa: S603  # our own program
        [*within, program, PROGRAM, "--frames", str(FRAMES), *words],
        env=os.environ | dict(change or {}), capture_output=True, check=False, timeout=PATIENCE,
    )  # fmt: skip
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise RuntimeError(f"{done.returncode}: {' '.join(said[-1:])}")
    out: dict[str, Any] = json.loads(done.stdout)
    return out


def again(world: Told, rng: np.random.Generator) -> str:
    """Another process, whose sets and dictionaries of words are hashed otherwise."""
    seed = str(rng.integers(1, 1 << 31))
    return differing(world.first, told(change={"PYTHONHASHSEED": seed}))


def threads(world: Told, rng: np.random.Generator) -> str:
    """On one thread, or on as many as there are."""
    number = str(rng.integers(1, 9))
    change = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    return differing(world.first, told(["--threads", number], change=change))


def layers(world: Told, rng: np.random.Generator) -> str:
    """With any threading layer of numba named: no kernel uses one."""
    return differing(world.first, told(change={"NUMBA_THREADING_LAYER": str(rng.choice(LAYERS))}))


def rays(world: Told, rng: np.random.Generator) -> str:  # noqa: ARG001  # nothing to draw
    """Without Embree: maps and sentences in the same bytes, and the pose to a centimetre.

    A tree of our own finds the same triangles but for rays that meet an edge, and rounds otherwise.
    """
    return pose_apart(world.first, told(["--hide", "embreex"]))


def pose_apart(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Which answers are not the same, in words, where poses may be a centimetre apart.

    Of other numbers nine digits are compared: another NumPy rounds its functions otherwise.
    """
    poses = [np.array(t["pose"]["modes"][0]["map_from_camera"]) for t in (one, other)]
    far = float(np.abs(poses[0] - poses[1]).max())
    if one["pose"]["status"] != other["pose"]["status"] or far > CLOSE:
        return f"the pose moved by {far:.4f}, {other['pose']['status']}"
    rest = ({n: nine_digits(v) for n, v in t.items() if n != "pose"} for t in (one, other))
    return differing(*rest)


def nine_digits(told: Any) -> Any:  # noqa: ANN401  # JSON
    """JSON whose numbers are rounded."""
    if isinstance(told, dict):
        return {k: nine_digits(v) for k, v in told.items()}
    if isinstance(told, list):
        return [nine_digits(v) for v in told]
    return float(f"{told:.9g}") if isinstance(told, float) else told


def differing(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Which answers are not the same, in words."""
    return ", ".join(f"{k} differs" for k in one if one[k] != other.get(k))


PROCESSES = (Told, 2.0, {
    "same seed, same bytes: another process": again,
    "same seed, same bytes: threads": threads,
    "same seed, same bytes: threading layers": layers,
    "without Embree": rays,
})  # fmt: skip


PART = "platforms"
SOURCE = Path(placegraph.__file__).parents[1]
TURKISH = ("tr_TR.UTF-8", "tr_TR.ISO-8859-9")
TWINE = "wheel and sdist, twine check"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
NUMPY = {"oldest": "numpy==1.26.0", "newest": "numpy"}
"""The oldest that pyproject allows, on the oldest Python, and the newest that all others take."""
_PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check", "install")
_INSTALL = 900.0  # an installation is given up after so long [s]


@dataclass(frozen=True)
class Platform:
    """How a process of another kind of machine is started here."""

    name: str
    words: tuple[str, ...] = ()  # for the program of `specimen`
    change: dict[str, str] = field(default_factory=dict)  # to its environment
    within: tuple[str, ...] = ()  # command that starts it


def together(*platforms: Platform) -> Platform:
    """All of them at once."""
    words = tuple(w for p in platforms for w in p.words)
    change = {name: value for p in platforms for name, value in p.change.items()}
    within = tuple(w for p in platforms for w in p.within)
    return Platform(" and ".join(p.name for p in platforms), words, change, within)


def quick(folder: Path) -> Iterator[Platform]:
    """Those that need no installation; each takes a few seconds."""
    yield Platform("no Embree, no PoseLib", ("--hide", "embreex", "poselib"))
    yield Platform("numba's workqueue", change={"NUMBA_THREADING_LAYER": "workqueue"})
    yield Platform("1 GB of memory", ("--memory", "1024"))
    plain = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    yield Platform("locale C, ASCII", change=plain)
    for name in TURKISH:
        if made := turkish(folder, name):
            change = {"LOCPATH": str(made), "LC_ALL": name, "PYTHONUTF8": "0"}
            yield Platform(f"locale {name}", ("--locale", name), change)
    yield Platform("TZ far east", change={"TZ": "Pacific/Kiritimati"})
    if shutil.which("taskset"):
        yield Platform("one core", within=("taskset", "-c", str(min(os.sched_getaffinity(0)))))
    if read_only := _read_only():
        change = {"HOME": "/nonexistent", "TMPDIR": str(folder)}
        yield Platform("read-only install, no home", change=change, within=read_only)


def turkish(folder: Path, name: str) -> Path | None:
    """Folder with a Turkish locale, made of Debian's `locales`; None where they are not installed."""
    with suppress(OSError, subprocess.CalledProcessError):
        command = ["localedef", "-i", "tr_TR", "-f", name.partition(".")[2], str(folder / name)]
        subprocess.run(command, check=True, capture_output=True)  # noqa: S603  # our own
        return folder
    return None


def _read_only() -> tuple[str, ...]:
    """Command within which the sources cannot be written, also by root; empty where that cannot be."""
    mount = (
        f'mount --bind "{SOURCE}" "{SOURCE}" && mount -o remount,ro,bind "{SOURCE}" && exec "$@"'
    )
    command = ("unshare", "--mount", "--propagation", "private", "sh", "-ec", mount, "sh")
    with suppress(OSError):
        done = subprocess.run([*command, "true"], check=False, capture_output=True)  # noqa: S603
        return () if done.returncode else command
    return ()


def agrees(platform: Platform, first: dict[str, Any]) -> str:
    """How its answers differ, in words; empty: they do not.

    Without Embree and PoseLib the pose may differ by a centimetre, and what led to it.
    """
    found = told(platform.words, change=platform.change, within=platform.within)
    if "embreex" in platform.words:
        return pose_apart(first, found)
    return differing(first, found)


def installed(python: str, what: list[str], folder: Path, first: dict[str, Any]) -> str:
    """Install in an empty environment, answer there, run the demo; what goes wrong, in words."""
    _run(python, "-m", "venv", str(folder / "venv"))
    program = str(folder / "venv" / "bin" / "python")
    _run(program, *_PIP, *what)
    compiled = str(folder.parent / "compiled")  # what is compiled is told apart by versions
    found = told(["--compiled", compiled], program=program, change={"PYTHONPATH": ""})
    demo = ["-m", "placegraph", "--compiled", compiled, "demo", "--out", str(folder / "demo")]
    _run(program, "-I", *demo)
    return pose_apart(first, found)


def pythons() -> dict[str, str]:
    """Interpreters at hand by version: those of the path, and pyenv's."""
    found: dict[str, str] = {}
    for version in PYTHONS:
        own = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
        at = shutil.which(f"python{version}")
        candidates = [str(p) for p in own] + ([at] if at else [])
        for candidate in candidates:
            with suppress(RuntimeError):
                if _run(candidate, "--version").startswith(f"Python {version}."):
                    found[version] = candidate
    return found


def installations(folder: Path) -> Iterator[tuple[str, str, list[str]]]:
    """Name, interpreter and what is installed, of each environment; builds wheel and sdist first."""
    [wheel], [sdist] = _built(folder)
    found = pythons()
    for version, python in found.items():
        yield f"wheel, Python {version}", python, [str(wheel)]
    oldest = found.get(PYTHONS[0], sys.executable)
    yield "sdist", oldest, [str(sdist)]
    for name, numpy in NUMPY.items():
        yield f"NumPy, {name} allowed", oldest, [str(wheel), numpy]


def _built(folder: Path) -> tuple[list[Path], list[Path]]:
    """Wheels and sdists in a folder; one of each is built where there is none."""
    if not folder.exists():
        command = ("-m", "hatchling", "build", "-d", str(folder))
        _run(sys.executable, *command, cwd=SOURCE.parent)
    return list(folder.glob("*.whl")), list(folder.glob("*.tar.gz"))


def _checked(folder: Path) -> str:
    """Nothing, where twine finds nothing wrong; `RuntimeError` with what it says else."""
    wheels, sdists = _built(folder)
    _run(sys.executable, "-m", "twine", "check", "--strict", *map(str, wheels + sdists))
    return ""


def rows(effort: Effort) -> Iterator[Row]:
    """One row a platform; installations where there is time for each."""
    first = told()
    (effort.folder / "locales").mkdir(parents=True)
    start = monotonic()
    for platform in (p for p in quick(effort.folder / "locales") if effort.wants(p.name)):
        yield _row(platform.name, lambda p=platform: agrees(p, first), effort)  # type: ignore[misc]
    dist = effort.folder / "dist"
    if find_spec("twine") and effort.wants(TWINE):
        yield _row(TWINE, lambda: _checked(dist), effort)
    for number, (name, python, what) in enumerate(installations(dist)):
        if not effort.wants(name):
            continue
        if monotonic() - start > effort.seconds:
            effort.say(f"{name}: left out, the time is over")
            continue
        place = effort.folder / f"installed{number}"
        place.mkdir()
        yield _row(name, lambda n=python, w=what, p=place: installed(n, w, p, first), effort)  # type: ignore[misc]
        shutil.rmtree(place)
    for version in sorted(set(PYTHONS) - set(pythons())):
        effort.say(f"Python {version}: left out, it is not on this machine")


def _row(name: str, trial: Callable[[], str], effort: Effort) -> Row:
    start = monotonic()
    try:
        broken = trial()
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        broken = str(error)
    if broken:
        effort.say(f"{name}: {broken}")
    found = {"untyped" if broken else "accepted": 1}
    return Row.counted(PART, name, found, effort.seed, monotonic() - start)


def _run(program: str, *words: str, cwd: Path | None = None) -> str:
    """What a program says; `RuntimeError` with its last words where it fails."""
    done = subprocess.run(  # noqa: S603  # our own
        [program, *words], cwd=cwd, capture_output=True, text=True, check=False, timeout=_INSTALL
    )
    if done.returncode:
        last = re.sub(r"\s+", " ", done.stderr.strip()[-300:])
        raise RuntimeError(f"{Path(program).name} {words[0]} ended with {done.returncode}: {last}")
    return done.stdout
