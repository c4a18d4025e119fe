"""Reader of ScanNet's annotated meshes: one folder, one scan.

Objects are ScanNet's: `<scan>.aggregation.json` says which segments make one, and
`<scan>_vh_clean_2.0.010000.segs.json` which segment a vertex of `<scan>_vh_clean_2.ply` is of.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import LabelKind, LabelTable, label_file
from placegraph.io.capture.images import image_size
from placegraph.io.capture.json_files import read_json
from placegraph.io.mesh.model import UNKNOWN, Model, ModelObject, read_bytes
from placegraph.io.mesh.ply import majority_vote, read_columns, read_ply

FILES = (
    "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.labels.ply", "_vh_clean.aggregation.json",
    "_vh_clean.segs.json", ".aggregation.json", "_vh_clean_2.ply", "_vh_clean.ply",
)  # fmt: skip
"""Endings of the files of a scan; of two that fit, the longer comes first."""
TABLES = (
    "scannetv2-labels.combined.tsv",
    "scannet-labels.combined.tsv",
)  # Names of ScanNet's label table
_RIGID = 1e-3


@dataclass(frozen=True, slots=True)
class Scan:
    """A scan's folder, and the name that its files begin with."""

    folder: Path
    name: str

    def file(self, ending: str) -> Path:
        """`scene0000_00` and `.txt`: `scene0000_00/scene0000_00.txt`."""
        return self.folder / f"{self.name}{ending}"


def scan_names(folder: Path) -> list[str]:
    """Return the names of the scans whose meshes or annotations lie in a folder; none where it is none."""
    try:
        files = [path.name for path in folder.iterdir()]
    except (OSError, ValueError):
        return []
    ends = ((file, next((end for end in FILES if file.endswith(end)), None)) for file in files)
    return sorted({file.removesuffix(end) for file, end in ends if end} - {""})


def find_scan(path: Path) -> Scan:
    """Return the scan of a folder; `InputError` where it holds several, none of which is called as it is."""
    names = scan_names(path)
    own = path.absolute().name
    if len(names) > 1 and own not in names:
        raise InputError(
            f"{path} contains several scans ({', '.join(names[:3])}, ...); put each into a folder "
            "with its name."
        )
    return Scan(path, own if own in names or not names else names[0])


def axis_alignment(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Return the rigid transform (4, 4) map_from_scan [m] that `<scan>.txt` of a scan's folder says.

    It stands the scan's walls along x and y and its floor at z = 0; the meshes and poses of ScanNet
    come without it. The identity where there is no such file, or no such line: ScanNet's test scans
    have none.

    Raises `InputError`: the line is not a rigid 4 x 4 matrix.
    """
    return alignment_of(find_scan(Path(path)))


def alignment_of(scan: Scan) -> NDArray[np.float64]:
    """Return the axis alignment (4, 4) map_from_scan [m] of a scan."""
    file = scan.file(".txt")
    said = read_meta(file).get("axisAlignment")
    if said is None:
        return np.eye(4)
    matrix = _matrix(said)
    if matrix is None or not is_rigid(matrix):
        raise InputError(
            f"{file}: axisAlignment is not a rigid transform of 16 numbers; download the file "
            "again, or delete the line to keep the scan's own axes."
        )
    return matrix


def read_meta(path: Path) -> dict[str, str]:
    """Return the lines `key = value` of a `<scan>.txt`; empty where there is no such file."""
    if not path.is_file():
        return {}
    pairs = (line.partition("=") for line in read_text(path).splitlines())
    return {key.strip(): value.strip() for key, sign, value in pairs if sign}


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Return 4 x 4 numbers of a text file, infinite ones included; `InputError` where they are not that."""
    matrix = _matrix(read_text(path))
    if matrix is None:
        raise InputError(f"{path} does not contain 4 x 4 numbers; export it again.")
    return matrix


def is_rigid(matrix: NDArray[np.float64], tolerance: float = _RIGID) -> bool:
    """Return whether a matrix (4, 4) is a rotation and a translation."""
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e6:
        return False
    r = matrix[:3, :3]
    last = np.abs(matrix[3] - (0, 0, 0, 1)).max()
    return bool(np.abs(r @ r.T - np.eye(3)).max() < tolerance > last and np.linalg.det(r) > 0)


def camera_of_matrix(
    name: object,
    intrinsic: NDArray[np.float64],
    size: tuple[int, int],
    calibrated_size: tuple[int, int] | None = None,
) -> Camera:
    """Return the camera of images of this width and height [px] by ScanNet's 4 x 4 intrinsics.

    ScanNet puts the centre of the first pixel at (0, 0), we at (0.5, 0.5). Intrinsics
    of another `calibrated_size` are scaled to the images'. `InputError` about `name` where
    that makes no camera.
    """
    k = intrinsic
    try:
        camera = Camera(*(calibrated_size or size), k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5)
        camera = camera.resize(*size)
    except (OptionError, ZeroDivisionError) as error:
        raise InputError(f"{name}: {error} Export the intrinsics again.") from error
    if not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height):
        raise InputError(
            f"{name}: the principal point lies outside the images of {size[0]} x {size[1]} "
            "pixels; if they were resized, add the scan's <scan>.txt, which gives their "
            "original size."
        )
    return camera


