"""Scene and pose of a capture: retrieval, then one filter in the best few scenes, one after another.

Retrieval proposes, poses decide: where none is sure in a scene, the next is looked into. Each is asked
alone: rays that leave a scan with gaps would meet its neighbours in a map of several.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import OptionError
from placegraph.estimate import Status
from placegraph.geometry import split_pose
from placegraph.indoor.encode import encoder as encoder_named
from placegraph.indoor.language import read
from placegraph.indoor.language.prior import unused
from placegraph.indoor.library.answer import search as search_in
from placegraph.indoor.localize import localized
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.pose.query import chosen_frames

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from placegraph.estimate import PoseEstimate, PoseMode, SceneEstimate, SceneMode
    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.library.options import SearchOptions
    from placegraph.indoor.library.scenes import Scenes
    from placegraph.indoor.map.scene import Scene

SCENES = 8
"""Scenes localized in at most."""
_LEAST = 0.02  # share of the particles of a scene that is looked at all


def localize(
    library: Scenes,
    capture: Capture | Sequence[Frame],
    *,
    frames: slice | Sequence[int] | None = None,
    most: int = SCENES,
    search: SearchOptions | None = None,
    description: str | None = None,
    encoder: str | Encoder | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    **options: Any,  # noqa: ANN401  # of `SceneMap.localize`
) -> PoseEstimate:
    """In which scene of a library a capture was taken, and where in it.

    Each mode names its scene, and its pose is in that scene's own map; so is the trajectory, in the
    best mode's. `stats["retrieval"]` holds what the search said. Maps are only read. Where the
    search finds that no scene fits, only depth can make a pose `OK`.

    Parameters
    ----------
    capture
        A capture, or frames in order of time.
    frames, search
        Which of them, all if not given; how scenes are searched.
    most
        Scenes localized in at most: the next only if no pose is `OK` yet.
    description
        What somebody says of the place: helps to find the scene, and the pose in it.
    encoder
        Says what patches show, by name or one of the library's own; if not given, the library's
        encoder of labels for captures that have some.
    progress
        Called with what is done, how far, and of how much.
    **options
        Of `SceneMap.localize`: options, refine, matcher, seed, device.

    Raises
    ------
    OptionError
        The library is empty; nothing that the frames show can be compared.
    InputError, MapError
        An image is broken; a map is gone, or another one than was added.
    MissingExtraError
        An option needs an extra.

    """
    _check(most, options)
    chosen = chosen_frames(capture, frames)
    found = search_in(library, chosen, description=description, options=search, most=most)
    reader = _reader(library, chosen, encoder)
    answers: list[PoseEstimate] = []
    looked = 0
    while looked < len(found.modes) and not (answers and answers[-1].status is Status.OK):
        candidates = found.modes[looked : looked + 1]
        looked += len(candidates)
        start = perf_counter()
        scene = _merged(library, [m.scene for m in candidates], reader)
        merging = perf_counter() - start
        estimate = localized(
            scene, chosen, shares=_shares(scene, candidates), encoder=reader,
            description=_useful(description, scene), progress=progress, **options,
        )  # fmt: skip
        answers.append(_in_their_own(estimate, scene, found, merging))
    best = min(answers, key=lambda answer: _RANK[answer.status])
    return _doubted(best, found, looked)


_RANK = {Status.OK: 0, Status.AMBIGUOUS: 1, Status.LOST: 2}


def _check(most: int, options: dict[str, Any]) -> None:
    if most < 1:
        raise OptionError(f"most is {most}; localize in at least one scene.")
    if {"shares", "prior"} & options.keys():
        raise OptionError("shares, prior: a library finds these itself; leave them out.")


def _reader(
    library: Scenes, frames: Sequence[Frame], given: str | Encoder | None
) -> Encoder | None:
    """Encoder that the filter reads the frames by; None: the frames' own instances, or none."""
    if given is None and frames[0].label_kind == "labels":
        return next((e for e in library.encoders if e.name == "labels"), None)
    if not isinstance(given, str):
        return given
    return next((e for e in library.encoders if e.name == given), None) or encoder_named(given)


