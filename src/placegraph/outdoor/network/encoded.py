"""A city as a network reads it: vectors of its words, graphs and embeddings of its cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.network.batches import WordFits, fits_of, word_fits
from placegraph.outdoor.network.graphs import PlaceGraphs, TextGraphs
from placegraph.outdoor.network.network import GraphTransformer, Matches
from placegraph.vectors import EmbeddedStore, Origin, Vectors, VectorStore, load_store
from placegraph.vectors.stores import Address


@dataclass(frozen=True, eq=False)
class EncodedCity:
    """A city read by a network; everything is derived on first use."""

    city: City
    network: GraphTransformer

    @cached_property
    def words(self) -> NDArray[np.float32]:
        """Vectors (T, d) of `city.words`."""
        return self.network.word_vectors(self.city.words)

    @cached_property
    def cells(self) -> PlaceGraphs:
        """Graphs of all cells, rows as `city.cells.points`."""
        return PlaceGraphs.of_cells(self.city)

    @cached_property
    def embeddings(self) -> NDArray[np.float32]:
        """Embeddings (C, D) of all cells (Eq. 10), rows as `city.cells.points`."""
        return self.network.embed_places(self.cells, self.words)

    @cached_property
    def origin(self) -> Origin:
        """What embeddings of this city by this network are told by from others."""
        return Origin(self.city.fingerprint, self.network.fingerprint)

    @cached_property
    def store(self) -> VectorStore:
        """The embeddings, ready to be searched."""
        return EmbeddedStore.of_rows(self._rows(), origin=self.origin)

    def keep(
        self,
        where: Address,
        *,
        name: str,
        bits: int = 16,
        resume: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
        timeout: float = 10.0,
    ) -> VectorStore:
        """Embed the cells and keep the vectors in a store; arguments and errors as of `load_store`."""
        if progress is not None:
            progress("embedding", 0, len(self.city.cells))
        return load_store(
            where, self._rows(), name=name, origin=self.origin,
            bits=bits, resume=resume, progress=progress, timeout=timeout,
        )  # fmt: skip

    def _rows(self) -> Vectors:
        cells = self.city.cells
        return Vectors.of(cells.points, self.embeddings, cells.lonlat)

    def text(self, query: Query) -> EncodedText:
        """A query as the network reads it."""
        # what is said again is no surer: the query has it once
        said = (*query.used, *(statement for statement, _ in query.unused))
        texts = TextGraphs.of([replace(query.description, statements=said)])
        fits = fits_of(texts, [query])
        counts, total = self.city.word_counts
        return EncodedText(texts, word_fits(fits, counts, total))

    def match(self, text: EncodedText, places: PlaceGraphs, rows: NDArray[np.int64]) -> Matches:
        """Match a text with places of this city (Eq. 14-17)."""
        return self.network.match(text.graphs, 0, places, rows, text.words, self.words)


@dataclass(frozen=True, eq=False)
class EncodedText:
    """A query as a network reads it."""

    graphs: TextGraphs
    """One text."""
    words: WordFits
    """How well words of the map fit its nodes."""
