"""Reader of ScanNet's annotated meshes: one folder, one scan.

Objects are ScanNet's: `<scan>.aggregation.json` says which segments make one, and
`<scan>_vh_clean_2.0.010000.segs.json` which segment a vertex of `<scan>_vh_clean_2.ply` is of.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.capture.camera import read_json
from placegraph.io.mesh.model import Model, Thing
from placegraph.io.mesh.ply import UNKNOWN, majority, read_columns, read_ply
from placegraph_io.dataset.scannet_files import (
    TABLES,
    Group,
    LabelMap,
    Scan,
    alignment_of,
    find_scan,
    find_table,
    read_aggregation,
    read_label_map,
    scan_names,
)

ANNOTATED = (
    ("_vh_clean_2.ply", ".aggregation.json", "_vh_clean_2.0.010000.segs.json"),
    ("_vh_clean.ply", "_vh_clean.aggregation.json", "_vh_clean.segs.json"),
)
"""Mesh, objects and segments that belong together, the decimated mesh first."""
LABELLED = "_vh_clean_2.labels.ply"
NYU40 = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf",
    "picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser", "pillow", "mirror",
    "floor mat", "clothes", "ceiling", "books", "refrigerator", "television", "paper", "towel",
    "shower curtain", "box", "whiteboard", "person", "night stand", "toilet", "sink", "lamp",
    "bathtub", "bag", "otherstructure", "otherfurniture", "otherprop",
)  # fmt: skip
"""NYU's 40 classes, of which the first is 1; 0 is unannotated."""
LEAST = 20
"""Vertices of a patch of one class that is an object: ScanNet's own smallest segment."""


def is_scannet(path: Path) -> bool:
    """Whether a path is a folder with a ScanNet mesh or annotation, or a mesh beside its annotation."""
    try:
        if path.is_dir():
            return bool(scan_names(path))
        scan = _scan_of_mesh(path)
        return scan is not None and any(
            path.name.endswith(ends[0]) and all(scan.file(end).is_file() for end in ends)
            for ends in ANNOTATED
        )
    except (OSError, ValueError):
        return False


def read_scannet(
    path: str | PathLike[str],
    *,
    label_table: str | PathLike[str] | None = None,
    label_column: str | None = None,
    align: bool = True,
) -> Model:
    """Read the annotated mesh of a ScanNet scan, in the map's axes.

    Of two annotated meshes the decimated one (`_vh_clean_2.ply`) is read. A triangle belongs to the
    object most of its corners are of; those of none become one object "unknown". Without
    annotation, `_vh_clean_2.labels.ply` tells classes (NYU40): connected patches of a class become
    objects.

    Parameters
    ----------
    path
        Folder of the scan, or its mesh.
    label_table
        `scannetv2-labels.combined.tsv`; looked for in the folder and the two above it if not given.
    label_column
        Column of that table whose label an object gets, such as `category` or `nyu40class`; what the
        table does not map keeps ScanNet's raw label. Raw labels if not given.
    align
        Whether the axis alignment of `<scan>.txt` is applied (`scannet_files.axis_alignment`).

    Raises
    ------
    InputError
        A file is missing or not what it should be, or files do not belong together.
    OptionError
        The table has no such column.

    """
    path = Path(path)
    scan = find_scan(path) if path.is_dir() else _scan_of_mesh(path)
    if scan is None or not path.exists():
        raise InputError(
            f"{path} {'is no' if path.exists() else 'does not exist; give the'} folder of a ScanNet "
            "scan, such as scans/scene0000_00."
        )
    files = _annotated(scan, None if path.is_dir() else path)
    if files is None:
        model = _by_class(scan)
    else:
        model = _by_object(files, _label_map(scan, label_table, label_column))
    named = scan.folder if scan.folder.absolute().name == scan.name else model.path
    if align:
        map_from_scan = alignment_of(scan)
        turned = model.vertices @ map_from_scan[:3, :3].T + map_from_scan[:3, 3]
        model = replace(model, vertices=turned)
    return replace(model, path=named)


def _scan_of_mesh(path: Path) -> Scan | None:
    end = next((files[0] for files in ANNOTATED if path.name.endswith(files[0])), None)
    return Scan(path.parent, path.name.removesuffix(end)) if end else None


@dataclass(frozen=True, slots=True)
class _Files:
    mesh: Path
    objects: Path
    segments: Path


def _annotated(scan: Scan, mesh: Path | None) -> _Files | None:
    """First complete set of files, that of a given mesh; None where only classes are known."""
    sets = [_Files(*(scan.file(end) for end in ends)) for ends in ANNOTATED]
    if mesh is not None:
        sets = [files for files in sets if files.mesh.name == mesh.name]
    missing = [[p for p in (f.mesh, f.objects, f.segments) if not p.is_file()] for f in sets]
    for files, gone in zip(sets, missing, strict=True):
        if not gone:
            return files
    if mesh is None and scan.file(LABELLED).is_file():
        return None
    gone = min(missing, key=len)
    names = " and ".join(p.name for p in gone)
    if any(p.suffix == ".ply" for p in gone):
        mend = "labels alone make no map: download the mesh too, or give the scan's .sens file"
    else:
        bare = next(files.mesh for files in sets if files.mesh.is_file())
        mend = f"download it, or give {bare} itself, which is then cut by geometry and colour"
    raise InputError(f"{scan.folder} has no {names}; {mend}.")


