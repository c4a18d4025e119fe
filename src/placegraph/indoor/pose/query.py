"""What is asked: where frames were taken in a map, and what is known of it beforehand."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, MapEncoder, for_map
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import FilterOptions, check_device
from placegraph.indoor.pose.motion import keyframes, level_poses
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.pose.prior import Prior


Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseQuery:
    """Where were these frames taken? Everything that the stages of the answer are told."""

    scene: Scene
    """The map; it is only read."""
    frames: Sequence[Frame] = ()
    """In order of time."""
    options: FilterOptions = field(default_factory=FilterOptions)
    encoder: MapEncoder | None = None
    """Says what patches show; None: the frames' own labels, if they have any."""
    prior: Prior | None = None
    """Roughly where the first frame was taken."""
    description: str | Sentence | None = None
    """What somebody said of where the last frame was taken."""
    shares: ArrayLike | None = None
    """(S,) share of the first particles of each merged scene."""
    seed: int = 0
    progress: Progress | None = None
    """Called with what is done, how far, and of how much."""

    @classmethod
    def of(
        cls,
        scene: Scene,
        capture: Capture | Sequence[Frame] | None = None,
        *,
        frames: slice | Sequence[int] | None = None,
        options: FilterOptions | None = None,
        encoder: str | Encoder | MapEncoder | None = None,
        device: str = "auto",
        **known: Any,  # noqa: ANN401  # the other fields
    ) -> PoseQuery:
        """The question about a capture, or about frames to come if there is none.

        Of the frames chosen those are kept that are keyframes by the options. Terms of the likelihood
        that the map cannot serve are switched off. Parameters and errors: `SceneMap.localize`.
        """
        check_device(device)
        options = options or FilterOptions()
        if known.get("seed", 0) < 0:
            raise OptionError(f"seed is {known['seed']}; a seed is not negative.")
        chosen: list[Frame] = []
        if capture is not None:
            chosen = chosen_frames(capture, frames)
            stamps = np.array([frame.stamp for frame in chosen])
            kept = keyframes(stamps, leveled(chosen), options.every, options.every_metre)
            chosen = [chosen[i] for i in kept]
        return cls(
            scene=scene,
            frames=chosen,
            options=replace(options, colour=options.colour and scene.coloured),
            encoder=None if encoder is None else for_map(encoder, scene),
            **known,
        )


def chosen_frames(
    capture: Capture | Sequence[Frame], frames: slice | Sequence[int] | None
) -> list[Frame]:
    """Frames of a capture by rows, by a slice, or all; raises `OptionError` where there are none."""
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


def leveled(frames: Sequence[Frame]) -> Floats:
    """Level poses (T, 4) of the odometry of frames."""
    return level_poses(
        np.stack([f.odometry for f in frames]), np.stack([f.gravity for f in frames])
    )
