"""From the columns of Overture to tags of OpenStreetMap, by the table `data/overture.tsv`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from importlib.resources import files
from typing import Any

Tags = dict[str, str]

TABLE = "data/overture.tsv"
BASE = frozenset({"infrastructure", "land", "land_use", "water"})
"""Types of the base theme, which bring tags of OpenStreetMap along."""
NO_TAG = "of a class that no tag stands for"
BY_NAME = "known by name alone: no tag stands for their category"
_VARIANTS = {"official": "official_name", "alternate": "alt_name", "short": "short_name"}
_LANGUAGE = re.compile(r"[a-z]{2,3}(-[A-Za-z]+)?")
_NUMBER_FIRST = re.compile(r"(\d+\w?)\s+(\D[^,]*)")
_NUMBER_LAST = re.compile(r"(\D[^,\d]*)\s+(\d+\w?)(?:,|$)")


@lru_cache(maxsize=1)
def table() -> dict[tuple[str, str, str], str]:
    """Tags by type, field and value, as the table writes them; values with a star come last."""
    text = files("placegraph_io.overture").joinpath(TABLE).read_text("utf-8")
    lines = [line.split("\t") for line in text.splitlines() if line and not line.startswith("#")]
    rows = [
        (kind, field, value, tags)
        for kind, field, values, tags in lines[1:]
        for value in values.split()
    ]
    rows.sort(key=lambda row: "*" in row[2])
    return {(kind, field, value): tags for kind, field, value, tags in rows}


@lru_cache(maxsize=1 << 14)
def _looked_up(kind: str, field: str, value: str, of: str = "") -> tuple[tuple[str, str], ...]:
    """Tags of a value, none where the table does not know it."""
    tags, star = table().get((kind, field, value)), ""
    if tags is None:
        for (its_kind, its_field, pattern), its_tags in _stars():
            tail = pattern.removeprefix("*")
            if (its_kind, its_field) == (kind, field) and value.endswith(tail):
                tags, star = its_tags, value.removesuffix(tail)
                break
    filled = (tags or "").replace("{}", value).replace("{*}", star).replace("{class}", of)
    return tuple((key, its) for key, _, its in (tag.partition("=") for tag in filled.split()))


@lru_cache(maxsize=1)
def _stars() -> tuple[tuple[tuple[str, str, str], str], ...]:
    return tuple((row, tags) for row, tags in table().items() if row[2].startswith("*"))


def tags_of(kind: str, row: Mapping[str, Any]) -> tuple[Tags, str]:
    """Tags of a row of a feature type, and what is to be counted of it, if anything.

    No tags: nothing can be told of it. A place of an unknown category keeps its names.
    """
    named = _names(row)
    if kind in BASE:
        tags = {str(k): str(v) for k, v in _pairs(row.get("source_tags"))}
        return (tags | named, "") if tags else ({}, NO_TAG)
    if kind == "place":
        tags = _of_place(row)
        if not tags:
            return named, BY_NAME if "name" in named else NO_TAG
        return tags | named, ""
    tags, known = _of_building(row) if kind == "building" else _of_segment(row)
    return (tags | named, "" if known else NO_TAG) if tags else ({}, NO_TAG)


def _of_place(row: Mapping[str, Any]) -> Tags:
    """Tags of the most specific category that has some, and of other categories beside it."""
    taxonomy, categories = row.get("taxonomy") or {}, row.get("categories") or {}
    ways = (
        [categories.get("primary")],
        [taxonomy.get("primary"), *reversed(taxonomy.get("hierarchy") or ())],
        [row.get("basic_category")],
    )
    tags: Tags = {}
    for value in (value for way in ways for value in way if value):
        if tags := dict(_looked_up("place", "category", str(value))):
            break
    others = [*(categories.get("alternate") or ()), *(taxonomy.get("alternates") or ())]
    for value in others:
        found = dict(_looked_up("place", "category", str(value)))
        if tags.keys().isdisjoint(found):
            tags |= found
    return tags


def _of_building(row: Mapping[str, Any]) -> tuple[Tags, bool]:
    """Tags of a building, which is one whatever it is for; and whether its class is known."""
    given = [(field, str(row[field])) for field in ("subtype", "class") if row.get(field)]
    found = [_looked_up("building", field, value) for field, value in given]
    tags = {"building": "yes"}
    for pairs in found:
        tags |= dict(pairs)
    return tags, all(found)


def _of_segment(row: Mapping[str, Any]) -> tuple[Tags, bool]:
    """Tags of a segment by subtype and class, then by what it is of its class."""
    subtype, its_class = str(row.get("subtype")), str(row.get("class") or "unknown")
    tags = dict(_looked_up("segment", subtype, its_class))
    rules = row.get("subclass_rules") or ()
    subclass = row.get("subclass") or next((r["value"] for r in rules if r.get("value")), None)
    if not tags or subclass is None:
        return tags, bool(tags)
    more = dict(_looked_up("segment", "subclass", str(subclass), its_class))
    return tags | more, bool(more)


def _names(row: Mapping[str, Any]) -> Tags:
    """Names, brand and address, under the keys of OpenStreetMap."""
    names, out = row.get("names") or {}, {}
    if names.get("primary"):
        out["name"] = str(names["primary"])
    for language, name in _pairs(names.get("common")):
        if name and _LANGUAGE.fullmatch(str(language)):
            out[f"name:{language}"] = str(name)
    for rule in names.get("rules") or ():
        key = _VARIANTS.get(str(rule.get("variant")))
        if key and rule.get("value"):
            out[key] = ";".join(filter(None, (out.get(key), str(rule["value"]))))
    brand = ((row.get("brand") or {}).get("names") or {}).get("primary")
    if brand:
        out["brand"] = str(brand)
    addresses = row.get("addresses") or ()
    return out | (_address(str(addresses[0].get("freeform") or "")) if addresses else {})


def _address(freeform: str) -> Tags:
    """House number and street of an address in free form, where it has both."""
    if first := _NUMBER_FIRST.match(freeform):
        number, street = first.groups()
    elif last := _NUMBER_LAST.match(freeform):
        street, number = last.groups()
    else:
        return {}
    return {"addr:housenumber": number, "addr:street": street.strip()}


def _pairs(
    mapping: Mapping[str, Any] | Iterable[tuple[str, Any]] | None,
) -> Iterable[tuple[str, Any]]:
    """Pairs of a map: Arrow hands a list of them out."""
    if mapping is None:
        return ()
    return mapping.items() if isinstance(mapping, dict) else mapping  # type: ignore[return-value]
