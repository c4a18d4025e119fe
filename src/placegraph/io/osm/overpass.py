"""Download of a place's OpenStreetMap data: a name goes in, a file for `read_osm` comes out.

OSMnx asks Nominatim for the place's outline and knows the servers, their limits and how to be polite
(its `settings`). Its `features` module is not used: it turns ways into polygons without vertex ids, goes
on with half a city when the server ran out of time, and writes the outline into the query once for
each key and type, where 33 keys and a detailed boundary exceed the 1 MiB that Overpass reads. A
`.osm` file is Overpass's own answer to the letter, with the date of the data and their licence; it goes
to disk without ever being whole in memory.
"""

from __future__ import annotations

import errno
import html
import math
import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from placegraph.errors import InputError, MissingExtraError, OptionError, ServiceError

Progress = Callable[[str, int], None]

SUFFIXES = (".osm", ".osm.pbf")
"""Endings that can be written."""
KEY = re.compile(r"[\w:.-]+")
PAD = 0.001
"""A place is fetched with its surroundings, this wide [deg]: from its edge one sees beyond it."""
PARTS, CORNERS = 16, 600
"""An outline is coarsened until it has no more parts and corners than these."""
METRES_A_DEGREE = 111_320.0
PAUSES = (20, 60)
"""Seconds to wait before asking a busy server once more, each time."""
SLOT = 30
"""Seconds the server may need to find a free slot and to begin its answer."""
BUSY = (429, 504)
"""HTTP status: too many requests, and the server found no time."""
_MEND = {
    "Nominatim": "Try again in some minutes.",
    "Overpass": "Try again in some minutes, or name another server (--overpass-url).",
}


@dataclass(frozen=True)
class FetchSummary:
    """Size of a downloaded file."""

    place: str
    """The place as the geocoder names it: check that it is the one that was meant."""
    nodes: int
    ways: int
    relations: int
    bytes: int

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
        Called with the step and how far it is: "finding" (0), "waiting" (seconds), "downloading"
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
    try:
        import osmnx as ox
    except ImportError as error:
        raise MissingExtraError(
            "OSMnx is not installed; run `pip install 'placegraph[osmnx]'`."
        ) from error
    out, query_keys = Path(out_path), sorted({keys} if isinstance(keys, str) else set(keys))
    _check(place, out, query_keys)
    report = progress or (lambda _step, _n: None)
    report("finding", 0)
    name, outline = find_area(ox, place)
    query = make_query(ox, query_keys, rings(outline))
    base = (overpass_url or ox.settings.overpass_url).rstrip("/").removesuffix("/interpreter")
    try:
        # In the same folder, so that replacing is atomic; gone afterwards, whatever happens.
        with TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as room:
            answer = file = Path(room) / "answer.osm"
            download(ox, f"{base}/interpreter", query, answer, report)
            if out.name.lower().endswith(".pbf"):
                file = answer.with_name("answer.osm.pbf")
            counts = copy_file(answer, file, report)
            size = file.stat().st_size
            if counts.total():
                file.replace(out)
    except OSError as error:
        raise InputError(
            f"{out} cannot be written: {error.strerror or error}; choose another folder or make room."
        ) from error
    if not counts.total():
        raise InputError(
            f"Overpass has no data in {name!r} for any of {len(query_keys)} keys; check the "
            "place, and that the server covers it."
        )
    return FetchSummary(name, counts["n"], counts["w"], counts["r"], size)


def _check(place: str, out: Path, keys: list[str]) -> None:
    if not place.strip():
        raise InputError("The place has no name; give one, such as 'Vaduz, Liechtenstein'.")
    if not out.name.lower().endswith(SUFFIXES):
        raise InputError(f"{out} has an unknown ending; choose one of {', '.join(SUFFIXES)}.")
    if not out.parent.is_dir():
        raise InputError(f"{out.parent} is not a folder; create it, or choose another for {out}.")
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file to write.")
    if not keys:
        raise OptionError("keys is empty; name at least one key, such as 'highway'.")
    for key in keys:
        if not KEY.fullmatch(key):
            raise OptionError(
                f"keys contains {key!r}; a key may only have letters, digits and : _ . -"
            )


def find_area(ox: Any, place: str) -> tuple[str, Any]:  # noqa: ANN401 - osmnx and shapely, loaded late
    """Return a place's full name and its outline, a polygon or several, longitude/latitude.

    Raises `InputError` where it is unknown, has no outline or is too large, `ServiceError` where
    Nominatim does not say.
    """
    import requests

    shapes: list[str] = []  # of all places of this name

    def check_response(response: requests.Response, **_: object) -> None:
        """Stop at a failure: OSMnx itself asks a busy server for ever, and reads errors as data."""
        if response.is_redirect:
            return
        check_status(response, "Nominatim")
        try:
            shapes.extend(str.strip(found["geojson"]["type"]) for found in response.json())
        except (LookupError, TypeError, ValueError, RecursionError) as error:
            raise malformed_error("Nominatim", response.content[:4096]) from error

    hooks = ox.settings.requests_kwargs | {"hooks": {"response": check_response}}
    try:
        with _settings(ox, use_cache=False, requests_kwargs=hooks, http_user_agent=_agent(ox)):
            found = ox.geocode_to_gdf(place)
        name, outline = str(found["display_name"].iloc[0]), found.geometry.iloc[0]
    except requests.RequestException as error:
        raise unreachable_error("Nominatim", error) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        if not shapes:
            raise InputError(
                f"No place named {place!r} was found; check the spelling, or add the region "
                "or country."
            ) from error
        if not {"Polygon", "MultiPolygon"} & set(shapes):
            raise InputError(
                f"{place!r} is only a point or line; name a town or district with an "
                "outline, or download an extract for `placegraph city build`."
            ) from error
        raise malformed_error("Nominatim", repr(error).encode()) from error
    if outline.is_empty:
        raise malformed_error("Nominatim", b"an outline of nothing")
    area = outline.area * METRES_A_DEGREE**2 * math.cos(math.radians(outline.centroid.y))
    if not area <= ox.settings.max_query_area_size:
        raise InputError(
            f"{name!r} covers {area / 1e6:,.0f} km2, which is too much for Overpass (limit: "
            f"{ox.settings.max_query_area_size / 1e6:,.0f} km2). Name a part of it, or download an "
            "extract for `placegraph city build`."
        )
    return name, outline


