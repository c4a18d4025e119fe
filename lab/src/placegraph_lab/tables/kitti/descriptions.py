"""`descriptions.jsonl`: texts of one's own with the places they were said at, one a line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import radians
from os import PathLike
from pathlib import Path
from typing import Any

from placegraph.core.files import regular
from placegraph.errors import InputError

FIELDS = ("id", "text", "longitude", "latitude", "heading_deg", "near")


@dataclass(frozen=True, slots=True)
class Description:
    """A text, where it was said, and what else was known."""

    id: str
    text: str
    longitude: float
    """Where it was said [deg]; the truth, for evaluation only."""
    latitude: float
    """Where it was said [deg]; the truth, for evaluation only."""
    heading: float | None = None
    """Where the speaker looked [rad], clockwise from north."""
    near: tuple[float, ...] | None = None
    """Longitude, latitude [deg] the speaker was known to be near; a third is the radius [m]."""


def read_descriptions(path: str | PathLike[str]) -> tuple[Description, ...]:
    """Read a file of descriptions; blank lines are passed over.

    Every line is a JSON object with ``id`` (text or a whole number, unique), ``text``,
    ``longitude``, ``latitude`` [deg], and perhaps ``heading_deg`` and ``near`` (longitude, latitude
    and perhaps a radius in metres).

    Raises
    ------
    InputError
        The file is missing, empty or not UTF-8; or a line is no such object: the message names line
        and field.

    """
    path = Path(path)
    try:
        text = regular(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        before = error.object[: error.start].count(b"\n")
        raise InputError(
            f"{path}, line {before + 1} is not UTF-8; save the file as UTF-8."
        ) from error
    found: dict[str, Description] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            told = _Line(path, number).told(line)
            if told.id in found:
                raise InputError(
                    f"{path}, line {number}: the id {told.id!r} is taken; make it unique."
                )
            found[told.id] = told
    if not found:
        raise InputError(
            f'{path} holds no description; write one a line: {{"id": "1", "text": "A bakery is north '
            'of me.", "longitude": 7.42, "latitude": 43.73}.'
        )
    return tuple(found.values())


@dataclass(frozen=True)
class _Line:
    path: Path
    number: int

    def told(self, line: str) -> Description:
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            deep = isinstance(error, RecursionError)
            why = getattr(error, "msg", "nested too deeply" if deep else "a number is too long")
            raise InputError(f"{self.path}, line {self.number} is not JSON: {why}.") from error
        if not isinstance(row, dict):
            raise self.wrong("it is no object; write {...} with id, text, longitude, latitude")
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

    def near(self, value: Any) -> tuple[float, ...] | None:  # noqa: ANN401  # as JSON has it
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
