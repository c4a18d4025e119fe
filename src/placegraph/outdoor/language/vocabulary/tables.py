"""Tables of the vocabulary: tab-separated text, plain or compressed, shipped or the user's own."""

from __future__ import annotations

import gzip
import lzma
from collections.abc import Callable, Iterator, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from placegraph.core.cache import cached
from placegraph.errors import InputError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

_PACKED: dict[str, Callable[[bytes], bytes]] = {".gz": gzip.decompress, ".xz": lzma.decompress}


def shipped() -> Traversable:
    """Return the folder of the tables that come with placegraph."""
    return files("placegraph.outdoor.language.vocabulary").joinpath("data")


def user_folder(path: str | Path) -> Path:
    """Return a user's folder of tables.

    Raises
    ------
    InputError
        If it is no folder.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no folder of vocabulary tables. Give a folder that holds your edited"
            " objects.tsv or words.tsv; tables that are missing there are taken from placegraph."
        )
    return folder


def find(name: str, folder: Path | None) -> Traversable | Path:
    """Return the table `name`, plain, .gz or .xz, from `folder` or else as shipped."""
    for place in (folder, shipped()):
        if place is None:
            continue
        for suffix in ("", *_PACKED):
            table = place.joinpath(name + suffix)
            if table.is_file():
                return table
    raise InputError(f"{name}: this table is missing from the installation; reinstall placegraph.")


def read_text(table: Traversable | Path) -> str:
    """Read a table as text.

    Raises
    ------
    InputError
        If it cannot be read, unpacked, or is no UTF-8 text.
    """
    unpack = _PACKED.get(f".{table.name.rpartition('.')[2]}")
    try:
        data = table.read_bytes()
        if unpack is None:
            return _decode(data)
        return cached(f"table-{sha256(data).hexdigest()[:16]}", lambda: unpack(data), _decode)
    except (OSError, EOFError, lzma.LZMAError) as error:
        raise InputError(f"{table}: cannot be read ({error}). Restore or delete it.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{table}: is not UTF-8 text ({error}). Save it as UTF-8.") from error


def _decode(data: bytes) -> str:
    return data.decode("utf-8-sig")


def rows(
    table: Traversable | Path, columns: Sequence[str]
) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield line number and stripped fields of every row of a small, editable table.

    Empty lines and lines that start with ``#`` are comments; the first other line must be the
    header `columns`. Fields missing at the end of a row are empty.

    Raises
    ------
    InputError
        Naming file and line, if the header is another or a row has too many fields.
    """
    header = None
    for number, line in enumerate(read_text(table).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = tuple(field.strip() for field in line.split("\t"))
        if header is None:
            header = fields
            if header != tuple(columns):
                raise InputError(
                    f"{table}, line {number}: the header must be {' '.join(columns)}"
                    f" (tab-separated), not {' '.join(header)!r}."
                )
            continue
        if len(fields) > len(columns):
            raise InputError(
                f"{table}, line {number}: {len(fields)} fields where {len(columns)}"
                f" ({', '.join(columns)}) are expected. Remove the surplus tabs."
            )
        yield number, fields + ("",) * (len(columns) - len(fields))
    if header is None:
        raise InputError(
            f"{table}: is empty; its first line must be the header {' '.join(columns)}."
        )
