"""The recipes that the tables of SG2Loc compare, and what they answer; answers are written down."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import PoseEstimate
from placegraph.indoor.encode import BoundEncoder, Encoder, MapEncoder, encoder, vectors_of
from placegraph.indoor.encode.labels import InstancesEncoder, LabelsEncoder
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.refine import RefineOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.label_noise import NoisyEncoder, NoisyLabels
from placegraph_lab.tables.indoor.metrics import Answer, measure
from placegraph_lab.tables.indoor.windows import DRIFT, Window
from placegraph_lab.tables.retrieval.retrieval_walks import RENDERING
from placegraph_lab.tables.runner import INDOOR, fingerprint
from placegraph_lab.tables.sg2loc.sets import Set, Walk

if TYPE_CHECKING:
    from placegraph_lab.tables.runner import Run

ANSWERING = (
    *INDOOR, *RENDERING, "placegraph_lab/tables/indoor/*.py", "placegraph_lab/tables/pairs/*.py",
    *(f"placegraph_lab/tables/sg2loc/{name}.py" for name in ("ask", "sets", "at_hand", "brought")),
)  # fmt: skip
"""Code that decides what the answers are."""
IMAGES = "appearance"
"""Encoder of images that bring no labels, if none is named."""
GRID = tuple(np.arange(0.2, 2.5, 0.2).tolist())
"""Heights of the ablation *Uniform sampling*: a grid of 0.2 m upwards, too [m]."""


@dataclass(frozen=True)
class Recipe:
    """A filter, and what comes after it."""

    options: FilterOptions
    refine: bool | RefineOptions = False


def recipes() -> dict[str, Recipe]:
    """By name: the paper's, its ablations, what its authors published, and ours."""
    paper = FilterOptions.paper()
    semantic = paper.only(semantic=True)
    finest = replace(paper.passes[-1], stride=1.0)
    return {
        **{
            name: Recipe(FilterOptions.preset(name), RefineOptions.preset(name) or False)
            for name in ("paper", "published", "coarse")
        },
        "ours": Recipe(FilterOptions(), refine=True),
        "semantic": Recipe(semantic),
        "semantic+depth": Recipe(paper.only(semantic=True, depth=True)),
        "depth": Recipe(paper.only(depth=True)),
        "RGB": Recipe(paper.only(colour=True)),
        "stride 1": Recipe(replace(semantic, passes=(*paper.passes[:-1], finest))),
        "uniform": Recipe(replace(semantic, heights=GRID)),
        "fixed": Recipe(replace(semantic, kld=False)),
    }


@dataclass(frozen=True)
class Reply:
    """What a recipe answered about a window."""

    filter: Answer
    """Of the filter alone; its seconds are the filter's."""
    whole: Answer
    """After refinement, where there is any."""
    refining: float
    """[s]"""
    right: bool
    """Whether it named the right one of merged scenes."""

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> Reply:
        """What `Asking.ask` wrote."""
        both = {name: Answer.from_dict(row[name]) for name in ("filter", "whole")}
        return cls(**row | both)


@dataclass(frozen=True)
class How:
    """What is the same in all rows of a table."""

    frames: int
    """Most frames asked of a set, a state and a length; 0: all."""
    encoder: str
    matcher: str
    seed: int
    device: str


