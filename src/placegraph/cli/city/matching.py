"""Options of how places are found and compared, which several commands have."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.encoded import EncodedCity

Matcher = Annotated[
    str,
    typer.Option(
        help="What judges places: fused (relations and network), or one alone: relational, "
        "transformer, embedding, edit-distance."
    ),
]
CandidatesBy = Annotated[
    str,
    typer.Option(
        help="Where places to judge come from: sparse (inverted index), dense (embeddings), both, "
        "all, or auto: both with --store, dense in very large maps, else sparse."
    ),
]
Store = Annotated[
    str | None,
    typer.Option(
        help="Vectors made by `placegraph city embed`: a file, or a Milvus server: "
        "http://[user:password@]host:port."
    ),
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
    from placegraph.vectors import open_store

    with open_store(store, origin=(encoded or city.encoded).origin) as opened:
        yield arguments | {"store": opened}


def _encoded(city: CityMap, weights: Path | None) -> EncodedCity | None:
    if weights is None:
        return None
    from placegraph.outdoor.network.encoded import EncodedCity
    from placegraph.outdoor.network.network import GraphTransformer

    return EncodedCity(city, GraphTransformer.open(weights))
