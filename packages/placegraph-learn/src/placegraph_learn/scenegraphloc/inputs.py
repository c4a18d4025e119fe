"""What the network is told of the objects of a map: the five modalities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError
from placegraph.indoor.map.scene import Scene
from placegraph_learn.scenegraphloc.features import NONE, RELATIONS, relation_row
from placegraph_learn.scenegraphloc.views import Views

if TYPE_CHECKING:
    from placegraph_learn.scenegraphloc.network import Objects

POINTS = 512  # of each object
PointSource = Literal["surface", "vertices"]
_DIRECTIONS = 1024
_PORTION = 1 << 14
_MOST = 4000
"""Objects of one room; every pair of them is an edge."""


@dataclass(frozen=True, eq=False)
class Room:
    """One scene graph as the network reads it; arrays, n objects."""

    name: str
    ids: tuple[str, ...]
    labels: tuple[str, ...]
    points: NDArray[np.float32]
    """(n, P, 3) less the room's mean [m]"""
    offsets: NDArray[np.float64]
    """(n, 3) barycentre of the root less the object's [m]"""
    edges: NDArray[np.int64]
    """(n (n - 1), 2) rows of source and target: a complete graph."""
    relations: NDArray[np.float32]
    """(n, 41) counts of the words of edges that leave the object."""
    attributes: NDArray[np.float32]
    """(n, A) counts of the object's attribute words."""
    owner: NDArray[np.int64]
    """(V,) row of the object of each view; ascending, each object has at least one."""
    views: NDArray[np.float32]
    """(V, f) image features"""
    poses: NDArray[np.float32]
    """(V, 7) quaternion x, y, z, w, and position [m], of scene_from_camera."""

    def __len__(self) -> int:
        return len(self.ids)

    def with_points(self, count: int) -> Room:
        """Room with the first `count` points of each object."""
        return replace(self, points=self.points[:, :count])


def rooms_of(
    scene: Scene,
    views: Views,
    *,
    attributes: Sequence[str] = (),
    count: int = 0,
    source: PointSource = "surface",
    rng: np.random.Generator,
) -> list[tuple[NDArray[np.int64], Room]]:
    """Rooms of a map, one for each scene that was merged into it, with the rows of their objects.

    Parameters
    ----------
    scene, views
        The map, and what images show of its objects.
    attributes
        Attribute words to count; without any the vectors are zero.
    count
        Length of the vectors of attributes; that of `attributes` if larger.
    source
        Where points come from: spread over the triangles by area, as coarse maps need it, or the
        vertices, the farthest from each other, as of the dense scans of 3RScan.
    rng
        Draws the points, of each room from the same state.

    Raises
    ------
    OptionError
        A scene has so many objects that its complete graph is no sense, or `source` is neither.

    """
    if source not in {"surface", "vertices"}:
        raise OptionError(f"points is {source!r}; it is 'surface' or 'vertices'.")
    clouds = _Clouds(scene, source)
    made = []
    for part, name in enumerate(scene.scenes):
        rows = np.flatnonzero(scene.scene_of == part)
        if not rows.size:
            continue
        _check_size(rows.size, scene.source or name)
        triples = _triples(scene, rows)
        edges, words = complete(len(rows), triples)
        points, mean = clouds.sample(rows, deepcopy(rng))  # merged or alone, it is the same room
        scene_from_map, seen = scene.scene_from_map[part], views.of(rows)
        turn = scene_from_map[:3, :3]
        room = Room(
            name=name,
            ids=tuple(scene.graph.ids[row] for row in rows),
            labels=tuple(scene.graph.labels[row] for row in rows),
            points=((points - mean) @ turn.T).astype(np.float32),
            offsets=_offsets(clouds.barycentres(rows), triples) @ turn.T,
            edges=edges,
            relations=_counts(edges[:, 0], words, len(rows)),
            attributes=_attributes([scene.attributes[row] for row in rows], attributes, count),
            owner=seen.owner,
            views=seen.features,
            poses=seen.poses(scene_from_map),
        )
        made.append((rows, room))
    return made


def _check_size(count: int, name: str) -> None:
    if count > _MOST:
        raise OptionError(
            f"{name}: {count} objects in one room; the network relates each to each, which is meant "
            f"for up to {_MOST}."
        )


