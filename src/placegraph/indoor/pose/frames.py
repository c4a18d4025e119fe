"""Which frames of a capture are asked about."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame


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