@contextmanager
def _settings(ox: Any, **changes: object) -> Iterator[None]:  # noqa: ANN401 - the module osmnx
    """Change global settings of OSMnx and restore them afterwards."""
    before = {name: getattr(ox.settings, name) for name in changes}
    try:
        vars(ox.settings).update(changes)
        yield
    finally:
        vars(ox.settings).update(before)


def rings(outline: Any) -> list[str]:  # noqa: ANN401 - shapely's geometry, untyped
    """Return rings around a place, as Overpass's polygon filter wants them: "lat lon lat lon ..."."""
    pad = PAD
    while True:  # widened by twice what the simplification may cut off
        wide = outline.buffer(pad).simplify(pad / 2)
        rings = [np.array(part.exterior.coords) for part in getattr(wide, "geoms", [wide])]
        if len(rings) <= PARTS and sum(map(len, rings)) <= CORNERS:
            earth = [np.clip(ring, (-180, -90), (180, 90)) for ring in rings]
            return [" ".join(f"{y:.5f} {x:.5f}" for x, y in ring) for ring in earth]
        pad *= 2


def make_query(ox: Any, keys: list[str], rings: list[str]) -> str:  # noqa: ANN401 - the module osmnx
    """Return an Overpass query for the elements with one of the keys, and what they consist of.

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


def download(ox: Any, url: str, query: str, target: Path, report: Progress) -> None:  # noqa: ANN401
    """Post the query and stream the answer to a file; wait while the server is busy."""
    import requests

    settings = ox.settings
    for pause in (*PAUSES, None):
        report("downloading", 0)
        try:
            with requests.post(
                url,
                data={"data": query},
                headers={"User-Agent": _agent(ox), "Referer": settings.http_referer},
                timeout=settings.requests_timeout + SLOT,
                stream=True,
                **settings.requests_kwargs,
            ) as response:
                if response.status_code not in BUSY or pause is None:
                    check_status(response, "Overpass")
                    size = 0
                    with target.open("wb") as file:
                        for chunk in response.iter_content(1 << 18):
                            size += file.write(chunk)
                            report("downloading", size)
                    break
        except requests.RequestException as error:
            raise unreachable_error("Overpass", error) from error
        report("waiting", pause)
        time.sleep(pause)
    with target.open("rb") as file:  # an answer cut short says so at its end, with status 200
        file.seek(max(0, target.stat().st_size - (1 << 16)))
        remark = re.search(rb"<remark>(.*?)</remark>", file.read(), re.DOTALL)
    if remark:
        raise ServiceError(
            f"Overpass failed: {shorten(remark[1])}. Fetch a smaller place, try again in "
            "some minutes, or download an extract for `placegraph city build`."
        )


def copy_file(answer: Path, target: Path, report: Progress) -> Counter[str]:
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
                    report("writing", n)
                counts[item.type_str()] += 1
                if writer is not None:
                    writer.add(item)
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        with answer.open("rb") as file:
            raise malformed_error("Overpass", file.read(4096)) from error
    return counts


def _agent(ox: Any) -> str:  # noqa: ANN401 - the module osmnx
    """Return the user agent, as both services require."""
    return f"placegraph, {ox.settings.http_user_agent}"


def check_status(response: Any, service: str) -> None:  # noqa: ANN401 - requests, loaded late
    """Raise `ServiceError` where the service did not answer what was asked."""
    if not response.ok:
        why = shorten(response.content[:4096])
        raise ServiceError(
            f"{service} answered {response.status_code} {response.reason}"
            f"{f' ({why})' if why else ''}. {_MEND[service]}"
        )


def unreachable_error(service: str, error: Exception) -> ServiceError:
    """Return the error of a service that does not answer."""
    return ServiceError(
        f"{service} cannot be reached, or closed the connection: "
        f"{shorten(str(error).encode())}. Check the network and the server's address, and "
        "try again."
    )


def malformed_error(service: str, answer: bytes) -> ServiceError:
    """Return the error of a service that answers something else."""
    return ServiceError(
        f"{service} returned an unexpected answer: {shorten(answer) or 'nothing'}. {_MEND[service]}"
    )


def shorten(text: bytes, most: int = 200) -> str:
    """Return the text of a page or message on one line, without its markup."""
    plain = re.sub(r"<(style|script|title)\b.*?</\1>|<[^>]*>", " ", text.decode(errors="replace"),
                   flags=re.DOTALL)  # fmt: skip
    line = " ".join(html.unescape(plain).split()).rstrip(".")
    return line if len(line) <= most else line[: most - 1] + "…"
