"""Options that several commands of `placegraph city` have."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import numbers_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.encoded import EncodedCity

KNOWN = "What is known"
JUDGED = "How places are found and judged"
WRITTEN = "What is written"

MapFile = Annotated[Path, Argument(help="City map (.city), made by `placegraph city build`.")]
Top = Annotated[int, Option(help="How many places at most.")]
Near = Annotated[
    str | None, Option(help="LON,LAT you are known to be near, with --radius.", panel=KNOWN)
]
Radius = Annotated[
    float, Option(help="Radius of --near [m]: half of the prior lies within.", panel=KNOWN)
]
Preset = Annotated[
    str,
    Option(
        help="default; paper: transformer by cosine on the 10 best by embedding; published: "
        "embedding alone, as the paper's code works. The options below override it.",
        panel=JUDGED,
    ),
]
Matcher = Annotated[
    str | None,
    Option(
        help="What judges places: relational (if nothing is said), fused (relations and network), "
        "transformer, embedding, edit-distance, edit-distance-plain (the paper's costs).",
        panel=JUDGED,
    ),
]
Score = Annotated[
    str | None,
    Option(
        help="What the transformer ranks by: logit (matching log odds, if nothing is said) or "
        "cosine (of the joint embeddings, as in the paper).",
        panel=JUDGED,
    ),
]
CandidatesBy = Annotated[
    str | None,
    Option(
        help="Where places to judge come from: sparse (inverted index), dense (embeddings), both, "
        "all, or auto (if nothing is said): both with --store, else sparse.",
        panel=JUDGED,
    ),
]
Candidates = Annotated[
    int | None,
    Option(
        help="How many cells are judged; 50 if nothing is said. Relational and fused matching count "
        "cells only where embeddings propose them (dense, both).",
        panel=JUDGED,
    ),
]
Store = Annotated[
    str | None,
    Option(
        help="Vectors made by `placegraph city embed`: a file, or a Milvus server: "
        "http://[user:password@]host:port.",
        panel=JUDGED,
    ),
]
Weights = Annotated[
    Path | None,
    Option(help="Other weights than the shipped ones, from `placegraph city train`.", panel=JUDGED),
]


@contextmanager
def matching(
    city: CityMap, store: str | None, weights: Path | None, **chosen: str | int | None
) -> Iterator[dict[str, Any]]:
    """Arguments of `CityMap.locate`, those `chosen` that are not None; a store is closed at the end.

    Raises `StoreError` where the store is of another map or of other weights.
    """
    arguments: dict[str, Any] = {k: v for k, v in chosen.items() if v is not None}
    encoded = _encoded(city, weights)
    if encoded is not None:
        arguments["encoded"] = encoded
    if store is None:
        yield arguments
        return
    from placegraph.vectors import open_store

    with open_store(store, origin=(encoded or city.encoded).origin) as opened:
        yield arguments | {"store": opened}


def _encoded(city: CityMap, weights: Path | None) -> EncodedCity | None:
    if weights is None:
        return None
    from placegraph.outdoor.network.encoded import EncodedCity
    from placegraph.outdoor.network.network import GraphTransformer

    return EncodedCity(city, GraphTransformer.open(weights))


def lonlat(value: str | None, option: str) -> tuple[float, float] | None:
    """Longitude and latitude of an option's text [deg]; raises `OptionError` where it is none."""
    if value is None:
        return None
    mend = "give longitude and latitude as 7.42,43.73."
    longitude, latitude = numbers_of(value, option, {2}, mend)
    return longitude, latitude