@dataclass(frozen=True, slots=True)
class LabelMap:
    """ScanNet's table of labels, in one of its columns."""

    path: Path
    of_raw: Mapping[str, str]  # Label of a raw category; those without one are left out
    of_id: Mapping[
        int, str
    ]  # Label of a ScanNet label id, the raw category where the column is empty


def find_label_table(folder: Path) -> Path | None:
    """Return ScanNet's label table in a scan's folder or one of the two above it."""
    around = (folder, *folder.absolute().parents[:2])
    return next((at / name for at in around for name in TABLES if (at / name).is_file()), None)


def read_label_map(path: str | PathLike[str], column: str = "raw_category") -> LabelMap:
    """Read `scannetv2-labels.combined.tsv`; labels are those of `column`, such as `nyu40class`.

    Raises `InputError`: the file is missing, lacks the columns `id` and `raw_category`, or an id is no
    number; `OptionError`: it has no such column.
    """
    path = Path(path)
    rows = list(csv.reader(read_text(path).splitlines(), delimiter="\t", quoting=csv.QUOTE_NONE))
    head = rows[0] if rows else []
    if not {"id", "raw_category"} <= set(head):
        raise InputError(
            f"{path} has no columns `id` and `raw_category`; use ScanNet's {TABLES[0]}."
        )
    if column not in head:
        raise OptionError(f"label_column is {column!r}; {path} has {', '.join(head)}.")
    at, raw_at, id_at = (head.index(name) for name in (column, "raw_category", "id"))
    of_raw, of_id = {}, {}
    for line, row in enumerate(rows[1:], 2):
        if not any(row):
            continue
        cells = [cell.strip() for cell in row] + [""] * (len(head) - len(row))
        raw, label, number = cells[raw_at], cells[at], cells[id_at]
        if not (number.isascii() and number.isdigit() and len(number) < 6):
            raise InputError(f"{path}, line {line}: the id is {number[:40]!r}, not a number.")
        if label:
            of_raw[raw] = label
        of_id[int(number)] = label or raw
    return LabelMap(path, of_raw, {i: name for i, name in of_id.items() if i < 1 << 16})


@dataclass(frozen=True, slots=True)
class Group:
    """One object of an aggregation."""

    id: int
    label: str
    segments: list[int]


def read_aggregation(path: Path) -> list[Group]:
    """Return the objects of an `.aggregation.json`; `InputError` where it is missing or not that."""
    content = read_json(path)
    listed = content.get("segGroups") if isinstance(content, dict) else None
    if not isinstance(listed, list):
        raise InputError(f"{path} has no list `segGroups`; download the file again.")
    groups = [_group(path, row, entry) for row, entry in enumerate(listed)]
    if len({group.id for group in groups}) < len(groups):
        raise InputError(f"{path}: two objects have the same objectId; download the file again.")
    return groups


def _group(path: Path, row: int, entry: object) -> Group:
    if isinstance(entry, dict):
        id_ = entry.get("objectId", entry.get("id"))
        label, segments = entry.get("label"), entry.get("segments")
        is_valid = isinstance(segments, list) and all(type(s) is int for s in segments)
        if type(id_) is int and isinstance(label, str) and isinstance(segments, list) and is_valid:
            return Group(id_, label.strip() or "unknown", segments)
    raise InputError(
        f"{path}: entry {row} of segGroups lacks objectId (a number), label (text) or segments (a list "
        "of numbers); download the file again."
    )


def read_text(path: Path) -> str:
    """Return the text of a file in any encoding; `InputError` where it cannot be read."""
    return read_bytes(path).decode("utf-8-sig", errors="replace")


def _matrix(text: str) -> NDArray[np.float64] | None:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return None
    return np.array(numbers).reshape(4, 4) if len(numbers) == 16 else None


Wanted = Literal["auto", "labels", "instances"] | None
END = ".aggregation.json"
FOLDERS: dict[LabelKind, str] = {"instances": "instance-filt", "labels": "label-filt"}


