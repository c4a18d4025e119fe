"""Published figures that stand beside the measured ones in the refinement's tables.

The paper's are from 3RScan and ScanNet, real scans of other rooms with a learned encoder, and their
coarse poses are worse than ours: they say what the paper's refinement gains there, not what ours
would. Its "before" is its filter with semantics, depth and colour, its "after" adds Sec. 3.6.
"""

from __future__ import annotations

from dataclasses import dataclass

Pair = tuple[float | None, float | None]
Recall = tuple[float | None, float | None, float | None, float | None]

_NO_PAIR: Pair = (None, None)
_NO_RECALL: Recall = (None, None, None, None)


@dataclass(frozen=True)
class Published:
    """One published row."""

    source: str
    """Where it stands, and what it was measured on."""
    places: tuple[str, ...]
    """Keys of `indoor_refine.PLACES` whose tables it belongs to."""
    length: int
    """Frames."""
    recall_before: Recall = _NO_RECALL
    """Within (10 cm, 5), (25 cm, 2), (25 cm, 5), (25 cm, 10 degrees)."""
    recall: Recall = _NO_RECALL
    mean_before: Pair = _NO_PAIR
    """[m], [deg]"""
    mean: Pair = _NO_PAIR
    median_before: Pair = _NO_PAIR
    median: Pair = _NO_PAIR
    seconds: float | None = None
    """Of the refinement, on a GPU."""


_HOUSE = ("house",)
_PAPER_SECONDS = 5.5  # Table 4, "Final Opt.", once a sequence

PUBLISHED = (
    Published(
        "paper, 3RScan, Tab. 1, 2, 4, 7", _HOUSE, 5,
        recall_before=(0.35, None, None, 0.61), recall=(0.50, 0.32, None, 0.65),
        mean=(2.43, 21.24), median=(0.20, 3.27), seconds=_PAPER_SECONDS,
    ),
    Published(
        "paper, 3RScan, Tab. 1, 2, 4", _HOUSE, 10, recall=(None, 0.33, None, None),
        mean=(2.30, 20.50), median=(0.18, 2.96), seconds=_PAPER_SECONDS,
    ),
    Published(
        "paper, 3RScan, Tab. 1, 2, 4", _HOUSE, 25, recall=(None, 0.39, None, None),
        mean=(6.15, 22.93), median=(0.14, 2.73), seconds=_PAPER_SECONDS,
    ),
    Published(
        "paper, ScanNet, Tab. 2, 9, 10", _HOUSE, 5,
        recall_before=(0.26, None, None, 0.69), recall=(0.41, 0.36, None, 0.72),
        mean_before=(0.56, 11.92), mean=(0.53, 11.55),
        median_before=(0.15, 2.45), median=(0.12, 2.55),
    ),
    Published(
        "paper, ScanNet, Tab. 2, 9, 10", _HOUSE, 10,
        recall_before=(0.28, None, None, 0.73), recall=(0.49, 0.39, None, 0.79),
        mean_before=(0.54, 10.23), mean=(0.44, 8.14),
        median_before=(0.14, 2.08), median=(0.10, 2.30),
    ),
    Published(
        "paper, ScanNet, Tab. 2, 9, 10", _HOUSE, 25,
        recall_before=(0.32, None, None, 0.75), recall=(0.58, 0.42, None, 0.80),
        mean_before=(0.46, 10.42), mean=(0.29, 4.55),
        median_before=(0.13, 1.99), median=(0.09, 2.29),
    ),
)  # fmt: skip


def published(place: str, length: int) -> list[Published]:
    """Published rows that stand in a table of poses that were found."""
    return [p for p in PUBLISHED if place in p.places and p.length == length]
