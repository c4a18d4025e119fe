"""Which scene does a sentence describe, and does one about a pose help? Recall of both.

Scenes: procedural homes, the flat that ships, rooms of the house. Poses: single frames of the house.

    python benchmarks/scene_sentences.py

Prints Markdown tables, recall@1/3/5 by the number of facts in a sentence and recall of poses, and
writes them as JSON. The house is left out where ../shared is missing.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from placegraph.indoor.build import build_scene
from placegraph_lab.tables.indoor import spoken_poses
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.indoor.windows import house_windows
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.scene.sentences import (
    FACTS,
    WRONG,
    Asked,
    Scene,
    ask,
    figures,
    report,
    rooms_of,
    scenes_of,
    speed,
)
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import home, scene_of

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap

ROOT = Path(__file__).parents[1]
HOUSE = ROOT.parent / "shared/data/house/map/house.glb"
OUT = ROOT / "benchmarks/results/scene_sentences.json"


def main(
    seed: Annotated[int, typer.Option(help="Of homes and sentences.")] = 0,
    homes: Annotated[int, typer.Option(help="Procedural homes.")] = 60,
    each: Annotated[int, typer.Option(help="Sentences a scene and row.")] = 4,
    every: Annotated[int, typer.Option(help="Frames from one asked about to the next.")] = 8,
    out: Annotated[Path, typer.Option(help="JSON file.")] = OUT,
) -> None:
    """Measure recall of scenes and of poses by text, and print Markdown."""
    house = build_scene(HOUSE, None) if HOUSE.exists() else None
    scenes = _scenes(homes, house, np.random.default_rng(seed))
    rng = np.random.default_rng(seed + 1)
    asked: list[Asked] = []
    for facts in FACTS:
        for wrong in WRONG:
            asked += ask(scenes, rng, facts=facts, wrong=wrong, each=each)
    times = speed(scenes, rng)
    print(f"{len(scenes)} scenes; recall@1/3/5 among 10 and among 50\n")
    print(report(asked))
    print("\n" + ", ".join(f"{name} {value:.2f}" for name, value in times.items()))
    record = {"machine": machine(), "seed": seed, "times": times, "scenes": figures(asked)}
    if house is not None:
        windows = house_windows(HOUSE.parents[1], 1, every=every)
        spoken = spoken_poses.ask(house, windows, rng, seed=seed)
        print(f"\n{len(windows)} single frames of the house\n\n{spoken_poses.report(spoken)}")
        record["poses"] = spoken_poses.figures(spoken)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(dumps(record), encoding="utf-8")


def _scenes(homes: int, house: SceneMap | None, rng: np.random.Generator) -> list[Scene]:
    scenes = []
    for number in range(homes):
        interior = home(rng).furnish(rng)
        scenes.append(scenes_of(scene_of(interior), f"home {number}"))
    scenes.append(scenes_of(scene_of(Flat.load("altbau").furnish(rng)), "altbau"))
    if house is not None:
        scenes += rooms_of(scenes_of(house, "house"))
    else:
        print(f"{HOUSE} is not there: it is left out.", file=sys.stderr)
    return scenes


if __name__ == "__main__":
    typer.run(main)
