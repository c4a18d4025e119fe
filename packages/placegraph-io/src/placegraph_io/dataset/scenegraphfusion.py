"""Reader of scene graphs that SceneGraphFusion predicts (Wu et al., 2021): surfels, nodes, edges.

Its program writes `predictions.json`, the graph of its segments, beside `inseg.ply` and
`node_semantic.ply`, whose points are surfels with the number of their segment as `label`. There is
no mesh: surfels become small squares, or give their labels to a mesh of the same place. Segments
that a *same part* edge joins are one thing, as they are there, which bears the smallest number.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.capture.json_files import LabelEntry, read_json
from placegraph.io.mesh.model import Model, Texture
from placegraph.io.mesh.nearest_kernels import find_nearest
from placegraph.io.mesh.ply import majority_vote, make_objects, read_columns, read_ply, to_integers

Rows = NDArray[np.int64]
Floats = NDArray[np.float64]


PREDICTIONS = ("predictions.json", "prediction.json")
_SAME, _NONE = "same part", "none"


def is_scenegraphfusion(path: Path) -> bool:
    """Return whether a path is a folder that SceneGraphFusion wrote to, or its `predictions.json`."""
    try:
        folder = path.parent if path.name in PREDICTIONS else path
        return all(
            any((folder / name).is_file() for name in names) for names in (PREDICTIONS, SURFELS)
        )
    except (OSError, ValueError):
        return False


def read_scenegraphfusion(
    path: str | PathLike[str], *, mesh: str | PathLike[str] | None = None
) -> Model:
    """Read what SceneGraphFusion predicted of a scan.

    A thing's label is the likeliest class of its segments, entry in its attribute `probability`;
    relations are the likeliest of each edge, without *none*. Surfels of segments of which nothing
    was predicted, for they were small, are one thing "unknown".

    `path`: folder, or its `predictions.json`; `mesh`: mesh (PLY or OBJ, z up) in the axes of the
    recording's poses, such as ScanNet's `_vh_clean_2.ply`: its surface and colours are used, with the
    surfels' labels.

    Raises `InputError`: a file is missing or damaged; graph and surfels share no segment; the mesh lies
    elsewhere.
    """
    folder = Path(path)
    folder = folder.parent if folder.name in PREDICTIONS else folder
    graph = _read_graph(_find_file(folder, PREDICTIONS), folder)
    left_out: Counter[str] = Counter()
    surfels = read_surfels(_find_file(folder, SURFELS), left_out)
    ids = graph.object_of(surfels.segments)
    if not (ids >= 0).any():
        raise InputError(
            f"{surfels.path} and {graph.path} have no segment in common; take both from one run."
        )
    if mesh is None:
        model = make_squares(surfels, ids)
        of = model.object_of
    else:
        model, of = transfer_labels(Path(mesh), surfels, ids, left_out)
    things, object_of, missing = make_objects(of, len(model.triangles), graph.table())
    row = {thing.id: i for i, thing in enumerate(things)}
    relations = {(row.get(str(a)), name, row.get(str(b))) for a, name, b in graph.relations()}
    return replace(
        model,
        path=folder,
        objects=things,
        object_of=object_of,
        relations=tuple(
            sorted((a, n, b) for a, n, b in relations if a is not None and b is not None)
        ),
        left_out=left_out + model.left_out + missing,
    )


def _find_file(folder: Path, names: tuple[str, ...]) -> Path:
    found = next((folder / name for name in names if (folder / name).is_file()), None)
    if found is None:
        raise InputError(
            f"{folder} has no {' or '.join(names)}; give the folder that SceneGraphFusion wrote to "
            "(its --pth_out)."
        )
    return found


@dataclass(frozen=True, slots=True)
class _Graph:
    path: Path
    labels: dict[int, tuple[str, float]]  # Likeliest class of a segment, and how likely it is
    edges: dict[tuple[int, int], str]  # Likeliest relation
    owner: dict[int, int]  # Smallest segment of the thing that a segment is part of

    def object_of(self, segments: Rows) -> Rows:
        """Return the number of the thing of each segment, -1: nothing was predicted of it."""
        known = np.array(sorted(self.owner), np.int64)
        things = np.array([self.owner[i] for i in known.tolist()], np.int64)
        at = np.minimum(np.searchsorted(known, segments), max(len(known) - 1, 0))
        return np.where(known[at] == segments, things[at], -1) if len(known) else segments * 0 - 1

    def table(self) -> dict[str, LabelEntry]:
        """Return the names of things, by their numbers."""
        parts: dict[int, list[float]] = {}
        for segment, thing in self.owner.items():
            parts.setdefault(thing, []).append(self.labels[segment][1])
        return {
            str(thing): LabelEntry(
                self.labels[thing][0], "", {"probability": f"{sum(p) / len(p):.3f}"}
            )
            for thing, p in sorted(parts.items())
        }

    def relations(self) -> set[tuple[int, str, int]]:
        """Return the relations between things."""
        found = {
            (self.owner[a], name, self.owner[b])
            for (a, b), name in self.edges.items()
            if name not in {_SAME, _NONE} and a in self.owner and b in self.owner
        }
        return {relation for relation in found if relation[0] != relation[2]}


def _read_graph(path: Path, folder: Path) -> _Graph:
    nodes, edges = (_object(path, _select_scan(path, folder), key) for key in ("nodes", "edges"))
    labels: dict[int, tuple[str, float]] = {}
    for key, entry in nodes.items():
        if _parse_number(key) is None:
            raise InputError(
                f"{path}: {key[:40]!r} is not a segment number; run SceneGraphFusion again."
            )
        label, probability = _most_likely(path, entry)
        if label:
            labels[int(key)] = label, probability
    joined: dict[tuple[int, int], str] = {}
    for key, entry in edges.items():
        a, _, b = key.partition("_")
        one, other = _parse_number(a), _parse_number(b)
        if one is None or other is None:
            raise InputError(
                f"{path}: {key[:40]!r} is not an edge `from_to`; run SceneGraphFusion again."
            )
        joined[one, other] = _most_likely(path, entry)[0]
    return _Graph(path, labels, joined, _merge_parts(labels, joined))


def _select_scan(path: Path, folder: Path) -> dict[str, Any]:
    """Return the graph, alone or under the name of its scan."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path} is not a graph of SceneGraphFusion; it must be a JSON object.")
    if "nodes" in content:
        return content
    graphs = {k: v for k, v in content.items() if isinstance(v, dict) and "nodes" in v}
    names = (folder.absolute().name, folder.absolute().parent.name)
    found = [graphs[name] for name in names if name in graphs] or list(graphs.values())
    if not found or (len(graphs) > 1 and not set(names) & graphs.keys()):
        what = "contains the graphs of several scans" if graphs else "has no `nodes`"
        raise InputError(f"{path} {what}; give the one of {folder.absolute().name}.")
    graph: dict[str, Any] = found[0]
    return graph


