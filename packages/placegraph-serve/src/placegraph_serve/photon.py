"""Search of names, kinds and sentences, and of what lies at a point, answered as Photon does."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError, RequestError
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.objects import POINT, find_labelled

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph_serve.places import Dispatcher

CLOSE = 80.0
"""Similarity, of 100, from which a misspelt name is found."""
NEAR = 2000.0
"""Distance from the point that was given after which a name counts half, at zoom `ZOOM` [m]."""
ZOOM = 12
BIAS = 0.4
"""Photon's default of `location_bias_scale`, at which distance counts as `NEAR` says."""
STREET = 60.0
"""Largest distance of an address from its street [m]."""
TOUCHES = 100.0
"""Largest gap between the boxes of two ways of one street [m]."""
_MOST = 400
"""Names looked at."""
_TYPES = {"highway": "street", "railway": "street", "waterway": "locality", "natural": "other"}
_PLACES = {"city": "city", "town": "city", "village": "city", "suburb": "district",
           "neighbourhood": "locality", "quarter": "district", "hamlet": "locality"}  # fmt: skip
"""Photon's layers of a place; all else is a house."""
_REACH = {"city": 20_000.0, "district": 3000.0}
"""Largest distance from the point that stands for a place, to lie in it [m]."""
CORNER = 30.0
"""Largest distance of a corner from both of its streets [m]."""
_LANDMARKS = frozenset(("amenity", "building", "historic", "leisure", "office", "shop", "tourism"))
_STOPS = frozenset(f"railway={v}" for v in ("halt", "station", "subway_entrance", "tram_stop"))
"""Keys of what is near a place; people stand in a park or on a square."""
_GROUNDS = frozenset(("place=square", "leisure=park", "leisure=garden"))
LEAST, SUGGESTED = 0.01, 0.05
"""Smallest probability of a place that is given an address; and that a search box is told of."""
FAR = 5.0 * STREET
"""Largest distance of what a place is near where nothing is closer [m]."""


