"""Elements of OpenStreetMap within rings, from Overpass: the query, and its answer as a file.

They are asked for here and not through OSMnx's `features` module, because that turns ways into
polygons without vertex ids, goes on with half a city when the server ran out of time, and writes the
outline into the query once for each key and type, where 33 keys and a detailed boundary exceed the
1 MiB that Overpass reads. Overpass's own OSM XML is taken instead: it holds elements, ids and tags
as they are, and goes to disk without ever being whole in memory. A `.osm` file is this answer to the
letter, with the date of the data and their licence.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
from collections import Counter
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from placegraph.errors import ServiceError
from placegraph.formats.place.services import accept, agent, gist, nonsense, unreachable

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Progress = Callable[[str, int], None]

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
