"""Download of a place's OpenStreetMap data: a name goes in, a file for `read_osm` comes out.

OSMnx finds the place's outline and knows the servers, their limits and how to be polite (its
`settings`). Its `features` module is not asked: it turns ways into polygons without vertex ids, goes
on with half a city when the server ran out of time, and writes the outline into the query once for
each key and type, where 33 keys and a detailed boundary exceed the 1 MiB that Overpass reads. A
`.osm` file is Overpass's own answer to the letter, which goes to disk without ever being whole in
memory, with the date of the data and their licence.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from placegraph.errors import InputError, OptionError, ServiceError
from placegraph.io.osm.nominatim import find, rings
from placegraph.io.osm.services import (
    accept,
    agent,
    gist,
    nonsense,
    osmnx_or_what_installs_it,
    unreachable,
)

Progress = Callable[[str, int], None]


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


PAUSES = (20, 60)
"""Seconds to wait before asking a busy server once more, each time."""
SLOT = 30
"""Seconds the server may need to find a free slot and to begin its answer."""
BUSY = (429, 504)
"""HTTP status: too many requests, and the server found no time."""


def query_of(ox: Any, keys: list[str], rings: list[str]) -> str:  # noqa: ANN401 - the module osmnx
    """Overpass query for the elements with one of the keys, and what they consist of.

    Of the relations only areas are wanted. Routes and rivers would bring every way of a continent,
    and so would the borders of countries, states and counties.
    """
    memory = ox.settings.overpass_memory
    size = "" if memory is None else f"[maxsize:{memory}]"
    either = "|".join(key.replace(".", "[.]") for key in keys)
    tagged = f'[~"^({either})$"~"."]'
    areas = '["type"~"^(multipolygon|boundary)$"]["admin_level"!~"^[1-6]$"]'
    wanted = "\n".join(
        f'node{tagged}(poly:"{ring}");\n'
        f'way{tagged}(poly:"{ring}");\n'
        f'relation{areas}{tagged}(poly:"{ring}");'
        for ring in rings
    )
    return (
        f"[out:xml][timeout:{ox.settings.requests_timeout:.0f}]{size};\n"
        f"(\n{wanted}\n);\n(._;>;);\nout body;\n"
    )


def download(ox: Any, url: str, query: str, target: Path, told: Progress) -> None:  # noqa: ANN401
    """Post the query and write the answer to a file as it comes; wait where the server is busy."""
    import requests

    settings = ox.settings
    for pause in (*PAUSES, None):
        told("downloading", 0)
        try:
            with requests.post(
                url,
                data={"data": query},
                headers={"User-Agent": agent(ox), "Referer": settings.http_referer},
                timeout=settings.requests_timeout + SLOT,
                stream=True,
                **settings.requests_kwargs,
            ) as response:
                if response.status_code not in BUSY or pause is None:
                    accept(response, "Overpass")
                    _store(response, target, told)
                    break
        except requests.RequestException as error:
            raise unreachable("Overpass", error) from error
        told("waiting", pause)
        time.sleep(pause)
    with target.open("rb") as file:  # an answer cut short says so at its end, with status 200
        file.seek(max(0, target.stat().st_size - (1 << 16)))
        remark = re.search(rb"<remark>(.*?)</remark>", file.read(), re.DOTALL)
    if remark:
        raise ServiceError(
            f"Overpass gave up: {gist(remark[1])}. Fetch a smaller place, try again in some "
            "minutes, or download an extract for `placegraph city build`."
        )


def _store(response: Any, target: Path, told: Progress) -> None:  # noqa: ANN401 - requests, loaded late
    size = 0
    with target.open("wb") as file:
        for chunk in response.iter_content(1 << 18):
            size += file.write(chunk)
            told("downloading", size)


def copied(answer: Path, target: Path, told: Progress) -> Counter[str]:
    """Write the answer to the target as PBF, unless they are the same file, and count elements.

    Returns how many nodes ("n"), ways ("w") and relations ("r") there are. To read all of the
    answer is also the proof that it is whole.
    """
    import osmium

    if shutil.disk_usage(target.parent).free < answer.stat().st_size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # libosmium would end the process
    counts: Counter[str] = Counter()
    try:
        with ExitStack() as stack:
            writer = None
            if target != answer:
                writer = stack.enter_context(osmium.SimpleWriter(target))
            for n, item in enumerate(osmium.FileProcessor(answer)):
                if n % 10_000 == 0:
                    told("writing", n)
                counts[item.type_str()] += 1
                if writer is not None:
                    writer.add(item)
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        with answer.open("rb") as file:
            raise nonsense("Overpass", file.read(4096)) from error
    return counts
