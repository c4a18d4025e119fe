"""OpenStreetMap files at any URL that fsspec knows (``https://``, ``s3://``, ``memory://``), fetched to disk.

What is fetched goes into a ``.part`` beside a note of which file it is of; cut off, it goes on from there.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from hashlib import sha256
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from placegraph.core import files as locks
from placegraph.core.files import write_error, write_file
from placegraph.errors import (
    InputError,
    MissingExtraError,
    OptionError,
    PlacegraphError,
    ServiceError,
)
from placegraph.io.osm.osm import SUFFIXES, check_osm, one_line

if TYPE_CHECKING:
    Progress = Callable[[str, int, int | None], None]


CHUNK = 8 << 20
"""Bytes that are held in memory at once."""
VERSIONS = ("etag", "lastmodified", "mtime", "created")
"""Fields of file systems that show a change of a file, the best first."""
CONNECT, SILENT = 30.0, 120.0
"""A server that does not answer, or says nothing more, for so long is gone [s]."""


SMALL = 64 << 20
"""Bytes of an extract that one map is made of, in memory: some 9 million nodes, 16 bytes each."""


def is_url(place: object) -> bool:
    """Return whether a place is no path of this machine."""
    return "://" in str(place)


def file_name(place: str | PathLike[str]) -> str:
    """Return the name of a file: of a URL without what it is asked with, as that may be a key."""
    if not is_url(place):
        return Path(place).name
    parts = urlsplit(str(place))
    return PurePosixPath(parts.path or parts.netloc).name


def is_osm_url(url: str) -> bool:
    """Return whether a URL is of an OpenStreetMap file, by its name."""
    return file_name(url).lower().endswith(SUFFIXES)


def is_large(extract: str | PathLike[str]) -> bool:
    """Return whether one map of an extract, or of one at a URL, may take more memory than there is."""
    if is_url(extract):
        return (remote_size(str(extract)) or 0) > SMALL
    path = Path(extract)
    return path.is_file() and path.stat().st_size > SMALL


def open_file_system(url: str) -> tuple[Any, str]:
    """Return the file system, as of fsspec, of a URL, and the path in it.

    Raises
    ------
    MissingExtraError, OptionError
        fsspec, or what it takes for such a URL, is not installed; or no file system knows it.

    """
    try:
        import fsspec

        options: dict[str, Any] = {}
        if urlsplit(url).scheme in ("http", "https"):
            from aiohttp import ClientTimeout

            limits = ClientTimeout(total=None, sock_connect=CONNECT, sock_read=SILENT)
            options["client_kwargs"] = {"timeout": limits}
        system, root = fsspec.core.url_to_fs(url, **options)
    except ImportError as error:
        raise MissingExtraError(
            f"{url} is read with fsspec, but {one_line(error)}: run `pip install "
            "'placegraph[scale]'`; s3:// also needs s3fs, and gs:// gcsfs."
        ) from error
    except ValueError as error:
        raise OptionError(
            f"{url}: this kind of URL is not supported ({one_line(error)})."
        ) from error
    except Exception as error:  # each file system has its own
        raise OptionError(f"{url} cannot be opened: {one_line(error)}.") from error
    return system, str(root).rstrip("/")


def remote_size(url: str) -> int | None:
    """Return the bytes of an OpenStreetMap file at a URL; None where its server does not say.

    Raises
    ------
    InputError
        It is not there, empty, a folder, or no OpenStreetMap file by its name.
    MissingExtraError, OptionError
        As of `open_file_system`.
    ServiceError
        Its server does not answer, or refuses.

    """
    size: int | None = _file_info(url, *open_file_system(url))["size"]
    return size


def fetch_file(url: str, folder: Path, progress: Progress | None = None) -> Path:
    """Fetch an OpenStreetMap file into a folder; where the same one lies there already, at once.

    Raises
    ------
    InputError
        As `remote_size`; or it changed while it was fetched.
    MapError
        The folder cannot be written, as on a full disk.
    MissingExtraError, OptionError, ServiceError
        As `remote_size`; and where the connection is cut, after which the same call goes on.

    """
    system, root = open_file_system(url)
    told = _file_info(url, system, root)
    path = folder / sha256(url.encode()).hexdigest()[:8] / file_name(url)
    part, note = path.with_name(f"{path.name}.part"), path.with_name("note.json")
    size = told["size"]
    step = f"fetching {path.name}" + (f" ({size / 1e6:,.1f} MB)" if size else "")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        known = note.exists() and note.read_text() == json.dumps(told)
        if None in told.values() or not known:  # it may be another one, or a part of another one
            path.unlink(missing_ok=True)
            part.unlink(missing_ok=True)
            write_file(note, [json.dumps(told).encode()])
        if path.exists():
            return path
        with part.open("ab") as file:
            for chunk in _read_chunks(
                url, system, root, file.tell(), lambda: file.truncate(file.seek(0))
            ):
                file.write(chunk)
                if progress is not None:
                    progress(step, file.tell(), size)
            fetched = file.tell()
            file.flush()
            os.fsync(file.fileno())
        if size is not None and fetched < size:
            raise ServiceError(_cut_error(url, f"only {fetched:,} of {size:,} bytes were received"))
        if _file_info(url, system, root) != told or fetched != (size or fetched):
            part.unlink()
            raise InputError(f"{url} changed while it was fetched; run the same command again.")
        part.rename(path)
    except OSError as error:
        raise write_error(Path(error.filename or part), error) from error
    return path


def fetch_all(
    extracts: Sequence[str | PathLike[str]], folder: Path, progress: Progress | None = None
) -> list[Path]:
    """Fetch extracts at URLs into a folder, after checking that all exist, and return all paths.

    Raises as `fetch_file`, and `InputError` where a file is missing.
    """
    paths = [check_osm(Path(path)).resolve() for path in extracts if not is_url(path)]
    urls = [str(path) for path in extracts if is_url(path)]
    for url in urls:
        remote_size(url)
    return paths + [fetch_file(url, folder, progress).resolve() for url in urls]


@contextmanager
def fetch_temporarily(path: Any, out: Path, progress: Progress | None = None) -> Iterator[Any]:  # noqa: ANN401
    """Yield an extract on this machine; one at a URL is fetched to a temporary copy beside `out`.

    Raises as `fetch_file`; what is cut off stays for the same call. `MapLockedError` where another is at it.
    """
    if not isinstance(path, str) or not is_url(path):
        yield path
        return
    remote_size(path)  # before anything is written
    room = out.parent / f".{out.name}.fetched"
    with ExitStack() as stack:
        try:
            stack.enter_context(locks.lock_file(room))
        except OSError as error:
            raise write_error(out.parent, error) from error
        found = fetch_file(path, room, progress)
        stack.callback(shutil.rmtree, room, ignore_errors=True)
        try:
            yield found
        except PlacegraphError as error:  # the copy is gone before this is read
            raise type(error)(str(error).replace(str(found), path)) from error


def _file_info(url: str, system: Any, root: str) -> dict[str, Any]:  # noqa: ANN401  # fsspec has no types
    """Return size of a file and the properties by which a change is seen."""
    if not is_osm_url(url):
        raise InputError(
            f"{url} has an unknown ending; OpenStreetMap files end in {', '.join(SUFFIXES)}."
        )
    try:
        info = system.info(root)
    except Exception as error:  # each file system has its own
        raise _failure(url, error) from error
    if info.get("type") == "directory":
        raise InputError(f"{url} is a folder; name an OpenStreetMap file in it.")
    if info.get("size") == 0:
        raise InputError(f"{url} is empty; download or export it again.")
    plain = {key.lower().replace("-", "").replace("_", ""): value for key, value in info.items()}
    version = next((str(plain[key]) for key in VERSIONS if plain.get(key)), None)
    return {"url": url, "size": info.get("size"), "version": version}


def _read_chunks(
    url: str, system: Any, root: str, begun: int, anew: Callable[[], object]  # noqa: ANN401
) -> Iterator[bytes]:  # fmt: skip
    """Yield chunks of a file from a byte on; without ranges, after `anew`, from the first."""
    for first, how in ((begun, {}), (0, {"block_size": 0})):
        try:
            with system.open(root, "rb", **how) as file:
                if first:
                    file.seek(first)
                while chunk := file.read(CHUNK):
                    yield chunk
        except ValueError as error:  # its server hands out no ranges
            if how:
                raise _failure(url, error) from error
            anew()
        except Exception as error:  # each file system has its own
            raise _failure(url, error) from error
        else:
            return


def is_missing(error: Exception) -> bool:
    """Return whether a file is not there; fsspec says so of servers that do not answer, too."""
    cause = error.__cause__ or error
    gone = isinstance(cause, LookupError | FileNotFoundError)
    return isinstance(error, FileNotFoundError) and (gone or getattr(cause, "status", None) == 404)


def _failure(url: str, error: Exception) -> InputError | ServiceError:
    """Return the error about a file."""
    if is_missing(error):
        return InputError(f"{url} does not exist; check the URL.")
    cause = error.__cause__ or error
    return ServiceError(_cut_error(url, f"{type(cause).__name__}: {one_line(Exception(cause))}"))


def _cut_error(url: str, why: str) -> str:
    return (
        f"{url} cannot be read ({why}). Check the URL and the connection; the same command "
        "resumes the download."
    )
