"""How well descriptions of one's own find their places on a map of one's own."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import DescriptionError, InputError
from placegraph.io.osm.osm import SUFFIXES
from placegraph_lab.tables.kitti.descriptions import Description as Told
from placegraph_lab.tables.kitti.descriptions import read_descriptions
from placegraph_lab.tables.outdoor.metrics import RADII, RANKS, Answer, Score, measure, score
from placegraph_lab.tables.runner import markdown, number, share, shares

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.search.request import Matcher


Progress = Callable[[str, int], None]


TEXTS = "descriptions.jsonl"
MAPS = tuple(f"map{ending}" for ending in SUFFIXES)


@dataclass(frozen=True)
class OwnPairs:
    """Answers to all descriptions of a folder."""

    source: str  # name of the map
    told: tuple[Told, ...]
    answers: tuple[Answer, ...]
    outside: tuple[str, ...]
    """Ids of descriptions whose place the map does not cover: nothing can find them."""

    @property
    def score(self) -> Score:
        """Recall, median error, calibration, statuses and times."""
        return score(self.answers)

    def to_dict(self, *, answers: bool = False) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`; with every answer if wanted."""
        row = {"map": self.source, **self.score.to_dict(), "outside": list(self.outside)}
        del row["exact"]  # there is no grid but the map's own
        if answers:
            row["answers"] = [
                {
                    "id": told.id,
                    "status": answer.status,
                    "probability": answer.probability,
                    "distance_m": [round(float(d), 2) for d in answer.distance],
                    "own_cell": list(answer.own_cell or ()),
                    "seconds": round(answer.seconds, 5),
                }
                for told, answer in zip(self.told, self.answers, strict=True)
            ]
        return row

    def table(self) -> str:
        """Markdown, and a sentence about what lies outside the map."""
        s = self.score
        header = ["", *(f"{r:.0f} m @1/3/5" for r in RADII), "own cell @1/3/5", "median"]
        header += ["calibration error", "OK", "OK right", "p50"]
        bins = s.calibration
        row = [f"{s.queries:,} descriptions"]
        row += [shares(s.within[r][k] for k in RANKS) for r in RADII]
        row += [shares(s.own_cell.get(k) for k in RANKS), number(s.median, 0, "m")]
        row += [f"{share(bins.error)} (perfect {share(bins.floor)})" if bins else "–"]
        row += [share(s.status.get("OK", 0.0)), share(s.right.get("OK"))]
        row += [number(1e3 * s.p50, 1, "ms")]
        lines = [markdown(header, [row])]
        if self.outside:
            shown = ", ".join(self.outside[:5]) + (" ..." if len(self.outside) > 5 else "")
            lines.append(f"Outside of {self.source}: {len(self.outside):,} ({shown}).")
        return "\n\n".join(lines)


def evaluate_folder(
    folder: str | PathLike[str],
    *,
    matcher: Matcher = "relational",
    progress: Progress | None = None,
) -> OwnPairs:
    """Locate every description of a folder on its map.

    The folder holds ``descriptions.jsonl`` (`read_descriptions`) and the map: one ``*.city``, or
    ``map.osm.pbf`` (or ``.osm``, ``.osm.gz`` ...), which is built elsewhere and thrown away. Only the
    text, and ``heading_deg`` and
    ``near`` where they are given, reach the map. `matcher` is that of `CityMap.locate`.

    Raises `OptionError`: there is no such matcher; `InputError`: A file is missing, there are
    several maps, or a line is wrong; `MapError`: the map is no sound city map.
    """
    folder, steps = Path(folder), progress or (lambda _step, _n: None)
    told = read_descriptions(folder / TEXTS)
    city = _map(folder, steps)
    _ask(city, told[0], matcher)  # the first answer also derives what is searched
    answers = []
    for n, one in enumerate(told):
        steps("locating", n)
        answers.append(_ask(city, one, matcher))
    outside = tuple(t.id for t in told if not _covered(city, t))
    return OwnPairs(city.source, told, tuple(answers), outside)


def _map(folder: Path, steps: Progress) -> CityMap:
    from placegraph.outdoor.city import CityMap, build_city

    maps = sorted(folder.glob("*.city"))
    if len(maps) > 1:
        raise InputError(
            f"{folder} holds several maps, {maps[0].name} and {maps[1].name}; keep one."
        )
    if maps:
        return CityMap.open(maps[0])
    extract = next((folder / name for name in MAPS if (folder / name).exists()), None)
    if extract is None:
        raise InputError(
            f"{folder} holds no map; put map.osm.pbf there, or a map made by `placegraph city build`."
        )
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "map.city"
        build_city(extract, path, progress=steps)
        return CityMap.open(path)


def _ask(city: CityMap, told: Told, matcher: Matcher) -> Answer:
    """Give a text to the map; one that cannot be read at all has no place."""
    start = time.perf_counter()
    try:
        estimate = city.locate(
            told.text, top=max(RANKS), heading=told.heading, near=told.near, matcher=matcher
        )
    except DescriptionError:
        return Answer(np.zeros(0), (), (time.perf_counter() - start), "LOST", 0.0, ())
    return measure(
        estimate,
        told.longitude,
        told.latitude,
        seconds=time.perf_counter() - start,
        cell=city.cells.at(told.longitude, told.latitude),
    )


def _covered(city: CityMap, told: Told) -> bool:
    """Whether the place lies in the bounding box of the map's objects."""
    at = city.plane.to_plane((told.longitude, told.latitude))
    low, high = city.objects.points.min(axis=0), city.objects.points.max(axis=0)
    return bool(((low <= at) & (at <= high)).all())
