"""Scene graph: nodes are objects, edges are spatial relations, both stored in columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.pickling import PickleFields
from placegraph.errors import MissingExtraError, OptionError

if TYPE_CHECKING:
    import networkx as nx

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SceneGraph(PickleFields):
    """Scene graph of N nodes in D = 2 or 3 dimensions and M edges.

    Row i of every node column is one object; row j of every edge column reads
    "`sources[j]` is `relations[j]` of `targets[j]`". Arguments are converted to read-only arrays and
    checked. Graphs are equal if all their columns are.

    Raises
    ------
    OptionError
        Columns differ in length, ids repeat, numbers are not finite, edges point nowhere.

    """

    ids: tuple[str, ...]
    """Unique ids, stable between versions of a map."""
    labels: tuple[str, ...]
    positions: Floats
    """(N, D) float64 [m]"""
    sources: Rows
    """(M,) int64, rows of nodes."""
    targets: Rows
    """(M,) int64, rows of nodes."""
    relations: tuple[str, ...]
    """(M,)"""
    names: tuple[str, ...] = ()
    """(N,), empty strings for objects without a name, or none at all."""
    extents: Floats | None = None
    """(N, D) float64 [m], full lengths along the axes."""
    embeddings: NDArray[np.float32] | None = None
    """(N, E) float32"""
    weights: Floats | None = None
    """(M,) float64"""

    def __post_init__(self) -> None:
        n, m = len(self.ids), len(self.relations)
        _put(self, "ids", _texts("ids", self.ids, n))
        _put(self, "labels", _texts("labels", self.labels, n))
        _put(self, "names", _texts("names", self.names or ("",) * n, n))
        _put(self, "relations", _texts("relations", self.relations, m))
        if len(set(self.ids)) != n:
            twice = Counter(self.ids).most_common(1)[0][0]
            raise OptionError(f"ids: {twice!r} is used by several nodes; make ids unique.")
        _put(self, "positions", _numbers("positions", self.positions, (n, None), np.float64))
        d = self.positions.shape[1]
        if d not in (2, 3):
            raise OptionError(f"positions: they have {d} dimensions; give 2 or 3.")
        if self.extents is not None:
            _put(self, "extents", _numbers("extents", self.extents, (n, d), np.float64))
            if np.any(self.extents < 0):
                raise OptionError(
                    "extents: a length is negative; give full side lengths in metres."
                )
        if self.embeddings is not None:
            vectors = _numbers("embeddings", self.embeddings, (n, None), np.float32)
            _put(self, "embeddings", vectors)
        if self.weights is not None:
            _put(self, "weights", _numbers("weights", self.weights, (m,), np.float64))
        for end in ("sources", "targets"):
            rows = _rows(end, getattr(self, end), n)
            if rows.shape != (m,):
                raise OptionError(f"{end}: shape is {rows.shape}, but there are {m} relations.")
            _put(self, end, rows)

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        counts = Counter(self.relations).most_common()
        edges = f": {', '.join(f'{count} {relation}' for relation, count in counts)}"
        return (
            f"SceneGraph({len(self)} nodes in {self.positions.shape[1]}-d, "
            f"{len(self.relations)} edges{edges if counts else ''})"
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SceneGraph):
            return NotImplemented
        return all(_same(getattr(self, f), getattr(other, f)) for f in self.__slots__)

    __hash__ = None  # type: ignore[assignment]  # columns may be large: compare, do not hash

    def triples(self) -> list[tuple[str, str, str]]:
        """Return (label, relation, label) of every edge, in order."""
        return [
            (self.labels[s], relation, self.labels[t])
            for s, relation, t in zip(self.sources, self.relations, self.targets, strict=True)
        ]

    def subgraph(self, rows: ArrayLike) -> SceneGraph:
        """Return the nodes in `rows` (row numbers in any order, or a mask (N,)) and the edges among them.

        Raises `OptionError` where a row repeats or does not exist.
        """
        rows = np.asarray(rows)
        if rows.dtype == np.bool_ and rows.shape != (len(self),):
            raise OptionError(
                f"rows: the mask has shape {rows.shape}, but there are {len(self)} nodes."
            )
        rows = _rows("rows", np.flatnonzero(rows) if rows.dtype == np.bool_ else rows, len(self))
        place = np.full(len(self), -1)
        place[rows] = np.arange(rows.size)
        if np.count_nonzero(place >= 0) != rows.size:
            raise OptionError("rows: a row is repeated; give each node once.")
        kept = np.flatnonzero((place[self.sources] >= 0) & (place[self.targets] >= 0))
        return SceneGraph(
            ids=tuple(self.ids[i] for i in rows),
            labels=tuple(self.labels[i] for i in rows),
            names=tuple(self.names[i] for i in rows),
            positions=self.positions[rows],
            extents=None if self.extents is None else self.extents[rows],
            embeddings=None if self.embeddings is None else self.embeddings[rows],
            sources=place[self.sources[kept]],
            targets=place[self.targets[kept]],
            relations=tuple(self.relations[j] for j in kept),
            weights=None if self.weights is None else self.weights[kept],
        )

    def to_networkx(self) -> nx.MultiDiGraph[str]:
        """Return a NetworkX graph whose nodes are the ids and whose edge keys are the edges' rows.

        Node attributes: label, name, position, and extent, embedding where there are any; edge
        attributes: relation, and weight. Raises `MissingExtraError` without NetworkX.
        """
        try:
            from networkx import MultiDiGraph
        except ImportError as error:
            raise MissingExtraError(
                "NetworkX is not installed; run `pip install 'placegraph[networkx]'`."
            ) from error
        graph: nx.MultiDiGraph[str] = MultiDiGraph(
            dimensions=self.positions.shape[1],
            extent_shape=_row_shape(self.extents),
            embedding_shape=_row_shape(self.embeddings),
            weight_shape=_row_shape(self.weights),
        )
        for i, id_ in enumerate(self.ids):
            graph.add_node(id_, label=self.labels[i], name=self.names[i])
            _annotate(graph.nodes[id_], "position", self.positions, i)
            _annotate(graph.nodes[id_], "extent", self.extents, i)
            _annotate(graph.nodes[id_], "embedding", self.embeddings, i)
        for j, (s, t) in enumerate(zip(self.sources, self.targets, strict=True)):
            source, target = self.ids[s], self.ids[t]
            graph.add_edge(source, target, key=j, relation=self.relations[j])
            _annotate(graph.edges[source, target, j], "weight", self.weights, j)
        return graph

    @classmethod
    def from_networkx(cls, graph: nx.DiGraph[Any]) -> SceneGraph:
        """Undo `to_networkx`, or convert any directed NetworkX graph with these attributes.

        Nodes need ``label`` and ``position``, edges need ``relation``; ``name`` is optional for each
        node, ``extent``, ``embedding`` and ``weight`` for all together. Nodes become ids by `str`.
        Raises `OptionError`, naming the missing attribute.
        """
        if not graph.is_directed():
            raise OptionError(
                "The graph is undirected, but relations have a direction; use a DiGraph or "
                "MultiDiGraph."
            )
        nodes: list[tuple[Hashable, dict[str, Any]]] = list(graph.nodes(data=True))
        edges = list(graph.edges(keys=True, data=True)) if graph.is_multigraph() else []
        if not graph.is_multigraph():
            edges = [(s, t, 0, data) for s, t, data in graph.edges(data=True)]
        keys = [key for _, _, key, _ in edges]
        if all(type(key) is int for key in keys) and len(set(keys)) == len(keys):
            edges.sort(key=lambda edge: edge[2])  # our own keys: the edges' rows
        row = {node: i for i, (node, _) in enumerate(nodes)}
        objects = [(f"node {node!r}", data) for node, data in nodes]
        links = [(f"edge {s!r} -> {t!r}", data) for s, t, _, data in edges]
        facts = graph.graph
        positions: Any = np.zeros((0, facts.get("dimensions", 2)))
        if objects:
            positions = _attributes(objects, "position")
        return cls(
            ids=tuple(str(node) for node, _ in nodes),
            labels=tuple(_attributes(objects, "label")),
            names=tuple(data.get("name", "") for _, data in nodes),
            positions=positions,
            extents=_optional(objects, "extent", facts.get("extent_shape")),
            embeddings=_optional(objects, "embedding", facts.get("embedding_shape")),
            sources=np.array([row[s] for s, _, _, _ in edges], np.int64),
            targets=np.array([row[t] for _, t, _, _ in edges], np.int64),
            relations=tuple(_attributes(links, "relation")),
            weights=_optional(links, "weight", facts.get("weight_shape")),
        )


def _put(graph: SceneGraph, field: str, value: object) -> None:
    object.__setattr__(graph, field, value)


def _texts(field: str, texts: Iterable[str], count: int) -> tuple[str, ...]:
    column = tuple(texts)
    if len(column) != count:
        raise OptionError(f"{field}: {len(column)} entries are given, expected {count}.")
    if any(not issubclass(kind, str) for kind in {*map(type, column)}):
        text = next(text for text in column if not isinstance(text, str))
        raise OptionError(f"{field}: {text!r} is not a string.")
    return column


def _numbers(
    field: str, values: ArrayLike, shape: tuple[int | None, ...], dtype: type[np.generic]
) -> NDArray[Any]:
    """Return a finite read-only array; None in `shape` means any length."""
    try:
        with np.errstate(over="ignore"):  # overflow gives infinity, refused below
            array = np.array(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise OptionError(f"{field}: not an array of numbers ({error}).") from error
    if len(array.shape) != len(shape) or any(
        wanted not in (None, got) for got, wanted in zip(array.shape, shape, strict=True)
    ):
        wanted_shape = ", ".join("any" if length is None else str(length) for length in shape)
        raise OptionError(f"{field}: shape is {array.shape}, expected ({wanted_shape}).")
    if not np.all(np.isfinite(array)):
        raise OptionError(f"{field}: a number is not finite or too large for {array.dtype}.")
    array.flags.writeable = False
    return array


def _rows(field: str, values: ArrayLike, count: int) -> Rows:
    """Return a read-only vector of row numbers below `count`."""
    array = np.asarray(values)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise OptionError(
            f"{field}: {array.dtype} {array.shape} is given, expected a vector of row indices."
        )
    if array.size and (int(array.min()) < 0 or int(array.max()) >= count):
        raise OptionError(f"{field}: a row index is outside 0 to {count - 1}.")
    rows = array.astype(np.int64)
    rows.flags.writeable = False
    return rows


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    return type(a) is type(b) and a == b


def _annotate(data: dict[str, Any], key: str, column: NDArray[Any] | None, i: int) -> None:
    """Add row i of a column as plain numbers: a float, or a tuple of floats."""
    if column is not None:
        value = column[i].tolist()
        data[key] = tuple(value) if isinstance(value, list) else value


def _attributes(rows: list[tuple[str, dict[str, Any]]], key: str) -> list[Any]:
    for what, data in rows:
        if key not in data:
            raise OptionError(f"{what} has no attribute {key!r}; add it, or drop it everywhere.")
    return [data[key] for _, data in rows]


def _optional(
    rows: list[tuple[str, dict[str, Any]]], key: str, row_shape: tuple[int, ...] | None
) -> Any:  # noqa: ANN401  # unchecked attributes; SceneGraph checks them
    """Return column `key`, None where no row has it; `row_shape` decides where there are no rows."""
    if rows:
        return _attributes(rows, key) if any(key in data for _, data in rows) else None
    return None if row_shape is None else np.zeros((0, *row_shape))


def _row_shape(column: NDArray[Any] | None) -> tuple[int, ...] | None:
    return None if column is None else column.shape[1:]
