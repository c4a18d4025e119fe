"""`descriptions.jsonl`: texts of one's own with the places they were said at, one a line."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from math import radians
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.files import check_regular
from placegraph.errors import DescriptionError, InputError
from placegraph.io.osm.osm import SUFFIXES
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.tables.outdoor.metrics import RADII, RANKS, Answer, Score, measure, score
from placegraph_lab.tables.runner import markdown, number, share, shares

if TYPE_CHECKING:
    from placegraph.outdoor.options import Matcher

FIELDS = ("id", "text", "longitude", "latitude", "heading_deg", "near")


@dataclass(frozen=True, slots=True)
class Description:
    """A text, where it was said, and what else was known."""

    id: str
    text: str
    longitude: float
    """Longitude of the speaker [deg]; the truth, for evaluation only."""
    latitude: float
    """Latitude of the speaker [deg]; the truth, for evaluation only."""
    heading: float | None = None
    """Viewing direction of the speaker [rad], clockwise from north."""
    near: tuple[float, ...] | None = None
    """Longitude, latitude [deg] the speaker was known to be near; a third is the radius [m]."""


def read_descriptions(path: str | PathLike[str]) -> tuple[Description, ...]:
    """Read a file of descriptions; blank lines are passed over.

    Every line is a JSON object with ``id`` (text or a whole number, unique), ``text``,
    ``longitude``, ``latitude`` [deg], and perhaps ``heading_deg`` and ``near`` (longitude, latitude
    and perhaps a radius in metres).

    Raises `InputError`: the file is missing, empty or not UTF-8; or a line is no such object: the
    message names line and field.
    """
    path = Path(path)
    try:
        text = check_regular(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        before = error.object[: error.start].count(b"\n")
        raise InputError(
            f"{path}, line {before + 1} is not UTF-8; save the file as UTF-8."
        ) from error
    found: dict[str, Description] = {}
    for row, line in enumerate(text.split("\n"), 1):
        if line.strip():
            told = _Line(path, row).description(line)
            if told.id in found:
                raise InputError(
                    f"{path}, line {row}: the id {told.id!r} is taken; make it unique."
                )
            found[told.id] = told
    if not found:
        raise InputError(
            f'{path} contains no description; write one a line: {{"id": "1", "text": "A bakery is '
            'north of me.", "longitude": 7.42, "latitude": 43.73}.'
        )
    return tuple(found.values())


@dataclass(frozen=True)
class _Line:
    path: Path
    number: int

    def description(self, line: str) -> Description:
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            deep = isinstance(error, RecursionError)
            why = getattr(error, "msg", "nested too deeply" if deep else "a number is too long")
            raise InputError(f"{self.path}, line {self.number} is not JSON: {why}.") from error
        if not isinstance(row, dict):
            raise self.wrong("it is not an object; write {...} with id, text, longitude, latitude")
        for name in FIELDS[:4]:
            if row.get(name) is None:
                raise self.wrong(f"{name} is missing; every line has {', '.join(FIELDS[:4])}")
        if unknown := sorted(row.keys() - set(FIELDS)):
            raise self.wrong(f"there is no field {unknown[0]!r}; fields are {', '.join(FIELDS)}")
        id_, text = row["id"], row["text"]
        if type(id_) not in (str, int) or id_ == "":
            raise self.wrong("id is neither text nor a whole number")
        if not isinstance(text, str) or not text.strip():
            raise self.wrong("text is empty, or no text")
        longitude, latitude = self.place(row["longitude"], row["latitude"], "")
        heading = row.get("heading_deg")
        return Description(
            str(id_),
            text,
            longitude,
            latitude,
            None if heading is None else radians(self.number_in(heading, "heading_deg", 3600.0)),
            self.near(row.get("near")),
        )

    def near(self, value: Any) -> tuple[float, ...] | None:
        if value is None:
            return None
        if not isinstance(value, list) or len(value) not in (2, 3):
            raise self.wrong("near is not [longitude, latitude] or [longitude, latitude, radius]")
        place = self.place(value[0], value[1], "near: ")
        if len(value) == 2:
            return place
        radius = self.number_in(value[2], "near: radius", 1e7)
        if radius < 1.0:
            raise self.wrong("near: radius is less than a metre")
        return (*place, radius)

    def place(self, longitude: object, latitude: object, head: str) -> tuple[float, float]:
        return (
            self.number_in(longitude, f"{head}longitude", 180.0),
            self.number_in(latitude, f"{head}latitude", 90.0),
        )

    def number_in(self, value: object, name: str, most: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong(f"{name} is {str(value)[:40]!r}, not a number")
        if not abs(value) <= most:  # before it is made a float: whole numbers of JSON have no end
            said = (
                f"{value:g}" if abs(value) < 1e9 or isinstance(value, float) else "a whole number"
            )
            raise self.wrong(f"{name} is {said}; it lies between -{most:g} and {most:g}")
        return float(value)

    def wrong(self, how: str) -> InputError:
        return InputError(f"{self.path}, line {self.number}: {how}.")


Progress = Callable[[str, int], None]
TEXTS = "descriptions.jsonl"
MAPS = tuple(f"map{ending}" for ending in SUFFIXES)


@dataclass(frozen=True)
class OwnPairs:
    """Answers to all descriptions of a folder."""

    source: str  # name of the map
    descriptions: tuple[Description, ...]
    answers: tuple[Answer, ...]
    outside: tuple[str, ...]
    """Ids of descriptions whose place the map does not cover: nothing can find them."""

    @property
    def score(self) -> Score:
        return score(self.answers)

    def to_dict(self, *, answers: bool = False) -> dict[str, Any]:
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
                for told, answer in zip(self.descriptions, self.answers, strict=True)
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
            f"{folder} contains no map; put map.osm.pbf there, or a map made by `placegraph city "
            "build`."
        )
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "map.city"
        build_city(extract, path, progress=steps)
        return CityMap.open(path)


def _ask(city: CityMap, description: Description, matcher: Matcher) -> Answer:
    """Give a text to the map; one that cannot be read at all has no place."""
    start = time.perf_counter()
    try:
        estimate = city.locate(
            description.text,
            top=max(RANKS),
            heading=description.heading,
            near=description.near,
            matcher=matcher,
        )
    except DescriptionError:
        return Answer(np.zeros(0), (), (time.perf_counter() - start), "LOST", 0.0, ())
    return measure(
        estimate,
        description.longitude,
        description.latitude,
        seconds=time.perf_counter() - start,
        cell=city.cells.at(description.longitude, description.latitude),
    )


def _covered(city: CityMap, description: Description) -> bool:
    at = city.plane.to_plane((description.longitude, description.latitude))
    low, high = city.objects.points.min(axis=0), city.objects.points.max(axis=0)
    return bool(((low <= at) & (at <= high)).all())
