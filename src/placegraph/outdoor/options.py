"""Options of the outdoor wing that the command line and the server take as well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from placegraph.core.options import check_options, option
from placegraph.errors import OptionError

KNOWN = "Prior knowledge"
JUDGED = "Search and matching"
SMALLEST, LARGEST = 1.0, 10_000.0
"""Range of the sizes of cells [m]."""

Matcher = Literal[
    "fused", "relational", "transformer", "edit-distance", "edit-distance-plain", "embedding"
]
"""Matchers: relational matching, also shifted by the network (``fused``); the network alone (Eq. 14-17);
graph edit distance at our costs, or at the paper's; the cosine of graph embeddings alone (Eq. 11)."""
Score = Literal["logit", "cosine"]
"""Scores of the transformer: log odds of the matching probability (Eq. 17), which rest on what the
statements say literally, or the cosine of the joint embeddings (Eq. 15-16)."""
By = Literal["sparse", "dense", "both", "all"]
"""Sources of candidates: inverted index of viewpoints, embeddings, both in turn, or all cells."""


@dataclass(frozen=True)
class CellOptions:
    """Sizes of the cells of a city map."""

    cell_size: float = option(
        50.0, "Edge of a cell.", unit="m", minimum=SMALLEST, maximum=LARGEST, flag="--cell-size"
    )
    stride: float | None = option(
        None,
        "Distance of cell centres; the cell size if not given.",
        unit="m",
        minimum=SMALLEST,
        maximum=LARGEST,
        flag="--stride",
    )
    edge_distance: float | None = option(
        None,
        "Objects nearer than this are joined by an edge; the cell size if not given.",
        unit="m",
        minimum=SMALLEST,
        maximum=LARGEST,
        flag="--edge-distance",
    )

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def sizes(self) -> tuple[float, float, float]:
        """Cell size, stride and edge distance [m]."""
        stride = self.cell_size if self.stride is None else self.stride
        edges = self.cell_size if self.edge_distance is None else self.edge_distance
        return self.cell_size, stride, edges


@dataclass(frozen=True, eq=False)
class LocateOptions:
    """Options of every localization of a sentence."""

    top: int = option(5, "Maximum number of places in the answer.", minimum=1, flag="--top")
    radius: float = option(
        1000.0,
        "Radius around the known position (`near`) that contains half of the prior; unused without "
        "`near`.",
        unit="m",
        minimum=1,
        maximum=1e7,
        flag="--radius",
        panel=KNOWN,
    )
    heading_deg: float | None = option(
        None,
        "Direction of view, clockwise from north: gives 'left of me' a meaning.",
        unit="deg",
        minimum=float("-inf"),
        flag="--heading-deg",
        panel=KNOWN,
    )


@dataclass(frozen=True, eq=False)
class RankingOptions:
    """Options of the search: how places are found and compared."""

    matcher: Matcher = option(
        "relational",
        "Matcher: relational (best for its cost), fused (relational plus the network on the "
        "best places), transformer, embedding, edit-distance, or edit-distance-plain (every "
        "edit costs 1, as in the paper).",
        flag="--matcher",
        panel=JUDGED,
    )
    score: Score | None = option(
        None,
        "Score of the transformer: logit (log odds of a match; the default) or cosine (of the joint "
        "embeddings, as in the paper).",
        flag="--score",
        panel=JUDGED,
    )
    by: By | Literal["auto"] = option(
        "auto",
        "Source of candidates: sparse (inverted index), dense (embeddings: fast on maps of "
        "any size, but lower recall and never OK), both, all, or auto (both with --store, "
        "otherwise sparse).",
        flag="--candidates-by",
        panel=JUDGED,
    )
    candidates: int = option(
        50,
        "Number of cells that embeddings propose (n of Eq. 12), or the inverted index to matchers of "
        "cells. Relational and fused matching count cells only with dense and both.",
        minimum=1,
        flag="--candidates",
        panel=JUDGED,
    )

    def __post_init__(self) -> None:
        check_options(self)
        if self.score is not None and self.matcher != "transformer":
            raise OptionError(
                f"score is {self.score!r}, but it applies only to the transformer, and "
                f"matcher is {self.matcher!r}; remove it."
            )
