"""Scene and pose of a capture: retrieval, then a pose in each of the best few scenes, one by one.

Retrieval proposes, poses decide: unless frames fit beyond doubt, the next scene is looked into, and that
in which they fit best is named. Each is asked alone: rays that leave a scan with gaps would meet
its neighbours in a map of several.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode, SceneEstimate, Status
from placegraph.core.geometry import split_pose
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder
from placegraph.indoor.encode import encoder as encoder_named
from placegraph.indoor.language import Sentence, read
from placegraph.indoor.language.prior import find_unused
from placegraph.indoor.library.search import SceneCollection, SearchOptions
from placegraph.indoor.localize import localize_capture
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.pose.window import chosen_frames
from placegraph.indoor.status import choose_scene, diagnostics_of, doubt_by_search, fit_odds
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.library.library import SceneLibrary

MAX_SCENES = 8  # Scenes localized in at most
CERTAIN = 6.0  # Log odds from which on a pose that is `OK` ends the search; a lesser one ..
RIVALS = 2  # ... has to fit better than what is found in so many scenes after it.
TWIN_SHARE = 0.5
"""A scene with more than this share of the probability of the one that is sure is looked into in any
case: it may be its twin."""


def localize(
    library: SceneCollection,
    capture: Capture | Sequence[Frame],
    *,
    frames: slice | Sequence[int] | None = None,
    most: int = MAX_SCENES,
    search: SearchOptions | None = None,
    description: str | None = None,
    encoder: str | Encoder | None = None,
    **options: Any,  # noqa: ANN401  # of `SceneMap.localize`
) -> PoseEstimate:
    """Return in which scene of a library a capture was taken, and where in it.

    Each mode names its scene, and its pose is in that scene's own map; so is the trajectory, in the
    best mode's. `stats["retrieval"]` holds what the search said. Maps are only read. Where the
    search finds that no scene fits, only a clear pose is `OK`.

    Raises `OptionError`: the library is empty; nothing that the frames show can be compared;
    `InputError` or `MapError`: an image is broken; a map is gone, or another one than was added;
    `MissingExtraError`: an option needs an extra.

    `capture`: a capture, or frames in order of time.
    `frames`, `search`: which of them, all if not given; how scenes are searched.
    `most`: scenes localized in at most: the next only as long as no pose is certain.
    `description`: what somebody says of the place: helps to find the scene, and the pose in it.
    `encoder`: says what patches show, by name or one of the library's own; if not given, the
        library's encoder of labels for captures that have some.
    `options`: of `SceneMap.localize`: options, refine, matcher, seed, device, progress.
    """
    if most < 1:
        raise OptionError(f"most is {most}; give at least 1.")
    if {"shares", "prior"} & options.keys():
        raise OptionError("shares, prior: a library computes these itself; remove them.")
    chosen = chosen_frames(capture, frames)
    retrieved = library.search(chosen, description=description, options=search, most=most)
    scenes = library.open_scenes(retrieved.stats.get("rows", ()))
    retrieved = defer_colourless(scenes, chosen, retrieved, encoder)
    answers = localize_in_scenes(
        scenes, chosen, retrieved, description=description, encoder=encoder, **options
    )
    return doubt_by_search(choose_scene(answers), retrieved, len(answers))


def defer_colourless(
    library: SceneLibrary,
    frames: Sequence[Frame],
    retrieved: SceneEstimate,
    encoder: str | Encoder | None = None,
) -> SceneEstimate:
    """Move scenes without colours to the end if frames have only colours to be compared by."""
    if encoder is not None or not _have_only_colours(frames):
        return retrieved
    modes = sorted(retrieved.modes, key=lambda m: not library.scene(m.scene).has_colours)
    return replace(retrieved, modes=tuple(modes))


def _have_only_colours(frames: Sequence[Frame]) -> bool:
    return not any(f.label_kind or f.depth() is not None for f in frames)


def localize_in_scenes(
    library: SceneLibrary,
    frames: Sequence[Frame],
    retrieved: SceneEstimate,
    *,
    description: str | Sentence | None = None,
    encoder: str | Encoder | None = None,
    **options: Any,  # noqa: ANN401  # of `SceneMap.localize`
) -> list[PoseEstimate]:
    """Localize frames in the scenes that a search found, one by one, until no other can matter.

    Scenes that `defer_colourless` moved to the end are not searched if another one is.
    """
    reader = encoder  # of the frames; None: the frames' own instances, or none
    if encoder is None and frames[0].label_kind == "labels":
        reader = next((e for e in library.encoders if e.name == "labels"), None)
    elif isinstance(encoder, str):
        own = next((e for e in library.encoders if e.name == encoder), None)
        reader = own or encoder_named(encoder)
    assert not isinstance(reader, str)  # noqa: S101
    sentence = read(description) if isinstance(description, str) else description
    answers: list[PoseEstimate] = []
    by_colours = reader is None and _have_only_colours(frames)
    for mode in retrieved.modes:
        if by_colours and answers and not library.scene(mode.scene).has_colours:
            break
        if _is_settled(answers, [m.probability for m in retrieved.modes]):
            break
        start = perf_counter()
        scene = _open_merged(library, mode.scene, reader)
        opening = perf_counter() - start
        useful = sentence  # what says nothing of this scene was heard by the search
        if sentence is not None and len(find_unused(sentence, scene)) >= len(sentence.statements):
            useful = None
        estimate = localize_capture(
            scene, frames, shares=[1.0 / len(scene.scenes)] * len(scene.scenes), encoder=reader,
            description=useful, **options,
        )  # fmt: skip
        answers.append(_move_to_scene(estimate, scene, retrieved, opening))
    return answers


def _is_settled(answers: list[PoseEstimate], probabilities: Sequence[float]) -> bool:
    """Return whether no other scene needs to be looked into. Of labels alone the search knew as much."""
    sure = [answer.status is Status.OK for answer in answers]
    if not any(sure):
        return False
    first, looked = sure.index(True), len(answers)
    if looked < len(probabilities) and probabilities[looked] > TWIN_SHARE * probabilities[first]:
        return False
    certain = sure[-1] and (
        diagnostics_of(answers[-1]).labels_only or fit_odds(answers[-1]) >= CERTAIN
    )
    return certain or looked - first > RIVALS


def _open_merged(library: SceneLibrary, name: str, reader: Encoder | None) -> Scene:
    """Return the map of a scene, named in its poses, with the vectors that the library has of it.

    The library caches the last ones with their tables.
    """

    def make() -> Scene:
        scene, vectors = library.scene(name), library.entry(name).signature.vectors
        if reader is None or reader.key not in vectors:
            made = replace(scene, graph=replace(scene.graph, embeddings=None), encoder="")
        else:
            made = scene.with_embeddings(vectors[reader.key], encoder=reader.key)
        return merge_scenes({name: made})

    return library.cache_merged((reader and reader.key, name), make)


def _move_to_scene(
    estimate: PoseEstimate, scene: Scene, retrieved: SceneEstimate, opening: float
) -> PoseEstimate:
    """Move the poses of an estimate to the map of its scene; scenes are shifted when merged, never turned."""
    into = {name: scene.scene_from_map[i] for i, name in enumerate(scene.scenes)}

    def move(mode: PoseMode) -> PoseMode:
        moved = into[mode.scene] @ mode.map_from_camera
        return replace(mode, map_from_camera=moved, pose=split_pose(np.asarray(moved))[0])

    trajectory, refinement = estimate.trajectory, estimate.refinement
    if estimate.best is not None:
        trajectory = into[estimate.best.scene] @ trajectory
    if refinement is not None:
        coarse = refinement.coarse
        refinement = replace(
            refinement, coarse=move(coarse),
            coarse_trajectory=into[coarse.scene] @ refinement.coarse_trajectory,
        )  # fmt: skip
    retrieval = {"elsewhere": retrieved.elsewhere} | {
        m.scene: m.probability for m in retrieved.modes
    }
    seconds = retrieved.stats["seconds"] | {"opening": round(opening, 4)}
    return replace(
        estimate,
        modes=tuple(map(move, estimate.modes)),
        trajectory=trajectory,
        refinement=refinement,
        map=None,  # the merged one has other axes
        stats=estimate.stats | {"retrieval": retrieval | {"seconds": seconds}},
    )
