"""Options of how places are found and compared, which several commands have."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.learn.encoded import EncodedCity

Matcher = Annotated[
    str,
    typer.Option(
        help="fused, relational, transformer, edit-distance or embedding; see docs/learned-matcher.md."
    ),
]
CandidatesBy = Annotated[
    str,
    typer.Option(
        help="sparse (inverted index), dense (embeddings), both, all, or auto: by the map's size."
    ),
]
Store = Annotated[
    str | None,
    typer.Option(help="Where embeddings are searched: a file, or http://host:port of Milvus."),
]
Weights = Annotated[
    Path | None,
    typer.Option(help="Other weights than the shipped ones, from `placegraph city train`."),
]


@contextmanager
def matching(
    city: CityMap, matcher: str, by: str, store: str | None, weights: Path | None
) -> Iterator[dict[str, Any]]:
    """Arguments of `CityMap.locate`; a store is closed at the end.

    Raises `StoreError` where the store is of another map or of other weights.
    """
    arguments: dict[str, Any] = {"matcher": matcher, "by": by}
    encoded = _encoded(city, weights)
    if encoded is not None:
        arguments["encoded"] = encoded
    if store is None:
        yield arguments
        return
    from placegraph.outdoor.vectors import Origin, map_fingerprint, open_store

    network = (encoded or city.encoded).network
    origin = Origin(map_fingerprint(city), network.fingerprint)
    with open_store(store, origin=origin) as opened:
        yield arguments | {"store": opened}


def _encoded(city: CityMap, weights: Path | None) -> EncodedCity | None:
    if weights is None:
        return None
    from placegraph.outdoor.learn.encoded import EncodedCity
    from placegraph.outdoor.learn.network import GraphTransformer

    return EncodedCity(city, GraphTransformer.open(weights))