@dataclass(frozen=True, slots=True)
class LabelImages:
    """Label images of a scan, by number of the frame."""

    files: dict[int, Path] = field(default_factory=dict)
    camera: Camera | None = None
    kind: LabelKind = "labels"
    names: dict[int, str] = field(default_factory=dict)
    table: LabelTable | None = None
    notes: tuple[str, ...] = ()  # Why label images are not used

    def reader(self, index: int) -> Callable[[], NDArray[np.int32]] | None:
        """Return the function that reads a frame's label image; None where it has none."""
        if self.camera is None or index not in self.files:
            return None
        offset = 1 if self.kind == "instances" else 0
        return label_file(self.files[index], self.camera, offset, self.table)


def find_labels(
    folder: Path,
    wanted: Wanted,
    camera: Camera,
    *,
    label_column: str | None = None,
) -> LabelImages:
    """Return the label images that lie in a scan's folder; "auto" takes instances, else labels, else none.

    They show what the colour images show, whose camera is given. Names of labels are those of a
    column of ScanNet's table, the raw categories if none is given.

    Raises `InputError`: what is wanted is not there or cannot be read; labels lack ScanNet's table;
    `OptionError`: `wanted` is none of its values; the table has no such column.
    """
    if wanted not in {"auto", "labels", "instances", None}:
        raise OptionError(
            f"labels is {wanted!r}; it must be 'auto', 'labels', 'instances' or None."
        )
    if wanted is None:
        return LabelImages()
    for kind, name in FOLDERS.items():
        if wanted not in {"auto", kind}:
            continue
        files = list_numbered(folder / name, (".png",))
        if not files:
            if wanted == kind:
                raise InputError(
                    f"{folder / name} contains no image `0.png`, which labels={kind!r} needs; "
                    f"unpack the scan's _2d-{name}.zip there."
                )
            continue
        if kind == "labels" and wanted == "auto" and find_label_table(folder) is None:
            note = (
                f"{folder / name} is not used, because its numbers need ScanNet's {TABLES[0]}; put "
                "it there or in a folder above."
            )
            return LabelImages(notes=(note,))
        size = image_size(next(iter(files.values())))
        view = camera if size == (camera.width, camera.height) else camera.resize(*size)
        names, table = _read_meanings(folder, kind, label_column)
        return LabelImages(files, view, kind, names, table)
    return LabelImages()


def _read_meanings(
    folder: Path, kind: LabelKind, column: str | None
) -> tuple[dict[int, str], LabelTable | None]:
    """Return the names by id, and what ids mean."""
    table = find_label_table(folder)
    labels = read_label_map(table, column or "raw_category") if table else None
    if kind == "instances":
        above = folder.absolute().parent
        files = (find_scan(folder).file(END), above / f"{above.name}{END}")
        groups = next((read_aggregation(file) for file in files if file.is_file()), [])
        said = labels.of_raw if labels and column else {}
        return {group.id: said.get(group.label, group.label) for group in groups}, None
    if labels is None:
        raise InputError(
            f"{folder / FOLDERS[kind]} contains class numbers, which need ScanNet's {TABLES[0]}; "
            f"put it in {folder} or a folder above."
        )
    names = dict(labels.of_id)
    return names, LabelTable(names, labels.path, 0)


