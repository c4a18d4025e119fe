"""Where frames were taken, in one map or in any of a library, when nobody knows: the slow question."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, split_pose
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.depth_unit import check_unit
from placegraph.indoor.likelihood.observe import sight
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.estimate import estimate_pose
from placegraph.indoor.pose.placed import placed
from placegraph.indoor.pose.polish import Fit, polished
from placegraph.indoor.pose.prior import Prior
from placegraph.indoor.pose.query import PoseQuery
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.slide import freed
from placegraph.indoor.pose.window import Window, own_encoder, shows_something

if TYPE_CHECKING:
    from placegraph.core.estimate import PoseEstimate
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.frame import Frame

HEIGHT = 0.15
"""A told height with a larger standard deviation [m] is none: on a map of RViz there is no height."""


def look_up(window: Window, rng: Generator) -> tuple[PoseEstimate, Fit]:
    """Estimate of a window's last frame in the whole map, or around the query's prior, and its best fit."""
    seeds = search(window, rng)
    fits = freed(window, polished(window, seeds, rng), rng)
    return estimate_pose(window, fits), fits[0]


@dataclass(frozen=True, eq=False)
class Finder:
    """Maps in which frames are looked up.

    `known`: options, encoder and device, as of `SceneMap.localize`.
    """

    maps: SceneMap | SceneLibrary
    known: dict[str, Any]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the maps; a plain map has that of its first scene."""
        return self.maps.scenes[:1] if isinstance(self.maps, Scene) else self.maps.names

    def named(self, name: str) -> str:
        """The name, or that of the only map where none is given; `OptionError` where it is none."""
        if not name and len(self.scenes) == 1:
            return self.scenes[0]
        if name not in self.scenes:
            known = ", ".join(self.scenes[:5])
            raise OptionError(f"scene is {name!r}; name one of {known or 'an empty library'}.")
        return name

    def scene(self, name: str) -> SceneMap:
        """Map of a name; `OptionError` where there is none, `InputError` where its file is gone."""
        return self.maps if isinstance(self.maps, Scene) else self.maps.scene(name)

    def query(self, name: str, seed: int) -> PoseQuery:
        """The question in one map."""
        return PoseQuery.of(self.scene(name), seed=seed, **self.known)

    def anywhere(self, frames: Sequence[Frame], rng: Generator) -> tuple[str, PoseEstimate]:
        """In which map the last of some frames was taken, and where; the name is empty if in none.

        Raises
        ------
        OptionError
            Nothing that the frames show can be compared.
        InputError, MapError
            An image is broken, or depth is not in metres; a map of the library is gone.

        """
        if isinstance(self.maps, Scene):
            return self.near(frames, self.scenes[0], None, rng)
        seed = int(rng.integers(1 << 31))
        estimate = self.maps.localize(frames, refine=False, seed=seed, **self.known)
        return (estimate.best.scene.partition("/")[0] if estimate.best else ""), estimate

    def near(
        self, frames: Sequence[Frame], name: str, prior: Prior | None, rng: Generator
    ) -> tuple[str, PoseEstimate]:
        """Where in one map, around a prior of the first frame if there is one; errors as `anywhere`."""
        query = replace(self.query(name, 0), prior=prior)
        encoder = query.encoder or own_encoder(query.scene, frames[-1])
        seen = [sight(frame, encoder, query.options) for frame in frames]
        if not shows_something(seen[-1]):
            raise OptionError("frame: no depth, no known labels, no colours: nothing to compare.")
        shown = [s for s in seen if shows_something(s)]
        check_unit(float(np.linalg.norm(np.ptp(query.scene.bounds, axis=0))), shown)
        window = Window(query, Scorer(query.scene, query.options.likelihood), shown)
        estimate, _ = look_up(window, rng)
        return name, placed(query.scene, estimate)


def prior_of(map_from_camera: Floats, covariance: Floats) -> Prior:
    """A pose (4, 4) with its covariance (6, 6) as a prior; who tells a height loosely knows none."""
    (x, y, z, yaw), _ = split_pose(map_from_camera)
    spread = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    turn = min(float(np.sqrt(covariance[5, 5])), np.pi)
    height = float(z) if covariance[2, 2] < HEIGHT**2 else None
    return Prior(float(x), float(y), height, float(yaw), max(spread, 0.02), max(turn, 0.01))
