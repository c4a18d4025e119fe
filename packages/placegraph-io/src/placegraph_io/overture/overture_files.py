"""Files of Overture: found in folders and by URL, told apart by type, read by row groups."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from placegraph.errors import InputError, OptionError
from placegraph.io.osm.osm import one_line
from placegraph_io.overture.overture_tags import BASE

if TYPE_CHECKING:
    from placegraph_io.overture.overture import Box

TELLS = {
    "place": ("categories", "taxonomy", "basic_category"),
    "segment": ("subclass_rules", "subclass", "connectors", "road_surface"),
    "building": ("class", "has_parts", "is_underground", "num_floors"),
}
"""Columns by which a type is told where neither folder nor file says it, in this order."""
NEEDED = {
    "place": ("names",),
    "segment": ("subtype", "class"),
    "building": ("subtype", "class"),
}
"""Columns without which a type says nothing."""
READ = frozenset(
    (
        "id", "geometry", "names", "categories", "taxonomy", "basic_category", "confidence",
        "operating_status", "brand", "addresses", "subtype", "class", "subclass", "subclass_rules",
        "source_tags",
    )
)  # fmt: skip
"""Columns that are read, where a file has them."""
EDGES = ("xmin", "ymin", "xmax", "ymax")
DAMAGED = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, MemoryError)
"""What is raised where a file's columns contradict each other or are of other types, beside PyArrow's own
errors."""
_TYPE = re.compile(r"[/\\]type=([a-z_]+)[/\\]")
_MAGIC = b"PAR1"
_LOOK = """
import sys
from io import BytesIO
from pyarrow.parquet import read_metadata
try:
    found = read_metadata(BytesIO(sys.stdin.buffer.read()))
    groups = [found.row_group(i) for i in range(found.num_row_groups)]
    said = [group.column(i).statistics for group in groups for i in range(group.num_columns)]
except Exception:
    pass
"""
"""Looks at all statistics of a footer; what PyArrow itself finds wrong is for the reader to say."""
_STREAM = 1 << 20
"""Bytes of a column fetched at once: a row group of any size is read piece by piece."""


@dataclass(frozen=True)
class OvertureFile:
    """One Parquet file of one feature type."""

    path: str
    filesystem: Any
    type: str

    def batches(self, box: Box | None, rows: int) -> Iterator[dict[str, list[Any]]]:
        """Columns, by name, of the rows that meet a box, at most so many at a time.

        Row groups whose statistics lie beside the box are not read.
        """
        import pyarrow.parquet as pq

        with self.filesystem.open_input_file(self.path) as stream:
            if box is not None:
                _check_statistics(stream, self.path)
            file = pq.ParquetFile(stream, buffer_size=_STREAM, pre_buffer=False)
            groups = [
                i for i in range(file.num_row_groups) if _meets(file.metadata.row_group(i), box)
            ]
            names = [name for name in file.schema_arrow.names if name in READ or name == "bbox"]
            for batch in file.iter_batches(rows, groups, names, use_threads=False):
                inside = batch if box is None else batch.filter(_inside(batch.column("bbox"), box))
                wanted = [name for name in inside.schema.names if name in READ]
                yield {name: inside.column(name).to_pylist() for name in wanted}


def files_of(
    paths: Sequence[str], suffixes: tuple[str, ...], counts: Counter[str]
) -> Iterator[OvertureFile]:
    """Files of all paths that are of a known type and whole in their columns, in order.

    Those of other types that lie in a folder are counted. Raises `InputError` where a path holds
    none, or a file is no Parquet, or lacks a column.
    """
    for path in paths:
        filesystem, root = _filesystem(path)
        found = list(_listed(filesystem, root, suffixes, path))
        alone = found == [root]
        for name in found:
            kind = _type(filesystem, name, path)
            if kind in NEEDED or kind in BASE:
                yield OvertureFile(name, filesystem, kind)
            elif alone:
                raise InputError(
                    f"{path} holds {kind or 'rows of no known type'}; of Overture places, buildings, "
                    "segments and the base theme are read."
                )
            else:
                counts[f"files of {kind or 'no known type'}"] += 1


def _filesystem(path: str) -> tuple[Any, str]:
    """PyArrow's file system of a path or URL, and the path in it; by fsspec where it has none."""
    from pyarrow import fs

    if "://" not in path:
        return fs.LocalFileSystem(), path
    try:
        return fs.FileSystem.from_uri(path)
    except (ValueError, OSError, NotImplementedError) as error:
        try:
            import fsspec

            found, root = fsspec.core.url_to_fs(path)
        except (ImportError, ValueError) as other:
            raise OptionError(
                f"{path}: no file system knows this URL ({one_line(error)}; {one_line(other)})."
            ) from other
        return fs.PyFileSystem(fs.FSSpecHandler(found)), str(root)


