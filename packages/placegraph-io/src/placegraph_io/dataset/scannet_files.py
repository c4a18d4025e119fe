"""What lies in a ScanNet scan's folder beside mesh and images: names, alignment, cameras, labels."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.camera import read_json

FILES = (
    "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.labels.ply", "_vh_clean.aggregation.json",
    "_vh_clean.segs.json", ".aggregation.json", "_vh_clean_2.ply", "_vh_clean.ply",
)  # fmt: skip
"""How files of a scan are called after its name; the longer of two that fit comes first."""
TABLES = ("scannetv2-labels.combined.tsv", "scannet-labels.combined.tsv")
"""Names of ScanNet's label table."""
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
    """Names of the scans whose meshes or annotations lie in a folder; none where it is none."""
    try:
        files = [path.name for path in folder.iterdir()]
    except (OSError, ValueError):
        return []
    ends = ((file, next((end for end in FILES if file.endswith(end)), None)) for file in files)
    return sorted({file.removesuffix(end) for file, end in ends if end} - {""})


def find_scan(path: Path) -> Scan:
    """Scan of a folder; `InputError` where it holds several, none of which is called as it is."""
    names = scan_names(path)
    own = path.absolute().name
    if len(names) > 1 and own not in names:
        raise InputError(
            f"{path} holds several scans ({', '.join(names[:3])}, ...); give each a folder of its name."
        )
    return Scan(path, own if own in names or not names else names[0])


def axis_alignment(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) map_from_scan [m] that `<scan>.txt` of a scan's folder says.

    It stands the scan's walls along x and y and its floor at z = 0; the meshes and poses of ScanNet
    come without it. The identity where there is no such file, or no such line: ScanNet's test scans
    have none.

    Raises
    ------
    InputError
        The line is not a rigid 4 x 4 matrix.

    """
    return alignment_of(find_scan(Path(path)))


def alignment_of(scan: Scan) -> NDArray[np.float64]:
    """As `axis_alignment`, of a scan that was found."""
    file = scan.file(".txt")
    said = read_meta(file).get("axisAlignment")
    if said is None:
        return np.eye(4)
    matrix = _matrix(said)
    if matrix is None or not is_rigid(matrix):
        raise InputError(
            f"{file}: axisAlignment is no rigid transform of 16 numbers; download the file again, or "
            "delete the line to keep the scan's own axes."
        )
    return matrix


def read_meta(path: Path) -> dict[str, str]:
    """Lines `key = value` of a `<scan>.txt`; empty where there is no such file."""
    if not path.is_file():
        return {}
    pairs = (line.partition("=") for line in read_text(path).splitlines())
    return {key.strip(): value.strip() for key, sign, value in pairs if sign}


def read_matrix(path: Path) -> NDArray[np.float64]:
    """4 x 4 numbers of a text file, infinite ones included; `InputError` where they are not that."""
    matrix = _matrix(read_text(path))
    if matrix is None:
        raise InputError(f"{path} does not hold 4 x 4 numbers; export it again.")
    return matrix


def is_rigid(matrix: NDArray[np.float64], tolerance: float = _RIGID) -> bool:
    """Whether a matrix (4, 4) is a rotation and a translation."""
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e6:
        return False
    r = matrix[:3, :3]
    last = np.abs(matrix[3] - (0, 0, 0, 1)).max()
    return bool(np.abs(r @ r.T - np.eye(3)).max() < tolerance > last and np.linalg.det(r) > 0)


def camera_of_matrix(
    name: object,
    intrinsic: NDArray[np.float64],
    size: tuple[int, int],
    said: tuple[int, int] | None = None,
) -> Camera:
    """Camera of images of this width and height [px] by ScanNet's 4 x 4 intrinsics.

    ScanNet puts the centre of the first pixel at (0, 0), we at (0.5, 0.5). Where the intrinsics are
    `said` to be of another size, they are brought to the images'. `InputError` about `name` where
    that makes no camera.
    """
    k = intrinsic
    try:
        camera = Camera(*(said or size), k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5)
        camera = camera.resized(*size)
    except (OptionError, ZeroDivisionError) as error:
        raise InputError(f"{name}: {error} Export the intrinsics again.") from error
    if not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height):
        raise InputError(
            f"{name}: the principal point lies outside the images of {size[0]} x {size[1]} pixels; are "
            "they made smaller? Then put the scan's <scan>.txt, which says their first size, beside."
        )
    return camera


# ------------------------------------------------------------------------------------ labels


@dataclass(frozen=True, slots=True)
class LabelMap:
    """ScanNet's table of labels, in one of its columns."""

    path: Path
    of_raw: Mapping[str, str]
    """Label of a raw category; those without one are left out."""
    of_id: Mapping[int, str]
    """Label of a ScanNet label id, the raw category where the column is empty."""


def find_table(folder: Path) -> Path | None:
    """ScanNet's label table in a scan's folder or one of the two above it."""
    around = (folder, *folder.absolute().parents[:2])
    return next((at / name for at in around for name in TABLES if (at / name).is_file()), None)


def read_label_map(path: str | PathLike[str], column: str = "raw_category") -> LabelMap:
    """Read `scannetv2-labels.combined.tsv`; labels are those of `column`, such as `nyu40class`.

    Raises
    ------
    InputError
        The file is missing, lacks the columns `id` and `raw_category`, or an id is no number.
    OptionError
        It has no such column.

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
    """Objects of an `.aggregation.json`; `InputError` where it is missing or not that."""
    content = read_json(path)
    listed = content.get("segGroups") if isinstance(content, dict) else None
    if not isinstance(listed, list):
        raise InputError(f"{path} has no list `segGroups`; download the file again.")
    groups = [_group(path, row, entry) for row, entry in enumerate(listed)]
    if len({group.id for group in groups}) < len(groups):
        raise InputError(f"{path}: two objects have one objectId; download the file again.")
    return groups


def _group(path: Path, row: int, entry: object) -> Group:
    if isinstance(entry, dict):
        id_ = entry.get("objectId", entry.get("id"))
        label, segments = entry.get("label"), entry.get("segments")
        whole = isinstance(segments, list) and all(type(s) is int for s in segments)
        if type(id_) is int and isinstance(label, str) and isinstance(segments, list) and whole:
            return Group(id_, label.strip() or "unknown", segments)
    raise InputError(
        f"{path}: entry {row} of segGroups lacks objectId (a number), label (text) or segments (a list "
        "of numbers); download the file again."
    )


def read_text(path: Path) -> str:
    """Text of a file in any encoding; `InputError` where it cannot be read."""
    try:
        return regular(path).read_bytes().decode("utf-8-sig", errors="replace")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error


def _matrix(text: str) -> NDArray[np.float64] | None:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return None
    return np.array(numbers).reshape(4, 4) if len(numbers) == 16 else None