def _label_map(
    scan: Scan, table: str | PathLike[str] | None, column: str | None
) -> LabelMap | None:
    if column is None:
        return None
    found = Path(table) if table is not None else find_table(scan.folder)
    if found is None:
        raise InputError(
            f"{scan.folder}: label_column needs ScanNet's {TABLES[0]}, which lies neither there nor in "
            "the two folders above; give it as label_table."
        )
    return read_label_map(found, column)


# -------------------------------------------------------------------------- objects of segments


def _by_object(files: _Files, labels: LabelMap | None) -> Model:
    mesh = read_ply(files.mesh)
    groups = read_aggregation(files.objects)
    segments = _segments(files, len(mesh.vertices))
    left_out: Counter[str] = Counter()
    of_vertex = _group_of_vertex(files, groups, segments, left_out)
    things = [_thing(group, labels, left_out) for group in groups]
    return _model(mesh, things, of_vertex, left_out)


def _segments(files: _Files, count: int) -> NDArray[np.int64]:
    """Segment (V,) of each vertex."""
    content = read_json(files.segments)
    listed = content.get("segIndices") if isinstance(content, dict) else None
    try:
        column = np.asarray(listed if isinstance(listed, list) else "none")
    except (ValueError, OverflowError):
        column = np.asarray("none")
    if column.dtype.kind not in "iu" and column.size:
        raise InputError(
            f"{files.segments} has no list `segIndices` of numbers; download the file again."
        )
    if column.shape != (count,):
        raise InputError(
            f"{files.segments} has segments of {column.size} vertices, but {files.mesh} has {count}; "
            "they belong to different meshes: download both again."
        )
    return column.astype(np.int64)


def _group_of_vertex(
    files: _Files, groups: list[Group], segments: NDArray[np.int64], left_out: Counter[str]
) -> NDArray[np.int64]:
    """Row of groups (V,) of each vertex, -1: none."""
    row_of: dict[int, int] = {}
    for row, group in enumerate(groups):
        left_out["segments that several objects name"] += len(row_of.keys() & set(group.segments))
        row_of |= dict.fromkeys(group.segments, row)  # the last one has it, as in ScanNet's scripts
    present, place = np.unique(segments, return_inverse=True)
    rows = np.array([row_of.get(s, -1) for s in present.tolist()], np.int64)
    absent = len(row_of) - int((rows >= 0).sum())
    if row_of and absent == len(row_of):
        raise InputError(
            f"{files.objects} names no segment that {files.segments} has; they belong to different "
            "scans or meshes: download both again."
        )
    left_out["segments that the mesh does not have"] += absent
    of_vertex: NDArray[np.int64] = rows[place]
    return of_vertex


def _thing(group: Group, labels: LabelMap | None, left_out: Counter[str]) -> Thing:
    if labels is None:
        return Thing(str(group.id), group.label)
    label = labels.of_raw.get(group.label)
    if label is None:
        left_out["labels that the table does not map"] += 1
    return Thing(str(group.id), label or group.label, attributes={"raw_category": group.label})


# ---------------------------------------------------------------------------- patches of a class


def _by_class(scan: Scan) -> Model:
    file = scan.file(LABELLED)
    coloured = scan.file(ANNOTATED[0][0])
    label = _classes(file)
    left_out: Counter[str] = Counter()
    mesh = read_ply(coloured if coloured.is_file() else file)
    if len(mesh.vertices) != len(label):
        mesh = read_ply(file)
    if mesh.path == file:  # its colours are a legend's
        left_out["colours that tell classes"] = len(mesh.vertices)
        mesh = replace(mesh, colours=np.full(mesh.vertices.shape, 255, np.uint8))
    patch = patches(mesh.triangles, label)
    roots, inverse, counts = np.unique(patch, return_inverse=True, return_counts=True)
    known = label[roots] > 0
    small = known & (counts < LEAST)
    left_out[f"patches of fewer than {LEAST} vertices"] = int(small.sum())
    known &= ~small
    row = np.where(known, np.cumsum(known) - 1, -1)
    things = [Thing(str(i), NYU40[int(c) - 1]) for i, c in enumerate(label[roots[known]], start=1)]
    return _model(mesh, things, row[inverse], left_out)


def _classes(file: Path) -> NDArray[np.int64]:
    """Class (V,) of each vertex, 1 to 40; 0: none."""
    vertex = read_columns(file).get("vertex")
    if vertex is None or "label" not in vertex.single:
        raise InputError(f"{file} has no vertices with a `label`; download the file again.")
    column = vertex.single["label"]
    return np.where((column >= 1) & (column <= len(NYU40)), column, 0).astype(np.int64)


def patches(triangles: NDArray[np.int64], label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lowest vertex (V,) of the connected patch of one label (V,) that every vertex is of."""
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    edges = edges[label[edges[:, 0]] == label[edges[:, 1]]]
    root = np.arange(len(label))
    while True:
        low, high = np.sort(root[edges], axis=1).T
        apart = low < high
        if not apart.any():
            return root
        np.minimum.at(root, high[apart], low[apart])
        while (root[root] < root).any():
            root = root[root]


# ----------------------------------------------------------------------------------------- both


def _model(
    mesh: Model, things: list[Thing], of_vertex: NDArray[np.int64], left_out: Counter[str]
) -> Model:
    """Model whose triangles belong to what most of their corners do; -1 becomes "unknown"."""
    left_out["vertices of no object"] = int((of_vertex < 0).sum())
    thing_of = majority(of_vertex[mesh.triangles])
    if (thing_of < 0).any() or not things:
        thing_of = np.where(thing_of < 0, len(things), thing_of)
        things = [*things, Thing(UNKNOWN, UNKNOWN)]
    return replace(mesh, things=tuple(things), thing_of=thing_of, left_out=+left_out)
