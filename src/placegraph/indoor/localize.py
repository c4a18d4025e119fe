"""A capture finds its pose in a scene map: table, filter in passes, polish, verdict."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.motion import keyframes
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scorer import Scorer
from placegraph.indoor.sequence import Sequence_, leveled

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from placegraph.estimate import PoseEstimate
    from placegraph.formats.capture import Capture
    from placegraph.formats.frame import Frame
    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.indoor.search import Prior

    Progress = Callable[[str, int, int], None]

WINDOW = 30
"""Frames that are searched and fitted together; a longer capture is tracked."""


def localize(
    scene: SceneMap,
    capture: Capture | Sequence[Frame],
    *,
    frames: slice | Sequence[int] | None = None,
    prior: Prior | None = None,
    encoder: Encoder | None = None,
    options: FilterOptions | None = None,
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
    encoder
        Says what patches show; the capture's own labels if not given.
    options
        `FilterOptions`; what measured best if not given.
    seed
        Of all randomness.
    device
        ``auto``, ``cpu`` or ``cuda`` (extra ``gpu``).
    progress
        Called with what is done, how far, and of how much.

    Raises
    ------
    OptionError
        No frame is chosen; nothing that the frames show can be compared with the map.
    InputError
        An image is broken.
    MissingExtraError
        The device asked for needs an extra.

    """
    options = options or FilterOptions()
    if seed < 0:
        raise OptionError(f"seed is {seed}; a seed is not negative.")
    chosen = _chosen(capture, frames)
    stamps = np.array([frame.stamp for frame in chosen])
    kept = keyframes(stamps, leveled(chosen), options.every, options.every_metre)
    chosen = [chosen[i] for i in kept]
    if len(chosen) > WINDOW:
        from placegraph.indoor.tracker import follow

        return follow(scene, chosen, prior, encoder, options, seed, device, progress)
    scorer = Scorer(scene, options.likelihood, device)
    sequence = Sequence_.of(scene, chosen, encoder, options, scorer)
    return sequence.localized(prior, np.random.default_rng(seed), progress)


def _chosen(
    capture: Capture | Sequence[Frame], frames: slice | Sequence[int] | None
) -> list[Frame]:
    rows: Any = range(len(capture))
    if isinstance(frames, slice):
        rows = rows[frames]
    elif frames is not None:
        if isinstance(frames, (str, int)) or not all(
            isinstance(i, (int, np.integer)) for i in frames
        ):
            raise OptionError(f"frames is {frames!r}; give a slice, or rows as whole numbers.")
        rows = list(frames)
        if any(not -len(capture) <= i < len(capture) for i in rows):
            raise OptionError(f"frames: a row lies outside the capture's {len(capture)} frames.")
    if not rows:
        raise OptionError(f"frames: none chosen of the capture's {len(capture)}.")
    chosen = [capture[i] for i in rows]
    if any(b.stamp <= a.stamp for a, b in itertools.pairwise(chosen)):
        raise OptionError(
            "frames: their stamps must grow; choose each frame once, in order of time."
        )
    return chosen