def _object(path: Path, graph: dict[str, Any], key: str) -> dict[str, Any]:
    found = graph.get(key, {})
    if not isinstance(found, dict):
        raise InputError(f"{path}: `{key}` must be an object whose keys are segment numbers.")
    return found


def _parse_number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None


def _most_likely(path: Path, entry: object) -> tuple[str, float]:
    """Return the likeliest name, and how likely it is, of a name, a list of names, or log-probabilities.

    The program writes 0 for the logarithm of a probability of 0. So what the others leave of 1 is
    what a 0 has, if it is alone; ("", 0) where that cannot be told.
    """
    if isinstance(entry, list) and entry:
        entry = entry[0]
    if isinstance(entry, str):
        return entry, 1.0
    if not isinstance(entry, dict) or not entry:
        raise InputError(
            f"{path}: {str(entry)[:60]} must be a name, or an object from names to numbers."
        )
    if not all(type(v) in {int, float} and abs(v) < 1e300 for v in entry.values()):
        raise InputError(
            f"{path}: {str(entry)[:60]} contains invalid numbers; run SceneGraphFusion again."
        )
    shares = {name: math.exp(min(v, 0.0)) for name, v in entry.items() if v != 0}
    zeros = [name for name, v in entry.items() if v == 0]
    rest = 1.0 - sum(shares.values())
    if len(zeros) == 1 and rest > 0:
        shares[zeros[0]] = rest
    elif rest > max(shares.values(), default=0.0):
        return "", 0.0
    best = max(shares, key=lambda name: shares[name])
    return best, shares[best]


def _merge_parts(
    labels: dict[int, tuple[str, float]], edges: dict[tuple[int, int], str]
) -> dict[int, int]:
    """Return the smallest segment of those that are the same part, of one label, for each segment."""
    owner = {segment: segment for segment in labels}

    def root(segment: int) -> int:
        while owner[segment] != segment:
            owner[segment] = owner[owner[segment]]
            segment = owner[segment]
        return segment

    for (a, b), name in edges.items():
        if name == _SAME and a in owner and b in owner and labels[a][0] == labels[b][0]:
            one, other = sorted((root(a), root(b)))
            owner[other] = one
    return {segment: root(segment) for segment in owner}


