"""One seed, one answer: over processes, hash seeds, threads, threading layers and ray casters."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from placegraph_lab.campaign import specimen

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
