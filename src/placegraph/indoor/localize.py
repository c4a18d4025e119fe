"""A capture finds its pose in a scene map: table, filter in passes, polish, verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.encode import for_map
from placegraph.indoor.likelihood.observe import sight
from placegraph.indoor.likelihood.scorer import Scorer
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.frames import chosen_frames
from placegraph.indoor.pose.motion import keyframes
from placegraph.indoor.pose.sequence import Sequence_, leveled, usable
from placegraph.indoor.refine import RefineOptions, chosen_matcher, refine_estimate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike

    from placegraph.estimate import PoseEstimate
    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.indoor.encode import Encoder, MapEncoder
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.pose.search import Prior
    from placegraph.indoor.refine.matching import Matcher

    Progress = Callable[[str, int, int], None]

WINDOW = 30
"""Frames that are searched and fitted together; a longer capture is tracked."""


def localize(
    scene: Scene,
    capture: Capture | Sequence[Frame],
    *,
    frames: slice | Sequence[int] | None = None,
    prior: Prior | None = None,
    description: str | Sentence | None = None,
    shares: ArrayLike | None = None,
    encoder: str | Encoder | MapEncoder | None = None,
    options: FilterOptions | None = None,
    refine: bool | RefineOptions = True,
    matcher: str | Matcher = "auto",
    seed: int = 0,
    device: str = "auto",
    progress: Progress | None = None,
) -> PoseEstimate:
    """Where the last frame of a capture, and every other, was taken.

    The same seed on the same machine gives the same answer; the map is only read.

    Parameters
    ----------
    capture
        A capture, or frames in order of time.
    frames
        Which of them; all if not given.
    prior
        Roughly where the first frame was taken, if known; else the whole map is searched.
    description
        What somebody says of where the last frame was taken: "next to the sofa, facing the window"
        (of a capture that is tracked, being longer than `WINDOW`, the first). It shapes the first
        particles, and counts as one witness for the poses found.
    shares
        (S,) of a merged map: share of the first particles that each of its scenes gets.
    encoder
        Says what patches show: a name such as ``appearance``, an `Encoder`, or one bound to this
        map; the capture's own labels if not given.
    options
        `FilterOptions`; what measured best if not given.
    refine
        Fit the best mode to images and depth, to centimetres; `RefineOptions` say how.
    matcher
        How images are matched with renderings of the map: ``auto`` and ``guided`` need no extra;
        ``sift``, ``xfeat``, ``roma``, ``romav2`` need theirs; or a `Matcher` of one's own.
    seed
        Of all randomness.
    device
        ``auto``, ``cpu`` or ``cuda`` (extra ``gpu``).
    progress
        Called with what is done, how far, and of how much.

    Raises
    ------
    OptionError
        No frame is chosen; nothing that the frames show can be compared with the map; the
        description says nothing that the map has.
    MapError
        The map holds vectors of another encoder.
    InputError
        An image is broken.
    MissingExtraError
        The device or the matcher asked for needs an extra.

    """
    options = options or FilterOptions()
    if seed < 0:
        raise OptionError(f"seed is {seed}; a seed is not negative.")
    chosen = chosen_frames(capture, frames)
    stamps = np.array([frame.stamp for frame in chosen])
    kept = keyframes(stamps, leveled(chosen), options.every, options.every_metre)
    chosen = [chosen[i] for i in kept]
    if not isinstance(refine, bool | RefineOptions):
        raise OptionError(f"refine is {refine!r}; it is True, False or RefineOptions.")
    refining = RefineOptions() if refine is True else refine or None
    matching = chosen_matcher(matcher, device) if refining else None
    reading = None if encoder is None else for_map(encoder, scene)
    sequence = None
    if len(chosen) > WINDOW:
        from placegraph.indoor.pose.tracker import Tracker, follow

        if prior is not None:
            raise OptionError(
                f"prior: a capture of {len(chosen)} frames is tracked, which starts without one; "
                "choose fewer frames."
            )
        tracker = Tracker(
            scene, options=options, encoder=reading, seed=seed, device=device,
            description=description, shares=shares,
        )  # fmt: skip
        coarse = follow(tracker, chosen, progress)
        senses = usable(scene, options)
        sightings = [sight(frame, None, senses) for frame in chosen[-WINDOW:]] if refining else []
    else:
        scorer = Scorer(scene, options.likelihood, device)
        sequence = Sequence_.of(scene, chosen, reading, options, scorer, description, shares)
        coarse = sequence.localized(prior, np.random.default_rng(seed), progress)
        sightings = sequence.sightings
    if refining is None:
        return coarse
    return refine_estimate(
        coarse, scene, sightings, matcher=matching, options=refining, device=device,
        progress=progress, sequence=sequence,
    )  # fmt: skip
