"""Reproducibility: the same answers over processes, threads, ray casters, locales and installations."""

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
from functools import partial
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
TIMEOUT = 1800.0  # of a process [s]; the first compiles
POSE_TOLERANCE = 0.01  # between numbers of two pose matrices by different ray casters
LAYERS = ("workqueue", "omp", "tbb")


class Reference:
    """Answers of a process without changes."""

    def __init__(self, _folder: Path) -> None:
        self.answers = run_specimen()


def run_specimen(
    words: Sequence[str] = (),
    *,
    change: Mapping[str, str] | None = None,
    within: Sequence[str] = (),
    program: str = sys.executable,
) -> dict[str, Any]:
    """Return the answers of `specimen` in a process whose environment has `change`.

    Raises `RuntimeError` with the last line of its error output where it fails.
    """
    done = subprocess.run(  # noqa: S603  # our own program
        [*within, program, PROGRAM, "--frames", str(FRAMES), *words],
        env=os.environ | dict(change or {}), capture_output=True, check=False, timeout=TIMEOUT,
    )  # fmt: skip
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise RuntimeError(f"{done.returncode}: {' '.join(lines[-1:])}")
    out: dict[str, Any] = json.loads(done.stdout)
    return out


def use_another_process(world: Reference, rng: np.random.Generator) -> str:
    """Compare a process with another hash seed."""
    seed = str(rng.integers(1, 1 << 31))
    return list_differences(world.answers, run_specimen(change={"PYTHONHASHSEED": seed}))


def use_other_threads(world: Reference, rng: np.random.Generator) -> str:
    """Compare a process with another number of threads."""
    number = str(rng.integers(1, 9))
    change = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    return list_differences(world.answers, run_specimen(["--threads", number], change=change))


def use_other_threading_layer(world: Reference, rng: np.random.Generator) -> str:
    """Compare a process with another threading layer of numba: no kernel uses one."""
    return list_differences(
        world.answers, run_specimen(change={"NUMBA_THREADING_LAYER": str(rng.choice(LAYERS))})
    )


def hide_embree(world: Reference, rng: np.random.Generator) -> str:  # noqa: ARG001  # nothing to draw
    """Compare a process without Embree: the same bytes of maps and sentences, poses to a centimetre."""
    return compare_poses(world.answers, run_specimen(["--hide", "embreex"]))


