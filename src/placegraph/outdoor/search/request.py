"""What is asked: where in a city was this said? Every stage takes it whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypedDict, Unpack, get_args

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.likelihood.statements import Words
from placegraph.outdoor.map.city import City
from placegraph.outdoor.network.encoded import EncodedCity, EncodedText
from placegraph.outdoor.search.whereabouts import Whereabouts
from placegraph.vectors import Region, VectorStore

Matcher = Literal[
    "fused", "relational", "transformer", "edit-distance", "edit-distance-plain", "embedding"
]
"""fused: relational matching, shifted by the network; relational; the network alone (Eq. 14-17);
graph edit distance at our costs, or at the paper's; the cosine of the graph embeddings alone
(Eq. 11)."""
Score = Literal["logit", "cosine"]
"""What the transformer ranks by: log odds of the matching probability (Eq. 17), which rest on what
the statements say literally, or the cosine of the joint embeddings (Eq. 15-16)."""
Preset = Literal["default", "paper", "published"]
By = Literal["sparse", "dense", "both", "all"]
"""Candidates by the inverted index of viewpoints, by embeddings, by both in turn, or all cells."""
MATCHERS: tuple[Matcher, ...] = get_args(Matcher)
SCORES: tuple[Score, ...] = get_args(Score)
WAYS: tuple[By, ...] = get_args(By)
_OF_VIEWPOINTS = ("fused", "relational")


class MatchingOptions(TypedDict, total=False):
    """`preset`, the `language` of the text, and fields of `Matching`, as `CityMap.locate` takes them."""

    preset: Preset
    language: str | None
    matcher: Matcher
    score: Score | None
    by: By | Literal["auto"]
    candidates: int
    store: VectorStore | None
    region: Region | None
    encoded: EncodedCity | None


PRESETS: dict[Preset, MatchingOptions] = {
    "default": {},
    "paper": {"matcher": "transformer", "score": "cosine", "by": "dense", "candidates": 10},
    "published": {"matcher": "embedding", "by": "dense", "candidates": 10},
}
"""The paper's pipeline (Eq. 9-16), and what its published code does: cross attention there leaves
every graph as it is, so that what ranks is a cosine of embeddings made without the partner."""


@dataclass(frozen=True, eq=False)
class Matching:
    """How places are found and compared; raises `OptionError` where there is no such way."""

    matcher: Matcher = "relational"
    """``relational`` measures best at the price; ``fused`` lets the network judge its best places
    as well. ``transformer`` (Eq. 14-17), ``edit-distance``, ``edit-distance-plain`` (every edit
    costs 1, as in the paper) or ``embedding`` (Eq. 11) alone, on cells."""
    score: Score | None = None
    """What the transformer ranks by; ``logit`` where not given. Of the transformer alone."""
    by: By | Literal["auto"] = "auto"
    """Candidates by the inverted index (``sparse``), by embeddings (``dense``), ``both``, or ``all``
    places; ``auto`` takes both where a store is given, else the inverted index. Embeddings alone
    are fast in maps of any size, find less, and are never sure (`OK`)."""
    candidates: int = 50
    """How many cells embeddings propose (the paper's n of Eq. 12), or the inverted index to matchers
    of cells. Relational and fused matching look at viewpoints: the index gives them as many as it
    takes, and a count given to `preset` or `CityMap.locate` is refused there, and by ``all``."""
    store: VectorStore | None = None
    """Where embeddings are searched, such as a Milvus server; the map's own if not given."""
    region: Region | None = None
    """The place is known to lie in it."""
    encoded: EncodedCity | None = None
    """The map as another network than the shipped one reads it."""
    shipped: Callable[[], EncodedCity] | None = field(default=None, repr=False)
    """Hands out the map as the shipped network reads it; made anew where not given."""

    def __post_init__(self) -> None:
        if self.matcher not in MATCHERS or self.by not in ("auto", *WAYS):
            raise OptionError(
                f"matcher {self.matcher!r}, candidates by {self.by!r}: choose among "
                f"{', '.join(MATCHERS)} and auto, {', '.join(WAYS)}."
            )
        if self.score is not None and (self.score not in SCORES or self.matcher != "transformer"):
            raise OptionError(
                f"score is {self.score!r} of matcher {self.matcher!r}; the transformer alone has "
                f"one: {', '.join(SCORES)}."
            )
        if not is_count(self.candidates):
            raise OptionError(f"candidates is {self.candidates!r}; choose at least 1.")

    @classmethod
    def preset(cls, name: Preset, **options: Unpack[MatchingOptions]) -> Matching:
        """Options of a preset (`PRESETS`), but for those given.

        Raises
        ------
        OptionError
            As `Matching` does; or `candidates` are given where nothing counts cells.

        """
        if name not in PRESETS:
            raise OptionError(f"preset is {name!r}; choose among {', '.join(PRESETS)}.")
        chosen: dict[str, Any] = {**PRESETS[name], **options}
        matcher = chosen.get("matcher")
        # what a preset says goes with its matcher: a score is the transformer's, cells are not
        # what relational matching looks at
        gone = {"score"} if matcher != "transformer" else set()
        gone |= {"by", "candidates"} if matcher in _OF_VIEWPOINTS else set()
        found = cls(**{k: v for k, v in chosen.items() if k in options or k not in gone})
        if "candidates" in options and not found.counted:
            raise OptionError(
                f"candidates is {found.candidates}, but {found.matcher} by {found.way} does not "
                "count cells; find them by dense or both, or leave it out."
            )
        return found

    @property
    def way(self) -> By:
        """How candidates are found."""
        if self.by != "auto":
            return self.by
        return "sparse" if self.store is None else "both"

    @property
    def counted(self) -> bool:
        """Whether `candidates` says how many cells are looked at."""
        return self.way in ("dense", "both") or (self.way == "sparse" and self.of_cells)

    @property
    def of_cells(self) -> bool:
        """Whether the matcher ranks cells, as in the paper, and not viewpoints."""
        return self.matcher not in _OF_VIEWPOINTS

    @property
    def ranks(self) -> bool:
        """Whether the matcher's scores only rank: cosines and edits, but not the log odds of Eq. 17."""
        return self.of_cells and (self.matcher != "transformer" or self.score == "cosine")

    def read(self, city: City) -> EncodedCity:
        """The city as the network reads it."""
        if self.encoded is not None:
            return self.encoded
        if self.shipped is not None:
            return self.shipped()
        from placegraph.outdoor.network.encoded import EncodedCity
        from placegraph.outdoor.network.network import GraphTransformer

        return EncodedCity(city, GraphTransformer.default())

    def check(self, city: City) -> None:
        """Raise `OptionError` or `StoreError` where a source is none, or of another map or network."""
        from placegraph.vectors import Origin, Region
        from placegraph.vectors.stores import refuse_other

        if self.region is not None:
            if not isinstance(self.region, Region):
                raise OptionError(
                    f"region is {self.region!r}; give a `Region` of west, south, east and north in "
                    "degrees."
                )
            self.region.checked()
        if self.encoded is not None and not _reads(self.encoded, city):
            raise OptionError(
                f"encoded is not {city!r} as a network reads it; give `EncodedCity` of it."
            )
        if self.store is None:
            return
        found = getattr(self.store, "origin", None)
        if not isinstance(found, Origin):
            raise OptionError(
                f"store is {self.store!r}, no store of vectors; open one by `open_store`."
            )
        wanted = self.read(city).origin
        # empty is not known
        known = Origin(found.map or wanted.map, found.model or wanted.model)
        refuse_other("The store", known, wanted)


def _reads(encoded: object, city: City) -> bool:
    """Whether it is this city, or the same one opened twice, as a network reads it."""
    from placegraph.outdoor.network.encoded import EncodedCity

    return isinstance(encoded, EncodedCity) and (
        encoded.city is city or encoded.origin.map == city.fingerprint
    )


def is_count(value: object) -> bool:
    """Whether it is a whole number from 1 on."""
    return isinstance(value, int | np.integer) and value is not True and bool(value >= 1)


@dataclass(frozen=True, eq=False)
class Request:
    """A description compiled against a city, what else is known, and how to match it."""

    city: City
    query: Query
    known: Whereabouts = field(default_factory=Whereabouts)
    matching: Matching = field(default_factory=Matching)

    @property
    def positive(self) -> bool:
        """Whether anything is said to be there."""
        return any(not s.negated for s in self.query.used)

    @cached_property
    def words(self) -> Words:
        """How well every token of the map fits every mention."""
        return self.query.words(len(self.city.views.share))

    @cached_property
    def log_prior(self) -> NDArray[np.float64]:
        """Log prior (W,) of all viewpoints, or nothing where nothing is known."""
        return self.known.log_of_views(self.city.views)

    @cached_property
    def highest(self) -> float:
        """Largest log prior of a viewpoint."""
        views = len(self.city.views)
        return float(self.log_prior.max()) if len(self.log_prior) else -float(np.log(views))

    def relative(self, rows: NDArray[np.int32]) -> NDArray[np.float64]:
        """Log prior (K,) of viewpoints, against the largest."""
        known = len(self.log_prior) > 0
        return self.log_prior[rows] - self.highest if known else np.zeros(len(rows))

    @property
    def encoded(self) -> EncodedCity:
        """The city as the network reads it."""
        return self.matching.read(self.city)

    @cached_property
    def text(self) -> EncodedText:
        """The query as the network reads it."""
        return self.encoded.text(self.query)

    @cached_property
    def embedding(self) -> NDArray[np.float32]:
        """Embedding (1, D) of the text graph (Eq. 9)."""
        return self.encoded.network.embed_texts(self.text.graphs)

    def inside(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether positions (K, 2) [m] lie in the region that was given."""
        region = self.matching.region
        return (
            np.ones(len(positions), np.bool_)
            if region is None
            else within(self.city, positions, region)
        )


def within(city: City, positions: NDArray[np.float64], region: Region) -> NDArray[np.bool_]:
    """Whether positions (K, 2) [m] lie in a region."""
    region.checked()
    longitude, latitude = city.plane.to_lonlat(positions).T
    east, west = longitude <= region.east, longitude >= region.west
    across = east | west if region.crosses_date_line else east & west
    return across & (latitude >= region.south) & (latitude <= region.north)