def _listed(filesystem: Any, root: str, suffixes: tuple[str, ...], said: str) -> Iterator[str]:  # noqa: ANN401
    """Parquet files of a folder, by name, or the one file that a path is."""
    from pyarrow import fs

    try:
        (info,) = filesystem.get_file_info([root])
        if info.type == fs.FileType.NotFound:
            raise InputError(f"{said} does not exist; check the path.")
        if info.type == fs.FileType.File:
            yield root
            return
        inside = filesystem.get_file_info(fs.FileSelector(root, recursive=True))
    except OSError as error:
        raise InputError(f"{said} cannot be reached: {one_line(error)}.") from error
    names = sorted(i.path for i in inside if i.is_file and i.path.lower().endswith(suffixes))
    if not names:
        raise InputError(
            f"{said} holds no Parquet file ({', '.join(suffixes)}); name a folder of Overture's, such as "
            "theme=places."
        )
    yield from names


def _type(filesystem: Any, name: str, said: str) -> str:  # noqa: ANN401
    """Feature type of a file: by its folder, else by its columns; "" where it is none of Overture's.

    Raises `InputError` where the file is no Parquet, or lacks what its type needs.
    """
    named = _TYPE.search(name)
    if named and named[1] not in NEEDED and named[1] not in BASE:
        return named[1]  # not opened
    columns = _columns(filesystem, name)
    kind = (
        named[1] if named else next((k for k, tells in TELLS.items() if columns & set(tells)), "")
    )
    if not named and "source_tags" in columns and kind != "segment":
        kind = "land_use"  # or another of the base theme: all are read alike
    if not kind:
        return ""
    lacks = [c for c in ("id", "geometry", *NEEDED.get(kind, ("source_tags",))) if c not in columns]
    if kind == "place" and not columns & set(TELLS["place"]):
        lacks.append(TELLS["place"][0])
    lacks += [f"bbox.{edge}" for edge in EDGES if f"bbox.{edge}" not in columns]
    if lacks:
        raise InputError(
            f"{name if name != said else said} has no column {', '.join(lacks)}, which Overture's "
            f"{kind}s have; download it again, with all columns of a release since 2024-07."
        )
    return kind


def _columns(filesystem: Any, name: str) -> set[str]:  # noqa: ANN401
    """Names of columns, with those of the edges in ``bbox``; checks how shapes are written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with filesystem.open_input_file(name) as stream:
            schema = pq.read_schema(stream)
    except (pa.ArrowException, OSError, *DAMAGED) as error:
        raise InputError(
            f"{name} cannot be read as Parquet: {one_line(error)}. Download it again."
        ) from error
    out = set(schema.names)
    if "geometry" in out:
        kind = schema.field("geometry").type
        kind = getattr(kind, "storage_type", kind)
        if not (pa.types.is_binary(kind) or pa.types.is_large_binary(kind)):
            raise InputError(
                f"{name}: geometry is {kind}, and not WKB; export it as GeoParquet with WKB."
            )
    if "bbox" in out and pa.types.is_struct(schema.field("bbox").type):
        out |= {f"bbox.{field.name}" for field in schema.field("bbox").type}
    return out


def _check_statistics(stream: Any, name: str) -> None:  # noqa: ANN401
    """Raise `InputError` where looking at a file's statistics ends the process, as some damage does."""
    tail = min(
        stream.size(), 8 + int.from_bytes(stream.read_at(4, max(0, stream.size() - 8)), "little")
    )
    footer = _MAGIC + stream.read_at(tail, stream.size() - tail)
    with suppress(OSError):  # no process can be started, as in a sandbox: read as it is
        look = [sys.executable, "-P", "-c", _LOOK]
        died = subprocess.run(look, input=footer, capture_output=True, check=False)  # noqa: S603
        if died.returncode < 0:
            raise InputError(
                f"{name} is damaged: reading its statistics ends PyArrow, by "
                f"{signal.strsignal(-died.returncode)}. Download it again."
            )


def _meets(group: Any, box: Box | None) -> bool:  # noqa: ANN401
    """Whether a row group may hold rows that meet a box, by its statistics."""
    if box is None:
        return True
    low, high = {}, {}
    for i in range(group.num_columns):
        column = group.column(i)
        if column.path_in_schema.startswith("bbox.") and column.statistics is not None:
            if not column.statistics.has_min_max:
                continue
            edge = column.path_in_schema.removeprefix("bbox.")
            low[edge], high[edge] = column.statistics.min, column.statistics.max
    return not (
        low.get("xmin", -180.0) > box.east
        or high.get("xmax", 180.0) < box.west
        or low.get("ymin", -90.0) > box.north
        or high.get("ymax", 90.0) < box.south
    )


def _inside(bbox: Any, box: Box) -> Any:  # noqa: ANN401
    """Which rows of a column of boxes meet a box; those without one do."""
    import pyarrow.compute as pc

    west, south, east, north = (pc.struct_field(bbox, edge) for edge in EDGES)
    beside = [
        pc.greater(west, box.east),
        pc.less(east, box.west),
        pc.greater(south, box.north),
        pc.less(north, box.south),
    ]
    out = beside[0]
    for also in beside[1:]:
        out = pc.or_kleene(out, also)
    return pc.invert(pc.fill_null(out, False))