SURFELS = ("inseg.ply", "node_semantic.ply")
"""The first has the colours of the place, the second those of labels."""
REACH = 0.1  # A vertex of a mesh has the label of the nearest surfel within this [m]
GRID = 0.04  # Surfels of a thing are brought together in cubes of this side [m]
_OVERLAP = 1.2
_NUMBERS = ("x", "y", "z", "nx", "ny", "nz")


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """Points with the numbers of their segments."""

    path: Path
    points: Floats  # (S, 3) [m]
    normals: Floats  # (S, 3)
    colours: NDArray[np.uint8]  # (S, 3) sRGB
    segments: Rows  # (S,)


def read_surfels(path: Path, left_out: Counter[str]) -> Surfels:
    """Read the surfels of a PLY file; `InputError` where it lacks what they have."""
    vertex = read_columns(path).get("vertex")
    columns = {} if vertex is None else vertex.single
    missing = {*_NUMBERS, "label"} - columns.keys()
    if missing:
        raise InputError(
            f"{path} lacks {', '.join(sorted(missing))} of its points; give what SceneGraphFusion wrote."
        )
    numbers = np.stack([columns[name].astype(np.float64) for name in _NUMBERS], axis=1)
    names = ("red", "green", "blue")
    colours = np.full((len(numbers), 3), 255, np.uint8)
    if path.name == SURFELS[0] and set(names) <= columns.keys():
        colours = np.stack([np.clip(columns[n], 0, 255) for n in names], axis=1).astype(np.uint8)
    else:
        left_out[f"colours; add {SURFELS[0]} to have them"] += 1
    good = np.isfinite(numbers).all(axis=1)
    if not good.all():
        left_out["surfels that are not numbers"] += int((~good).sum())
    return Surfels(
        path,
        numbers[good, :3],
        numbers[good, 3:],
        colours[good],
        to_integers(columns["label"])[good],
    )


def transfer_labels(
    path: Path, surfels: Surfels, ids: Rows, left_out: Counter[str]
) -> tuple[Model, Rows]:
    """Return a mesh, and the number of the thing of each of its triangles."""
    from placegraph.io.mesh.obj import is_obj, read_obj

    model = read_obj(path) if is_obj(path) else read_ply(path)
    rows = find_nearest(model.vertices, surfels.points, REACH)
    far = rows < 0
    if far.all():
        raise InputError(
            f"{path} has no vertex within {REACH:g} m of a surfel of {surfels.path}; give the mesh of "
            "that scan, in the axes of its poses."
        )
    if far.any():
        left_out[f"vertices of the mesh without a surfel within {REACH:g} m"] += int(far.sum())
    of = np.where(far, -1, ids[rows])
    return model, majority_vote(of[model.triangles])


def make_squares(surfels: Surfels, ids: Rows) -> Model:
    """Return a square for the surfels of each thing in each cube, at their mean.

    `object_of` holds ids of objects, not rows.
    """
    cells = np.floor(surfels.points / GRID)
    low = cells.min(axis=0)
    span = cells.max(axis=0) - low + 1
    unique, thing = np.unique(ids, return_inverse=True)
    if not float(span.prod()) * len(unique) < 2.0**62:
        raise InputError(
            f"{surfels.path} is over {span.max() * GRID:.3g} m large; give it in metres."
        )
    x, y, z = (cells - low).astype(np.int64).T
    nx, ny, nz = span.astype(np.int64)
    _, group = np.unique(((thing * nx + x) * ny + y) * nz + z, return_inverse=True)
    count = np.bincount(group)

    def mean(values: NDArray[Any]) -> Floats:
        return np.stack([np.bincount(group, column) / count for column in values.T], axis=1)

    centre, normal = mean(surfels.points), mean(surfels.normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), (0.0, 0.0, 1.0))
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    along = np.cross(normal, least)
    along *= _OVERLAP * GRID / 2 / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normal, along)
    corners = [centre - along - across, centre + along - across]
    corners += [centre + along + across, centre - along + across]
    first = 4 * np.arange(len(count))[:, None]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    of = np.empty(len(count), np.int64)
    of[group] = ids
    return Model(
        path=surfels.path,
        objects=(),
        vertices=vertices,
        triangles=np.concatenate([first + (0, 1, 2), first + (0, 2, 3)], axis=1).reshape(-1, 3),  # noqa: RUF005
        object_of=np.repeat(of, 2),
        colours=np.repeat(np.rint(mean(surfels.colours)).astype(np.uint8), 4, axis=0),
        uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(2 * len(count), np.int64),
        pictures=(Texture(None),),
    )
