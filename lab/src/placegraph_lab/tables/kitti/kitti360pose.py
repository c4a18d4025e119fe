"""The protocol of KITTI360Pose: retrieval of the exact cell, and localization within metres.

The truth (a pose's best cell and position) is read here and nowhere else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.network import GraphTransformer
from placegraph_lab.datasets.kitti360pose import Kitti360Pose
from placegraph_lab.tables.kitti.graphs import (
    EDGE_DISTANCE,
    Names,
    Reading,
    description_of,
    scene_graph,
)
from placegraph_lab.tables.kitti.matchers import (
    EditDistance,
    Matcher,
    Relational,
    Transformer,
    TripleBag,
)
from placegraph_lab.tables.runner import markdown, number, share, shares

RANKS = (1, 3, 5)  # k of the retrieval recall
TOPS = (1, 5, 10)  # k of the localization recall
RADII = (5.0, 10.0, 15.0)  # A place within this distance of the truth is a hit [m]

BAG, EDIT, EDIT_PLAIN = "triple bag", "edit distance", "edit distance, plain"
TRANSFORMER, RELATIONAL = "transformer", "relational"
MATCHERS = (BAG, EDIT_PLAIN, EDIT, TRANSFORMER, RELATIONAL)
SLOW = (EDIT, EDIT_PLAIN)  # those that only get some of the queries

PAPER = {
    "Text2Pos": ((0.14, 0.28, 0.37), (0.12, 0.25, 0.33)),
    "RET": ((0.18, 0.34, 0.44), None),
    "Text2Loc": ((0.31, 0.54, 0.64), (0.28, 0.49, 0.58)),
    "MambaPlace": ((0.35, 0.61, 0.72), (0.31, 0.53, 0.62)),
    "GOTLoc, rule-based": ((0.39, 0.68, 0.80), (0.24, 0.52, 0.66)),
    "GOTLoc, transformer": ((0.36, 0.58, 0.67), (0.30, 0.49, 0.57)),
    "GOTLoc on OSM, rule-based": ((0.24, 0.48, 0.57), (0.29, 0.50, 0.58)),
    "GOTLoc on OSM, transformer": ((0.23, 0.43, 0.53), (0.22, 0.39, 0.48)),
    "CMMLoc": (None, (0.32, 0.53, 0.63)),
    "MNCL": (None, (0.44, 0.67, 0.75)),
    "Des4Pos": (None, (0.45, 0.69, 0.77)),
    "PARC-Loc": (None, (0.51, 0.76, 0.83)),
}
"""Published recall@1/3/5 on validation and test: Table II of the paper, and later work."""
POINT_CLOUD = {110: 1310.67, 220: 2618.63, 330: 3898.24, 447: 5546.19}
"""Table V: MB of the point cloud of drive 0003 by cells ..."""
SCENE_GRAPH = {110: 0.13, 220: 0.23, 330: 0.35, 447: 0.71}  # ... and of the paper's scene graphs.


@dataclass(frozen=True, eq=False)
class Split:
    """Cells and poses of a split, with the graphs that matchers compare."""

    name: str
    data: Kitti360Pose
    reading: Reading
    cells: NDArray[np.int64]  # (K,) rows of the data
    poses: NDArray[np.int64]  # (P,) rows of the data
    edge_distance: float = EDGE_DISTANCE

    @classmethod
    def of(
        cls,
        data: Kitti360Pose,
        name: str,
        reading: Reading = "honest",
        *,
        edge_distance: float = EDGE_DISTANCE,
    ) -> Split:
        """Raises `OptionError` where the data have no such split."""
        return cls(name, data, reading, *data.split(name), edge_distance)

    @property
    def centers(self) -> Floats:
        """Centres (K, 2) of the cells [m]."""
        return self.data.cells.centers[self.cells]

    def graphs(self, names: Names) -> list[SceneGraph]:
        return [
            scene_graph(self.data, int(c), names=names, edge_distance=self.edge_distance)
            for c in self.cells
        ]

    def pairs(self, names: Names) -> tuple[list[Description], NDArray[np.int64]]:
        """Query graphs of all poses, and the row (P,) among the K cells that each belongs to.

        What training needs besides `graphs` and `centers`.
        """
        told = [
            description_of(
                self.data, int(p), reading=self.reading, names=names,
                edge_distance=self.edge_distance,
            )
            for p in self.poses
        ]  # fmt: skip
        return told, np.searchsorted(self.cells, self.data.poses.cells[self.poses])

    def matcher(
        self,
        name: str,
        rng: np.random.Generator,
        *,
        network: GraphTransformer | None = None,
        candidates: int = 20,
    ) -> tuple[Matcher, Names]:
        """One of `MATCHERS`, and how queries call things for it.

        `network`: for the transformer, as GOTLoc prints it; the shipped one where not given;
        `candidates`: how many cells edit distance looks at.
        """
        if name not in MATCHERS:
            raise OptionError(f"There is no matcher {name!r}; choose one of {', '.join(MATCHERS)}.")
        if name == RELATIONAL:
            return Relational.of(self.data, self.cells), Names(self.data)
        if name == TRANSFORMER:
            network = network or GraphTransformer.default(printed=True)
            if not network.shape.printed:
                raise OptionError(
                    "The weights are of another network than the paper's; give those of "
                    "placegraph-lab train-kitti360pose, or of placegraph city train --printed."
                )
            names = Names(self.data, osm=True)
            return Transformer(LabelGraphs.of_graphs(self.graphs(names)), network), names
        names = Names(self.data, coloured=True)
        graphs = self.graphs(names)
        bag = TripleBag.of(graphs, self.centers, rng)
        if name == BAG:
            return bag, names
        plain = name == EDIT_PLAIN
        centers = self.centers if self.reading == "honest" and not plain else None
        return EditDistance(graphs, centers, bag, candidates, plain=plain), names


@dataclass(frozen=True)
class Result:
    """One matcher on the poses of a split."""

    split: str
    matcher: str
    reading: Reading
    queries: int
    cells: int
    retrieval: dict[int, float]  # recall of the exact cell by rank
    centered: dict[int, dict[float, float]]
    """Recall by rank and radius [m], a cell's centre being the pose."""
    refined: dict[int, dict[float, float]]
    """The same, the pose being where in the cell the statements fit best."""
    p50: float  # median time for a query, all cells [s]
    off: dict[str, float] = field(default_factory=dict)
    """Median distance of the first place [m], by how it is placed."""
    on_osm: bool = False
    """Whether cells and texts were made from OpenStreetMap, not from the point cloud."""