def complete(
    count: int, triples: Sequence[tuple[int, int, int]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (E, 2) of the complete graph, and the word (E,) that the published data give each.

    Pairs that are annotated come first, once each, then all others. The k-th edge bears the word of
    the k-th triple (subject, row of the word, object): where a pair has two relations, all later
    words are shifted. So it was trained, and so it is here.
    """
    pairs = np.array(
        list(dict.fromkeys((s, t) for s, _, t in triples)), np.int64
    ).reshape(-1, 2)  # fmt: skip
    told = np.eye(count, dtype=np.bool_)
    told[pairs[:, 0], pairs[:, 1]] = True
    edges = np.concatenate([pairs, np.argwhere(~told)])
    words = np.full(len(triples) + len(edges) - len(pairs), RELATIONS.index(NONE), np.int64)
    words[: len(triples)] = [word for _, word, _ in triples]
    return edges, words[: len(edges)]


def barycentre(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean (3,) of the corners of the convex hull of points (n, 3).

    Corners are the farthest points in 1024 directions: all of a box or a plane, and of rounder
    things enough for a mean.
    """
    found = np.unique(points, axis=0).astype(np.float64)
    ways = _ways()
    corners = [
        part[np.unique((part @ ways).argmax(axis=0))]
        for part in np.split(found, range(_PORTION, len(found), _PORTION))
    ]
    near = np.concatenate(corners)
    return np.asarray(near[np.unique((near @ ways).argmax(axis=0))].mean(axis=0))


def _ways() -> NDArray[np.float64]:
    """Directions (3, 1024), evenly spread over the sphere (Fibonacci's lattice)."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / _DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z])


class _Clouds:
    """Points of the objects of a map."""

    def __init__(self, scene: Scene, source: PointSource) -> None:
        self.mesh, self.source = scene.mesh, source
        order = np.argsort(self.mesh.object_of, kind="stable")
        ends = np.searchsorted(self.mesh.object_of[order], np.arange(len(scene) + 1))
        self.triangles = [order[a:b] for a, b in pairwise(ends.tolist())]
        self.areas = np.linalg.norm(self.mesh.normals(), axis=1)

    def vertices(self, row: int) -> NDArray[np.float32]:
        """(V, 3) of an object."""
        return self.mesh.vertices[np.unique(self.mesh.triangles[self.triangles[row]])]

    def barycentres(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, 3) of objects."""
        return np.array([barycentre(self.vertices(row)) for row in rows.tolist()])

    def sample(
        self, rows: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points (n, 512, 3) of objects, and the mean (3,) of their room."""
        if self.source == "vertices":
            clouds = [self.vertices(row) for row in rows.tolist()]
            points = np.stack([farthest(cloud, POINTS, rng) for cloud in clouds])
            return points, np.concatenate(clouds).mean(axis=0, dtype=np.float64)
        points = np.stack([self._spread(row, rng) for row in rows.tolist()])
        weights = np.array([self.areas[self.triangles[row]].sum() for row in rows.tolist()])
        weights = np.maximum(weights, 1e-12)
        return points, np.average(points.mean(axis=1), axis=0, weights=weights)

    def _spread(self, row: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """(512, 3) on the surface of an object, by area."""
        own = self.triangles[row]
        areas = self.areas[own] + 1e-12
        chosen = own[rng.choice(len(own), POINTS, p=areas / areas.sum())]
        a, b, c = np.moveaxis(self.mesh.vertices[self.mesh.triangles[chosen]], 1, 0)
        u, v = rng.random((2, POINTS, 1))
        u, v = np.where(u + v > 1.0, (1.0 - u, 1.0 - v), (u, v))
        return np.asarray(a + u * (b - a) + v * (c - a), np.float64)


def farthest(
    points: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """`count` of the points (V, 3), each the farthest from those before; drawn where they are fewer."""
    cloud = points.astype(np.float64)
    if len(cloud) < count:
        return cloud[rng.integers(len(cloud), size=count)]
    chosen = np.empty(count, np.int64)
    chosen[0] = rng.integers(len(cloud))
    distance = np.full(len(cloud), np.inf)
    for k in range(1, count):
        apart = ((cloud - cloud[chosen[k - 1]]) ** 2).sum(axis=1)
        distance = np.minimum(distance, apart)
        chosen[k] = distance.argmax()
    return cloud[chosen]


def _triples(scene: Scene, rows: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Relations among some objects (row, row of the word, row) that 3DSSG has a word for."""
    place = {row: k for k, row in enumerate(rows.tolist())}
    graph = scene.graph
    found = []
    for s, name, t in zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(),
                          strict=True):  # fmt: skip
        word = relation_row(name)
        if word and s in place and t in place and s != t:  # "none" is told by being left out
            found.append((place[s], word, place[t]))
    return found


def _offsets(
    barycentres: NDArray[np.float64], triples: Sequence[tuple[int, int, int]]
) -> NDArray[np.float64]:
    """From each object to the root (n, 3): the object most often in annotated pairs, or the first."""
    ends = [row for s, _, t in triples for row in (s, t)]
    root = int(np.bincount(ends, minlength=len(barycentres)).argmax())
    return barycentres[root] - barycentres


def _counts(rows: NDArray[np.int64], words: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    flat = np.bincount(rows * len(RELATIONS) + words, minlength=count * len(RELATIONS))
    return flat.reshape(count, -1).astype(np.float32)


def _attributes(
    said: Sequence[Mapping[str, str]], words: Sequence[str], count: int
) -> NDArray[np.float32]:
    """Counts (n, A) of the words in all groups of attributes: color, material, state, ..."""
    column = {word: k for k, word in enumerate(words)}
    table = np.zeros((len(said), max(count, len(words))), np.float32)
    for row, groups in enumerate(said):
        for text in groups.values():
            for word in text.lower().split(","):
                if word.strip() in column:
                    table[row, column[word.strip()]] += 1.0
    return table


def together(rooms: Sequence[Room], *, device: Any = "cpu") -> Objects:  # noqa: ANN401
    """Several rooms as the tensors that the network reads, one after the other."""
    import torch

    from placegraph_learn.scenegraphloc.network import Objects

    def joined(arrays: list[NDArray[Any]]) -> torch.Tensor:
        return torch.from_numpy(np.concatenate(arrays).astype(np.float32)).to(device)

    sizes = tuple(len(room) for room in rooms)
    starts = np.cumsum((0, *sizes[:-1]))
    owner = [r.owner + start for r, start in zip(rooms, starts.tolist(), strict=True)]
    return Objects(
        points=joined([r.points for r in rooms]),
        offsets=joined([r.offsets for r in rooms]),
        edges=tuple(torch.tensor(r.edges, device=device) for r in rooms),
        sizes=sizes,
        relations=joined([r.relations for r in rooms]),
        attributes=joined([r.attributes for r in rooms]),
        owner=torch.from_numpy(np.concatenate(owner)).to(device),
        views=joined([r.views for r in rooms]),
        poses=joined([r.poses for r in rooms]),
    )
