"""How much a sentence helps a single frame to be localized, and how much a wrong one hurts.

The sentence is made of the true pose by ray casting (what is nearest, ahead, to the left, to the
right and behind), and the pose then thrown away; a wrong one is that of another frame.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, split_pose
from placegraph.indoor.map.floor import WORDS, label_words, nameless
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.metrics import NEAR, Answer, measure
from placegraph_lab.tables.runner import markdown, share

if TYPE_CHECKING:
    from placegraph_lab.tables.indoor.windows import Window

SAID = ("nothing", "true", "wrong")  # sentences: none, of the true pose, of another frame's
TERMS = {"colour": {"colour": True}, "depth + colour": {"depth": True, "colour": True}}
FACTS = 2  # statements in a sentence, where there is that much to say
_NEXT_TO = 1.3  # what is nearer is next to one [m]
_SIDES = {"facing the {}": 0.0, "the {} is on my left": 90.0, "the {} is on my right": -90.0,
          "the {} is behind me": 180.0}  # fmt: skip
_OFF = 20.0  # degrees that a thing may lie beside the direction that is said
_RAYS = 90  # around the horizon
_LEVELS = np.deg2rad(np.linspace(-45.0, 30.0, 16))
_LEAST = 6  # rays that meet a thing that is spoken of


@dataclass(frozen=True)
class Spoken:
    """One localization."""

    terms: str
    said: str  # one of `SAID`
    text: str
    answer: Answer


def describe_pose(scene: SceneMap, map_from_camera: Floats, rng: Generator, facts: int) -> str:
    """What somebody at a pose (4, 4) might say of it, up to `facts` statements; empty for nothing."""
    pose, _ = split_pose(map_from_camera)
    turn = np.arange(_RAYS) * 2.0 * np.pi / _RAYS
    a, e = (grid.ravel() for grid in np.meshgrid(turn, _LEVELS))
    rays = np.stack(
        [np.cos(e) * np.cos(a + pose[3]), np.cos(e) * np.sin(a + pose[3]), np.sin(e)], 1
    )
    hits = scene.caster.cast(pose[:3], rays)
    met = hits.triangle >= 0
    thing = scene.mesh.object_of[hits.triangle[met]]
    away, left = (hits.distance * np.cos(e))[met], np.rad2deg(a)[met]
    said = []
    for row in np.unique(thing[np.bincount(thing)[thing] >= _LEAST]).tolist():
        words = label_words(scene.graph.labels[row])
        if nameless(scene.graph.labels[row]) or words[-1] in WORDS - {"window", "windows"}:
            continue
        own, name = thing == row, " ".join(words)
        if away[own].min() < _NEXT_TO:
            said.append(f"next to the {name}")
        middle = left[own][away[own].argmin()]
        for form, side in _SIDES.items():
            if abs((middle - side + 180.0) % 360.0 - 180.0) < _OFF:
                said.append(form.format(name))
    chosen = rng.permutation(len(said))[:facts]
    return ". ".join(said[i] for i in chosen)


def ask(
    scene: SceneMap, windows: Sequence[Window], rng: Generator, *, seed: int = 0
) -> list[Spoken]:
    """Localize every window without a sentence, with a true one, and with a wrong one."""
    texts = [describe_pose(scene, w.truth, rng, FACTS) for w in windows]
    others = [(i + int(rng.integers(1, len(windows)))) % len(windows) for i in range(len(windows))]
    out = []
    for terms, use in TERMS.items():
        options = PoseSearchOptions().only(**use)
        for i, window in enumerate(windows):
            for said, text in zip(SAID, ("", texts[i], texts[others[i]]), strict=True):
                start = time.perf_counter()
                estimate = scene.localize(
                    window.capture, description=text or None, options=options, refine=False,
                    seed=seed,
                )  # fmt: skip
                answer = measure(
                    estimate, window.truth, seconds=time.perf_counter() - start,
                    frames=len(window.capture), window=window.name, place=window.place,
                    changed=window.changed,
                )  # fmt: skip
                out.append(Spoken(terms, said, text, answer))
    return out


def figures(spoken: Sequence[Spoken]) -> dict[str, dict[str, dict[str, float]]]:
    """By terms and sentence: recall at 0.5 m and 10 degrees, held by any mode, wrong OK, seconds."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for terms in TERMS:
        for said in SAID:
            own = [s.answer for s in spoken if (s.terms, s.said) == (terms, said)]
            if own:
                right = np.array([a.within(*NEAR) for a in own])
                sure = np.array([a.status == "OK" for a in own])
                out.setdefault(terms, {})[said] = {
                    "windows": len(own),
                    "recall": float(right.mean()),
                    "held": float(np.mean([a.held for a in own])),
                    "wrong_ok": float((sure & ~right).mean()),
                    "seconds": float(np.median([a.seconds for a in own])),
                }
    return out


def report(spoken: Sequence[Spoken]) -> str:
    """Markdown table of `figures`."""
    header = ["terms", "sentence", "recall", "held", "OK and wrong", "s"]
    rows = [
        [
            terms,
            said,
            share(f["recall"]),
            share(f["held"]),
            share(f["wrong_ok"]),
            f"{f['seconds']:.2f}",
        ]
        for terms, by in figures(spoken).items()
        for said, f in by.items()
    ]
    return markdown(header, rows)