class Asking:
    """Asks about windows that nobody asked about yet; all tables share one journal."""

    def __init__(self, run: Run, how: How, *, fresh: bool) -> None:
        self.run, self.how = run, how
        self.journal = replace(run, name="sg2loc").journal(fresh=fresh)
        self._code = fingerprint(ANSWERING)  # once: what is loaded now is what answers
        self._warm: set[str] = set()
        self._merged = lru_cache(maxsize=2)(merged_scenes)

    def replies(
        self,
        of: Set,
        recipe: str,
        length: int,
        *,
        drift: tuple[float, float] = DRIFT,
        step: int = 1,
        merged: int = 1,
    ) -> list[Reply]:
        """Replies to windows of a set; of each, every `step`-th frame is used, the last of them too."""
        how, its = self.how, recipes()[recipe]
        asked = of.windows(length, how.frames, how.seed, drift)
        said = repr((its, replace(how, frames=0), drift, merged, str(self.run.shared.resolve())))
        base = f"{self._code} {of.name} {hashlib.sha256(said.encode()).hexdigest()[:12]}"
        asked = [(walk, _keyframes(window, step)) for walk, window in asked]
        keys = [f"{base} {walk.map} {window.name}" for walk, window in asked]

        def ask(i: int) -> dict[str, Any]:
            walk, window = asked[i]
            if recipe not in self._warm:  # what is timed is compiled; `ask` readies each map
                self._warm.add(recipe)
                short = replace(window, capture=window.capture[:2])
                self.ask(of, its, of.scene(walk.map), short, walk.map)
            return self.ask(of, its, *self._placed(of, walk, window, merged), walk.map)

        left = len(self.journal.missing(keys))
        if left:
            self.run.say(f"{of.name}: {recipe}, {length} frames: {left} windows to ask")
        return [Reply.from_dict(row) for row in self.journal.filled(keys, ask)]

    def _placed(self, of: Set, walk: Walk, window: Window, merged: int) -> tuple[SceneMap, Window]:
        """A window's map, and the window; or that map beside others in one, and the window there."""
        if merged == 1:
            return of.scene(walk.map), window
        names = group(of, walk.map, merged)
        scene = self._merged(of, names)
        map_from_scene = np.linalg.inv(scene.scene_from_map[names.index(walk.map)])
        return scene, replace(window, truth=map_from_scene @ window.truth)

    def ask(
        self, of: Set, recipe: Recipe, scene: SceneMap, window: Window, name: str
    ) -> dict[str, Any]:
        """What `Reply.from_dict` reads; `name`: the right one of merged scenes."""
        how = self.how
        matcher = how.matcher if isinstance(recipe.refine, RefineOptions) else "auto"
        encoder = self.ready(of, recipe, scene, window)
        start = time.perf_counter()
        estimate = scene.localize(
            window.capture, encoder=encoder, options=recipe.options,
            refine=recipe.refine, matcher=matcher, seed=how.seed, device=how.device,
        )  # fmt: skip
        seconds, told, coarse, refining = (
            time.perf_counter() - start,
            estimate.refinement,
            estimate,
            0.0,
        )
        if told is not None:
            coarse = replace(estimate, modes=(told.coarse, *estimate.modes[1:]))
            refining = sum(told.stats["seconds"].values())
        best = estimate.best
        return {
            "filter": _measured(coarse, window, seconds - refining),
            "whole": _measured(estimate, window, seconds),
            "refining": refining,
            "right": best is not None and (len(scene.scenes) == 1 or best.scene == name),
        }

    def ready(self, of: Set, recipe: Recipe, scene: SceneMap, window: Window) -> MapEncoder:
        """Make what a map needs before it is asked, its mapping in Table 4; returns its encoder."""
        scene.visibility(recipe.options)  # whose panoramas every start needs; casts rays, too
        return self.encoder(of, scene, window)

    def encoder(self, of: Set, scene: SceneMap, window: Window) -> MapEncoder:
        """What patches show of a map: 30 % wrong where frames bring labels, or said of images."""
        if of.own_ids and not self.how.encoder:
            return NoisyEncoder(InstancesEncoder(scene), seed=self.how.seed, name=window.place)
        its = self.unbound(window)
        known = scene.derived(("sg2loc", its.key), lambda s: vectors_of(its, s))
        return BoundEncoder(its, known)

    def unbound(self, window: Window) -> Encoder:
        """The same of any map, but where images bring ids of a map's own objects."""
        if self.how.encoder or window.capture.label_kind != "labels":
            return encoder(self.how.encoder or IMAGES)
        words = window.capture.label_names.values()
        return NoisyLabels(LabelsEncoder(), words, seed=self.how.seed, name=window.place)


def _measured(estimate: PoseEstimate, window: Window, seconds: float) -> dict[str, Any]:
    return measure(
        estimate, window.truth, seconds=seconds, frames=len(window.capture), window=window.name,
        place=window.place, changed=window.changed,
    ).to_dict()  # fmt: skip


def _keyframes(window: Window, step: int) -> Window:
    """The same window of every `step`-th frame, the last one among them."""
    return replace(window, capture=window.capture[(len(window.capture) - 1) % step :: step])


def merged_scenes(of: Set, names: tuple[str, ...]) -> SceneMap:
    """One map of several of a set."""
    return merge_scenes({name: of.scene(name) for name in names})


def group(of: Set, name: str, count: int) -> tuple[str, ...]:
    """A map and `count` - 1 others, of other rooms, that come after it; fewer where there are fewer."""
    first = {room: map_ for map_, room in reversed(of.rooms.items())} | {of.rooms[name]: name}
    rooms = list(first)
    at = rooms.index(of.rooms[name])
    return tuple(sorted(first[room] for room in (rooms[at:] + rooms[:at])[:count]))
