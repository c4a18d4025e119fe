"""Drawn homes as places that the network of SceneGraphLoc learns from."""

from __future__ import annotations

from functools import partial

import numpy as np

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.io.capture.capture import Capture
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.home.home import CAMERA, change_home, home, record, scene_of, visit
from placegraph_learn.scenegraphloc.lessons import Material, SurveyedScene, World, place_capture


def homes(
    count: int,
    *,
    seed: int = 0,
    frames: int = 16,
    changes: bool = True,
    camera: Camera | None = None,
) -> list[World]:
    """Draw procedural homes, each from its own seed.

    `count`: number of homes; `seed`: the same seed, the same homes; `frames`: images of each of the
    walks: one to know the objects by, one whose patches are learned; `changes`: whether a home is known
    as it was months before, too, when things stood elsewhere; `camera`: of the images; `record.CAMERA`
    if not given.
    """
    if count < 1 or frames < 1:
        raise OptionError(f"homes: {count}, frames: {frames}; choose at least one of each.")
    return [
        World(f"home-{seed}-{i:04d}", partial(_home, seed, i, frames, camera, changes=changes))
        for i in range(count)
    ]


def _home(seed: int, index: int, frames: int, camera: Camera | None, *, changes: bool) -> Material:
    rng = np.random.default_rng([seed, index])
    flat = home(rng)
    then = flat.furnish(rng)
    now = change_home(then, rng) if changes else then

    def walk(interior: Interior) -> Capture:
        way = visit(flat, interior, rng, frames=frames)
        lit = float(rng.random())
        taken = record(
            interior, way, rng, camera=camera or CAMERA, daylight=lit, labels=None
        )  # fmt: skip
        return place_capture(taken, way.map_from_camera)

    earlier = SurveyedScene(scene_of(then), (walk(then),)) if changes else None
    return Material(SurveyedScene(scene_of(now), (walk(now),)), (walk(now),), earlier)