def evaluate(
    split: Split,
    name: str,
    matcher: Matcher,
    names: Names,
    *,
    poses: Iterable[int] | None = None,
    within: Relational | None = None,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Give every pose's query graph, and nothing else of it, to a matcher.

    `poses`: rows of the data; all of the split where not given; `within`: finds the pose within a
    cell, from the honest statements; those of the split where not given; `progress`: is told how
    many queries are done.
    """
    data, honest = split.data, Names(split.data)
    within = within or Relational.of(data, split.cells)
    rows = split.poses if poses is None else np.fromiter(poses, np.int64)
    if not len(rows):
        raise OptionError("There are no poses to evaluate.")
    exact, centered, refined, seconds = [], [], [], []
    for n, pose in enumerate(rows.tolist()):
        query = description_of(
            data, pose, reading=split.reading, names=names, edge_distance=split.edge_distance
        )
        start = time.perf_counter()
        scores = matcher.scores(query)
        top = _best(scores, max(*RANKS, *TOPS))
        seconds.append(time.perf_counter() - start)
        exact.append(split.cells[top] == data.poses.cells[pose])
        centered.append(_distances(split, pose, top, split.centers[top]))
        told = description_of(data, pose, names=honest)
        refined.append(_distances(split, pose, top, within.poses(told, top)))
        if progress is not None:
            progress(n + 1)
    return Result(
        split=split.name,
        matcher=name,
        reading=split.reading,
        queries=len(rows),
        cells=len(split.cells),
        retrieval={k: float(np.mean([e[:k].any() for e in exact])) for k in RANKS},
        centered=_recall(centered),
        refined=_recall(refined),
        p50=float(np.median(seconds)),
        off={
            "centered": float(np.median([d[0] for d in centered])),
            "refined": float(np.median([d[0] for d in refined])),
        },
        on_osm=bool(data.tags),
    )


def _best(scores: Floats, top: int) -> NDArray[np.int64]:
    order = np.argsort(-scores, kind="stable")[:top]
    return order[np.isfinite(scores[order])]


def _distances(split: Split, pose: int, cells: NDArray[np.int64], at: Floats) -> Floats:
    """Distances [m] of places (k, 2) in cells from a pose; another drive is infinitely far."""
    data = split.data
    off = np.hypot(*(at - data.poses.positions[pose, :2]).T)
    same = data.cells.scene[split.cells[cells]] == data.poses.scene[pose]
    return np.append(np.where(same, off, np.inf), np.inf)  # never empty


def _recall(distances: Sequence[Floats]) -> dict[int, dict[float, float]]:
    return {
        k: {r: float(np.mean([(d[:k] <= r).any() for d in distances])) for r in RADII} for k in TOPS
    }


def retrieval_table(results: Sequence[Result]) -> str:
    """Table II: recall@1/3/5 of the exact cell, with the published figures above."""
    header = ["", *(f"{split} k = {k}" for split in ("validation", "test") for k in RANKS), "p50"]
    rows = []
    for name, sets in PAPER.items():
        rows.append(
            [
                f"{name} (published)",
                *(share(s[i] if s else None) for s in sets for i in range(3)),
                "–",
            ]
        )
    for title, found in _grouped(results).items():
        cells = [
            share(found[split].retrieval[k]) if split in found else "–"
            for split in ("validation", "test")
            for k in RANKS
        ]
        some = next(iter(found.values()))
        rows.append([title, *cells, number(1e3 * some.p50, 1, "ms")])
    return markdown(header, rows)


def localization_table(results: Sequence[Result], split: str) -> str:
    """Localization recall at 5/10/15 m of a split, from centres and from poses within cells."""
    header = ["", *(f"k = {k}, {how}" for how in ("centre", "pose") for k in TOPS), "queries"]
    rows = []
    for title, found in _grouped(results).items():
        if split in found:
            r = found[split]
            cells = [shares(table[k].values()) for table in (r.centered, r.refined) for k in TOPS]
            rows.append([title, *cells, f"{r.queries:,}"])
    return markdown(header, rows)


def size_table(data: Kitti360Pose, scene: str = "0003") -> str:
    """Table V: MB of a drive's points, and of its graphs, against the number of cells.

    As many cells as in the paper, with its figures; quarters of a drive that has fewer than 110.
    """
    cells, _ = data.split(scene)
    published = [n for n in POINT_CLOUD if n <= len(cells)]
    counts = published or [max(1, round(len(cells) * part / 4)) for part in range(1, 5)]
    points = [data.cells.point_bytes[cells[:n]].sum() / 1e6 for n in counts]
    graphs = [data.graph_bytes(cells[:n]) / 1e6 for n in counts]
    rows = [
        ["points and colours", *(number(mb, 2) for mb in points)],
        ["point cloud (published)", *(number(POINT_CLOUD.get(n), 2) for n in counts)],
        ["scene graphs", *(number(mb, 4) for mb in graphs)],
        ["scene graphs (published)", *(number(SCENE_GRAPH.get(n), 2) for n in counts)],
        ["ratio", *(number(p / g) for p, g in zip(points, graphs, strict=True))],
    ]
    return markdown(["MB of drive " + scene, *(f"{n:,} cells" for n in counts)], rows)


def _grouped(results: Sequence[Result]) -> dict[str, dict[str, Result]]:
    grouped: dict[str, dict[str, Result]] = {}
    for r in results:
        reading = "the text" if r.reading == "honest" else "positions known"
        title = f"{r.matcher}{' on OSM' if r.on_osm else ''}, {reading}"
        grouped.setdefault(title, {})[r.split] = r
    return grouped