def search(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Answer `requests.Search`: names that begin so or nearly so, kinds, or what a sentence describes."""
    found = [
        (score, city, row)
        for city in _cities(dispatcher)
        for row, score in rows_of(city, request).items()
    ]
    found.sort(key=lambda entry: -entry[0])
    features = [city.feature(row) for _, city, row in found[: request["limit"]]]
    features = features or find_described(dispatcher, request)
    return {"type": "FeatureCollection", "features": features}


def reverse(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Answer `requests.Reverse`: what has a name and lies nearest to a point."""
    found = [
        (away, city, row)
        for city in _cities(dispatcher)
        for row, away in city.find_nearest(request).items()
    ]
    found.sort(key=lambda entry: entry[0])
    features = [city.feature(row) for _, city, row in found[: request["limit"]]]
    return {"type": "FeatureCollection", "features": features}


@dataclass(eq=False)
class Gazetteer:
    """A city's objects as addresses: their streets, districts and towns."""

    city: CityMap
    title: str = ""
    """Name of the map."""

    @cached_property
    def named(self) -> NDArray[np.bool_]:
        """(N,) whether an object has a name."""
        return np.diff(self.city.objects.name_starts) > 0

    @cached_property
    def streets(self) -> NDArray[np.bool_]:
        """(N,) whether an object is a street."""
        objects = self.city.objects
        ways = np.array([label.startswith("highway=") for label in objects.labels])
        return ways[objects.label_values[objects.label_starts[:-1]]] & (objects.kind != POINT)

    @cached_property
    def spoken(self) -> NDArray[np.bool_]:
        """(N,) whether an object has a name that tells people where they are."""
        labels, firsts = self.city.objects.labels, self.city.objects.label_starts[:-1]
        known = [
            label in _GROUNDS | _STOPS or label.partition("=")[0] in _LANDMARKS | {"highway"}
            for label in labels
        ]
        found: NDArray[np.bool_] = np.array(known)[self.city.objects.label_values[firsts]]
        return found & self.named & ~self.city.hidden

    @cached_property
    def towns(self) -> dict[str, NDArray[np.int64]]:
        """Objects with a name of each layer of `_REACH`."""
        labels = {
            layer: frozenset(f"place={v}" for v, own in _PLACES.items() if own == layer)
            for layer in _REACH
        }
        found = {name: find_labelled(self.city.objects, own) for name, own in labels.items()}
        return {name: rows[self.named[rows]] for name, rows in found.items()}

    def measure_distances(
        self, at: Floats, reach: float, mask: NDArray[np.bool_]
    ) -> dict[int, float]:
        """Return distances [m] from a point (2,) to objects of a mask (N,); 0 inside an area.

        Only objects count whose box begins within `reach` [m].
        """
        rows = np.flatnonzero(mask)
        west, south, east, north = self.city.columns.box[rows].T
        close = (west <= at[0] + reach) & (east >= at[0] - reach)
        close &= (south <= at[1] + reach) & (north >= at[1] - reach)
        return {row: self._measure_distance(at, row) for row in rows[close].tolist()}

    def _measure_distance(self, at: Floats, row: int) -> float:
        o, (east, north) = self.city.objects, at.tolist()
        where = o.part_starts, o.point_starts, o.points, o.kind[row], row, east, north
        return float(nearest_on_parts(*where)[2]) ** 0.5

    def find_nearest(self, request: Mapping[str, Any]) -> dict[int, float]:
        """Return the objects with a name nearest to a point, and how far each is [m]."""
        at = self.city.plane.to_plane((request["lon"], request["lat"]))
        low, high = self.city.columns.box[:, :2], self.city.columns.box[:, 2:]
        bound = np.hypot(*np.maximum(np.maximum(low - at, at - high), 0.0).T)
        last, found = 1000.0 * request["radius"], dict[int, float]()
        rows = np.flatnonzero(self.named & self.select(request) & (bound <= last))
        for row in rows[np.argsort(bound[rows], kind="stable")].tolist():
            enough = len(found) >= request["limit"]
            if enough and bound[row] > sorted(found.values())[request["limit"] - 1]:
                break
            found[row] = self._measure_distance(at, row)
        return {row: away for row, away in found.items() if away <= last}

    def select(self, request: Mapping[str, Any]) -> NDArray[np.bool_]:
        """Return whether objects (N,) are of the layers, tags and box of a request."""
        objects = self.city.objects
        fits = np.array([_is_wanted(label, request) for label in objects.labels], np.bool_)
        mask: NDArray[np.bool_] = fits[objects.label_values[objects.label_starts[:-1]]]
        if request.get("bbox") is not None:
            at, box = self.city.plane.to_lonlat(objects.center), request["bbox"]
            mask &= ((at >= box[:2]) & (at <= box[2:])).all(axis=1)
        return mask

    def find_ways(self, row: int) -> list[int]:
        """Return the ways of the street that a way belongs to: of its name, and touching one another."""
        objects = self.city.objects
        same = self.city.name_index.by_words.get(" ".join(tokens(objects.name(row))), ())
        rest = [
            r for r in _objects(self.city, dict.fromkeys(same, 1.0), self.first) if self.streets[r]
        ]
        street, box = [row], self.city.columns.box
        while touching := [
            r for r in rest
            if r not in street
            and (box[r, :2] <= box[street, 2:].max(axis=0) + TOUCHES).all()
            and (box[r, 2:] >= box[street, :2].min(axis=0) - TOUCHES).all()
        ]:  # fmt: skip
            street += touching
        return street

    def without_town(self, words: str) -> str:
        """Return words without the name of the city or of a place in it at their end."""
        names = [self.city.objects.name(row) for rows in self.towns.values() for row in rows]
        ends = (f" {' '.join(tokens(name))}" for name in (self.title, *names))
        return next((words.removesuffix(end) for end in ends if words.endswith(end)), words)

    @property
    def first(self) -> int:
        """Number of the first token that is a name; those before are labels."""
        return len(self.city.objects.labels)

    def feature(self, row: int) -> dict[str, Any]:
        """Return an object as a feature with Photon's properties."""
        objects, plane = self.city.objects, self.city.plane
        key, _, value = objects.label(row).partition("=")
        kind, _, number = objects.osm(row).partition("/")
        properties: dict[str, Any] = {
            "osm_type": kind[0].upper(), "osm_id": int(number), "osm_key": key, "osm_value": value,
            "type": _layer(key, value), "name": objects.name(row),
        }  # fmt: skip
        properties |= self.find_address(row)
        rows = self.find_ways(row) if self.streets[row] and self.named[row] else [row]
        boxes = self.city.columns.box[rows]
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        if (high > low).any():
            (west, south), (east, north) = plane.to_lonlat([low, high]).tolist()
            properties["extent"] = [west, north, east, south]  # Photon's order
        return _feature(plane.to_lonlat(objects.center[row]).tolist(), properties)

    def find_address(self, row: int) -> dict[str, str]:
        """Return street, district and city of an object, as far as the map knows them."""
        objects, address = self.city.objects, {}
        at = objects.center[row].astype(float)
        place = any(row in rows for rows in self.towns.values())
        if not self.streets[row] and not place:
            away = self.measure_distances(at, STREET, self.streets & self.named)
            street = min(away, key=away.__getitem__, default=row)
            if away.get(street, STREET) < STREET:
                address["street"] = objects.name(street)
        return address | {k: objects.name(r) for k, r in self.find_towns(at).items() if r != row}

    def find_towns(self, at: Floats) -> dict[str, int]:
        """Return the district and the city of a point (2,), as far as the map knows them."""
        found = {}
        for layer, rows in self.towns.items():
            off = np.hypot(*(self.city.objects.center[rows] - at).T)
            if len(rows) and off.min() < _REACH[layer]:
                found[layer] = int(rows[off.argmin()])
        return found

    def name_place(self, at: Floats) -> dict[str, str]:
        """Return `address` (ground or street, and nearest landmark) and `town` of a point (2,)."""
        objects = self.city.objects
        for reach, most in ((STREET, None), (FAR, 1)):
            away = self.measure_distances(at, reach, self.spoken)
            near = sorted((r for r in away if away[r] < reach), key=away.__getitem__)[:most]
            if near:
                break
        if not away:  # of another city
            return {}
        streets = {objects.name(r): away[r] for r in reversed(near) if self.streets[r]}
        names = sorted(streets, key=streets.__getitem__)
        where = " and ".join(names[: 1 + (len(names) > 1 and streets[names[1]] < CORNER)])
        where = f"near {where}" if where and streets[names[0]] > STREET else where
        grounds = [r for r in near if objects.label(r) in _GROUNDS and away[r] == 0.0]
        where = objects.name(grounds[0]) if grounds else where
        others = (objects.name(r) for r in near
                  if (objects.label(r).partition("=")[0] in _LANDMARKS or objects.label(r) in _STOPS)
                  and not objects.name(r)[0].isdigit())  # fmt: skip  # a house number
        beside = next((f"near {name}" for name in others if name not in {where, *names}), "")
        town = self.find_towns(at).get("city")
        address = ", ".join(filter(None, (where, beside)))
        return {"address": address} | ({} if town is None else {"town": objects.name(town)})


def _cities(dispatcher: Dispatcher, map_name: str | None = None) -> Iterator[Gazetteer]:
    """Yield the city of a map's name, or else all; `RequestError` where there is none."""
    entry = None if map_name is None else dispatcher.places.entry(map_name)
    entries = (entry,) if entry and entry.kind == "city" else dispatcher.places.entries()
    names = [e.name for e in entries if e.kind == "city"]
    if not names:
        raise RequestError(
            "This server has no city map; start it with one.", status=404, code="map_unknown"
        )
    for name in names:
        city, known = dispatcher.places.city(name), dispatcher.gazetteers.get(name)
        if known is None or known.city is not city:
            known = dispatcher.gazetteers[name] = Gazetteer(city, name)
        yield known


def name_places(dispatcher: Dispatcher, answer: dict[str, Any]) -> dict[str, Any]:
    """Give the likely places outdoors of an answer their `address` and `town`."""
    modes = [
        m for k, m in enumerate(answer["estimate"]["modes"])
        if m.get("latitude") is not None and not m.get("scene")
        and (k == 0 or m["probability"] >= LEAST)
    ]  # fmt: skip
    with suppress(RequestError):  # a world in shards holds no city
        for city, mode in itertools.product(_cities(dispatcher, answer.get("map")), modes):
            at = city.city.plane.to_plane((mode["longitude"], mode["latitude"]))
            mode.update(city.name_place(at))
    return answer


def rows_of(gazetteer: Gazetteer, request: Mapping[str, Any]) -> dict[int, float]:
    """Return objects that a text names, or else is the kind of, and how well."""
    city, text = gazetteer.city, request["q"]
    words = " ".join(tokens(text))
    if not words:
        return {}
    rows = _objects(city, _names(city, words), gazetteer.first)
    while (
        not rows and (rest := gazetteer.without_town(words)) != words
    ):  # "High Street, Hafenstadt"
        words = rest
        rows = _objects(city, _names(city, words), gazetteer.first)
    rows = rows or _objects(city, _labels(city, text), 0)
    mask = gazetteer.select(request)
    scores = {row: fit for row, fit in rows.items() if mask[row]}
    if request["lat"] is not None and request["lon"] is not None:
        at = city.plane.to_plane((request["lon"], request["lat"]))
        reach = NEAR * 2.0 ** (ZOOM - request["zoom"])
        weight = (1.0 - request["location_bias_scale"]) / (1.0 - BIAS)
        for row in scores:
            away = float(np.hypot(*(city.objects.center[row] - at)))
            scores[row] /= (1.0 + away / reach) ** weight
    best: dict[int, float] = {}
    ways: set[int] = set()
    for row in sorted(scores, key=lambda row: -scores[row]):
        if row not in ways:
            best[row] = scores[row]
        if len(best) >= request["limit"]:
            break
        if (
            request["dedupe"]
            and gazetteer.streets[row]
            and gazetteer.named[row]
            and row not in ways
        ):
            ways.update(gazetteer.find_ways(row))
    return best


def _names(city: CityMap, words: str) -> dict[int, float]:
    """Rows of the city's names by how well they fit."""
    from rapidfuzz import fuzz, process

    known = city.name_index.by_words
    last = words.rsplit(maxsplit=1)[-1]
    fits: dict[str, float] = {}
    for name in known:
        if name.startswith(words):
            fits[name] = 1.0 if len(name) == len(words) else 0.9
        elif f" {words}" in name:
            fits[name] = 0.7
    if not fits and len(last) > 2:
        near = process.extract(words, known.keys(), scorer=fuzz.ratio, score_cutoff=CLOSE, limit=20)
        fits = {name: 0.6 * score / 100.0 for name, score, _ in near}
    best = sorted(fits, key=lambda name: (-fits[name], len(name), name))[:_MOST]
    return {row: fits[name] for name in best for row in known[name]}


def _labels(city: CityMap, text: str) -> dict[int, float]:
    """Rows of the city's labels that a word of the vocabulary means: "bakery", "Bäckerei"."""
    from placegraph.outdoor.search.request import parse

    try:
        mentions = [m for m in parse(city, text).mentions if m.senses]
    except PlacegraphError:
        return {}
    if len(mentions) != 1 or len(tokens(text)) > 3:  # a sentence is for `locate`
        return {}
    return {
        row: 0.5 * sense.weight
        for sense in mentions[0].senses
        if sense.weight >= 0.7
        for row in city.label_index.get(sense.label, ())
    }


def _objects(city: CityMap, tokens_of: Mapping[int, float], first: int) -> dict[int, float]:
    """Objects that bear tokens (rows counted from `first`), and the best fit of each."""
    starts, rows = city.token_objects
    found: dict[int, float] = {}
    for token, fit in tokens_of.items():
        for row in rows[starts[first + token] : starts[first + token + 1]].tolist():
            found[row] = max(fit, found.get(row, 0.0))
    return found


def find_described(dispatcher: Dispatcher, request: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the likely places that a sentence describes, in all maps, as features."""
    near = None if None in (request["lat"], request["lon"]) else (request["lon"], request["lat"])
    if request["layer"] or request["osm_tag"] or request["bbox"]:
        return []
    try:
        estimate = dispatcher.places.world().locate(request["q"], near=near, top=request["limit"])
    except PlacegraphError:
        return []
    known = name_places(dispatcher, {"estimate": estimate.to_dict()})["estimate"]
    features = []
    for mode in known["modes"]:
        if (
            mode["longitude"] is None
            or mode["probability"] < SUGGESTED
            or known["status"] == "LOST"
        ):
            continue
        inside = ", ".join(filter(None, (mode["room"], mode["building"])))
        properties = {
            "osm_type": "N", "osm_id": 0, "osm_key": "placegraph", "osm_value": "described",
            "type": "house", "name": inside or mode.get("address") or request["q"],
            "city": mode.get("town", ""), "probability": mode["probability"],
        }  # fmt: skip
        features.append(_feature([mode["longitude"], mode["latitude"]], properties))
    return features


def _layer(key: str, value: str) -> str:
    return _PLACES.get(value, "house") if key == "place" else _TYPES.get(key, "house")


def _is_wanted(label: str, request: Mapping[str, Any]) -> bool:
    """Return whether objects of a label are of the layers and tags of a request."""
    key, _, value = label.partition("=")
    if request["layer"] and _layer(key, value) not in request["layer"]:
        return False
    wanted = {tag for tag in request["osm_tag"] if "!" not in tag}
    excluded = {tag.replace("!", "") for tag in request["osm_tag"]} - wanted
    own = {key, label.replace("=", ":"), f":{value}"}  # as Photon writes tags
    return own.isdisjoint(excluded) and not (wanted and own.isdisjoint(wanted))


def _feature(at: list[float], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": "Point", "coordinates": at}
    known = {name: value for name, value in properties.items() if value != ""}
    return {"type": "Feature", "geometry": geometry, "properties": known}