def _merged(library: Scenes, names: Sequence[str], reader: Encoder | None) -> Scene:
    """These scenes as one map, by name; the library keeps the last ones, and with them their tables."""
    ordered = tuple(sorted(names))
    return library.kept(
        (reader and reader.key, ordered),
        lambda: merge_scenes({name: _with(library, name, reader) for name in ordered}),
    )


def _with(library: Scenes, name: str, reader: Encoder | None) -> Scene:
    """Map of a scene with the vectors that the library has of it; without, if it has none."""
    scene = library.scene(name)
    vectors = library.entry(name).signature.vectors
    if reader is None or reader.key not in vectors:
        return replace(scene, graph=replace(scene.graph, embeddings=None), encoder="")
    return scene.with_embeddings(vectors[reader.key], encoder=reader.key)


def _useful(description: str | None, scene: Scene) -> Sentence | None:
    """What was said, if it is of anything in these scenes: the search has heard it already."""
    if description is None:
        return None
    sentence = read(description)
    useful = len(unused(sentence, scene)) < len(sentence.statements)
    return sentence if useful else None


def _shares(scene: Scene, candidates: Sequence[SceneMode]) -> list[float]:
    """Share (S,) of the particles of each scene of the merged map: parts of one share evenly."""
    names = [part.partition("/")[0] for part in scene.scenes]
    total = sum(m.probability for m in candidates) or 1.0
    share = {m.scene: max(_LEAST, m.probability / total) for m in candidates}
    return [share[name] / names.count(name) for name in names]


def _doubted(estimate: PoseEstimate, found: SceneEstimate, looked: int) -> PoseEstimate:
    """Estimate with the doubts of the search, where depth did not decide.

    The search saw no depth: a pose that depth makes `OK` was believed by more than it knew.
    """
    measured = estimate.stats.get("trust", {}).get("depth") is not None
    if estimate.status is not Status.OK or measured:
        return estimate
    left_out = 1.0 - found.elsewhere - sum(m.probability for m in found.modes[:looked])
    if found.status is Status.LOST:
        doubt = (
            f"But it may be in no scene of the library ({found.elsewhere:.0%}): homes that are not in "
            "it fit the capture as well."
        )
    elif left_out > 0.1:
        doubt = (
            f"But it may be another scene ({left_out:.0%}) than the {looked} looked into; look into "
            "more."
        )
    else:
        return estimate
    return replace(estimate, status=Status.AMBIGUOUS, reason=f"{estimate.reason} {doubt}")


def _in_their_own(
    estimate: PoseEstimate, scene: Scene, found: SceneEstimate, merging: float
) -> PoseEstimate:
    """Estimate with poses in the maps of their scenes."""
    into = {name: scene.scene_from_map[i] for i, name in enumerate(scene.scenes)}
    trajectory = estimate.trajectory
    if estimate.best is not None:
        trajectory = into[estimate.best.scene] @ trajectory
    retrieval = {"elsewhere": found.elsewhere} | {m.scene: m.probability for m in found.modes}
    refinement = estimate.refinement
    if refinement is not None:
        refinement = replace(
            refinement,
            coarse=_own(refinement.coarse, into),
            coarse_trajectory=into[refinement.coarse.scene] @ refinement.coarse_trajectory,
        )
    return replace(
        estimate,
        modes=tuple(_own(m, into) for m in estimate.modes),
        trajectory=trajectory,
        refinement=refinement,
        stats=estimate.stats | {"retrieval": retrieval | {"seconds": found.stats["seconds"] | {
            "merging": round(merging, 4)}}},
    )  # fmt: skip


def _own(mode: PoseMode, into: dict[str, Any]) -> PoseMode:
    """Mode with its pose in its own scene's map; scenes are shifted when merged, never turned."""
    pose, _ = split_pose(np.asarray(into[mode.scene] @ mode.map_from_camera))
    return replace(mode, map_from_camera=into[mode.scene] @ mode.map_from_camera, pose=pose)