def compare_poses(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Describe differences; poses may differ by a centimetre, other numbers in the tenth digit."""
    poses = [np.array(t["pose"]["modes"][0]["map_from_camera"]) for t in (one, other)]
    far = float(np.abs(poses[0] - poses[1]).max())
    if one["pose"]["status"] != other["pose"]["status"] or far > POSE_TOLERANCE:
        return f"the pose moved by {far:.4f}, {other['pose']['status']}"
    others = ({n: round_numbers(v) for n, v in t.items() if n != "pose"} for t in (one, other))
    return list_differences(*others)


def round_numbers(value: Any) -> Any:  # noqa: ANN401  # JSON
    """Round the numbers of JSON to nine digits."""
    if isinstance(value, dict):
        return {k: round_numbers(v) for k, v in value.items()}
    if isinstance(value, list):
        return [round_numbers(v) for v in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


def list_differences(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Describe which answers differ; empty where none does."""
    return ", ".join(f"{k} differs" for k in one if one[k] != other.get(k))


PROCESSES = (Reference, 2.0, {
    "same seed, same bytes: another process": use_another_process,
    "same seed, same bytes: threads": use_other_threads,
    "same seed, same bytes: threading layers": use_other_threading_layer,
    "without Embree": hide_embree,
})  # fmt: skip


PART = "platforms"
SOURCE = Path(placegraph.__file__).parents[1]
TURKISH = ("tr_TR.UTF-8", "tr_TR.ISO-8859-9")
TWINE = "wheel and sdist, twine check"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
NUMPY = {"oldest": "numpy==1.26.0", "newest": "numpy"}
"""Requirements: the oldest NumPy that pyproject allows, and the newest."""
_PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check", "install")
_INSTALL = 900.0  # timeout of an installation [s]


@dataclass(frozen=True)
class Platform:
    """Environment in which a process acts like another machine."""

    name: str
    words: tuple[str, ...] = ()  # for the program of `specimen`
    change: dict[str, str] = field(default_factory=dict)  # to its environment
    within: tuple[str, ...] = ()  # command that starts it


def combine(*platforms: Platform) -> Platform:
    """Return a platform with the properties of all."""
    words = tuple(w for p in platforms for w in p.words)
    change = {name: value for p in platforms for name, value in p.change.items()}
    within = tuple(w for p in platforms for w in p.within)
    return Platform(" and ".join(p.name for p in platforms), words, change, within)


def quick(folder: Path) -> Iterator[Platform]:
    """Yield the platforms that need no installation."""
    yield Platform("no Embree, no PoseLib", ("--hide", "embreex", "poselib"))
    yield Platform("numba's workqueue", change={"NUMBA_THREADING_LAYER": "workqueue"})
    yield Platform("1 GB of memory", ("--memory", "1024"))
    plain = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    yield Platform("locale C, ASCII", change=plain)
    for name in TURKISH:
        if made := make_turkish_locale(folder, name):
            change = {"LOCPATH": str(made), "LC_ALL": name, "PYTHONUTF8": "0"}
            yield Platform(f"locale {name}", ("--locale", name), change)
    yield Platform("TZ far east", change={"TZ": "Pacific/Kiritimati"})
    if shutil.which("taskset"):
        yield Platform("one core", within=("taskset", "-c", str(min(os.sched_getaffinity(0)))))
    if read_only := _read_only():
        change = {"HOME": "/nonexistent", "TMPDIR": str(folder)}
        yield Platform("read-only install, no home", change=change, within=read_only)


def make_turkish_locale(folder: Path, name: str) -> Path | None:
    """Make a Turkish locale from Debian's `locales`; None where they are not installed."""
    with suppress(OSError, subprocess.CalledProcessError):
        command = ["localedef", "-i", "tr_TR", "-f", name.partition(".")[2], str(folder / name)]
        subprocess.run(command, check=True, capture_output=True)  # noqa: S603  # our own
        return folder
    return None


def _read_only() -> tuple[str, ...]:
    """Return a command under which the sources are read-only; empty where that is impossible."""
    mount = (
        f'mount --bind "{SOURCE}" "{SOURCE}" && mount -o remount,ro,bind "{SOURCE}" && exec "$@"'
    )
    command = ("unshare", "--mount", "--propagation", "private", "sh", "-ec", mount, "sh")
    with suppress(OSError):
        done = subprocess.run([*command, "true"], check=False, capture_output=True)  # noqa: S603
        return () if done.returncode else command
    return ()


def check_platform(platform: Platform, first: dict[str, Any]) -> str:
    """Describe how the answers on a platform differ; empty where they do not."""
    found = run_specimen(platform.words, change=platform.change, within=platform.within)
    if "embreex" in platform.words:
        return compare_poses(first, found)
    return list_differences(first, found)


def check_installation(python: str, what: list[str], folder: Path, first: dict[str, Any]) -> str:
    """Install in an empty environment, answer there and run the demo; describe what goes wrong."""
    _run(python, "-m", "venv", str(folder / "venv"))
    program = str(folder / "venv" / "bin" / "python")
    _run(program, *_PIP, *what)
    compiled = str(folder.parent / "compiled")
    found = run_specimen(["--compiled", compiled], program=program, change={"PYTHONPATH": ""})
    demo = ["-m", "placegraph", "--compiled", compiled, "demo", "--out", str(folder / "demo")]
    _run(program, "-I", *demo)
    return compare_poses(first, found)


def find_pythons() -> dict[str, str]:
    """Find interpreters by version, on the path and of pyenv."""
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
    """Yield name, interpreter and requirements of each environment; build wheel and sdist first."""
    [wheel], [sdist] = _built(folder)
    found = find_pythons()
    for version, python in found.items():
        yield f"wheel, Python {version}", python, [str(wheel)]
    oldest = found.get(PYTHONS[0], sys.executable)
    yield "sdist", oldest, [str(sdist)]
    for name, numpy in NUMPY.items():
        yield f"NumPy, {name} allowed", oldest, [str(wheel), numpy]


def _built(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return wheels and sdists of a folder; build one of each where there is none."""
    if not folder.exists():
        command = ("-m", "hatchling", "build", "-d", str(folder))
        _run(sys.executable, *command, cwd=SOURCE.parent)
    return list(folder.glob("*.whl")), list(folder.glob("*.tar.gz"))


def _check_wheels(folder: Path) -> str:
    """Run twine check; `RuntimeError` with its output where it fails."""
    wheels, sdists = _built(folder)
    _run(sys.executable, "-m", "twine", "check", "--strict", *map(str, wheels + sdists))
    return ""


def rows(effort: Effort) -> Iterator[Row]:
    """Yield a row for each platform, and for each installation while there is time."""
    first = run_specimen()
    (effort.folder / "locales").mkdir(parents=True)
    start = monotonic()
    for platform in (p for p in quick(effort.folder / "locales") if effort.wants(p.name)):
        yield _row(platform.name, lambda p=platform: check_platform(p, first), effort)  # type: ignore[misc]
    dist = effort.folder / "dist"
    if find_spec("twine") and effort.wants(TWINE):
        yield _row(TWINE, lambda: _check_wheels(dist), effort)
    for number, (name, python, what) in enumerate(installations(dist)):
        if not effort.wants(name):
            continue
        if monotonic() - start > effort.seconds:
            effort.report(f"{name}: skipped, the time is over")
            continue
        place = effort.folder / f"installed{number}"
        place.mkdir()
        trial = partial(check_installation, python, what, place, first)
        yield _row(name, trial, effort)
        shutil.rmtree(place)
    for version in sorted(set(PYTHONS) - set(find_pythons())):
        effort.report(f"Python {version}: skipped, it is not installed")


def _row(name: str, trial: Callable[[], str], effort: Effort) -> Row:
    start = monotonic()
    try:
        broken = trial()
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        broken = str(error)
    if broken:
        effort.report(f"{name}: {broken}")
    found = {"untyped" if broken else "accepted": 1}
    return Row.from_counts(PART, name, found, effort.seed, monotonic() - start)


def _run(program: str, *words: str, cwd: Path | None = None) -> str:
    """Return the output of a program; `RuntimeError` with the end of its error output where it fails."""
    done = subprocess.run(  # noqa: S603  # our own
        [program, *words], cwd=cwd, capture_output=True, text=True, check=False, timeout=_INSTALL
    )
    if done.returncode:
        last = re.sub(r"\s+", " ", done.stderr.strip()[-300:])
        raise RuntimeError(f"{Path(program).name} {words[0]} ended with {done.returncode}: {last}")
    return done.stdout
