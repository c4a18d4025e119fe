"""What each table of the SG2Loc paper asks: its rows, its columns, its sequence lengths."""

from __future__ import annotations

from typing import NamedTuple


class Spec(NamedTuple):
    """One table."""

    asks: str
    columns: tuple[str, ...] = ()
    lengths: tuple[int, ...] = (5,)
    rows: tuple[tuple[str, str, bool], ...] = ()
    """Name, recipe, and whether what comes after the filter counts."""
    pace: float = 0.0
    """Seconds in which a frame is done with (Table 6); 0: as measured."""
    rooms: int = 1
    """Fewest rooms that a set shows."""


FULL = (
    ("SG2Loc as printed", "paper", True),
    ("SG2Loc as published, filter alone", "published", False),
    ("placegraph's default", "ours", True),
)
SEMANTIC = ("SG2Loc w/ semantic", "semantic", False)
ALL = ("SG2Loc w/ semantic+depth+RGB", "paper", False)
COARSE = (FULL[0], ("SG2Loc (Coarse)", "coarse", True), FULL[2])
ABLATION = (
    ("Max. raycast resolution", "stride 1", False),
    ("Uniform sampling", "uniform", False),
    ("w/o adaptive resampling", "fixed", False),
    SEMANTIC,
    ("SG2Loc w/ semantic+depth", "semantic+depth", False),
    ALL,
    *FULL[::2],
)
ONE_SIGNAL = (
    SEMANTIC, ("SG2Loc w/ depth", "depth", False), ("SG2Loc w/ RGB", "RGB", False),
)  # fmt: skip
ERRORS = ("mean", "median")
NEAR, TWO = "25 cm / 2° / both", "10 cm 5° / 25 cm 10°"
LENGTHS = (5, 10, 25, 50)

SPECS = {
    1: Spec("How far off are poses of 5 to 50 frames? Mean and median.", ERRORS, LENGTHS, FULL),
    2: Spec("How many poses of 5 to 50 frames are right?", (NEAR,), LENGTHS, FULL),
    3: Spec("How many bytes does the map of a scene take?"),
    4: Spec("How long do mapping, localizing and the final fit take?", rows=FULL),
    5: Spec("Which scene of 10 or 50 was a sequence taken in, and how long does it take?", rooms=2),
    6: Spec(
        "What remains of 100 frames that come as fast as they were taken?",
        (*ERRORS, NEAR), (100,), FULL[::2],
    ),
    7: Spec("What is each part of the method worth?", (TWO,), (5,), ABLATION),
    8: Spec("What is each signal worth alone?", (*ERRORS, TWO), (5,), ONE_SIGNAL),
    9: Spec("What are the signals worth, by length? Errors.", ERRORS, LENGTHS[:3], (SEMANTIC, ALL, FULL[0])),
    10: Spec("What are the signals worth, by length? Recall.", (TWO,), LENGTHS[:3], (SEMANTIC, ALL, FULL[0])),
    11: Spec(
        "Is the pose found in several scenes that are one map?",
        ("R@1", *ERRORS, TWO), (50,), FULL[::2], rooms=3,
    ),
    12: Spec("What does one coarse pass cost? Errors.", ERRORS, (5, 25), COARSE),
    13: Spec("What does one coarse pass cost? Recall.", (NEAR,), (5, 25), COARSE),
    14: Spec(
        "What does the drift of odometry cost?", ("median", "25 cm 2°"), (5,), FULL[::2]
    ),
}  # fmt: skip
"""By number in the paper."""