def list_numbered(folder: Path, endings: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder whose stem is a number, by it; `InputError` where two have the same."""
    try:
        files = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.") from error
    found: dict[int, Path] = {}
    for file in files:
        stem = file.stem
        if file.suffix.lower() not in endings or not (stem.isascii() and stem.isdigit()):
            continue
        if len(stem) > 12:
            raise InputError(f"{file}: {stem[:40]} is not a frame number; rename the file.")
        if int(stem) in found:
            raise InputError(
                f"{file} and {found[int(stem)].name} have the same frame number; remove one of "
                "them."
            )
        found[int(stem)] = file
    return dict(sorted(found.items()))


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
MIN_PATCH = 20  # Vertices of a patch of one class that is an object: ScanNet's own smallest segment


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

    `path`: folder of the scan, or its mesh; `label_table`: `scannetv2-labels.combined.tsv`; looked for
    in the folder and the two above it if not given; `label_column`: column of that table whose label an
    object gets, such as `category` or `nyu40class`; what the table does not map keeps ScanNet's raw
    label. Raw labels if not given; `align`: whether the axis alignment of `<scan>.txt` is applied
    (`scannet_files.axis_alignment`).

    Raises `InputError`: a file is missing or not what it should be, or files do not belong together;
    `OptionError`: the table has no such column.
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
        model = _read_classes(scan)
    else:
        labels = _label_map(scan, label_table, label_column)
        mesh = read_ply(files.mesh)
        groups = read_aggregation(files.objects)
        segments = _segments(files, len(mesh.vertices))
        left_out: Counter[str] = Counter()
        of_vertex = _group_of_vertex(files, groups, segments, left_out)
        objects = [_make_object(group, labels, left_out) for group in groups]
        model = _model(mesh, objects, of_vertex, left_out)
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
    """Return the first complete set of files, that of a given mesh; None where only classes are known."""
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
        mend = (
            "labels alone are not enough for a map; also download the mesh, or give the scan's "
            ".sens file"
        )
    else:
        bare = next(files.mesh for files in sets if files.mesh.is_file())
        mend = f"download it, or give {bare} itself, which is then segmented by geometry and colour"
    raise InputError(f"{scan.folder} has no {names}; {mend}.")


def _label_map(
    scan: Scan, table: str | PathLike[str] | None, column: str | None
) -> LabelMap | None:
    if column is None:
        return None
    found = Path(table) if table is not None else find_label_table(scan.folder)
    if found is None:
        raise InputError(
            f"{scan.folder}: label_column needs ScanNet's {TABLES[0]}, but it is not in this "
            "folder or the two above; give it as label_table."
        )
    return read_label_map(found, column)


def _segments(files: _Files, count: int) -> NDArray[np.int64]:
    """Return the segment (V,) of each vertex."""
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
    """Return the row of groups (V,) of each vertex, -1: none."""
    row_of: dict[int, int] = {}
    for row, group in enumerate(groups):
        left_out["segments that belong to several objects"] += len(
            row_of.keys() & set(group.segments)
        )
        row_of |= dict.fromkeys(group.segments, row)  # the last one has it, as in ScanNet's scripts
    present, place = np.unique(segments, return_inverse=True)
    rows = np.array([row_of.get(s, -1) for s in present.tolist()], np.int64)
    absent = len(row_of) - int((rows >= 0).sum())
    if row_of and absent == len(row_of):
        raise InputError(
            f"{files.objects} and {files.segments} have no segment in common, so they belong to "
            "different scans or meshes; download both again."
        )
    left_out["segments that the mesh does not have"] += absent
    of_vertex: NDArray[np.int64] = rows[place]
    return of_vertex


def _make_object(group: Group, labels: LabelMap | None, left_out: Counter[str]) -> ModelObject:
    if labels is None:
        return ModelObject(str(group.id), group.label)
    label = labels.of_raw.get(group.label)
    if label is None:
        left_out["labels that the table does not map"] += 1
    return ModelObject(
        str(group.id), label or group.label, attributes={"raw_category": group.label}
    )


def _read_classes(scan: Scan) -> Model:
    file = scan.file(LABELLED)
    coloured = scan.file(ANNOTATED[0][0])
    vertex = read_columns(file).get("vertex")
    if vertex is None or "label" not in vertex.single:
        raise InputError(f"{file} has no vertices with a `label`; download the file again.")
    column = vertex.single["label"]
    label = np.where((column >= 1) & (column <= len(NYU40)), column, 0).astype(np.int64)
    left_out: Counter[str] = Counter()
    mesh = read_ply(coloured if coloured.is_file() else file)
    if len(mesh.vertices) != len(label):
        mesh = read_ply(file)
    if mesh.path == file:  # its colours are a legend's
        left_out["colours that encode classes"] = len(mesh.vertices)
        mesh = replace(mesh, colours=np.full(mesh.vertices.shape, 255, np.uint8))
    patch = label_patches(mesh.triangles, label)
    roots, inverse, counts = np.unique(patch, return_inverse=True, return_counts=True)
    known = label[roots] > 0
    small = known & (counts < MIN_PATCH)
    left_out[f"patches of fewer than {MIN_PATCH} vertices"] = int(small.sum())
    known &= ~small
    row = np.where(known, np.cumsum(known) - 1, -1)
    objects = [
        ModelObject(str(i), NYU40[int(c) - 1]) for i, c in enumerate(label[roots[known]], start=1)
    ]
    return _model(mesh, objects, row[inverse], left_out)


def label_patches(triangles: NDArray[np.int64], label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the lowest vertex (V,) of the connected patch of one label (V,) that every vertex is of."""
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


def _model(
    mesh: Model, objects: list[ModelObject], of_vertex: NDArray[np.int64], left_out: Counter[str]
) -> Model:
    """Return the model whose triangles belong to what most of their corners do; -1 becomes "unknown"."""
    left_out["vertices without an object"] = int((of_vertex < 0).sum())
    object_of = majority_vote(of_vertex[mesh.triangles])
    if (object_of < 0).any() or not objects:
        object_of = np.where(object_of < 0, len(objects), object_of)
        objects = [*objects, ModelObject(UNKNOWN, UNKNOWN)]
    return replace(mesh, objects=tuple(objects), object_of=object_of, left_out=+left_out)
