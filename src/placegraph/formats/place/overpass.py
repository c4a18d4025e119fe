"""Download of a place's OpenStreetMap data: a name goes in, a file for `read_osm` comes out.

OSMnx finds the place's outline and knows the servers, their limits and how to be polite (its
`settings`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from placegraph.errors import InputError, OptionError
from placegraph.formats.place.nominatim import find, rings
from placegraph.formats.place.overpass_answer import copied, download, query_of
from placegraph.formats.place.services import osmnx_or_what_installs_it

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterable
    from os import PathLike

    from placegraph.formats.place.overpass_answer import Progress

SUFFIXES = (".osm", ".osm.pbf")
"""Endings that can be written."""
KEY = re.compile(r"[\w:.-]+")


@dataclass(frozen=True)
class FetchSummary:
    """What was fetched."""

    place: str
    """The place as the geocoder names it, so that one sees whether it is the one that was meant."""
    nodes: int
    ways: int
    relations: int
    bytes: int
    """Size of the file."""

    def __str__(self) -> str:
        return (
            f"{self.place}: {self.nodes:,} nodes, {self.ways:,} ways, "
            f"{self.relations:,} relations, {self.bytes / 1e3:,.0f} kB."
        )


def fetch_osm(
    place: str,
    out_path: str | PathLike[str],
    *,
    keys: Iterable[str],
    overpass_url: str | None = None,
    progress: Progress | None = None,
) -> FetchSummary:
    """Download a place's OpenStreetMap data from Overpass and write it to `out_path`.

    Elements keep their ids and tags. An old file is replaced only by a whole new one.

    Parameters
    ----------
    place
        Name of a place that has an outline: a town, a district, a campus.
    out_path
        File to write; its ending is one of `SUFFIXES`.
    keys
        Elements with one of these keys are fetched, and what they consist of; `keys_read` has all
        that `build_city` reads.
    overpass_url
        Overpass server, up to and without `/interpreter`; that of `osmnx.settings` if not given.
    progress
        Is told the step and how far it is: "finding" (0), "waiting" (seconds), "downloading"
        (bytes), "writing" (elements).

    Raises
    ------
    MissingExtraError
        OSMnx is not installed.
    OptionError
        A key is none.
    InputError
        The place is unknown, has no outline, is too large or holds nothing; or the file cannot be
        written.
    ServiceError
        A server cannot be reached, is too busy, or answers nonsense or only in part.

    """
    ox = osmnx_or_what_installs_it()
    out, query_keys = _check(place, Path(out_path)), _keys(keys)
    told = progress or (lambda _step, _n: None)
    told("finding", 0)
    name, outline = find(ox, place)
    query = query_of(ox, query_keys, rings(outline))
    base = (overpass_url or ox.settings.overpass_url).rstrip("/").removesuffix("/interpreter")
    try:
        # In the same folder, so that replacing is atomic; gone afterwards, whatever happens.
        with TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as room:
            answer = Path(room) / "answer.osm"
            download(ox, f"{base}/interpreter", query, answer, told)
            counts, size = _moved(answer, out, told)
    except OSError as error:
        raise InputError(
            f"{out} cannot be written: {error.strerror or error}; choose another folder or make room."
        ) from error
    if not counts.total():
        raise InputError(
            f"Overpass knows nothing in {name!r} with one of {len(query_keys)} keys; check "
            "that this is the place you mean, and that the server covers it."
        )
    return FetchSummary(name, counts["n"], counts["w"], counts["r"], size)


def _moved(answer: Path, out: Path, told: Progress) -> tuple[Counter[str], int]:
    """Put an answer in the place of `out`, unless it is empty; counts of elements, and bytes."""
    file = answer
    if out.name.lower().endswith(".pbf"):
        file = answer.with_name("answer.osm.pbf")
    counts = copied(answer, file, told)
    size = file.stat().st_size
    if counts.total():
        file.replace(out)
    return counts, size


def _check(place: str, out: Path) -> Path:
    if not place.strip():
        raise InputError("The place has no name; give one, such as 'Vaduz, Liechtenstein'.")
    if not out.name.lower().endswith(SUFFIXES):
        raise InputError(f"{out} has an unknown ending; choose one of {', '.join(SUFFIXES)}.")
    if not out.parent.is_dir():
        raise InputError(f"{out.parent} is not a folder; create it, or choose another for {out}.")
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file to write.")
    return out


def _keys(keys: Iterable[str]) -> list[str]:
    chosen = sorted({keys} if isinstance(keys, str) else set(keys))
    if not chosen:
        raise OptionError("keys is empty; name at least one key, such as 'highway'.")
    for key in chosen:
        if not KEY.fullmatch(key):
            raise OptionError(f"keys holds {key!r}; a key has letters, digits and : _ . - only.")
    return chosen
