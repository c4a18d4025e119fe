"""Which scene does a sentence describe, and does one about a pose help? Recall of both.

Rooms that somebody described (`worlds/data/sentences`), against a bag of words. Scenes: procedural
homes, the flat that ships, rooms of the house. Poses: single frames of the house.

    placegraph-lab table scene_sentences

Prints Markdown tables: how often a described room comes first, recall@1/3/5 by the number of facts in
a sentence, recall of poses; and writes them as JSON. The house is left out where ../shared is missing.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from placegraph.indoor.build import build_scene
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.windows import house_windows
from placegraph_lab.tables.runner import Quick, Run, Seed, option, table
from placegraph_lab.tables.scene import spoken_poses, told
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


def _scenes(homes: int, house: SceneMap | None, rng: np.random.Generator) -> list[Scene]:
    scenes = []
    for number in range(homes):
        interior = home(rng).furnish(rng)
        scenes.append(scenes_of(scene_of(interior), f"home {number}"))
    scenes.append(scenes_of(scene_of(Flat.load("altbau").furnish(rng)), "altbau"))
    if house is not None:
        scenes += rooms_of(scenes_of(house, "house"))
    return scenes


@table()
def scene_sentences(
    run: Run,
    seed: Seed = 0,
    homes: Annotated[int, option("Procedural homes.")] = 60,
    each: Annotated[int, option("Sentences a scene and row.")] = 4,
    every: Annotated[int, option("Frames from one asked about to the next.")] = 8,
    draws: Annotated[int, option("Sets of ten rooms that a described room stands among.")] = 20,
    *,
    quick: Quick = False,
) -> None:
    """Which scene does a sentence describe, and does one about a pose help? Recall of both."""
    if quick:
        homes, each, every, draws = 12, 1, 100, 1
    glb = run.data / "house/map/house.glb"
    house = build_scene(glb, None) if glb.exists() else None
    if house is None:
        run.say(f"{glb} is not there: it is left out.")
    described = told.ask(house, np.random.default_rng(seed), draws=draws)
    print(f"Rooms that somebody described, first among ten of {described[0]['rooms']}\n")
    print(f"{told.report(described)}\n")
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
    record: dict[str, Any] = {"times": times, "scenes": figures(asked), "described": described}
    if house is not None:
        windows = house_windows(run.data / "house", 1, every=every)
        spoken = spoken_poses.ask(house, windows, rng, seed=seed)
        print(f"\n{len(windows)} single frames of the house\n\n{spoken_poses.report(spoken)}")
        record["poses"] = spoken_poses.figures(spoken)
    run.save(record)
